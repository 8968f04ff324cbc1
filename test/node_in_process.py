"""A controller node in the test's own process, and a driver in simulated time.

y reaches the node by a call in the place of a message, with stamps of simulated time, and v comes
back likewise: whatever else runs on the machine, every run is the same. Services, parameters and
diagnostics go through ROS. This is the one place that knows how the node is entered.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

# Before rclpy reads it.
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from ros_processes import Probe
from std_srvs.srv import SetBool, Trigger
from waiting import wait_until

from backlash_ros.core import Parameters, build_plant, build_reference
from backlash_ros.core.jobs import Executor
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.sample_counter import Output
from backlash_ros.middleware import prefer_loopback
from backlash_ros.nodes.controller import ControllerNode
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.tools.bringup.supervisor import free_domain

START_NS = 1_800_000_000_000_000_000
NOISE = 1e-3


@contextmanager
def node_with(
    values: dict[str, object], domain: int, *remapped: str,
) -> Iterator[ControllerNode]:
    """A controller node in this process; it begins unconfigured with autostart: False."""
    arguments = ['--ros-args', '--log-level', values.pop('log', 'fatal'), *remapped]
    for name, value in values.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ['-p', f'{name}:={text.replace("inf", ".inf")}']
    # A failure elsewhere ends all processes by a signal, which must end them.
    prefer_loopback(os.environ)
    rclpy.init(args=arguments, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = ControllerNode()
        # Samples come as fast as they are computed: a worker would fall behind them.
        node._executor = Executor()
        try:
            yield node
        finally:
            node.finish()
            Node.destroy_node(node)
    finally:
        rclpy.try_shutdown()


def catch_commands(node: ControllerNode, sent: Callable[[float], None]) -> None:
    io: Any = node._io
    publish = io.publish
    def note(commands: Mapping[str, float]) -> None:
        sent(commands[''])
        publish(commands)
    io.publish = note


def hand_over(node: ControllerNode, y_m: float | None, output: Output | None) -> None:
    untyped: Any = node
    if y_m is not None:
        untyped._on_reference({'': y_m})
    if output is not None:
        untyped._on_output({'': output})


def look_for_silence(node: ControllerNode) -> None:
    untyped: Any = node
    for loop in node.loops.loops:
        loop.heard.y_at = -1e9
    untyped._look_for_silence()


class Bench:
    """The node, the plant of the paper's example with some noise, and what was commanded."""

    def __init__(self, node: ControllerNode, domain: int) -> None:
        self.node: Any = node
        self.probe = Probe(domain)
        self.sent: list[float] = []
        p = Parameters({'output_noise_std': NOISE})
        self.plant, self._reference = build_plant(p), build_reference(p)
        self._executor = PromptExecutor(node)
        self._k = 0
        catch_commands(node, self.sent.append)
        self.node._io.now_ns = lambda: self._now_ns + 1_000_000
        self.v = 0.0

    @property
    def _now_ns(self) -> int:
        return START_NS + 10_000_000 * self._k

    @property
    def loop(self) -> ControlLoop:
        (loop,) = self.node.loops.loops
        return loop

    @property
    def state(self) -> str:
        return str(self.node._state_machine.current_state[1])

    def run(self, samples: int) -> None:
        for _ in range(samples):
            self.plant.step(self.sent[-1] if self.sent else self.v)
            self._k += 1
            # Times of arrival, which would be of another clock, are left out.
            hand_over(
                self.node, self._reference(0.01 * self._k),
                Output(self.plant.measure(), self._now_ns, 0, 0, self._k))
            for loop in self.node.loops.loops:
                loop.core.refine()  # however long it takes

    def serve(self) -> None:
        self._executor.spin_once(timeout_sec=0.005)
        self.probe.spin(0.005)

    def wait_until(self, condition: Callable[[], object], what: str) -> None:
        wait_until(condition, what, self.serve)

    def ask(self, service: str, kind: type[Any], request: Any) -> Any:
        client = self.probe.node.create_client(kind, f'/controller/{service}')
        self.wait_until(client.service_is_ready, service)
        answer = client.call_async(request)
        self.wait_until(answer.done, f'an answer of {service}')
        return answer.result()

    def change(self, *transitions: int) -> bool:
        return all(
            self.ask('change_state', ChangeState, ChangeState.Request(transition=Transition(id=t)))
            .success for t in transitions)

    def set_bool(self, service: str, value: bool) -> bool:
        return bool(self.ask(service, SetBool, SetBool.Request(data=value)).success)

    def trigger(self, service: str) -> Any:
        return self.ask(service, Trigger, Trigger.Request())

    def set_parameters(self, **values: object) -> Any:
        """What the node says to new values, of which none or all are taken; __ stands for a dot."""
        return self.node.set_parameters_atomically([
            Parameter(name.replace('__', '.'), value=value) for name, value in values.items()])


@contextmanager
def bench(active: bool = True, **values: object) -> Iterator[Bench]:
    """A node with these parameters, which knows the noise; active, unless told otherwise."""
    known = {'autostart': False, 'estimator.output_noise_std': NOISE, 'on_rival': 'warn'}
    with free_domain() as domain, node_with({**known, **values}, domain) as node:
        made = Bench(node, domain)
        try:
            if active:
                made.node.trigger_configure()
                made.node.trigger_activate()
            yield made
        finally:
            made._executor.shutdown()
            made.probe.close()
