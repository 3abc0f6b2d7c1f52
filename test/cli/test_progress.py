"""Progress: a bar on a terminal, lines elsewhere, and the time left."""

import io

from ou_monitor.cli.output import Progress
import pytest


class Terminal(io.StringIO):
    """A standard error that is a terminal."""

    def isatty(self):
        """Say so."""
        return True


@pytest.fixture
def clock(monkeypatch):
    """Return the time in a list, s; to be set."""
    now = [100.0]
    monkeypatch.setattr('time.monotonic', lambda: now[0])
    return now


def test_short_work_shows_no_progress_off_a_terminal(capsys, clock):
    """Nothing reaches a log file in the first minute, and a line each minute then."""
    with Progress('work') as progress:
        for second in range(360):
            clock[0] = 100.0 + second
            progress(second / 360.0)
            if second == 59:
                assert capsys.readouterr().err == ''
        progress(1.0)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == 'work: 17% done, 5 min left' and len(lines) == 5
    assert lines[-1] == 'work: 83% done, 60 s left'


def test_json_on_standard_output_shows_no_progress(capsys, clock):
    """Beside JSON on standard output nothing is written, however long it takes."""
    with Progress('work', quiet=True) as progress:
        for second in range(360):
            clock[0] = 100.0 + second
            progress(second / 360.0)
    assert capsys.readouterr() == ('', '')


def test_progress_draws_and_wipes_on_a_terminal(monkeypatch):
    """The bar fills to 100 % and is gone at the end, also after an exception."""
    terminal = Terminal()
    monkeypatch.setattr('sys.stderr', terminal)
    with pytest.raises(KeyboardInterrupt):
        with Progress('work') as progress:
            progress(1.0)
            assert 'work [####' in terminal.getvalue() and '100%' in terminal.getvalue()
            raise KeyboardInterrupt
    assert terminal.getvalue().endswith('\r\x1b[K')


@pytest.mark.parametrize('width', [20, 40, 80])
def test_the_bar_fits_and_tells_the_time_left(monkeypatch, clock, width):
    """What an earlier run did took no time of this one: half at the start counts for nothing."""
    import os

    terminal = Terminal()
    monkeypatch.setattr('sys.stderr', terminal)
    monkeypatch.setattr('shutil.get_terminal_size', lambda *_, **__: os.terminal_size((width, 24)))
    with Progress('work') as progress:
        progress(0.5)
        clock[0] += 30.0
        progress(0.75)
        shown = terminal.getvalue().split('\r')[-1].removesuffix('\x1b[K')
    assert shown.endswith('75%, 30 s left') and len(shown) <= width


def test_a_standard_error_that_is_closed_stops_nothing(monkeypatch, clock):
    gone = io.StringIO()
    monkeypatch.setattr('sys.stderr', gone)
    with Progress('work') as progress:
        progress(0.1)
        gone.close()
        clock[0] += 90.0
        progress(0.5)
