"""Node that learns the backlash and cancels it: plant_output and reference in, control out."""

import sys
import time
from collections import deque
from collections.abc import Mapping
from functools import partial
from itertools import cycle
from math import isfinite, nan
from signal import SIGTERM
from typing import Any

from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.timer import Timer

from backlash_ros.core import assembly
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.jobs import Executor, WorkerExecutor
from backlash_ros.core.loop import sample_counter
from backlash_ros.core.loop.command_history import KEPT_COMMANDS
from backlash_ros.core.loop.control_loop import JointLoops
from backlash_ros.core.loop.diagnosis import Neighbours
from backlash_ros.core.loop.sample_counter import Output, SampleCounter, Timing
from backlash_ros.core.parameters import CONTROLLER, ParameterError, Parameters
from backlash_ros.core.priority import answer_first
from backlash_ros.nodes.control.joint import Joint, offer_services
from backlash_ros.nodes.control.publishing import StepPublisher
from backlash_ros.nodes.control.rivals import RivalWatch
from backlash_ros.nodes.runtime.driver_io import DriverIo, check_style
from backlash_ros.nodes.runtime.executor import PromptExecutor, refuse_unfit_transitions
from backlash_ros.nodes.runtime.messages import DEPTH, DIAGNOSTICS_PERIOD_S, KEPT_QOS, line_of
from backlash_ros.nodes.runtime.process import ProcessNode, emit, run


