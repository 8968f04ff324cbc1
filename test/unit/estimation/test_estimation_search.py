"""The search for the gap, and the fit that goes on from there."""

from __future__ import annotations

from functools import cache
from math import nan, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from records import Truth, output, resonance, swing
from scipy.special import chdtri

from backlash_ros.core.estimation.constants import CANDIDATES, ENGAGED
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted, searched, with_other_gaps
from backlash_ros.core.estimation.fit.search import Found, search
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.estimation.regression.readings import weights_of
from backlash_ros.core.plant.state_model import StateModel

NOISE = 1e-3
MODEL = resonance()

truths = st.builds(
    Truth, m=st.floats(0.2, 5.0), c_r=st.floats(0.2, 1.0), c_l=st.floats(-1.0, -0.2),
    share=st.floats(0.0, 1.0),
)
seeds = st.integers(0, 1000)
uncertainties = st.sampled_from([0.0, 0.2])


@cache
def around(uncertainty: float) -> Around:
    """The exact G, said to be as uncertain as this."""
    model = StateModel(MODEL)
    return Around(build_error_model(model, uncertainty), NOISE)


def found_in(v: np.ndarray, y: np.ndarray, uncertainty: float) -> Found:
    """What the search finds."""
    known = around(uncertainty)
    return drained(search(
        v, y, weights_of(y), known.model, known.error, known.told_std, 100.0, Pace()
    ))


def fit_from(
    v: np.ndarray, y: np.ndarray, truth: Truth, off: float, known: Around,
) -> Fitted:
    """A fit that begins with a gap that is off by a share."""
    gap = truth.gap * (1.0 + off)
    start = Start(gap, float(v[0]) + truth.share * gap)
    return drained(fitted(v, y, known, start, truth.m, Pace()))


@settings(max_examples=15)
@given(truths, seeds, uncertainties)
def test_search_finds_the_gap(truth: Truth, seed: int, uncertainty: float) -> None:
    v = swing(300, seed=seed)
    found = found_in(v, output(MODEL, v, truth, NOISE, seed), uncertainty)
    best = found.candidates[0]
    assert best.evidence > found.null + ENGAGED
    assert min(
        abs(candidate.gap / truth.gap - 1.0) for candidate in found.candidates[:CANDIDATES]
    ) <= 0.05
    # m G [p] is the whole of the motion, so that even a gap that is a little off gives m.
    assert best.m == pytest.approx(truth.m, rel=0.1)


def test_candidates_are_sorted_and_the_null_is_the_evidence_of_a_constant() -> None:
    v = swing(300)
    found = found_in(v, output(MODEL, v, Truth(), NOISE), 0.0)
    evidence = [candidate.evidence for candidate in found.candidates]
    assert evidence == sorted(evidence, reverse=True)
    still = np.random.default_rng(0).standard_normal(300) * NOISE
    nothing = found_in(v, still, 0.0)
    assert nothing.candidates[0].evidence < nothing.null + ENGAGED


@pytest.mark.parametrize('v', [np.zeros(50), np.array([0.0, 1.0, 2.0])], ids=['still', 'short'])
def test_without_motion_or_samples_there_is_no_candidate(v: np.ndarray) -> None:
    assert found_in(v, np.zeros(len(v)), 0.2).candidates == []


def test_no_gap_is_wider_than_allowed() -> None:
    v = swing(300)
    y = output(MODEL, v, Truth(), NOISE)
    known = around(0.0)
    found = drained(search(
        v, y, weights_of(y), known.model, known.error, NOISE, 0.5 * Truth().gap, Pace()
    ))
    assert max(candidate.gap for candidate in found.candidates) <= 0.5 * Truth().gap


