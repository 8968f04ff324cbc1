"""The period of a driver, whatever is lost or comes twice."""

from collections.abc import Iterable
from math import isnan

import numpy as np
import pytest

from backlash_ros.core.loop.driver_period import DriverPeriod


def stamped(ticks: Iterable[float], period_s: float) -> DriverPeriod:
    """What is known of a driver that has sent messages at these times [periods]."""
    sender = DriverPeriod(period_s)
    for tick in ticks:
        sender.follow(1_800_000_000_000_000_000 + round(tick * period_s * 1e9))
    return sender


@pytest.mark.parametrize('nominal_s', [0.02, 0.002])
@pytest.mark.parametrize('slow', [-0.05, 0.005, 0.059])
@pytest.mark.parametrize(('lost', 'twice', 'jitter'), [
    (0.0, 0.0, 0.0), (0.0, 0.0, 0.2), (0.1, 0.0, 0.05), (0.0, 0.1, 0.05),
])
def test_the_period_of_a_driver_is_known_to_a_thousandth_after_a_second(
    nominal_s: float, slow: float, lost: float, twice: float, jitter: float,
) -> None:
    rng = np.random.default_rng(5)
    ticks = []
    for k in range(round(1.0 / nominal_s)):
        if rng.random() >= lost:
            ticks.append(k * (1.0 + slow) + jitter * rng.random())
            if rng.random() < twice:
                ticks.append(ticks[-1] + 0.01)
    period = stamped(ticks, nominal_s).newest()
    tolerance = 1e-3 if jitter < 0.2 else 4e-3 * nominal_s / 0.02
    assert abs(period.mean / nominal_s - 1.0 - slow) < max(tolerance, 1e-3)
    assert abs(period.mean / nominal_s - 1.0 - slow) * nominal_s < 3.0 * period.std + 1e-6


@pytest.mark.parametrize('ticks', [[0.5 * k for k in range(100)], [3.0 * k for k in range(100)],
                                   range(20), [0.0] * 100])
def test_no_period_is_told_of_messages_that_are_no_samples(ticks: Iterable[float]) -> None:
    assert isnan(stamped(ticks, 0.01).newest().mean)


def test_of_a_driver_that_is_held_up_all_the_time_no_period_is_told() -> None:
    rng = np.random.default_rng(1)
    ticks = [k + 0.75 * rng.random() for k in range(400) if rng.random() < 0.6]
    assert isnan(stamped(ticks, 0.01).newest().mean)
