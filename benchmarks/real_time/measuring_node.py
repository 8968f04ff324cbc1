"""A node of a measurement, in a domain of its own."""

from __future__ import annotations

import os

import rclpy
from rclpy.context import Context
from rclpy.node import Node

from backlash_ros.middleware.loopback import prefer_loopback
from backlash_ros.nodes.runtime.executor import PromptExecutor


class MeasuringNode:
    """Node and executor of whoever takes the place of the driver."""

    def __init__(self, domain: int) -> None:
        self._context = Context()
        prefer_loopback(os.environ)
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = Node('driver', context=self._context)
        # The executor of rclpy would begin to wait after the answer has come: the times would
        # be those of the driver.
        self._executor = PromptExecutor(self._node)

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)
