"""A drive that follows jumps of v at a speed of its own."""

import numpy as np
import pytest
from scipy.signal import lfilter

from backlash_ros.core.identification.identification import identify
from backlash_ros.core.identification.structure_search import Options
from backlash_ros.core.judgement.not_play import rate_limit
from backlash_ros.core.plant.backlash import play
from backlash_ros.tools.identify.outcome import identified_parameters

PERIOD_S, GAP = 0.02, 0.3


def goals(rng: np.random.Generator) -> np.ndarray:
    return np.repeat(rng.uniform(-10.0, 10.0, 60), 50)


def followed(v: np.ndarray, step: float) -> np.ndarray:
    place, out = v[0], []
    for goal in v:
        place = np.clip(goal, place - step, place + step)
        out.append(place)
    return np.array(out)


def measured(moved: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    p = play(moved, GAP, moved[0])
    return np.roll(lfilter([0.4], [1.0, -0.6], p), 1) + rng.normal(0.0, 0.005, len(p))


@pytest.mark.parametrize(('seed', 'speed'), [(1, 15.0), (2, 60.0), (3, 240.0)])
def test_gap_behind_a_drive_of_limited_speed(seed: int, speed: float) -> None:
    rng = np.random.default_rng(seed)
    v = goals(rng)
    y = measured(followed(v, speed * PERIOD_S), rng)
    found = identify(v, y, PERIOD_S, Options(orders=[1], delays=[0, 1]))
    assert found.usable
    assert found.gap == pytest.approx(GAP, abs=0.02 * GAP)
    assert abs(found.gap - GAP) < 4.0 * found.std['gap']
    assert 'per s at most: the fit is to v with this limit' in found.remarks[0]
    # A controller whose v is no faster never meets the limit of the drive.
    assert identified_parameters(found, {}).control.rate_max == pytest.approx(speed, rel=0.01)


@pytest.mark.parametrize('seed', range(3))
def test_drive_that_follows_at_once_has_no_limit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    v = goals(rng)
    assert rate_limit(v, measured(v, rng)) is None
