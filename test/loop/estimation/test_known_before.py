"""What was learned before the run: what confirms it, what replaces it, and what leaves it alone."""

from dataclasses import replace
from itertools import accumulate, islice

import numpy as np
import pytest
from known_gear import KNOWN, answers, estimator_knowing, learn
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.law import Law
from backlash_ros.core.plant.backlash import clamp

Array = NDArray[np.float64]

NOISE, SAMPLES = 1e-4, 2400  # samples: the record is let go twice
K = np.arange(SAMPLES)
MOTIONS: dict[str, Array] = {
    'multisine': 2.0 * np.sin(0.031 * K) + np.sin(0.083 * K + 1.0) + 0.4 * np.sin(0.17 * K),
    'sine': 3.0 * np.sin(2.0 * np.pi * K / 200.0),
    'triangle': 6.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * K / 200.0)),
}


def run(
    v: Array, known: float = 1.0, late: int = 0, also: Array | float = 0.0,
) -> tuple[Law, Array]:
    """A gear with a gap of 1, and (gap, its deviation, status) of each sample, shape (N, 3).

    known: gap that the estimator begins with. also: what moves y besides.
    """
    estimator = estimator_knowing(replace(KNOWN, c_r=0.5 * known, c_l=-0.5 * known))
    held = accumulate(v.tolist(), lambda p, low: clamp(p, low, low + 1.0), initial=0.5)
    y = answers([p - 0.5 for p in islice(held, 1, None)], late)
    y = y + NOISE * np.random.default_rng(1).standard_normal(len(v)) + also
    rows = []
    for applied, reading in zip(v.tolist(), y.tolist(), strict=True):
        learn(estimator, applied, reading)
        e = estimator.estimate
        rows.append((e.c_r - e.c_l, e.std_c_r + e.std_c_l, e.status))
    return estimator, np.array(rows)


@pytest.mark.parametrize(('known', 'late', 'motion'), [
    (0.6, 2, 'triangle'), (0.85, 0, 'multisine'), (1.0, 0, 'sine'),
])
def test_samples_that_tell_confirm_or_replace_it(known: float, late: int, motion: str) -> None:
    estimator, rows = run(MOTIONS[motion], known, late)
    gap, std, status = rows.T
    assert not estimator.report.unconfirmed
    assert status[-1] == Status.TRACKING
    assert gap[-1] == pytest.approx(1.0, abs=2e-3)
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
