"""A driver that the controller hears and the reference does not."""

from __future__ import annotations

from itertools import pairwise
from math import asin
from pathlib import Path

import pytest
from ros_processes import ros_world
from std_msgs.msg import Float64

from backlash_ros import topics

PERIOD_S, AMPLITUDE, FREQUENCY, BIAS = 0.01, 2.0, 0.02, 3.0


def test_reference_goes_by_its_own_clock_where_only_the_controller_hears_the_driver(
    tmp_path: Path,
) -> None:
    """To the reference a driver on another topic is as one that it has not discovered."""
    with ros_world(tmp_path) as world:
        probe = world.probe()
        y_m = probe.collect(topics.REFERENCE, Float64)
        commands = probe.collect(topics.CONTROL, Float64)
        period = {'sample_period': PERIOD_S}
        world.start('controller', period)
        reference = world.start(
            'reference', {
                **period, 'wait_for_subscribers': 2,
                'amplitude': AMPLITUDE, 'frequency': FREQUENCY, 'bias': BIAS,
            }, '--ros-args', '-r', f'{topics.PLANT_OUTPUT}:=not_heard',
        )
        world.start('plant', period)
        probe.wait_until(lambda: len({message.data for message in y_m}) > 100, 'y_m that moves')
        probe.wait_until(lambda: len(commands) > 100, 'commands')
        warning = 'plant_output is not heard here, but by the controller'
        assert reference.stderr.count('[WARN]') == reference.stderr.count(warning) == 1
    values = [message.data for message in y_m]
    start = values[0]
    assert start == pytest.approx(BIAS)
    begun = next(k for k, value in enumerate(values) if value != start)
    moving = values[begun:]
    # Where the process was held up a sample is left out, and none comes twice.
    samples = [asin((value - BIAS) / AMPLITUDE) / (FREQUENCY * PERIOD_S) for value in moving]
    assert samples == pytest.approx([round(sample) for sample in samples], abs=1e-6)
    assert all(before < after for before, after in pairwise(samples))
