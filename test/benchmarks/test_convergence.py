"""Convergence of switched systems to their limits, and the rail under an ESC."""

import math
import re

from chains import moments_of_switched, PAPER, THREE
from convergence import averaging_convergence, esc_chain, fit_order, main, SwitchedOU
import numpy as np
from ou_monitor.paper.theory import Generator, PRINTED_FACTOR, switching_intensity
from project import ROOT
import pytest

U0 = np.array([1.0, 0.0, 1.0])


@pytest.mark.parametrize('q, c', [(1.0, 1.0), (1.5, 0.2), (48e3, 138.0)])
def test_telegraph_has_sigma_squared_c_squared_over_q(q, c):
    """The printed formula gives half of it."""
    rail = SwitchedOU(63.0, Generator.telegraph(q, q), np.array([c, -c]))
    assert rail.sigma()**2 == pytest.approx(c**2 / q, rel=1e-12)
    assert rail.sigma(PRINTED_FACTOR)**2 == pytest.approx(c**2 / (2.0 * q), rel=1e-12)


@pytest.mark.parametrize('frequency, duty, phases', [
    (24e3, 0.5, 1), (24e3, 0.3, 4), (48e3, 0.9, 8), (36e3, 0.05, 3)])
def test_esc_noise_is_that_of_the_renewal_theorem(frequency, duty, phases):
    """sigma^2 = swing^2 [(1 - d)^2 Var(on) + d^2 Var(off)] / period."""
    chain, on = esc_chain(frequency, duty, phases)
    assert chain.stationary[on].sum() == pytest.approx(duty, rel=1e-12)
    starts = chain.stationary[-1] * chain.leaving[-1]
    assert starts == pytest.approx(frequency, rel=1e-12)
    period = 1.0 / frequency
    swing = 600.0
    spread = [(share * period) ** 2 / phases for share in (duty, 1.0 - duty)]
    expected = swing**2 * ((1.0 - duty) ** 2 * spread[0] + duty**2 * spread[1]) / period
    rail = SwitchedOU(63.0, chain, swing * on)
    assert rail.sigma()**2 == pytest.approx(expected, rel=1e-9)
    assert rail.level == pytest.approx(swing * duty / 63.0, rel=1e-12)
    assert rail.variance() * 126.0 / rail.sigma()**2 == pytest.approx(1.0, abs=3e-3)


def test_variance_of_the_telegraph_in_closed_form():
    """Var = c^2 / (alpha (alpha + 2q)): a first-order filter of a first-order drive."""
    alpha, q, c = 63.0, 200.0, 7.0
    rail = SwitchedOU(alpha, Generator.telegraph(q, q), np.array([c, -c]))
    assert rail.variance() == pytest.approx(c**2 / (alpha * (alpha + 2.0 * q)), rel=1e-12)


@pytest.mark.parametrize('eps', [1.0, 0.3])
def test_variance_of_the_switched_rail_is_where_its_moments_settle(eps):
    """The resolvent against the equation of the moments, run until it rests."""
    rail = SwitchedOU(2.0, THREE, np.array([1.0, -2.0, 0.5]))
    mean, covariance = moments_of_switched(rail.system(), 30.0, [0.0], eps, 'diffusion')
    assert mean[0] == pytest.approx(rail.level, rel=1e-9)
    assert covariance[0, 0] == pytest.approx(rail.variance(eps), rel=1e-9)


def test_sigma_is_the_intensity_of_the_diffusion_limit():
    """The package's general limit gives the same for this rail."""
    rail = SwitchedOU(2.0, THREE, np.array([1.0, -2.0, 0.5]))
    assert switching_intensity(rail.system(), [0.0])[0, 0] == pytest.approx(
        rail.sigma() ** 2, rel=1e-12)


def test_averaging_has_order_one_half():
    """First part, the order: rms of the largest error over [0, 1] goes as sqrt(eps)."""
    # The fitted slope has a standard error below 0.012 from 1000 paths at four eps over a factor
    # 16; what is beyond sqrt(eps) moves it by less than 0.02 (the exact root mean square at the
    # end shows it). Order 0 or 1 is forty errors away.
    t, eps = np.linspace(0.0, 1.0, 26), np.array([0.08, 0.04, 0.02, 0.005])
    largest, final = averaging_convergence(
        PAPER, t, U0, eps, np.random.default_rng(10), 1000)
    assert largest.order_error < 0.012
    # On the same draws: the largest distance of each path, then the mean square.
    rest = PAPER.simulate(t, U0, np.random.default_rng(10), eps=0.08, paths=1000) \
        - PAPER.averaged().solve(t, U0)
    worst = np.linalg.norm(rest, axis=2).max(axis=1)
    assert largest.error[0] == pytest.approx(math.sqrt(np.mean(worst**2)), rel=1e-12)
    for found in (largest, final):
        assert abs(found.order - 0.5) < 4.0 * found.order_error + 0.02
    limit = PAPER.averaged().solve(t, U0)[-1]
    exact = []
    for value in eps.tolist():
        mean, covariance = moments_of_switched(PAPER, 1.0, U0, value)
        exact.append(math.sqrt(np.trace(covariance) + np.sum((mean - limit) ** 2)))
    assert abs(fit_order(eps, exact).order - 0.5) < 0.02
    # The measured errors are those that the moments say.
    assert (np.abs(final.error - exact) < 4.5 * final.standard_error).all()


def test_fit_of_the_order_is_weighted():
    eps = np.array([0.1, 0.01, 0.001])
    fit = fit_order(eps, 3.0 * eps**0.5 * np.array([1.0, 1.0, 2.0]),
                    [1e-4, 1e-4, 1e3])
    assert fit.order == pytest.approx(0.5, abs=1e-6)


def test_the_command_prints_the_orders(capsys):
    """Averaging of order 1/2, the variance of order 2; the printed factor never gets there."""
    assert main() == 0
    rows = [line.split('|') for line in capsys.readouterr().out.splitlines()
            if line.startswith('| ') and 'eps' not in line]
    orders = {row[1].strip(): float(row[-2].split('±')[0]) for row in rows}
    assert orders['largest over 0.1 s'] == pytest.approx(0.5, abs=0.05)
    assert orders['with the 2'] == pytest.approx(2.0, abs=0.05)
    assert abs(orders['as printed']) < 0.1


def test_the_examples_of_the_document_give_their_output(capsys):
    text = (ROOT / 'doc/theory.md').read_text(encoding='utf-8')
    blocks = re.findall(r'```python\n(.*?)```\s*```text\n(.*?)```', text, flags=re.S)
    assert len(blocks) == 4
    number = r'[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?'
    names: dict[str, object] = {}
    for code, expected in blocks:
        exec(code, names)
        out = capsys.readouterr().out
        assert re.sub(number, '#', out).split() == re.sub(number, '#', expected).split()
        assert [float(n) for n in re.findall(number, out)] == pytest.approx(
            [float(n) for n in re.findall(number, expected)], rel=1e-5)
