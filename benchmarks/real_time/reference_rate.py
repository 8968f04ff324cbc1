"""How many messages the reference sends per sample period, beside sound and unsound drivers."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

# Before rclpy reads it.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from reporting import Check
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.middleware.loopback import prefer_loopback
from real_time.node_processes import DEADLINE_S, node_command, processes

PERIOD_S = 0.005
DRIVERS: dict[str, dict[str, object]] = {
    'a driver that keeps time': {},
    'a driver at a quarter of the rate': {'sample_period': 4.0 * PERIOD_S},
    'a driver that loses a third': {'output_loss': 0.33},
}
RATE_HEADER = ('beside', 'messages', 'per period')
MOST, LIMIT = 1.02, 'messages of the reference per period'


def measure_rates(duration_s: float) -> list[tuple[str, int, float]]:
    """Driver, messages of the reference, and messages per sample period."""
    return [
        (what, *_count(plant, duration_s)) for what, plant in DRIVERS.items()
    ]


def rate_checks(rates: Sequence[tuple[str, int, float]]) -> list[Check]:
    """Never more than one message per period, but for where the counting begins and ends."""
    return [
        Check(f'{LIMIT}, {what}', f'<= {MOST:g}', f'{share:.3f}', share <= MOST)
        for what, _, share in rates
    ]


def _count(plant: dict[str, object], duration_s: float) -> tuple[int, float]:
    values = {'sample_period': PERIOD_S}
    commands = {
        'controller': node_command('controller', values),
        'reference': node_command('reference', values),
        'plant': node_command('plant', {**values, **plant}),
    }
    with processes(commands) as (_, domain):
        context = Context()
        prefer_loopback(os.environ)
        rclpy.init(args=[], context=context, domain_id=domain)
        node = Node('counter', context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        heard: dict[str, int] = {topics.REFERENCE: 0, topics.PLANT_OUTPUT: 0}

        def listen(topic: str) -> None:
            def count(message: Float64) -> None:
                heard[topic] += 1

            node.create_subscription(Float64, topic, count, 1000)

        for topic in heard:
            listen(topic)
        try:
            deadline = time.monotonic() + DEADLINE_S
            while not all(heard.values()):
                if time.monotonic() > deadline:
                    raise RuntimeError(f'nothing was heard within {DEADLINE_S:g} s')
                executor.spin_once(timeout_sec=0.1)
            before, begin = heard[topics.REFERENCE], time.monotonic()
            while time.monotonic() < begin + duration_s:
                executor.spin_once(timeout_sec=0.1)
            count, passed = heard[topics.REFERENCE] - before, time.monotonic() - begin
        finally:
            executor.shutdown()
            node.destroy_node()
            rclpy.shutdown(context=context)
    return count, count * PERIOD_S / passed
