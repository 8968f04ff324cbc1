"""The controller in the fault campaign, and what it says of a driver with another rate."""

from collections import Counter
from collections.abc import Callable, Mapping
from math import nan

import numpy as np
from fault_loop.fault_world import Actuator, Driver, Sensor

from backlash_ros.core import Estimate, Parameters
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.loop.control_loop import ControlLoop, Phase
from backlash_ros.core.loop.control_loop import Driver as Asked
from backlash_ros.core.loop.diagnosis import Level, Neighbours, figures_of_loop, findings_of
from backlash_ros.core.loop.loop_statistics import Lately
from backlash_ros.core.loop.sample_counter import SampleCounter, kept_outputs
from backlash_ros.core.loop.wall_clock import WallClock


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
        self.restart(inherited, None)

    def restart(self, inherited: Estimate | None, v: float | None) -> None:
        """Another process takes over. v: control.initial, None where it is not set."""
        self._counter = SampleCounter(self.p.sample_period, from_zero=False)
        self._clock = WallClock()
        self._configure(inherited, v)
        self.active = True

    def _configure(self, inherited: Estimate | None, v: float | None) -> None:
        driver = self.driver
        asked = Asked(
            lambda: driver.answered_ns - self._clock.set_ns, may_report=lambda: driver.reports,
            steady_s=lambda: driver.tick * self.p.sample_period,
        )
        self.loop = ControlLoop(self.p, asked, inherited, self._counter, v)

    def cycle(self, clean_up: bool) -> None:
        self.deactivate()
        if clean_up:
            self._configure(None, self.loop.v if self.loop.knows_v else None)
        else:
            self.loop.renew(self.loop.estimate)
            self.loop.heard.y_at = nan
        self.active = True

    def deactivate(self) -> None:
        """End with what on_stop names."""
        self.active = False
        loop = self.loop
        if loop.statistics.used and not loop.standing_down:
            loop.end(self.p.on_stop)
            while self._send_next():
                pass

    def take_up(self, p: Parameters) -> None:
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
            loop.take_applied(v, stamp_ns - self._clock.of_stamps_ns)
        driver.applied.clear()
        outputs = driver.outputs[-kept_outputs(self.p.sample_period):]
        driver.outputs.clear()
        if not self.active:
            return
        for i, o in enumerate(outputs):
            now_ns = driver.answered_ns
            self._clock.look(now_ns, now_ns - driver.offset_ns, o.stamp_ns)
            of_stamps_ns = self._clock.of_stamps_ns
            output = o._replace(
                stamp_ns=o.stamp_ns - of_stamps_ns, sent_ns=o.sent_ns - of_stamps_ns,
                received_ns=o.received_ns - self._clock.set_ns)
            core = loop.core
            begins = loop.phase in (Phase.BEGINS, Phase.SILENT)
            step = loop.answer(output)
            if step is not None:
                self._send(step.v)
                loop.note_answer(step, output)
                self.note(step, begins or loop.core is not core)
                if i + 1 == len(outputs):
                    loop.core.refine()
        if loop.is_overdue:
            loop.give_up()
        self._send_next()

    def _send_next(self) -> bool:
        v = self.loop.next_command()
        if v is not None:
            self._send(v)
            self.loop.note_sent(v)
        return v is not None

    def _send(self, v: float) -> None:
        self.sent(v, self.loop.core.limits)
        self.driver.actuator.v = v


# Who is on the topics is known to a node alone.
OF_TOPICS = ('waiting for output', 'unheard')


def blamed(
    hz: float, slow: float, jitter: float, seconds: float, values: Mapping[str, object],
) -> tuple[list[str], Counter[str]]:
    """Texts that came first, as warning or error, second by second, and how often each kind.

    slow, jitter: as in Driver. The plant goes on in its own time: to a slow driver it is faster.
    """
    p = Parameters({'sample_period': 1.0 / hz, 'truth.scale_frequency': 1.0 + slow, **values})
    rng = np.random.default_rng(1)
    driver = Driver(p, rng, Actuator(), Sensor(rng, 10.0), False, slow=slow, jitter=jitter)
    controller = Controller(p, driver, None, lambda v, limits: None, lambda step, renewed: None)
    lately, texts, kinds = Lately(), [], Counter[str]()
    for k in range(round(seconds * hz)):
        driver.advance()
        controller.run(driver.reference(driver.tick * p.sample_period))
        if k % round(hz) == 0:
            loop = controller.loop
            said = [
                finding for finding in findings_of(figures_of_loop(
                    loop, p, loop.counter.sender.timing(), lately.gained(loop.counted, k / hz),
                    Neighbours(),
                ))
                if finding.level > Level.OK and finding.kind not in OF_TOPICS
            ]
            texts += [finding.text for finding in said[:1]]
            kinds.update(finding.kind for finding in said)
    return texts, kinds
