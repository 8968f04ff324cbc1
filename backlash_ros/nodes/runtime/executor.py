"""An executor for nodes with up to a thousand messages per second.

All uses of internals of rclpy, in its version for ROS 2 Jazzy, are in this file.
"""

import time
from collections.abc import Callable
from math import inf
from typing import Any, cast

from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer

WITH_INFO = Subscription.CallbackType.WithMessageInfo
Due = tuple[float, Callable[[], object]]  # when [ns, monotonic clock], and what is to be done
NOTHING_DUE: Due = inf, bool


class Polled(MutuallyExclusiveCallbackGroup):
    """Group of subscriptions whose messages wait for serve_polled, at a tenth of the cost."""


def serve_polled(subscription: Subscription) -> None:
    """Call the callback of a polled subscription with each waiting message, oldest first."""
    server_of(subscription)()


def server_of(subscription: Subscription) -> Callable[[], None]:
    """Return the function that serves this polled subscription."""
    # After a pause, to look up an attribute of rclpy costs microseconds: all are looked up now.
    take, callback, raw = subscription.handle.take_message, subscription.callback, subscription.raw
    message_type, depth = subscription.msg_type, subscription.qos_profile.depth

    def serve() -> None:
        for _ in range(depth):  # at most as many as the queue holds
            if (taken := take(message_type, raw)) is None:
                return
            callback(*taken)

    return serve


def refuse_unfit_transitions(node: Node) -> None:
    """Refuse a lifecycle transition that the present state does not have, instead of crashing."""
    service = next(s for s in node.services if s.srv_type is ChangeState)
    change = cast(Callable[..., Any], service.callback)

    def checked(request: ChangeState.Request, response: ChangeState.Response) -> Any:
        try:
            return change(request, response)
        except RuntimeError as error:  # RCLError has no public name
            node.get_logger().warning(f'no such transition now: {" ".join(str(error).split())}')
            response.success = False
            return response

    service.callback = checked


class PromptExecutor(SingleThreadedExecutor):
    """Serves the subscriptions of one node first, then all else; it expects no cancelled timers.

    The executor of rclpy builds a wait set of all entities for each message, which takes longer
    than to answer it. This one keeps a wait set of subscriptions, calls timers when they are due,
    and leaves the rest to rclpy five times a second. It wakes up as often, for signals.
    due: what to wake up for once.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self.add_node(node)
        self._node = node
        self._subscriptions: list[Subscription] = []  # of the wait set, and the polled ones
        # For each subscription, all that is needed from the arrival of a message to its callback:
        # after a pause, to look up an attribute of rclpy costs microseconds.
        self._served: list[tuple[Any, ...]] = []
        self._wait_set: Any = None
        self._look_at_ns = self._rclpy_at_ns = 0  # when timers are due, and all else
        self.due = NOTHING_DUE

    def can_execute(self, entity: Any) -> bool:
        return not isinstance(entity, (Subscription, Timer)) and bool(super().can_execute(entity))

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        self._wait_set = None
        return bool(super().shutdown(timeout_sec))

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Serve one message of each topic and whatever is due, after waiting until that at most."""
        wait_ns = int(min(self._look_at_ns, self.due[0])) - time.monotonic_ns()
        if timeout_sec is not None:
            wait_ns = min(wait_ns, int(timeout_sec * 1e9))
        if self.serve_urgent(max(wait_ns, 0)):
            # What is soon due is done now: later it might delay the next message, which mostly
            # comes within 12 ms.
            self.look_if_due(ahead_ns=12_000_000)
            return
        if time.monotonic_ns() >= self.due[0]:
            (_, act), self.due = self.due, NOTHING_DUE
            act()
        self.look_if_due()

    def serve_urgent(self, wait_ns: int) -> bool:
        """Wait wait_ns at most and serve one message of each topic; returns whether any came."""
        subscriptions = list(self._node.subscriptions)
        if subscriptions != self._subscriptions or self._wait_set is None:
            self._subscriptions = subscriptions
            self._served = [(
                each.handle, each.handle.pointer, each.handle.take_message, each.msg_type,
                each.raw, each.callback, each._callback_type == WITH_INFO,
            ) for each in subscriptions if not isinstance(each.callback_group, Polled)]
            self._wait_set = rclpy_implementation.WaitSet(
                len(self._served), 0, 0, 0, 0, 0, self._node.context.handle
            )
        if not self._served:
            time.sleep(wait_ns * 1e-9)
            return False
        wait_set = self._wait_set
        wait_set.clear_entities()
        for handle, *_ in self._served:
            wait_set.add_subscription(handle)
        wait_set.wait(wait_ns)
        ready = wait_set.get_ready_entities('subscription')
        for _, pointer, take, message_type, raw, callback, with_info in self._served:
            if pointer in ready and (taken := take(message_type, raw)) is not None:
                callback(*taken) if with_info else callback(taken[0])
        return bool(ready)

    def look_if_due(self, ahead_ns: int = 0) -> None:
        """Serve timers and whatever else is not urgent, if it is due within ahead_ns."""
        look_ns = 200_000_000  # longest wait of services and signals
        now = time.monotonic_ns()
        if now + ahead_ns < self._look_at_ns:
            return
        for timer in list(self._node.timers):
            if timer.time_until_next_call() <= ahead_ns:
                timer.handle.call_timer()
                timer.callback()
                if time.monotonic_ns() > now + 1_000_000:
                    return  # a message may wait, and comes before all else that is due
        if now + ahead_ns >= self._rclpy_at_ns:
            self._rclpy_at_ns = now + (0 if self._serve_rest() else look_ns)
        wait_ns = min((timer.time_until_next_call() for timer in self._node.timers),
                      default=look_ns)
        self._look_at_ns = min(now + max(wait_ns, 0), self._rclpy_at_ns)

    def _serve_rest(self) -> bool:
        while True:
            try:
                handler, _, _ = self.wait_for_ready_callbacks(timeout_sec=0.0)
            except TimeoutException:
                return False
            handler()
            # A coroutine that waits, as a service for the disk, is resumed another time.
            if handler.done():
                handler.result()  # raises what the callback has raised
                return True
