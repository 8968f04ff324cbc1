"""What samples that are let go still say, and what a residual hides from a single lag."""

from __future__ import annotations

import numpy as np
import pytest
from records import Truth, output, resonance, swing

from backlash_ros.core.estimation.constants import LAGS
from backlash_ros.core.estimation.fit.arrival import arrival, intersected
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.estimation.regression.residuals import largest_correlation
from backlash_ros.core.plant.state_model import StateModel

NOISE = 1e-3
TRUTH = Truth()
MODEL = StateModel(resonance())
THETA = np.array([TRUTH.m, TRUTH.m * TRUTH.c_r, TRUTH.m * TRUTH.c_l])


def fit_of(prior: Prior | None, size: float = 3.0) -> Fitted:
    """The fit of a record of 400 samples in which G is uncertain."""
    v = swing(400, size)
    y = output(resonance(), v, TRUTH, NOISE)
    around = Around(build_error_model(MODEL, 0.2), NOISE, prior, inherited=True)
    start = Start(TRUTH.gap, float(v[0]) + 0.5 * TRUTH.gap)
    return drained(fitted(v, y, around, start, TRUTH.m, Pace()))


def test_the_same_said_twice_is_not_known_better() -> None:
    prior = Prior(THETA, np.diag([1.0, 4.0, 9.0]))
    both = intersected(prior, prior)
    assert both.theta == pytest.approx(prior.theta)
    assert both.cov == pytest.approx(prior.cov)


def test_what_a_part_does_not_tell_stays_as_well_known_as_it_was() -> None:
    known = Prior(THETA, np.diag([1e-4, 1e-4, 1e-4]))
    blind = Prior(THETA + 1.0, np.diag([1e6, 1e6, 1e6]))
    both = intersected(known, blind)
    assert both.theta == pytest.approx(known.theta, abs=1e-3)
    assert both.cov == pytest.approx(known.cov, rel=0.01)


@pytest.mark.parametrize('seed', range(20))
def test_a_direction_that_is_unknown_leaves_what_is_known_of_the_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    cov = (axes * np.array([1e20, 1e-6, 1e-6])) @ axes.T
    known = Prior(THETA, np.diag([1e-7, 1e-5, 1e-5]))
    both = intersected(known, Prior(THETA + 1.0, 0.5 * (cov + cov.T)))
    assert np.linalg.eigvalsh(both.cov).min() > 0.0
    assert both.theta == pytest.approx(known.theta, abs=1e-2)


def test_unexplained_motion_makes_what_was_known_no_worse() -> None:
    sharp = Prior(THETA, np.diag([1e-3, 1e-3, 1e-3])**2)
    v = swing(400, 3.0)
    y = output(resonance(), v, TRUTH, NOISE) + 0.05 * np.sign(np.sin(0.2 * np.arange(400)))
    around = Around(build_error_model(MODEL, 0.2), NOISE, sharp, inherited=True)
    start = Start(TRUTH.gap, float(v[0]) + 0.5 * TRUTH.gap)
    solution = drained(fitted(v, y, around, start, TRUTH.m, Pace())).solution
    assert solution.inflation > 10.0
    assert np.all(np.sqrt(np.diag(solution.theta_cov)) <= 1.1e-3)


def test_what_contradicts_what_was_known_widens_it() -> None:
    wrong = Prior(1.2 * THETA, np.diag([1e-3, 1e-3, 1e-3])**2)
    part = fit_of(wrong)
    assert part.contested
    assert not fit_of(Prior(THETA, wrong.cov)).contested
    doubted, kept = arrival(part, contested=True), arrival(part, contested=False)
    assert np.trace(doubted.cov) > 10.0 * np.trace(kept.cov)


def test_residual_that_alternates_is_not_taken_for_white() -> None:
    rng = np.random.default_rng(1)
    # A period of four samples: nothing of it is seen in neighbours.
    periodic = np.sin(0.5 * np.pi * np.arange(1000) + 0.3)
    assert float(periodic[1:] @ periodic[:-1]) < 0.01 * float(periodic @ periodic)
    assert largest_correlation(periodic, LAGS) > 0.9
    assert largest_correlation(rng.standard_normal(1000), LAGS) < 0.12
