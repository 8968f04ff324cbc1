"""An executor for nodes whose messages come up to a thousand times a second.

All that looks inside of rclpy is in this file. It was tried with the versions of KNOWN_RCLPY; with
any other one make_executor takes the executor of rclpy itself, which is several times slower.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

KNOWN_RCLPY = ('7.1.',)  # begin of the versions: those of ROS 2 Jazzy
# Services and events may wait so long.
LOOK_NS = 100_000_000
# What is due so soon after a message is done at once: later it might hold up the next message.
AHEAD_NS = 5_000_000


class Polled(MutuallyExclusiveCallbackGroup):
    """Of subscriptions that no executor serves."""

    def can_execute(self, entity: Any) -> bool:
        """Never: whoever wants a message takes it."""
        return False


class Inbox:
    """The newest messages of a topic, at most `depth`, until somebody looks.

    To take a message costs a tenth of what it costs to be woken up by it.
    """

    def __init__(self, node: Node, message_type: type[Any], topic: str, depth: int) -> None:
        self._type, self._node = message_type, node
        untyped: Any = Polled
        self._subscription = node.create_subscription(
            message_type, topic, lambda _: None, depth, callback_group=untyped()
        )

    @property
    def publishers(self) -> int:
        """How many there are."""
        return int(self._subscription.get_publisher_count())

    def take_all(self) -> Iterator[tuple[Any, dict[str, Any]]]:
        """Message and info (time stamps, number) of all that have arrived, oldest first."""
        while (taken := self._subscription.handle.take_message(self._type, False)) is not None:
            yield taken

    def close(self) -> None:
        """Take no more."""
        self._node.destroy_subscription(self._subscription)


class NodeExecutor(SingleThreadedExecutor):
    """The executor of rclpy for one node, with what a node of this package asks of an executor."""

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._served_node = node
        self.add_node(node)

    def serve_urgent(self, wait_ns: int) -> bool:
        """Serve one message of each topic, and wait for the first one so long at most."""
        self.spin_once(timeout_sec=wait_ns / 1e9)
        for _ in list(self._served_node.subscriptions)[1:]:
            self.spin_once(timeout_sec=0.0)
        return True

    def look_if_due(self) -> None:
        """Serve what is not urgent, if it is time for that."""
        self.spin_once(timeout_sec=0.0)


def make_executor(node: Node, warn: Callable[[str], object]) -> NodeExecutor:
    """The fastest executor that the installed rclpy is known to bear; warn() says if it is slow."""
    try:
        installed = version('rclpy')
    except PackageNotFoundError:
        installed = 'of unknown version'
    if installed.startswith(KNOWN_RCLPY):
        return PromptExecutor(node)
    warn(
        f'rclpy {installed} is not one that the fast executor is known to work with '
        f'({", ".join(f"{known}*" for known in KNOWN_RCLPY)}): messages are served by the executor '
        'of rclpy, which may be too slow for sample periods below 5 ms'
    )
    return NodeExecutor(node)


class _Served(NamedTuple):
    """A subscription with all that is needed between the arrival of a message and its callback.

    After a pause every attribute of rclpy that is looked up there costs microseconds.
    """

    pointer: int
    take: Callable[[Any, bool], tuple[Any, dict[str, Any]] | None]
    message_type: Any
    raw: bool
    callback: Callable[..., None]
    with_info: bool  # whether the callback wants to know time stamp and number as well


class PromptExecutor(NodeExecutor):
    """Serves the subscriptions and guard conditions of one node at once, all else after them.

    The executor of rclpy makes a new wait set of every service, timer and event for each single
    message, which takes longer than to answer it. This one keeps a wait set of its own for what is
    urgent, calls timers when they are due, and every LOOK_NS leaves the rest to rclpy.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._subscriptions: list[Subscription] = []  # without the polled ones
        self._served: list[_Served] = []  # the same
        self._known: list[Subscription] = []  # the polled ones included
        self._guards: list[GuardCondition] = []
        self._wait_set: Any = None
        self._look_at_ns = 0  # after the messages
        self._rclpy_at_ns = 0  # leave the rest to rclpy

    def can_execute(self, entity: Any) -> bool:
        """Whether rclpy is to serve it."""
        return not isinstance(entity, (Subscription, GuardCondition, Timer)) \
            and bool(super().can_execute(entity))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Serve one message of each topic and what else is due; may return before the timeout.

        timeout_sec: how long to wait for something to do; None waits until the next look.
        """
        wait_ns = self._look_at_ns - time.monotonic_ns()
        if timeout_sec is not None:
            wait_ns = min(wait_ns, int(timeout_sec * 1e9))
        self._look(AHEAD_NS if self.serve_urgent(max(wait_ns, 0)) else 0)

    def look_if_due(self) -> None:
        """Serve what is not urgent, if it is time for that."""
        self._look(0)

    def _look(self, ahead_ns: int) -> None:
        """Serve what is not urgent and due within so long."""
        now = time.monotonic_ns()
        if now + ahead_ns < self._look_at_ns:
            return
        self._call_timers(ahead_ns)
        if now + ahead_ns >= self._rclpy_at_ns:
            self._rclpy_at_ns = now + (0 if self._serve_rest() else LOOK_NS)
        due = [timer.time_until_next_call() for timer in self._served_node.timers]
        wait_ns = min((ns for ns in due if ns is not None), default=LOOK_NS)
        self._look_at_ns = min(now + max(wait_ns, 0), self._rclpy_at_ns)

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop serving."""
        self._wait_set = None
        return bool(super().shutdown(timeout_sec))

    def serve_urgent(self, wait_ns: int) -> bool:
        """Serve one message of each topic, and wait for the first one so long at most.

        Returns whether there was any.
        """
        self._prepare()
        wait_set = self._wait_set
        wait_set.clear_entities()
        for subscription in self._subscriptions:
            wait_set.add_subscription(subscription.handle)
        for guard in self._guards:
            wait_set.add_guard_condition(guard.handle)
        wait_set.wait(wait_ns)
        ready = wait_set.get_ready_entities('subscription')
        served = bool(ready)
        for pointer, take, message_type, raw, callback, with_info in self._served:
            if pointer in ready and (taken := take(message_type, raw)) is not None:
                if with_info:
                    callback(*taken)
                else:
                    callback(taken[0])
        ready = wait_set.get_ready_entities('guard_condition')
        for guard in self._guards:
            if guard.handle.pointer in ready:
                guard.callback()
        return served

    def _prepare(self) -> None:
        """Make a wait set for what the node has now."""
        subscriptions = list(self._served_node.subscriptions)
        guards = list(self._served_node.guards)
        if subscriptions == self._known and guards == self._guards:
            return
        self._subscriptions = [
            each for each in subscriptions if not isinstance(each.callback_group, Polled)
        ]
        self._served = [
            _Served(
                each.handle.pointer, each.handle.take_message, each.msg_type, each.raw,
                each.callback, _wants_info(each.callback),
            ) for each in self._subscriptions
        ]
        self._known, self._guards = subscriptions, guards
        self._wait_set = rclpy_implementation.WaitSet(
            len(self._subscriptions), len(guards), 0, 0, 0, 0, self._served_node.context.handle
        )

    def _call_timers(self, ahead_ns: int) -> None:
        for timer in list(self._served_node.timers):
            try:
                due_ns = timer.time_until_next_call()
                if due_ns is None or due_ns > ahead_ns:
                    continue
                timer.handle.call_timer()
            except InvalidHandle:  # the callback of another one has destroyed it
                continue
            timer.callback()

    def _serve_rest(self) -> bool:
        """Let rclpy serve one thing that is ready; return whether there was any."""
        while True:
            try:
                handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
            except (ShutdownException, TimeoutException):
                return False
            handler()
            # What waits for something, as a service for the disk, is looked at again next time.
            if handler.done():
                handler.result()  # raises what the callback has raised
                return True


def _wants_info(callback: Callable[..., None]) -> bool:
    """As rclpy decides it: whoever can do with the message alone gets no more."""
    try:
        inspect.signature(callback).bind(object())
    except TypeError:
        return True
    return False
