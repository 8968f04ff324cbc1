"""Node that learns the backlash and cancels it: plant_output and reference in, control out."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import (
    WORKER_MODULES,
    build_controller,
    first_guess,
    known_before,
    warnings_of,
)
from backlash_ros.core.control.controller import REFINE_SHARE, ControlStep
from backlash_ros.core.estimate import Status
from backlash_ros.core.estimates_file import worth_saving
from backlash_ros.core.estimation2.executor import Executor, InlineExecutor
from backlash_ros.core.estimation2.worker import WorkerExecutor
from backlash_ros.core.loop.command_history import REMEMBERED
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.figures import Finding, Level
from backlash_ros.core.loop.sample_counter import Output, SampleCounter, kept_outputs
from backlash_ros.core.parameters import NOISE, Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.table import CONTROLLER
from backlash_ros.nodes.control.estimate_saver import EstimateSaver
from backlash_ros.nodes.control.first_command import FirstCommand
from backlash_ros.nodes.control.last_command_sender import LastCommandSender
from backlash_ros.nodes.control.model_publisher import ModelPublisher
from backlash_ros.nodes.control.services import offer_services
from backlash_ros.nodes.control.step_publisher import StepPublisher
from backlash_ros.nodes.diagnostics.diagnosis import Diagnosis, counts_of, values_of, worst
from backlash_ros.nodes.diagnostics.rivals import RivalWatch
from backlash_ros.nodes.runtime.declare import LiveParameters
from backlash_ros.nodes.runtime.driver_io import DriverIo, output_qos
from backlash_ros.nodes.runtime.events import emit
from backlash_ros.nodes.runtime.inbox import Inbox
from backlash_ros.nodes.runtime.lifecycle import ManagedNode
from backlash_ros.nodes.runtime.messages import (
    DEPTH,
    DIAGNOSTICS_PERIOD_S,
    KEPT,
    DiagnosticsPublisher,
    stamp_ns_of,
)
from backlash_ros.nodes.runtime.spin import run

# Share of a period for which the controller sleeps after the command: on a busy processor the
# driver, woken by the command, would have to wait for it otherwise.
POST_COMMAND_SLEEP = 0.05
PUT_OFF = 5  # samples for which a controller that is behind may leave the search for the gap alone


class ControllerNode(ManagedNode):
    """Answers every plant_output with a control; estimates and signals follow after it.

    In lockstep the k-th tick of /clock, reference and plant_output belong together, so that
    runs are repeatable; else the newest reference counts.
    """

    def __init__(self) -> None:
        super().__init__(CONTROLLER)
        p = self.settings
        if p.get_bool('lockstep') and p.get_str('io.style') != 'native':
            raise ParameterError('lockstep', True, 'needs io.style: native')
        # Whatever is wrong with the parameters ends the process before it takes part in anything.
        build_controller(p)
        for warning in warnings_of(p, with_reference=False):
            self.log.warning(warning)
        self.loop: ControlLoop | None = None  # None while unconfigured
        self._lockstep = p.get_bool('lockstep')
        # A fit that shared the process of the loop would hold up its commands.
        self._executor: Executor = (
            InlineExecutor() if self._lockstep else WorkerExecutor(WORKER_MODULES)
        )
        self._behind = 0  # outputs in a row that were answered after the next one had come
        self._io = DriverIo(self, p)
        # Whoever waits for the others begins with them; who does not may have been restarted.
        self._set_up(
            p, from_zero=not self._lockstep and p.get_int('wait_for_subscribers') > 0
        )
        self._saver = EstimateSaver(p.get_str('estimates.file'))
        self._saved_at = time.monotonic()
        self._queues: tuple[deque[Any], deque[Any], deque[Any]] = (deque(), deque(), deque())
        self._ticks, self._references, self._outputs = self._queues
        self._reference_at: float | None = None  # on the steady clock [s]
        self._told: Status | None = None  # the newest one that /diagnostics has
        self._driver: Subscription | None = None  # plant_output, once it may begin
        self._last_commands = LastCommandSender(self, self._io)
        self._rivals = RivalWatch(
            self, self._io.topics.control, self._io.advertise, self._mind_rivals
        )
        self._told_rivals = self._rivals.found
        self._commands_of_rivals: Subscription | None = None  # heard while standing down
        self._steps = StepPublisher(self)
        self._model = ModelPublisher(self)
        self._diagnostics = DiagnosticsPublisher(
            self, p.get_str('io.joint') or self._io.publisher.topic_name
        )
        # A stalled controller goes on with the newest values; in lockstep none may be skipped.
        self._reference = self.create_subscription(
            Float64, topics.REFERENCE, self._on_reference, KEPT if self._lockstep else 1
        )
        # The first command begins with what the driver reports, even if it is not learned from.
        self._reports = (
            None if self._lockstep else Inbox(self, Float64, topics.APPLIED_CONTROL, REMEMBERED)
        )
        self._first_command = FirstCommand(self, self._io, self._reports)
        self._diagnosis = Diagnosis(
            self, self._io, output_qos(p, DEPTH), self._reference.qos_profile
        )
        if self._lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, KEPT)
        offer_services(self, self)
        self._live = LiveParameters(
            self, p, self._check_change, self._take_up, lambda: self.loop is None
        )
        self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=self.steady_clock)
        if not self._lockstep:
            self.create_timer(0.05, self._look_for_silence, clock=self.steady_clock)
        self._announce()
        if p.get_bool('autostart'):
            self.start()

    def _announce(self) -> None:
        """Say in the log what the node is about."""
        p, output, control = self.settings, self._io.topics.output, self._io.topics.control
        name, period = self.resolve_topic_name, p.get_float('sample_period')
        self.log.info(
            f'started: {name(output)} and {name(topics.REFERENCE)} in, {name(control)} out, '
            f'sample_period {period:g} s ({1.0 / period:.4g} Hz); '
            + (f'waits for {topics.REFERENCE} and {output}' if p.get_bool('autostart')
               else 'autostart is false: waits for '
                    f'ros2 lifecycle set {self.get_fully_qualified_name()} configure')
        )

    @property
    def estimates_file(self) -> str:
        """Where estimates are saved, empty for nowhere."""
        return self._saver.file

    def save_estimates(self) -> Future[str]:
        """Begin to save the estimates; the result says why it failed, empty if it did not."""
        assert self.loop is not None
        return self._saver.save(self.loop.estimate, self._live.parameters)

    def configure(self) -> None:
        p = self._live.parameters
        before = known_before(p)
        self.loop = ControlLoop(
            p, self._io.publish, self._io.now_ns, before, self._counter,
            self._first_command.v_at_start(p), self._new_reports, self._executor,
        )
        self._model.publish(self.loop)
        if before.learned:
            self.log.info(
                f'going on with the estimates in {self.estimates_file}: m={before.m:.6g}, '
                f'c_r={before.c_r:.6g}, c_l={before.c_l:.6g}'
            )

    def activate(self) -> None:
        assert self.loop is not None
        self._rivals.begin()
        if self._driver is not None:
            # v goes on from the last command, but what the plant did meanwhile is unknown, and
            # that nobody was listened to is no silence of the driver.
            self.loop.renew(self.loop.estimate)
            self.loop.heard_at = None
            return
        if self._lockstep:  # simulated time hurts nobody
            self._await_loop()
        else:
            self.call_when(
                lambda: self._rivals.settled and self._knows_rivals(), self._await_loop,
                f'discovery of another controller of {self._rivals.topic} on this machine: '
                'end that one, or set on_rival: warn',
            )

    def _knows_rivals(self) -> bool:
        """Whether no controller of this machine has still to be found that may be in charge."""
        return self._rivals.complete or self._live.parameters.get_str('on_rival') == 'warn'

    def _await_loop(self) -> None:
        """Listen to plant_output as soon as everybody is there."""
        needed = self._conditions_of_start()
        self.call_when(
            lambda: all(condition() for condition in needed), self._listen_to_driver,
            f'{topics.REFERENCE} and the listeners of {self._io.topics.control}',
        )

    def deactivate(self) -> None:
        """Send the last command as on_stop says, and save what was learned."""
        loop, p = self.loop, self._live.parameters
        assert loop is not None
        self._last_commands.end()
        if loop.last is not None:
            # Before a ramp: whoever stops this process may not wait for its end.
            self._save(loop)
            if not loop.standing_down:
                self._last_commands.send_all(
                    loop, p.get_str('on_stop'), p.get_float('timeout.ramp'), self._diagnose
                )
            self._model.publish(loop)
        self._rivals.end()
        self._diagnose()

    def cleanup(self) -> None:
        if self.loop is not None and self.loop.knows_v:
            self._first_command.before = self.loop.v
        if self.loop is not None:
            self.loop.close()
        self.loop = None
        self._diagnose()

    def finish(self) -> None:
        super().finish()
        self._rivals.close()
        self._saver.close()
        self._executor.close()
        if self.loop is not None:
            self.log.info(', '.join(
                f'{key}: {count}' for key, count in counts_of(self.loop).items()
                if count or key == 'samples'
            ))

    def _conditions_of_start(self) -> list[Callable[[], bool]]:
        """What has to be there before plant_output is listened to, for that starts the loop."""
        wanted = max(self.settings.get_int('wait_for_subscribers'), int(self._lockstep))
        if not wanted:
            return []
        return [
            lambda: self._io.listeners >= wanted,
            # Beside the driver, those who listen want to hear everything.
            lambda: self._steps.listeners >= wanted - 1,
            (lambda: self._reference.get_publisher_count() > 0) if self._lockstep
            else (lambda: self._reference_at is not None),
        ]

    def _listen_to_driver(self) -> None:
        # Whoever is activated twice before everybody is there has two that wait.
        if self._driver is None:
            self._rivals.look()
            kept = kept_outputs(self.settings.get_float('sample_period'))
            self._driver = self._io.listen(self._on_output, min(kept, DEPTH))
            emit('ready')

    def _on_reference(self, message: Float64) -> None:
        loop = self.loop
        if loop is None:
            return
        if loop.take_reference(message.data):
            self._reference_at = time.monotonic()
        if self._lockstep:
            self._references.append(loop.y_m)
            self._pair()

    def _on_clock(self, message: Clock) -> None:
        self._ticks.append(stamp_ns_of(message))
        self._pair()

    def _on_output(self, output: Output) -> None:
        loop = self.loop
        if loop is None:
            for _ in self._new_reports():  # which are of no use to a loop that begins later
                pass
            return
        if loop.begins or not self.active:
            loop.hear_reports()
        if not self.active:
            return
        if self._lockstep:
            self._outputs.append(output)
            self._pair()
            return
        if loop.begins and not loop.standing_down and not (
            self._knows_rivals()
            and self._first_command.may_follow(loop, output, self._live.parameters)
        ):
            return
        was_silent = loop.silent
        step = loop.command(output)
        # Where the next output is waiting already, there is no time for what may be put off.
        behind = 0 < output.received_ns < time.time_ns() - self._period_ns
        if step is not None and not behind:
            time.sleep(self._post_command_sleep_s)
        loop.note()
        if was_silent and not loop.silent:
            self._last_commands.end()
        if step is None:
            return
        self._behind = self._behind + 1 if behind else 0
        if self._behind % PUT_OFF == 0:
            loop.core.refine(self._refine_budget_s)
        self._follow_up(loop, step, was_silent)

    def _new_reports(self) -> Iterator[tuple[float, int]]:
        """What the driver has reported to have applied since the last look: v, stamp [ns]."""
        if self._reports is not None:
            for message, info in self._reports.take_all():
                yield message.data, self._io.stamp_ns(info)

    def _pair(self) -> None:
        """Lockstep: answer as soon as tick, reference and output of a sample are there."""
        while self.loop is not None and self.active and all(self._queues):
            arrival = self.loop.counter.count(self._ticks.popleft())
            y_m = self._references.popleft()
            step = self.loop.step(self._outputs.popleft(), arrival, y_m)
            if step is not None:
                self.loop.core.refine()
                self._follow_up(self.loop, step, was_silent=False)

    def _follow_up(self, loop: ControlLoop, step: ControlStep, was_silent: bool) -> None:
        """Tell of a step."""
        self._steps.publish(loop, step)
        self._model.follow(loop, self.settings.get_float('sample_period'))
        if was_silent or step.estimate.status != self._told:
            self._told = step.estimate.status
            self._diagnose()

    def _check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that the running loop cannot take up."""
        build_controller(p, first_guess(p))
        changes = p[NOISE] != self._live.parameters[NOISE]
        if self.loop is not None and changes and NOISE not in self.loop.core.estimator.RETUNED:
            raise ParameterError(
                NOISE, p[NOISE], f'is not taken up live by {p.get_str("estimator.law")}',
                'clean the node up, set it, and configure again',
            )

    def _take_up(self, p: Parameters) -> None:
        before, self.settings = self.settings, p
        if self.loop is not None:
            self.loop.take_up(p)
        else:
            self._saver.file = p.get_str('estimates.file')
            if p['sample_period'] != before['sample_period']:
                self._set_up(p, from_zero=False)
        self._mind_rivals()

    def _set_up(self, p: Parameters, from_zero: bool) -> None:
        """Take up what follows from the sample period."""
        period = p.get_float('sample_period')
        self._post_command_sleep_s, self._period_ns = POST_COMMAND_SLEEP * period, period * 1e9
        self._refine_budget_s = REFINE_SHARE * period
        self._counter = SampleCounter(period, from_zero)

    def _mind_rivals(self) -> None:
        """Stand down or command again, as on_rival says, and tell of it."""
        loop, found = self.loop, self._rivals.found
        on_rival = self._live.parameters.get_str('on_rival')
        stand_down = on_rival == 'stand_down' and not self._rivals.came_first
        if loop is not None and stand_down != loop.standing_down:
            if stand_down:
                self._last_commands.end()
                loop.stand_down()
                self._commands_of_rivals = self._io.listen_to_commands(loop.hear_other)
            else:
                assert self._commands_of_rivals is not None
                self.destroy_subscription(self._commands_of_rivals)
                loop.resume()
        if found != self._told_rivals:
            self._told_rivals = found
            if not found:
                self.log.info(f'nobody else publishes {self._rivals.topic} any more')
        self._diagnose()

    def _look_for_silence(self) -> None:
        loop = self.loop
        if loop is None or not self.active:
            return
        self._save_now_and_then(loop)
        timeout = self._live.parameters.get_float('timeout.plant_output')
        if loop.heard_at is None or loop.silent or timeout == 0.0:
            return
        if time.monotonic() > loop.heard_at + timeout:
            loop.give_up()
            self._last_commands.begin(loop, self._live.parameters.get_str('on_timeout'))
            self._diagnose()

    def _save_now_and_then(self, loop: ControlLoop) -> None:
        period = self._live.parameters.get_float('estimates.save_period')
        if period > 0.0 and time.monotonic() > self._saved_at + period:
            self._saved_at = time.monotonic()
            self._save(loop)

    def _save(self, loop: ControlLoop) -> None:
        if self.estimates_file and worth_saving(loop.estimate):
            self.save_estimates().add_done_callback(
                lambda saved: self.log.error(saved.result()) if saved.result() else None
            )

    def _diagnose(self) -> None:
        loop = self.loop
        if loop is None:
            self._diagnostics.publish(
                Finding(Level.OK, 'unconfigured', 'unconfigured'), self._rivals.claim
            )
            return
        values = values_of(loop)
        if not self.active:
            text = f'inactive: no {self._io.topics.control} is published'
            self._diagnostics.publish(
                Finding(Level.OK, 'inactive', text), {**values, **self._rivals.claim}
            )
            return
        findings, details = self._diagnosis.findings(
            loop, self._live.parameters, self._reference_at,
            tuple(rival.name for rival in self._rivals.found),
        )
        self._diagnostics.publish(worst(findings), {**details, **values, **self._rivals.claim})


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(CONTROLLER, ControllerNode, args)


if __name__ == '__main__':
    sys.exit(main())
