"""An executor for nodes whose messages come up to a thousand times a second."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable
from typing import Any

from rclpy.executors import ShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription

# Services and events may wait so long; timers are looked after when they are due.
LOOK_NS = 20_000_000
S_TO_NS = 1e9


class PromptExecutor(SingleThreadedExecutor):
    """Serves the subscriptions and guard conditions of one node at once, all else now and then.

    The executor of rclpy makes a new wait set of every service, timer and event for each single
    message, which takes longer than to answer it. This one keeps a wait set of its own for what is
    urgent and leaves the rest to rclpy, after the messages: timers when they are due, services
    and events every LOOK_NS.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._served_node = node
        # Whether the callback wants to know time stamp and number as well.
        self._subscriptions: dict[Subscription, bool] = {}
        self._guards: list[GuardCondition] = []
        self._wait_set: Any = None
        self._look_at_ns = 0
        self.add_node(node)

    def can_execute(self, entity: Any) -> bool:
        """Whether rclpy is to serve it."""
        return not isinstance(entity, (Subscription, GuardCondition)) \
            and bool(super().can_execute(entity))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Serve one message of each topic and what else is due; may return before the timeout.

        timeout_sec: how long to wait for something to do; None waits until the next look.
        """
        wait_ns = self._look_at_ns - time.monotonic_ns()
        if timeout_sec is not None:
            wait_ns = min(wait_ns, int(timeout_sec * S_TO_NS))
        self._serve_urgent(max(wait_ns, 0))
        if time.monotonic_ns() >= self._look_at_ns:
            self._look()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop serving."""
        self._wait_set = None
        return bool(super().shutdown(timeout_sec))

    def _serve_urgent(self, wait_ns: int) -> None:
        self._prepare()
        wait_set = self._wait_set
        wait_set.clear_entities()
        for subscription in self._subscriptions:
            wait_set.add_subscription(subscription.handle)
        for guard in self._guards:
            wait_set.add_guard_condition(guard.handle)
        wait_set.wait(wait_ns)
        ready = wait_set.get_ready_entities('guard_condition')
        for guard in self._guards:
            if guard.handle.pointer in ready:
                guard.callback()
        ready = wait_set.get_ready_entities('subscription')
        for subscription, with_info in self._subscriptions.items():
            if subscription.handle.pointer in ready:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if taken is not None:
                    subscription.callback(*(taken if with_info else taken[:1]))

    def _prepare(self) -> None:
        """Make a wait set for what the node has now."""
        subscriptions = list(self._served_node.subscriptions)
        guards = list(self._served_node.guards)
        if subscriptions == list(self._subscriptions) and guards == self._guards:
            return
        self._subscriptions = {each: _wants_info(each.callback) for each in subscriptions}
        self._guards = guards
        self._wait_set = rclpy_implementation.WaitSet(
            len(subscriptions), len(guards), 0, 0, 0, 0, self._served_node.context.handle
        )

    def _look(self) -> None:
        """Let rclpy serve one thing that is ready, and say when to look again."""
        now = time.monotonic_ns()
        try:
            handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
        except (ShutdownException, TimeoutException):
            due = [timer.time_until_next_call() for timer in self._served_node.timers]
            self._look_at_ns = now + max(min([LOOK_NS, *(ns for ns in due if ns is not None)]), 0)
            return
        handler()
        handler.result()  # raises what the callback has raised
        self._look_at_ns = now  # there may be more


def _wants_info(callback: Callable[..., None]) -> bool:
    """As rclpy decides it: whoever can do with the message alone gets no more."""
    try:
        inspect.signature(callback).bind(object())
    except TypeError:
        return True
    return False