@settings(max_examples=15)
@given(truths, seeds, uncertainties, st.floats(-0.03, 0.03))
def test_fit_ends_within_its_deviations_of_the_truth(
    truth: Truth, seed: int, uncertainty: float, off: float,
) -> None:
    v = swing(400, seed=seed)
    result = fit_from(v, output(MODEL, v, truth, NOISE, seed), truth, off, around(uncertainty))
    solution = result.solution
    found = solution.crossings
    assert found is not None
    for value, std, true in (
        (found.m, found.std_m, truth.m), (found.c_r, found.std_c_r, truth.c_r),
        (found.c_l, found.std_c_l, truth.c_l), (solution.gap, found.std_gap, truth.gap),
    ):
        assert abs(value - true) <= 5.5 * std
        assert std <= 0.02 * abs(true)
    first = np.flatnonzero((v > truth.start(v)) | (v + truth.gap < truth.start(v)))
    if len(first) and first[0] > 20:
        assert solution.start == pytest.approx(truth.start(v), abs=0.05 * truth.gap)


@pytest.mark.parametrize('uncertainty', [0.0, 0.2])
def test_deviations_are_honest(uncertainty: float) -> None:
    errors, v = [], swing(400, seed=1)
    for seed in range(20):
        result = fit_from(v, output(MODEL, v, Truth(), NOISE, seed), Truth(), 0.01,
                          around(uncertainty))
        e = result.solution.theta - Truth().theta
        errors.append(float(e @ np.linalg.solve(result.solution.theta_cov, e)))
    freedom = 3 * len(errors)
    assert chdtri(freedom, 1.0 - 1e-3) / freedom <= np.mean(errors) / 3.0
    assert np.mean(errors) / 3.0 <= chdtri(freedom, 1e-3) / freedom


@settings(max_examples=10)
@given(truths, seeds, uncertainties)
def test_state_of_g_comes_with_the_fit(truth: Truth, seed: int, uncertainty: float) -> None:
    v = swing(400, seed=seed)
    exact = output(MODEL, v, truth)
    result = fit_from(v, exact + NOISE * np.random.default_rng(seed).standard_normal(400), truth,
                      0.01, around(uncertainty))
    x, cov = result.fit.state(result.solution)
    model = around(0.0).model
    # Without noise the two newest y and the u between them are the state.
    u_last = truth.m * (_play(v, truth) - truth.c_r)
    to_next = model.c * (model.a @ x + model.b * u_last)[0]
    v_next = np.append(v, v[-1])
    true_next = output(MODEL, v_next, truth)[-1]
    assert abs(model.c * x[0] - exact[-1]) <= 6.0 * model.c * np.sqrt(cov[0, 0])
    row = model.c * model.a[0]
    std_u = np.sqrt(np.diag(result.solution.theta_cov)).sum() * (1.0 + np.abs(v).max())
    theta_part = 6.0 * abs(model.c * model.b[0]) * std_u
    assert abs(to_next - true_next) <= 6.0 * np.sqrt(row @ cov @ row) + theta_part + 1e-9


def _play(v: np.ndarray, truth: Truth) -> float:
    p = truth.start(v)
    for value in v:
        p = min(max(p, value), value + truth.gap)
    return p


def test_lost_samples_and_repeated_readings_are_no_news() -> None:
    v = swing(400)
    y = output(MODEL, v, Truth(), NOISE)
    whole = fit_from(v, y, Truth(), 0.01, around(0.0)).solution
    lossy = y.copy()
    lossy[::3] = nan
    thinned = fit_from(v, lossy, Truth(), 0.01, around(0.0)).solution
    assert thinned.count == pytest.approx(266, abs=1)
    assert whole.count == 400
    coarse = np.round(y / 0.2) * 0.2
    assert fit_from(v, coarse, Truth(), 0.01, around(0.0)).solution.count < 250


def test_what_nothing_explains_widens_the_deviations() -> None:
    v = swing(600)
    y = output(MODEL, v, Truth(), NOISE)
    rng = np.random.default_rng(1)
    walk = 2e-2 * np.cumsum(rng.standard_normal(600))
    honest = fit_from(v, y, Truth(), 0.01, around(0.0))
    disturbed = fit_from(v, y + walk, Truth(), 0.01, around(0.0))
    assert honest.solution.inflation == 1.0
    assert disturbed.solution.inflation > 50.0
    assert disturbed.fit.unexplained(disturbed.solution) > 0.05
    assert honest.fit.unexplained(honest.solution) == 0.0


