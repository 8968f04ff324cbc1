"""What serves others: the page of live, and the executor of the nodes."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from live_pages import frames
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.node import Node
from ros_processes import wait_until
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from backlash_ros.nodes.live import HOST, PageServer
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.tools.bringup.supervisor import free_domain


@pytest.fixture
def served() -> Iterator[PageServer]:
    server = PageServer(0, shown_s=0.3)
    threading.Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01}).start()
    yield server
    server.shutdown()
    server.server_close()


def test_a_reader_that_takes_nothing_holds_up_nobody(served):
    # More than the kernel takes on the way.
    served.frames.append((1, {'x': 'x' * 20_000_000}, {}))
    with socket.create_connection(served.server_address[:2]) as slow:
        slow.sendall(f'GET /frames HTTP/1.1\r\nHost: {HOST}\r\n\r\n'.encode())
        slow.recv(1, socket.MSG_PEEK)
        for number in range(2, 20):
            served.frames.append((number, {'number': number}, {}))
            assert next(frames(served.address))['state'] == {'number': number}


def test_a_reader_gets_the_newest_points_and_each_of_them_once(served):
    for k in range(5):
        served.frames.append((k + 1, {}, {'c': {'m': [float(k)]}}))
    seen = frames(served.address)
    assert [curves['c']['m'] for curves in next(seen)['curves']] == [[2.0], [3.0], [4.0]]
    served.frames.append((6, {}, {'c': {'m': [5.0]}}))
    assert [curves['c']['m'] for curves in next(seen)['curves']] == [[5.0]]
    assert len(next(frames(served.address))['curves']) == 3


class Loop:
    """A node that talks to itself."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = Node('loop', context=self.context)
        self.executor = PromptExecutor(self.node)
        self.publisher = self.node.create_publisher(Float64, 'number', 10)

    def spin_until(self, condition: Callable[[], object], what: str) -> None:
        wait_until(condition, what, lambda: self.executor.spin_once(timeout_sec=0.02))

    def say(self, *values: float) -> None:
        self.spin_until(self.publisher.get_subscription_count, 'a subscriber')
        for value in values:
            self.publisher.publish(Float64(data=value))

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def loop() -> Iterator[Loop]:
    with free_domain() as domain:
        loop = Loop(domain)
        yield loop
        loop.close()


def test_a_node_is_woken_once_for_what_is_due(loop: Loop) -> None:
    calls: list[str] = []
    loop.executor.due = time.monotonic_ns() + 1e12, lambda: calls.append('too early')
    loop.executor.spin_once(timeout_sec=0.0)
    loop.executor.due = time.monotonic_ns() + 1e7, lambda: calls.append('due')
    loop.spin_until(lambda: calls, 'what is due')
    loop.executor.spin_once(timeout_sec=0.0)
    assert calls == ['due']


def test_a_flood_of_messages_stops_neither_timers_nor_services(loop: Loop) -> None:
    heard: list[float] = []
    ticks: list[int] = []
    def hear_and_say_again(message: Float64) -> None:
        heard.append(message.data)
        loop.publisher.publish(message)  # there is always one that waits
    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response
    loop.node.create_subscription(Float64, 'number', hear_and_say_again, 10)
    loop.node.create_service(Trigger, 'ask', answer)
    client = loop.node.create_client(Trigger, 'ask')
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    loop.node.create_timer(0.01, lambda: ticks.append(len(heard)), clock=steady)
    loop.say(1.0)
    loop.spin_until(lambda: len(ticks) >= 3 and len(heard) >= 3, 'ticks among messages')
    loop.spin_until(client.service_is_ready, 'the service')
    answered = client.call_async(Trigger.Request())
    loop.spin_until(answered.done, 'an answer')
    assert answered.result().success
    assert ticks[-1] > ticks[0]  # the messages went on as well
