"""The loops of all joints of an arm: one sampling clock, one message of commands."""

from collections.abc import Callable, Mapping
from functools import partial
from itertools import cycle
from math import isfinite

from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.jobs import Executor
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters


class JointLoops:
    """Answers a message about all joints with one of commands for all; no loop knows another.

    driver: what can be asked about that of a joint. before: estimates to begin with, of joints that
    do not begin with what was known before. by_name: the loops, in the order of `joints`; a
    single one may be nameless. turns: for each sample the loop that may look after fits then, or
    none.
    """

    def __init__(
        self, p: Parameters, send: Callable[[Mapping[str, float]], None],
        driver: Callable[[str], Driver], before: Mapping[str, Estimate],
        counter: SampleCounter, v: Mapping[str, float | None] | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.counter, self._send, self._together = counter, send, p.io.together
        self._commands: dict[str, float] = {}  # that wait for the message
        self.by_name = {
            joint: ControlLoop(
                p.of_joint(joint), partial(self._commands.__setitem__, joint), driver(joint),
                before.get(joint), counter, (v or {}).get(joint), executor,
            ) for joint in p.joint_names
        }
        self.loops = tuple(self.by_name.values())
        # To look after fits at every sample would cost as much as the sample; they take longer.
        pause = max(round(0.05 / p.sample_period / len(self.loops)), 1)  # samples
        self.turns = cycle([turn for loop in self.loops for turn in (loop, *[None] * (pause - 1))])

    def answer(self, outputs: Mapping[str, Output],
               y_m: float | None = None) -> dict[str, ControlStep]:
        """Send v(k) for y(k) of all joints that there are; returns the steps that were made."""
        arrival = self.counter.count(*next(iter(outputs.values())).counted)
        if self._together and any(
            loop.silent and not (joint in outputs and isfinite(outputs[joint].y))
            for joint, loop in self.by_name.items()
        ):
            outputs = {}  # an arm of which one joint is still lost does not begin
        steps = {}
        for joint, loop in self.by_name.items():
            if joint not in outputs:
                loop.skip(arrival)
            elif (step := loop.answer(outputs[joint], arrival, y_m)) is not None:
                steps[joint] = step
        self._send_waiting()
        # What the next commands need not wait for then.
        self.counter.sender.learn()
        for joint in steps:
            self.by_name[joint].core.structure.prepare()
        return steps

    def take_references(self, y_m: Mapping[str, float]) -> None:
        for joint, value in y_m.items():
            self.by_name[joint].take_reference(value)

    def give_up_silent(self) -> bool:
        """Give up drivers that are newly silent, or all joints; returns whether any is."""
        overdue = [loop for loop in self.loops if loop.is_overdue]
        for loop in self.loops if overdue and self._together else overdue:
            loop.give_up()
        return bool(overdue)

    def end(self, action: str) -> list[ControlLoop]:
        """As ControlLoop.end; returns the loops that command."""
        ending = [loop for loop in self.loops if loop.statistics.used and not loop.standing_down]
        for loop in ending:
            loop.end(action)
        return ending

    def send_next(self) -> bool:
        sent = [loop.send_next() for loop in self.loops]
        self._send_waiting()
        return any(sent)

    def _send_waiting(self) -> None:
        if self._commands:
            self._send(dict(self._commands))
            self._commands.clear()