def test_a_prior_counts_as_much_as_it_is_sure() -> None:
    v = swing(60)
    y = output(MODEL, v, Truth(), 100.0 * NOISE)
    known = around(0.0)._replace(told_std=100.0 * NOISE)
    alone = fit_from(v, y, Truth(), 0.0, known).solution
    prior = Prior(Truth().theta, 1e-8 * np.eye(3))
    helped = fit_from(v, y, Truth(), 0.0, known._replace(prior=prior)).solution
    assert np.abs(helped.theta - Truth().theta).max() <= 5e-4
    assert np.abs(helped.theta - Truth().theta).max() < np.abs(alone.theta - Truth().theta).max()


@settings(max_examples=8)
@given(truths, st.integers(0, 1000), st.sampled_from([0.8, 1.0, 1.2]))
def test_search_and_fit_learn_the_backlash_through_a_wrong_model(
    truth: Truth, seed: int, ratio: float,
) -> None:
    v = swing(500, seed=seed)
    y = output(resonance(5.0 * ratio), v, truth, NOISE, seed)
    result = drained(searched(v, y, around(0.2), 100.0, Pace()))
    assert result is not None
    assert result.solution.gap == pytest.approx(truth.gap, rel=0.02)
    assert result.solution.m == pytest.approx(truth.m, rel=0.02)
    if ratio != 1.0:
        assert result.solution.posterior.scale > 0.1


def test_a_constant_u_is_no_backlash() -> None:
    v = 0.1 * swing(300)
    y = NOISE * np.random.default_rng(0).standard_normal(300)
    assert drained(searched(v, y, around(0.2), 100.0, Pace())) is None


def test_a_first_gap_is_as_well_known_as_it_says() -> None:
    # v moves by half a gap per sample: the likelihood of 40 samples has several maxima.
    judged = wrong = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 7])
        truth = Truth(1.0, rng.uniform(0.3, 1.0), -rng.uniform(0.3, 1.0), rng.uniform())
        v = np.cumsum(rng.standard_normal(40))
        v *= rng.uniform(0.9, 3.0) / np.abs(v).max()
        y = output(MODEL, v, truth, NOISE * 10.0 ** rng.uniform(-1.0, 1.0), seed)
        found = drained(searched(v, y, around(0.0), 10.0, Pace()))
        # As for a first estimate.
        clear = found is not None and found.decided and found.fit.reversals > 0
        crossings = found.solution.crossings if found is not None and clear else None
        if crossings is not None and crossings.std_gap < 0.3 * crossings.gap:
            judged += 1
            wrong += abs(crossings.gap - truth.gap) > 5.0 * crossings.std_gap
    assert judged > 20
    assert wrong <= 1


def test_gap_that_a_prior_leaves_open_is_no_better_known_for_its_labels() -> None:
    v = np.array([0.0, 0.4, 0.8, 0.4, 0.0, 0.4, 0.8])  # never across the gap
    truth = Truth(1.0, 1.0, -1.0, 0.5)
    theta, cov = truth.theta, np.diag([1e-4, 0.01, 0.01])
    known = around(0.0)._replace(prior=Prior(theta, cov))
    y = output(MODEL, v, truth, NOISE)
    fit = fit_from(v, y, truth, 0.0, known)
    open_gap = drained(with_other_gaps(v, y, fit, Prior(theta, cov), Pace())).solution.std_gap
    assert open_gap == pytest.approx(sqrt(0.02), rel=0.3)


def test_few_samples_say_nothing_of_other_gaps() -> None:
    prior = Prior(Truth().theta, np.diag([1e-4, 0.01, 0.01]))
    known = around(0.0)._replace(prior=prior)
    for count in (1, 2, 3, 4, 6):
        v = swing(count)
        fit = fit_from(v, output(MODEL, v, Truth()), Truth(), 0.0, known)
        assert drained(with_other_gaps(v, output(MODEL, v, Truth()), fit, prior, Pace()))
