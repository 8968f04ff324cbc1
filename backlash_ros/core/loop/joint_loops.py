"""The loops of all joints of an arm: one sampling clock, one message of commands."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from functools import partial

from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.jobs.executor import Executor
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.sample_counter import JointOutputs, SampleCounter
from backlash_ros.core.parameters import Parameters


class JointLoops:
    """Answers a message about all joints with one of commands for all; no loop knows another.

    send: takes v, by joint, to the driver. by_name: the loops, in the order of `joints`; a single
    one may be nameless. reports: see ControlLoop, for the name of a joint.
    """

    def __init__(
        self, p: Parameters, send: Callable[[Mapping[str, float]], None],
        now_ns: Callable[[], int], before: Mapping[str, Estimate],
        counter: SampleCounter, v: Mapping[str, float | None] | None = None,
        reports: Callable[[str], Iterable[tuple[float, int]]] = lambda joint: (),
        executor: Executor | None = None,
    ) -> None:
        self.counter, self._send = counter, send
        self._commands: dict[str, float] = {}  # that wait for the message
        self.by_name = {
            joint: ControlLoop(
                p.of_joint(joint), partial(self._commands.__setitem__, joint), now_ns,
                before[joint], counter, (v or {}).get(joint), partial(reports, joint), executor,
            ) for joint in p.joint_names
        }

    def answer(
        self, outputs: JointOutputs, waiting: Container[str] = (),
    ) -> dict[str, ControlStep]:
        """Send v(k) for y(k) of all joints that there are.

        waiting: joints that are not to be answered. Returns the steps of those that were.
        """
        arrival = self.counter.count(outputs.stamp_ns, outputs.sequence, outputs.numbered)
        steps = {}
        for joint, loop in self.by_name.items():
            if joint in outputs.y and joint not in waiting:
                step = loop.answer(outputs.of(joint), arrival)
                if step is not None:
                    steps[joint] = step
            else:
                loop.skip(arrival)
        self.send()
        return steps

    def take_references(self, y_m: Mapping[str, float]) -> list[str]:
        """Take in references by joint; returns the joints whose is of use."""
        return [joint for joint, value in y_m.items()
                if self.by_name[joint].take_reference(value)]

    def send(self) -> None:
        """Send the commands that the loops have given since the last message, if any."""
        if self._commands:
            self._send(dict(self._commands))
            self._commands.clear()
