"""A driver whose rate is not that of the model: nobody else is blamed for it."""

from __future__ import annotations

import numpy as np
import pytest

from backlash_ros.core.assembly import build_plant, build_reference
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.diagnosis import findings_of
from backlash_ros.core.loop.figures import LoopFigures, Peer, TopicFigures
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters

LATENCY = 0.1  # of a period, from y to v


@pytest.mark.parametrize('period_s', [0.02, 0.002])
@pytest.mark.parametrize('share', [0.0, 0.03, 0.09])
@pytest.mark.parametrize('numbered', [True, False])
def test_only_the_rate_is_named(period_s: float, share: float, numbered: bool) -> None:
    p = Parameters({'sample_period': period_s, 'estimator.law': 'lms'})
    now_ns = [0]
    loop = ControlLoop(p, lambda v: None, lambda: now_ns[0], None, SampleCounter(period_s))
    plant, reference = build_plant(p), build_reference(p)
    rng = np.random.default_rng(2)
    samples = max(round(2.0 / period_s), 200)
    for k in range(samples):
        stamp_ns = 10**18 + round((k * (1.0 + share) + 0.05 * rng.random()) * period_s * 1e9)
        now_ns[0] = stamp_ns + round(LATENCY * period_s * 1e9)
        loop.take_reference(reference(k * period_s))
        loop.answer(Output(plant.measure(), stamp_ns, stamp_ns, stamp_ns, k + 1, numbered))
        plant.step(loop.v)
    statistics = loop.statistics
    assert (statistics.used, statistics.lost, loop.commands.late) == (samples, 0, 0)
    (found, *_) = findings_of(LoopFigures(
        period_s, control=TopicFigures('control', peers=(Peer('/driver', 'Float64'),)),
        status=loop.estimate.status, used=samples,
        intervals_s=statistics.intervals_s(), period=loop.counter.sender.newest(),
    ))
    rate = f'plant_output comes at {1.0 / (1.0 + share) / period_s:.3f}'[:24]
    assert found.text.startswith(rate) == (share > 0.005)
