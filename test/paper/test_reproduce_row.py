"""The verdict follows only from the ranges."""

import math

from hypothesis import given, strategies as st
from ou_monitor.paper.published import Printed, Row, RowVerdict
import pytest


def row(printed, recomputed, **ranges):
    return Row('Table 0', 'x', '', Printed(printed), recomputed, 'how', 'What it says.', **ranges)


@pytest.mark.parametrize('text, value, half_unit', [
    ('63.0', 63.0, 0.05), ('368', 368.0, 0.5), ('315.6e-3', 0.3156, 5e-5),
    ('7.91e-4', 7.91e-4, 5e-7), ('9.38', 9.38, 0.005), ('~0', 0.0, 0.5), ('5e-05', 5e-5, 5e-6)])
def test_rounding_is_half_a_unit_of_the_last_digit(text, value, half_unit):
    """Zeros at the end count; so does the exponent."""
    printed = Printed(text)
    assert printed.value == pytest.approx(value)
    assert printed.half_unit == pytest.approx(half_unit)
    assert printed.ends == pytest.approx((value - half_unit, value + half_unit), rel=1e-6)


@pytest.mark.parametrize('text', ['abc', '', 'nan', 'inf'])
def test_text_without_a_number_is_refused(text):
    with pytest.raises(ValueError, match=f"'{text}'"):
        Printed(text)


@pytest.mark.parametrize('recomputed, verdict', [
    (63.05, RowVerdict.AGREES), (62.95, RowVerdict.AGREES), (63.06, RowVerdict.DOES_NOT_HOLD),
    (62.94, RowVerdict.DOES_NOT_HOLD)])
def test_arithmetic_must_round_to_the_printed_number(recomputed, verdict):
    """Half a unit is rounded rightly either way."""
    assert row('63.0', recomputed).verdict is verdict


@pytest.mark.parametrize('text, recomputed, verdict', [
    ('> 0', 1e-300, RowVerdict.AGREES), ('> 0', 0.0, RowVerdict.DOES_NOT_HOLD),
    ('> 0', -1.0, RowVerdict.DOES_NOT_HOLD), ('< 1', 0.999, RowVerdict.AGREES),
    ('< 1', 1.0, RowVerdict.DOES_NOT_HOLD)])
def test_a_claim_is_a_bound(text, recomputed, verdict):
    assert row(text, recomputed).verdict is verdict


def test_three_standard_errors_reach():
    """2.9 away agrees, 3.1 away does not hold."""
    assert row('10', 10.5 + 2.9, error=1.0).verdict is RowVerdict.AGREES
    assert row('10', 10.5 + 3.1, error=1.0).verdict is RowVerdict.DOES_NOT_HOLD


def test_a_band_replaces_the_error():
    """A narrow band under a wide error decides, and the other way round."""
    assert row('10', 12.0, error=5.0, band=(11.0, 13.0)).verdict is RowVerdict.DOES_NOT_HOLD
    assert row('10', 12.0, error=0.1, band=(10.0, 13.0)).verdict is RowVerdict.AGREES


@pytest.mark.parametrize('name', ['inputs', 'printed_inputs'])
def test_rounding_needs_the_range_of_an_input(name):
    """Apart as they are, together within the range; further apart not even so."""
    near = {'inputs': (10.4, 12.0), 'printed_inputs': (9.0, 11.5)}
    far = {'inputs': (10.6, 12.0), 'printed_inputs': (9.0, 10.9)}
    assert row('10', 11.0).verdict is RowVerdict.DOES_NOT_HOLD
    assert row('10', 11.0, **{name: near[name]}).verdict is RowVerdict.ROUNDING
    assert row('10', 11.0, **{name: far[name]}).verdict is RowVerdict.DOES_NOT_HOLD


@given(st.floats(-1e6, 1e6), st.floats(0.0, 1e3), st.floats(0.0, 1e3), st.floats(0.0, 1e3))
def test_wider_ranges_never_make_it_worse(recomputed, error, below, above):
    order = [RowVerdict.DOES_NOT_HOLD, RowVerdict.ROUNDING, RowVerdict.AGREES]
    plain = order.index(row('100', recomputed).verdict)
    loose = row('100', recomputed, inputs=(recomputed - below, recomputed + above))
    wide = row('100', recomputed, error=error)
    assert order.index(loose.verdict) >= plain and order.index(wide.verdict) >= plain


def test_the_verdict_cannot_be_given():
    with pytest.raises(TypeError):
        row('1', 1.0, verdict=RowVerdict.AGREES)
    with pytest.raises(AttributeError):
        row('1', 1.0).verdict = RowVerdict.AGREES


@pytest.mark.parametrize('recomputed, ranges', [
    (math.nan, {}), (math.inf, {}), (1.0, {'error': math.nan}), (1.0, {'error': -1.0}),
    (1.0, {'band': (2.0, 1.0)}), (1.0, {'inputs': (math.nan, 1.0)})])
def test_rows_without_a_verdict_are_refused(recomputed, ranges):
    """NaN, infinities and ranges upside down."""
    with pytest.raises(ValueError, match='x: '):
        row('1', recomputed, **ranges)
