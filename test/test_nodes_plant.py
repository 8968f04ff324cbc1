"""The simulated plant in real time, when its process was held up."""

from __future__ import annotations

import time

import pytest
import rclpy
from std_msgs.msg import Float64

from backlash_ros.nodes.plant import PlantNode
from backlash_ros.tools.bringup.processes import free_domain

PERIOD_S = 10.0  # so long that the time that the test takes is nothing
PERIOD_NS = int(PERIOD_S * 1e9)


@pytest.mark.parametrize(('periods_ago', 'applied'), [
    (0.0, [1.0, 1.0, 2.0]), (1.0, [1.0, 2.0, 2.0]), (5.0, [2.0, 2.0, 2.0]),
])
def test_control_acts_from_its_arrival_though_the_plant_was_held_up(
    periods_ago: float, applied: list[float],
) -> None:
    with free_domain() as domain:
        rclpy.init(
            args=['--ros-args', '-p', f'sample_period:={PERIOD_S}'], domain_id=domain,
        )
        try:
            plant = PlantNode()
            used: list[float] = []
            step = plant._plant.step
            plant._plant.step = lambda v: used.append(v) or step(v)
            due_ns = time.monotonic_ns() + PERIOD_NS // 2  # of the third of three samples at once
            plant._on_tick(0, due_ns - 3 * PERIOD_NS)
            for v, ago in ((1.0, 9.0), (2.0, periods_ago)):
                arrived_ns = time.time_ns() - int(ago * PERIOD_NS)
                plant._on_control(Float64(data=v), {'received_timestamp': arrived_ns})
            plant._on_tick(3, due_ns)
            assert used == applied
            plant.destroy_node()
        finally:
            rclpy.shutdown()
