"""A node of a measurement, in a domain of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

# Before rclpy reads it.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from backlash_ros.middleware.loopback import prefer_loopback
from backlash_ros.nodes.runtime.executor import PromptExecutor


class MeasuringNode:
    """Node and executor of whoever takes the place of the driver, or listens."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        prefer_loopback(os.environ)
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self.node = Node('driver', context=self._context)
        # The executor of rclpy would begin to wait after the answer has come: the times would
        # be those of the driver.
        self.executor = PromptExecutor(self.node)

    def spin(self, seconds: float) -> None:
        """Listen for a moment, so long at most."""
        self.executor.spin_once(timeout_sec=max(seconds, 0.0))

    def wait_for(self, condition: Callable[[], object], longest_s: float) -> bool:
        """Listen until the condition holds; whether it does."""
        deadline = time.monotonic() + longest_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.spin(0.02)
        return True

    def close(self) -> None:
        """Leave the domain."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