class ControllerNode(LifecycleNodeMixin, ProcessNode):
    """Answers every plant_output with a control, then publishes estimates and signals.

    A managed node. In lockstep the k-th tick of /clock, reference and plant_output belong together,
    which makes runs repeatable; otherwise the newest reference is used. With `joints` each has a
    loop of its own: a message with y of all joints is answered by one with v of all.
    """

    reconfigurable = True

    def __init__(self) -> None:
        answer_first()
        ProcessNode.__init__(self, CONTROLLER)
        LifecycleNodeMixin.__init__(self)
        refuse_unfit_transitions(self)
        p = self.settings
        check_style(p)
        self.active = False
        self._io = DriverIo(self)
        # Samples count from 0 if it waits for the others; otherwise it may have been restarted.
        counter = SampleCounter(
            p.sample_period, from_zero=not p.lockstep and p.wait_for_subscribers > 0
        )
        # Not used while unconfigured: made now to raise any ParameterError before discovery.
        self.loops = JointLoops(p, self._io.publish, self._io.driver_of, {}, counter, {
            # In lockstep the only plant is the simulated one, which begins at 0.
            joint: initial if isfinite(initial) and not p.lockstep else None
            for joint in p.joint_names for initial in [p.of_joint(joint).control.initial]
        })
        # Fits have processes of their own, as they would delay the commands of the loop.
        self._executor = Executor() if p.lockstep else \
            WorkerExecutor(assembly.WORKER_MODULES, len(p.joint_names))
        if not p.lockstep:
            # The first command starts from the reported v, even if estimation does not use reports.
            self._io.listen_to(self._io.topics.applied, self._on_report, KEPT_COMMANDS)
        # Lockstep: ticks of /clock [ns], references and outputs that wait for each other.
        self._waiting: tuple[deque[Any], ...] = deque(), deque(), deque()
        self._around = Neighbours(), Timing(p.sample_period)  # at the newest look at the graph
        self._ending: Timer | None = None  # sends the commands of on_timeout
        to = self._io.topics
        self._rivals = RivalWatch(self, self._io, self._mind_rivals)
        self._steps = StepPublisher(self, p.joint_names)
        # After a stall the newest reference is used; in lockstep none may be skipped. Polled, as a
        # wake-up for each y_m would cost half as much processor time again.
        self._io.listen_to(
            to.reference, self._on_reference, KEPT_QOS if p.lockstep else 1, polled=not p.lockstep,
        )
        self.joints = [
            Joint(self, name, self._io, loop) for name, loop in self.loops.by_name.items()
        ]
        offer_services(self, self.joints)
        turns = cycle(self.joints)

        def look_and_tell() -> None:
            self._steps.look()
            self._diagnose(next(turns))

        # Apart, as both at once would delay a command.
        self.every(DIAGNOSTICS_PERIOD_S, self._look_around)
        self.every(DIAGNOSTICS_PERIOD_S / len(self.joints), look_and_tell)
        if p.lockstep:
            self.listen_to_clock(partial(self._pair, 0), KEPT_QOS)
        else:
            self.every(0.1, self._look_for_silence)
        for joint in self.joints:
            for warning in assembly.warnings_of(joint.p, with_reference=False):
                self.log.warning(line_of(joint.name, warning))
            if assembly.takes_model_as_exact(joint.p):
                self.log.info(line_of(
                    joint.name, 'plant.uncertainty is 0: G is taken as exact, which no data can '
                    'check. If it is not, estimates are off by more than their standard deviations:'
                    ' 0.2 allows for time constants that are 20 % off'
                ))
        name = self.resolve_topic_name
        self.log.info(
            f'started: {name(to.output)} and {name(to.reference)} in, {name(to.control)} out'
            f'{" for joints " if p.joints else ""}{", ".join(p.joints)}, '
            f'sample_period {p.sample_period:g} s ({1.0 / p.sample_period:.4g} Hz); waits for '
            + (f'{to.reference} and {to.output}' if p.autostart else
               f'ros2 lifecycle set {self.get_fully_qualified_name()} configure')
        )
        if p.autostart:
            untyped: Any = self
            untyped.trigger_configure()
            untyped.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            io, loops = self._io, self.loops
            v = {name: loop.v if loop.knows_v else None for name, loop in loops.by_name.items()}
            self.loops = JointLoops(self.settings, io.publish, io.driver_of, {}, loops.counter, v,
                                    self._executor)
        except ParameterError as error:  # rclpy would swallow it silently
            self.log.error(str(error))
            return TransitionCallbackReturn.FAILURE
        self.configured = True
        for joint in self.joints:
            joint.loop = self.loops.by_name[joint.name]
            joint.publish_model()
            e = joint.loop.estimate
            if e.learned:
                self.log.info(
                    f'going on with the estimates in {joint.p.estimates.file}: m={e.m:.6g}, '
                    f'c_r={e.c_r:.6g}, c_l={e.c_l:.6g}'
                )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = True
        self._rivals.follow(active=True)
        for loop in self.loops.loops:
            # While inactive the node did not listen: that is no silence of the driver. v continues
            # from the last command, but what the plant did meanwhile is unknown.
            loop.heard.y_at = nan
            if loop.statistics.used:
                loop.renew(loop.estimate)
        return TransitionCallbackReturn.SUCCESS

    def work(self, executor: PromptExecutor) -> None:
        to = self._io.topics
        while not (self.active or self.stopping):
            executor.spin_once()
        if self.wait_until(executor, self._are_all_there,
                           f'{to.reference} and the listeners of {to.control}'):
            self._rivals.look()
            self._steps.look()
            # This starts the loop.
            kept = sample_counter.kept_outputs(self.settings.sample_period)
            self._io.listen(self._on_output, min(kept, DEPTH))
            emit('ready')
        super().work(executor)

    def _are_all_there(self) -> bool:
        """Whether all awaited nodes are found: the driver, and those that hear every topic."""
        lockstep, io = self.settings.lockstep, self._io
        wanted = max(self.settings.wait_for_subscribers, int(lockstep))
        return (lockstep or time.monotonic() >= self._rivals.settled_at) and (not wanted or (
            io.publisher.get_subscription_count() >= wanted
            and self._steps.listeners >= wanted - 1
            and (self.count_publishers(io.topics.reference) > 0 if lockstep
                 else all(isfinite(loop.heard.y_m_at) for loop in self.loops.loops))
        ))

    def on_deactivate(self, state: LifecycleState | None) -> TransitionCallbackReturn:
        if self.active:
            self.active = False
            if any(loop.statistics.used for loop in self.loops.loops):
                # Saved before a ramp, during which the process may be killed.
                for joint in self.joints:
                    joint.save()
                self.loops.end(self.settings.on_stop)
                self._send_last()
                for joint in self.joints:
                    if not joint.loop.silent:  # else told when the silence was noticed
                        joint.publish_model(wait_s=1)
            self._rivals.follow(active=False)
            self._diagnose()
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_deactivate

    def _send_last(self) -> None:
        """Send the last commands; hold v after timeout.ramp, or on SIGTERM as a second signal."""
        p, diagnosed_at, why = self.settings, time.monotonic(), ''
        step_s, deadline = max(p.sample_period, 1e-3), diagnosed_at + p.timeout.ramp
        while self.loops.send_next():
            late = time.monotonic() + step_s > deadline
            if not why and (late or SIGTERM in self.signals[1:]):
                why = f'timeout.ramp={p.timeout.ramp:g} s' if late else 'SIGTERM'
                for loop in self.loops.end('hold'):
                    if loop.v != loop.core.limits.zero:
                        self.log.warning(
                            f'v={loop.v:.6g} is held: {why} came before it reached zero'
                        )
            time.sleep(step_s)
            if time.monotonic() > diagnosed_at + DIAGNOSTICS_PERIOD_S:
                diagnosed_at = time.monotonic()
                self._diagnose()  # or a controller that stands down would think it gone
        self._io.publisher.wait_for_all_acked(Duration(nanoseconds=100_000_000))

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.configured = False
        for loop in self.loops.loops:
            loop.core.close()
        self._diagnose()
        return TransitionCallbackReturn.SUCCESS

    def finish(self) -> None:
        self.on_deactivate(None)
        for joint in self.joints:
            joint.close()
        self._executor.close()

    def _on_reference(self, y_m: Mapping[str, float], *_: object) -> None:
        if self.configured and self.settings.lockstep:
            self._pair(1, y_m)
        elif self.configured:
            self.loops.take_references(y_m)

    def _on_report(self, applied: Mapping[str, float], info: dict[str, Any], _: object) -> None:
        for joint, v in applied.items():
            self.loops.by_name[joint].take_applied(v, self._io.stamp_ns(info))

    def _on_output(self, outputs: Mapping[str, Output]) -> None:
        if not self.active:
            return
        if self.settings.lockstep:
            self._pair(2, outputs[''])
            return
        self._io.serve_waiting()
        steps = self.loops.answer(outputs)
        if steps:
            period_s, output = self.settings.sample_period, next(iter(outputs.values()))
            if output.received_ns > self._io.now_ns() - period_s * 1e9:
                # Let the driver, which the command wakes up, have a busy processor first.
                time.sleep(0.05 * period_s)
            self._follow_up(steps)
            self._look_early(output)

    def _look_early(self, newest: Output) -> None:
        """Take waiting references and reports shortly before the next output is due.

        They do not delay it then, and a process that has just been awake answers sooner.
        """
        before_ns, period_ns, executor = 600_000, self.loops.counter.sender.period_ns, self.executor
        # At higher rates there is hardly a pause.
        if period_ns > 5 * before_ns and isinstance(executor, PromptExecutor):
            due_ns = self._io.arrival_ns(newest) + period_ns - before_ns
            executor.due = due_ns, self._io.serve_waiting

    def _pair(self, which: int, came: int | Mapping[str, float] | Output) -> None:
        """Lockstep: answer as soon as the tick, reference and output of a sample have come."""
        ticks, references, outputs = self._waiting
        self._waiting[which].append(came)
        while self.active and all(self._waiting):
            # The tick tells the sample, not the sequence number of the message.
            output = outputs.popleft()._replace(
                sequence=sample_counter.UNNUMBERED, stamp_ns=ticks.popleft()
            )
            self.loops.take_references(references.popleft())
            if steps := self.loops.answer({'': output}):
                self._follow_up(steps)

    def _follow_up(self, steps: Mapping[str, ControlStep]) -> None:
        self.loops.prepare(steps)
        self._steps.publish(self.loops.by_name, steps)
        for joint in self.joints:
            if joint.name in steps:
                joint.follow_model()
        if news := next((joint for joint in self.joints if joint.told != joint.state), None):
            self._diagnose(news)

    def check_change(self, p: Parameters) -> None:
        for joint in self.joints:
            joint.check_change(p.of_joint(joint.name))

    def take_up(self, before: Parameters) -> None:
        p = self.settings
        for joint in self.joints:
            if self.configured:
                joint.loop.take_up(joint.p)
        if p.sample_period != before.sample_period:
            self.loops.counter = SampleCounter(p.sample_period)
        self._mind_rivals()

    def _mind_rivals(self) -> None:
        control = self._io.topics.control
        stand_down = self.settings.on_rival == 'stand_down' and self._rivals.any_first
        changing = [loop for loop in self.loops.loops if loop.standing_down != stand_down]
        if changing and stand_down:
            for loop in changing:
                loop.stand_down()
            self._io.listen_to(control, self._hear_rival, 1, polled=False)
        elif changing:
            self.destroy_subscription(self._io.heard.pop(control))
            for loop in changing:
                loop.resume()
        self._diagnose()

    def _hear_rival(self, commands: Mapping[str, float], *_: object) -> None:
        for joint, v in commands.items():
            self.loops.by_name[joint].hear_other(v)

    def _look_for_silence(self) -> None:
        if not self.active:
            return
        self._io.serve_waiting()
        for joint in self.joints:
            if 0.0 < joint.p.estimates.save_period < time.monotonic() - joint.saved_at:
                joint.save()
        overdue = self.loops.overdue
        for joint in self.joints:
            if joint.loop in overdue:
                joint.publish_model()  # what it has learned of the noise is given up with it
                joint.loop.give_up()
        if overdue:
            if self._ending is None:
                step_s = max(self.settings.sample_period, 1e-3)
                self._ending = self.every(step_s, self._send_next)
            self._diagnose()

    def _send_next(self) -> None:
        if self._ending is not None and not (self.active and self.loops.send_next()):
            self.destroy_timer(self._ending)
            self._ending = None

    def _look_around(self) -> None:
        """Read the graph and the timing of messages, for what is told of all joints."""
        rivals = tuple(rival.name for rival in self._rivals.found)
        self._around = (self._io.neighbours(rivals),
                        self._io.known_of(self.loops.counter.sender.timing()))

    def _diagnose(self, *joints: Joint) -> None:
        if not joints:
            self._look_around()
        for joint in joints or self.joints:
            joint.told = joint.state
            joint.diagnose(*self._around, self._rivals.claim, self.active)


main = partial(run, CONTROLLER, ControllerNode)

if __name__ == '__main__':
    sys.exit(main())
