"""A driver in a process of its own; its arguments name its faults, or none.

second: another publisher of y. best_effort: both publish so, and below /motor.
"""

import signal
import sys
import time
from threading import Event

import rclpy
from made_up_driver import PERIOD_S, plant_parameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

from backlash_ros.core.assembly import build_plant


class FaultyDriver:
    """Publishes y at absolute deadlines and applies v with the next sample."""

    def __init__(self, faults: list[str]) -> None:
        self.sample = 0
        self.plant = build_plant(plant_parameters())
        self.v = 0.0
        self.node = rclpy.create_node('faulty_driver')
        best_effort = 'best_effort' in faults
        profile = QoSProfile(depth=10, reliability=(
            ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        ))
        topic = '/motor/plant_output' if best_effort else 'plant_output'
        self.output = self.node.create_publisher(Float64, topic, profile)
        if 'second' in faults:
            self.second = self.node.create_publisher(Float64, topic, profile)
        self.node.create_subscription(Float64, 'control', self.on_control, 1)

    def on_control(self, message: Float64) -> None:
        self.v = message.data

    def advance(self) -> None:
        """Go on by one sample period and publish what is due."""
        if self.sample:
            self.plant.step(self.v)
        self.sample += 1
        self.output.publish(Float64(data=self.plant.measure()))

    def run(self, stopping: Event) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        begin = time.monotonic()
        while not stopping.is_set():
            due = begin + self.sample * PERIOD_S
            while (remaining := due - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=remaining)
            executor.spin_once(timeout_sec=0.0)
            self.advance()


if __name__ == '__main__':
    stopping = Event()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    driver = FaultyDriver(sys.argv[1:])
    driver.run(stopping)
    rclpy.try_shutdown()
