"""The controller in the fault campaign: its loop with what the node does around it, without DDS.

What ControllerNode decides by wall clock and messages is decided here by simulated time: when the
driver is silent, when the first command may leave, how a stall is caught up with.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import isfinite

from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.loop.command_history import AWAITED_REPORTS
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.sample_counter import KEPT_OUTPUTS, Output, SampleCounter
from backlash_ros.core.parameters import Parameters
from fault_loop.fault_world import Driver


class Controller:
    """One process after the other, each with a loop. note: hears of every answer."""

    def __init__(
        self, p: Parameters, driver: Driver, inherited: Estimate | None,
        sent: Callable[[float, Limits], None], note: Callable[[ControlStep, bool], None],
    ) -> None:
        self.p = p
        self.driver = driver
        self.sent, self.note = sent, note
        self.stalled_until = 0
        self.active = True
        self._ramp: Iterator[float] = iter(())
        self.restart(inherited, None)

    def restart(self, inherited: Estimate | None, v: float | None) -> None:
        """Another process takes over. v: control.initial, None where it is not set."""
        self._counter = SampleCounter(self.p.sample_period, from_zero=False)
        self._configure(inherited, v)
        self.active = True

    def _configure(self, inherited: Estimate | None, v: float | None) -> None:
        self.loop = ControlLoop(
            self.p, self._send, lambda: self.driver.answered_ns, inherited, self._counter, v
        )
        self.unanswered = 0
        self.heard = self.driver.tick

    def cycle(self, clean_up: bool) -> None:
        """Deactivate, clean up and configure if wanted, and activate."""
        self.deactivate()
        v = self.loop.v if self.loop.knows_v else None
        if clean_up:
            self._configure(None, v)
        else:
            self.loop.renew(self.loop.estimate)
        self.heard, self.active = self.driver.tick, True

    def deactivate(self) -> None:
        """End with what on_stop names."""
        self._ramp = iter(())
        self.active = False
        loop = self.loop
        if loop.last is None or loop.standing_down:
            return
        for v in loop.last_commands(self.p.on_stop):
            loop.send(v)
            if v == loop.zero:
                break

    def take_up(self, p: Parameters) -> None:
        """Use other live parameters."""
        self.p = p
        self.loop.take_up(p)

    def run(self, y_m: float | None) -> None:
        """One sample period. y_m: a reference that has come, None if none has."""
        driver, loop = self.driver, self.loop
        if y_m is not None:
            loop.take_reference(y_m)
        if driver.tick < self.stalled_until:
            return
        for v, stamp_ns in driver.applied:
            loop.take_applied(v, stamp_ns)
        driver.applied.clear()
        outputs = driver.outputs[-KEPT_OUTPUTS:]
        driver.outputs.clear()
        if not self.active:
            return
        for i, output in enumerate(outputs):
            self._answer(output, behind=i + 1 < len(outputs))
        timeout = self.p.timeout.plant_output / self.p.sample_period
        if not loop.silent and 0.0 < timeout < driver.tick - self.heard:
            loop.give_up()
            self._ramp = loop.last_commands(self.p.on_timeout)
        v_next = next(self._ramp, None)
        if v_next is not None:
            loop.send(v_next)

    def _answer(self, output: Output, behind: bool) -> None:
        loop = self.loop
        if isfinite(output.y):
            self.heard = self.driver.tick
        if loop.begins and not loop.standing_down and not self._may_begin(output):
            return
        begins = loop.begins
        core = loop.core
        step = loop.answer(output)
        if step is None:
            return
        self._ramp = iter(())
        self.note(step, begins or loop.core is not core)
        if not behind:
            loop.core.refine()

    def _may_begin(self, output: Output) -> bool:
        if self.loop.learn_v(output.stamp_ns):
            return True
        self.unanswered += 1
        return not self.driver.reports or self.unanswered > AWAITED_REPORTS

    def _send(self, v: float) -> None:
        self.sent(v, self.loop.core.limits)
        self.driver.actuator.v = v
