"""A driver in a process of its own, with the fault named as its argument, or `none`.

At the end it prints by which share of a period the machine held it up at most.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time

import rclpy
from made_up_driver import PERIOD_S, plant_parameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

from backlash_ros.core.assembly import build_plant

RELIABILITY = {'best_effort': ReliabilityPolicy.BEST_EFFORT}


class FaultyDriver:
    """Publishes y at absolute deadlines and applies v with the next sample."""

    def __init__(self, fault: str) -> None:
        self.fault, self.sample = fault, 0
        self.period = PERIOD_S
        self.plant = build_plant(plant_parameters())
        self.held_up = 0.0  # share of a period
        self.commands = [0.0, 0.0, 0.0]  # the newest one last, one per sample
        self.node = rclpy.create_node('faulty_driver')
        profile = QoSProfile(
            depth=10, reliability=RELIABILITY.get(fault, ReliabilityPolicy.RELIABLE)
        )
        topic = '/motor/plant_output' if fault == 'delay' else 'plant_output'
        self.output = self.node.create_publisher(Float64, topic, profile)
        if fault == 'second':
            self.second = self.node.create_publisher(Float64, topic, profile)
        self.node.create_subscription(Float64, 'control', self.on_control, 1)

    def on_control(self, message: Float64) -> None:
        self.commands[-1] = message.data

    def advance(self) -> None:
        """Go on by one sample period and publish what is due."""
        if self.sample:
            self.plant.step(self.commands[0 if self.fault == 'delay' else -1])
        self.commands = [*self.commands[1:], self.commands[-1]]
        y = self.plant.measure()
        self.sample += 1
        self.output.publish(Float64(data=y))

    def run(self) -> None:
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        begin = time.monotonic()
        while True:
            due = begin + self.sample * self.period
            while (remaining := due - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=remaining)
            executor.spin_once(timeout_sec=0.0)
            self.held_up = max(self.held_up, (time.monotonic() - due) / self.period)
            self.advance()


if __name__ == '__main__':
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    driver = FaultyDriver(sys.argv[1])
    with contextlib.suppress(KeyboardInterrupt):
        driver.run()
    print(driver.held_up)
    rclpy.try_shutdown()
