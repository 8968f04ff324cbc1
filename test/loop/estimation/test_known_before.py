"""What was known before the run: what confirms, replaces, contradicts it, and what leaves it."""

from dataclasses import replace
from itertools import accumulate, islice
from math import pi, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter
from strategies import GEAR

from backlash_ros.core import Estimate, Parameters, Status, build_controller
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.plant.backlash import clamp

PARAMETERS = Parameters({
    **GEAR, 'plant.uncertainty': 0.05, 'estimator.output_noise_std': 1e-4,
    'estimator.initial.m': 1.0, 'estimator.initial.c_r': 0.5, 'estimator.initial.c_l': -0.5,
})
KNOWN = Estimate(1.0, 0.5, -0.5, 0.0, 1e-3, 2e-3, 2e-3)


def estimator_knowing(known: Estimate) -> Law:
    return build_controller(PARAMETERS, known).estimator


def answers(u: list[float], late: int = 0) -> NDArray[np.float64]:
    return np.asarray(lfilter([0.0] * late + GEAR['plant.numerator'], GEAR['plant.denominator'], u))


def learn(estimator: Law, v: float, y: float) -> None:
    estimator.update(y, Interval(v, v, v))
    estimator.refine()


Array = NDArray[np.float64]

NOISE, SAMPLES = 1e-4, 2400  # samples: the record is let go twice
K = np.arange(SAMPLES)
MOTIONS: dict[str, Array] = {
    'multisine': 2.0 * np.sin(0.031 * K) + np.sin(0.083 * K + 1.0) + 0.4 * np.sin(0.17 * K),
    'sine': 3.0 * np.sin(2.0 * np.pi * K / 200.0),
    'triangle': 6.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * K / 200.0)),
}


def run(
    v: Array, known: float = 1.0, late: int = 0, also: Array | float = 0.0, misled: int = -1,
    noise: float = NOISE,
) -> tuple[Law, Array]:
    """A gear with a gap of 1, and (gap, its deviation, status) of each sample, shape (N, 3).

    known: gap that the estimator begins with. also, noise: what moves y besides. misled: sample at
    which a gap of 1.3 is put in the place of what was estimated.
    """
    estimator = estimator_knowing(replace(KNOWN, c_r=0.5 * known, c_l=-0.5 * known))
    held = accumulate(v.tolist(), lambda p, low: clamp(p, low, low + 1.0), initial=0.5)
    y = answers([p - 0.5 for p in islice(held, 1, None)], late)
    y = y + noise * np.random.default_rng(1).standard_normal(len(v)) + also
    rows = []
    for k, (applied, reading) in enumerate(zip(v.tolist(), y.tolist(), strict=True)):
        if k == misled:
            estimator.estimate = replace(estimator.estimate, c_r=0.65, c_l=-0.65)
        learn(estimator, applied, reading)
        e = estimator.estimate
        rows.append((e.c_r - e.c_l, e.std_c_r + e.std_c_l, e.status))
    return estimator, np.array(rows)


@pytest.mark.parametrize(('known', 'late', 'motion', 'noise'), [
    (0.6, 2, 'triangle', NOISE), (0.85, 0, 'multisine', NOISE), (1.0, 0, 'sine', NOISE),
    (0.6, 0, 'multisine', 5.0 * NOISE),  # noisier than what was told
])
def test_samples_that_tell_confirm_or_replace_it(
    known: float, late: int, motion: str, noise: float,
) -> None:
    estimator, rows = run(MOTIONS[motion], known, late, noise=noise)
    gap, std, status = rows.T
    assert not estimator.report.unconfirmed
    assert (status[-1], gap[-1]) == (Status.TRACKING, pytest.approx(1.0, abs=2e-3))
    assert std[-1] < 0.5 * std[0]
    assert not np.any((status == Status.TRACKING) & (np.abs(gap - 1.0) > 0.1))


