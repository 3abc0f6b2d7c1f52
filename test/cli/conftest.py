"""What the tests of the commands share."""

import pytest


@pytest.fixture(autouse=True)
def patient(request, monkeypatch):
    """Let no line of progress come, however slow the machine; but where they are tested."""
    if request.module.__name__ != 'test_progress':
        monkeypatch.setattr('ou_monitor.cli.output._EVERY', float('inf'))
