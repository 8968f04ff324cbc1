"""The fit of readings that were rounded, by the intervals that they tell."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from records import Truth, output, resonance, swing

from backlash_ros.core.estimation.fit.learned_error import Learned, as_told, likelier
from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.rounding.rounding import with_rounding
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.plant.state_model import StateModel

STEP = 2e-3  # of the sensor
SAMPLES, SEEDS = 700, 12
TRUTH = Truth()
Z = np.exp(2j * np.pi * 0.005 * np.array([0.7, 1.9, 3.7]))  # where y moves


def triangle(steps: float) -> np.ndarray:
    """One speed, at which y moves by so many steps of the sensor per sample."""
    t = np.arange(SAMPLES) / 140.0
    size = steps * STEP * 140.0 / (4.0 * TRUTH.m)
    return size * (2.0 * np.abs(2.0 * (t - np.floor(t + 0.5))) - 1.0)


def rounded(v: np.ndarray, frequency_hz: float = 5.0, noise_std: float = 0.0) -> np.ndarray:
    return STEP * np.round(output(resonance(frequency_hz), v, TRUTH, noise_std) / STEP)


def by_values(v: np.ndarray, y: np.ndarray, uncertainty: float = 0.2) -> Fitted:
    model = StateModel(resonance())
    around = Around(build_error_model(model, uncertainty), STEP / 12**0.5)
    start = Start(TRUTH.gap, TRUTH.start(v))
    return drained(fitted(v, y, around, start, TRUTH.m, Pace()))


def told() -> Learned:
    error = build_error_model(StateModel(resonance()), 0.2)
    return as_told(error.model, error.count)


def both(v: np.ndarray, y: np.ndarray, uncertainty: float = 0.2) -> tuple[Fitted, Fitted]:
    """The fit by values, and by intervals."""
    values = by_values(v, y, uncertainty)
    return values, drained(with_rounding(v, y, by_values(v, y, uncertainty), Pace()))


@lru_cache
def motions() -> list[tuple[Fitted, Fitted]]:
    return [both(v, rounded(v, 5.0 + 0.05 * seed)) for seed, v in (
        (seed, swing(SAMPLES, seed=seed)) for seed in range(SEEDS)
    )]


def errors(fits: list[Fitted]) -> tuple[float, float]:
    """RMS of the errors of theta, and in their deviations."""
    off = np.array([fit.solution.theta - TRUTH.theta for fit in fits])
    std = np.array([np.sqrt(np.diag(fit.solution.theta_cov)) for fit in fits])
    return float(np.sqrt(np.mean(off**2))), float(np.sqrt(np.mean((off / std) ** 2)))


def test_intervals_tell_more_than_values_and_their_deviations_are_honest() -> None:
    values, intervals = zip(*motions(), strict=True)
    assert all(fit.fit.samples.rounding is not None for fit in intervals)
    as_values, _ = errors(list(values))
    as_intervals, in_deviations = errors(list(intervals))
    assert as_intervals < 0.75 * as_values
    assert 0.4 < in_deviations < 1.6
    for one, other in motions():
        assert other.solution.std_gap < 0.8 * one.solution.std_gap


def test_the_noise_of_the_readings_stays_what_it_is() -> None:
    for values, intervals in motions():
        assert intervals.solution.posterior.noise_std == pytest.approx(
            values.solution.posterior.noise_std, rel=0.05
        )


def test_rounding_that_repeats_is_no_motion_of_its_own() -> None:
    """At one speed the errors of rounding follow each other."""
    v = triangle(50.01)
    values, intervals = both(v, rounded(v), uncertainty=0.0)
    assert values.solution.inflation > 20.0
    assert intervals.solution.inflation < 0.2 * values.solution.inflation
    assert intervals.solution.std_gap < 0.2 * values.solution.std_gap
    off = np.abs(intervals.solution.theta - TRUTH.theta)
    assert (off < 4.0 * np.sqrt(np.diag(intervals.solution.theta_cov))).all()


def test_what_no_backlash_explains_still_widens_the_deviations() -> None:
    v = swing(SAMPLES)
    t = 0.005 * np.arange(SAMPLES)
    moved = STEP * np.round((rounded(v) + 5.0 * STEP * np.sin(2.0 * np.pi * 11.0 * t)) / STEP)
    values, intervals = both(v, moved, uncertainty=0.0)
    assert values.solution.moved_otherwise
    assert intervals.solution.inflation == values.solution.inflation  # no fit of intervals


@pytest.mark.parametrize('noise_std', [0.5 * STEP, 2.0 * STEP])
def test_with_as_much_noise_as_rounding_readings_remain_values(noise_std: float) -> None:
    v = swing(SAMPLES)
    assert both(v, rounded(v, noise_std=noise_std))[1].fit.samples.rounding is None


def test_readings_without_steps_remain_values() -> None:
    v = swing(SAMPLES)
    assert both(v, output(resonance(), v, TRUTH, 1e-3))[1].fit.samples.rounding is None


def test_lost_readings_tell_nothing() -> None:
    v = swing(SAMPLES)
    y = rounded(v)
    y[50:400:3] = np.nan
    values, intervals = both(v, y)
    assert intervals.fit.samples.rounding is not None
    assert intervals.solution.count == np.isfinite(y).sum()
    assert intervals.solution.std_gap < values.solution.std_gap
    assert abs(intervals.solution.gap - TRUTH.gap) < 4.0 * intervals.solution.std_gap


def test_more_samples_are_taken_in_as_intervals_too() -> None:
    v = swing(SAMPLES)
    y = rounded(v)
    half = SAMPLES // 2
    first = drained(with_rounding(v[:half], y[:half], by_values(v[:half], y[:half]), Pace()))
    fit = first.fit
    rows = fit.columns(v[half:], y[half:])
    fit.samples.take_rounded(rows, y[half:], first.solution.posterior)
    solution = fit.solve()
    assert fit.length == SAMPLES
    assert solution.std_gap < first.solution.std_gap
    assert abs(solution.gap - TRUTH.gap) < 4.0 * solution.std_gap


def test_a_reading_far_off_does_not_lead_astray() -> None:
    v = swing(SAMPLES)
    y = rounded(v)
    fit, solution, _ = drained(with_rounding(v, y, by_values(v, y), Pace()))
    more = swing(SAMPLES + 8)[SAMPLES:]
    rows = fit.columns(more, np.zeros(8))
    read = rows @ solution.posterior.mean
    read[3] += 20.0 * STEP
    fit.samples.take_rounded(rows, read, solution.posterior)
    # It counts as one that was read exactly, and so as no more than its weight.
    assert abs(fit.solve().gap - solution.gap) < 25.0 * solution.std_gap


def test_small_pieces_make_the_same_fit() -> None:
    v = swing(SAMPLES)
    y = rounded(v)
    whole = drained(with_rounding(v, y, by_values(v, y), Pace()))
    small = Pace()
    small.size = 400
    pieces = with_rounding(v, y, by_values(v, y), small)
    count = 0
    while True:
        try:
            next(pieces)
            count += 1
        except StopIteration as done:
            in_pieces = done.value
            break
    assert count > 50
    assert in_pieces.solution.theta == pytest.approx(whole.solution.theta, rel=1e-6)


def test_g_of_low_order_is_found_by_intervals_as_well() -> None:
    off = []
    for seed in range(6):
        v = swing(SAMPLES, seed=seed)
        true = resonance(6.0)
        y = rounded(v, 6.0)
        for fit in both(v, y):
            learned = likelier(fit.fit, fit.solution, told())
            response = learned.model.transfer_function.response(Z) / true.response(Z)
            off.append(float(np.abs(response - 1.0).max()))
    values, intervals = np.array(off).reshape(-1, 2).T
    assert np.median(intervals) < 0.7 * np.median(values)


@pytest.mark.parametrize('samples', [80, 120])
def test_what_a_command_that_did_not_act_leaves_is_no_sharper_reading(samples: int) -> None:
    """Few intervals, or such a sample among them, may lead astray: values stay then."""
    for seed in range(60):
        v = swing(samples, seed=seed)
        rng = np.random.default_rng(1000 + seed)
        acted = v.copy()
        acted[rng.integers(10, samples - 5)] += rng.normal(0.0, 0.03)
        values, intervals = both(v, rounded(acted, 5.0 + 0.3 * (seed % 4)))
        assert intervals.solution.rms <= 2.0 * values.solution.rms, seed


def test_g_that_explains_the_readings_as_well_stays() -> None:
    v = swing(SAMPLES)
    y = rounded(v, 6.0)
    fit = both(v, y)[1]
    first = likelier(fit.fit, fit.solution, told())
    assert first.model is not told().model
    assert likelier(fit.fit, fit.solution, first) is first