def test_samples_that_say_little_leave_it_as_it_is() -> None:
    # Coloured noise as large as a tenth of what the gap does: as vague after the record is let go.
    rng = np.random.default_rng(3)
    also = np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        also[k] = 0.98 * also[k - 1] + 0.02 * rng.standard_normal()
    estimator, rows = run(MOTIONS['sine'], also=also)
    gap, std, status = rows[20:].T
    assert np.ptp(gap) < 0.01
    assert std.max() <= 1.01 * std[0]
    assert estimator.report.unconfirmed
    assert not np.any(status == Status.TRACKING)


def test_what_v_does_within_a_gap_that_seems_too_wide_is_recorded_and_contradicts_it() -> None:
    rest = np.full(300, MOTIONS['multisine'][299])
    there_and_back = rest - 0.35 - 0.6 * np.sin(0.3 * K[:300] - 0.623)
    _, rows = run(np.concatenate([MOTIONS['multisine'][:300], rest, there_and_back]), misled=600)
    assert rows[620:, 0] == pytest.approx(1.0, abs=1e-4)
    assert rows[-1, 1] < 2e-5  # with all that was known before the rest


AMPLITUDE, FREQUENCY = 3.0, 2.0 * pi / 200.0  # of v, in gaps, and per sample
ACCELERATION = AMPLITUDE * FREQUENCY**2


def moved_by_a_sine(deceleration: float, late: int = 0, samples: int = 300) -> Law:
    """Move v as a sine. deceleration: of a load in the gap, by friction. late: samples of delay."""
    v = [AMPLITUDE * sin(FREQUENCY * k) for k in range(samples)]
    u, p, speed = [], 0.5, 0.0
    for wall in v:
        on = max(abs(speed) - deceleration, 0.0)
        moved = clamp(p + (on if speed > 0.0 else -on), wall, wall + 1.0)
        p, speed = moved, moved - p
        u.append(p - 0.5)
    estimator = estimator_knowing(KNOWN)
    for applied, y in zip(v, answers(u, late).tolist(), strict=True):
        learn(estimator, applied, y)
    return estimator


def test_a_load_that_coasts_is_named_and_its_crossings_are_in_doubt() -> None:
    estimator = moved_by_a_sine(0.5 * ACCELERATION)
    assert estimator.estimate.status is Status.INCONSISTENT
    assert estimator.report.coasts
    assert estimator.estimate.c_r == pytest.approx(0.5, abs=0.01)
    # By half of the motion that nothing explains, not by a share of the little gap of its own fit.
    assert 0.03 < estimator.estimate.std_c_r < 0.1


def test_friction_that_stops_the_load_is_backlash() -> None:
    estimator = moved_by_a_sine(2.0 * ACCELERATION)
    assert not estimator.report.coasts
    assert estimator.estimate.status is not Status.INCONSISTENT
    assert estimator.estimate.std_c_r < 0.01


def test_a_lag_that_nobody_told_of_is_no_load_that_coasts() -> None:
    estimator = moved_by_a_sine(2.0 * ACCELERATION, late=8)
    assert not estimator.report.coasts


@pytest.mark.parametrize('share', [0.03, 0.4])
def test_what_no_backlash_explains_contradicts_it_only_if_it_is_large(share: float) -> None:
    """share: of the gap by which y moves besides, as by friction, in the second half."""
    besides = share * np.sin(0.0137 * K) * (K > SAMPLES // 2)
    estimator, rows = run(MOTIONS['multisine'][:1700], also=besides[:1700])
    gap, _, states = rows[1250:].T
    assert gap == pytest.approx(1.0, abs=0.02)
    small = share < 0.1
    assert set(states.tolist()) == {Status.ACQUIRING if small else Status.INCONSISTENT}
    assert estimator.report.unconfirmed == small
    # In the end newer samples alone are searched, and a walk of u is found to explain them.
    _, rows = run(MOTIONS['multisine'], also=besides)
    assert (Status.INCONSISTENT in rows[1250:, 2]) != small
