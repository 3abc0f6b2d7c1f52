"""The voltage limit, given for the pack or per cell."""

from ou_monitor.analysis.crafts import pack_limit
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
import pytest


@pytest.mark.parametrize('voltage, cells, limit', [
    (None, None, None), (14.0, None, 14.0), (None, 4, 13.2), (3.5, 4, 14.0), (3.5, 1, 3.5),
    (4.5, None, 4.5)])
def test_with_cells_the_limit_is_volts_per_cell(voltage, cells, limit):
    """Without, of the whole; cells alone have a limit of their own."""
    found = pack_limit(voltage, cells)
    assert found == (None if limit is None else pytest.approx(limit, rel=1e-12))


def test_volts_of_the_pack_beside_cells_are_refused():
    with pytest.raises(InputError, match='no cell has 14 V: write 3.5, or leave --cells out'):
        pack_limit(14.0, 4)


@pytest.mark.parametrize('cells', ['0', '-1', '2.5', 'four', '99'])
def test_an_invalid_number_of_cells_is_one_line(cells, capsys):
    assert main(['analyze', 'x.csv', '--cells', cells]) == 2
    assert f"'{cells}' is not a number of cells, 1 to 28" in capsys.readouterr().err
