"""Node that learns the backlash and cancels it: plant_output and reference in, control out."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import Future
from itertools import cycle
from math import isfinite, nan
from typing import NamedTuple

from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from backlash_ros import topics
from backlash_ros.core.assembly import (
    WORKER_MODULES,
    build_controller,
    known_before,
    takes_model_as_exact,
    warnings_of,
)
from backlash_ros.core.control.controller import REFINE_SHARE, ControlStep
from backlash_ros.core.jobs.executor import Executor, InlineExecutor
from backlash_ros.core.jobs.worker import WorkerExecutor
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.joint_loops import JointLoops
from backlash_ros.core.loop.sample_counter import (
    JointOutputs,
    SampleCounter,
    kept_outputs,
)
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.table import CONTROLLER, JOINTS
from backlash_ros.nodes.control.joint import Joint
from backlash_ros.nodes.control.last_commands import LastCommandSender
from backlash_ros.nodes.control.publishing import StepPublisher
from backlash_ros.nodes.control.rivals import RivalWatch
from backlash_ros.nodes.control.services import offer_services
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.lifecycle import ManagedNode
from backlash_ros.nodes.runtime.messages import DEPTH, DIAGNOSTICS_PERIOD_S, KEPT_QOS, stamp_ns_of
from backlash_ros.nodes.runtime.parameters import let_parameters_change
from backlash_ros.nodes.runtime.process import emit, run

# Share of a period for which the controller sleeps after the command: on a busy processor the
# driver, woken by the command, would have to wait for it otherwise.
POST_COMMAND_SLEEP = 0.05
PUT_OFF = 5  # samples for which a controller that is behind may leave the search for the gap alone


class LockstepQueues(NamedTuple):
    """Ticks of /clock [ns], references and outputs that wait for each other."""

    ticks: deque[int]
    references: deque[float]
    outputs: deque[JointOutputs]


class SpareTime:
    """What the controller does between a command and the next output.

    Where the next output is waiting already, there is no time for what may be put off.
    """

    def __init__(self, sample_period_s: float) -> None:
        self._period_ns, self._sleep_s = sample_period_s * 1e9, POST_COMMAND_SLEEP * sample_period_s
        self._budget_s = REFINE_SHARE * sample_period_s
        self._behind = 0  # outputs in a row that were answered after the next one had come
        self._turn = 0  # of the joint that fits next

    def let_the_driver_go_on(self, received_ns: int) -> None:
        """Sleep a little. received_ns: when the output came that was answered."""
        behind = 0 < received_ns < time.time_ns() - self._period_ns
        self._behind = self._behind + 1 if behind else 0
        if not behind:
            time.sleep(self._sleep_s)

    def refine(self, loops: Sequence[ControlLoop]) -> None:
        """Let the next loop take up and submit fits."""
        if self._behind % PUT_OFF == 0:
            self._turn = (self._turn + 1) % len(loops)
            loops[self._turn].core.refine(self._budget_s)


class ControllerNode(ManagedNode):
    """Answers every plant_output with a control; estimates and signals follow after it.

    In lockstep the k-th tick of /clock, reference and plant_output belong together, so that
    runs are repeatable; else the newest reference counts. With `joints` there is a loop for each
    of them: a message has y of all, and one with v of all answers it.
    """

    def __init__(self) -> None:
        super().__init__(CONTROLLER)
        p = self.settings
        _check_style(p)
        for joint in p.joint_names:
            # Whatever is wrong with the parameters ends the process before it takes part in
            # anything.
            own = p.of_joint(joint)
            build_controller(own)
            for warning in warnings_of(own, with_reference=False):
                self.log.warning(f'{joint}: {warning}' if joint else warning)
        self.loops: JointLoops | None = None  # None while unconfigured
        # A fit that shared the process of the loop would hold up its commands.
        self._executor: Executor = (
            InlineExecutor() if p.lockstep else WorkerExecutor(WORKER_MODULES)
        )
        self._io = DriverIo(self, p)
        if not p.lockstep:
            # The first command begins with what the driver reports, even if it is not learned from.
            self._io.listen_to_reports()
        # Whoever waits for the others begins with them; who does not may have been restarted.
        self._counter = SampleCounter(
            p.sample_period, from_zero=not p.lockstep and p.wait_for_subscribers > 0
        )
        self._spare_time = SpareTime(p.sample_period)
        self._pairs = LockstepQueues(deque(), deque(), deque())
        self._driver: Subscription | None = None  # plant_output, once it may begin
        self._last_commands = LastCommandSender(self, self._io)
        self.joints: list[Joint] = []
        self._rivals = RivalWatch(
            self, self._io.topics.control, self._io.advertise, self._mind_rivals
        )
        self._commands_of_rivals: Subscription | None = None  # heard while standing down
        self._steps = StepPublisher(self, p.joint_names)
        # A stalled controller goes on with the newest values; in lockstep none may be skipped.
        references = self._io.listen_to_references(
            self._on_reference, KEPT_QOS if p.lockstep else 1
        )
        self.joints += [
            Joint(self, joint, p.of_joint(joint), self._io, references.qos_profile)
            for joint in p.joint_names
        ]
        if p.lockstep:
            self.create_subscription(Clock, topics.CLOCK, self._on_clock, KEPT_QOS)
        offer_services(
            self, lambda: self.configured, self.save_estimates,
            lambda: ', '.join(joint.saver.file for joint in self.joints),
        )
        let_parameters_change(
            self, self._check_change, self._take_up, lambda: self.loops is None
        )
        # One joint at a time: all at once would hold up a command.
        turn = cycle(self.joints)
        self.create_timer(
            DIAGNOSTICS_PERIOD_S / len(self.joints),
            lambda: next(turn).diagnose(self._rivals, self.active), clock=self.steady_clock,
        )
        if not p.lockstep:
            self.create_timer(0.05, self._look_for_silence, clock=self.steady_clock)
        self._announce()
        if p.autostart:
            self.start()

    def _announce(self) -> None:
        """Say in the log what the node is about."""
        p, to, name = self.settings, self._io.topics, self.resolve_topic_name
        period = p.sample_period
        joints = f'joints {", ".join(p.joint_names)}: ' if p.joint_names[0] else ''
        self.log.info(
            f'started: {joints}{name(to.output)} and {name(to.reference)} in, {name(to.control)} '
            f'out, sample_period {period:g} s ({1.0 / period:.4g} Hz); '
            + (f'waits for {to.reference} and {to.output}' if p.autostart
               else 'autostart is false: waits for '
                    f'ros2 lifecycle set {self.get_fully_qualified_name()} configure')
        )
        exact = [joint for joint in p.joint_names if takes_model_as_exact(p.of_joint(joint))]
        if exact:
            of = f' of {", ".join(exact)}' if exact[0] else ''
            self.log.info(
                f'plant.uncertainty{of} is 0: G is taken as exact, which no data can check. Where '
                'it is not, estimates are off by more than their deviations: 0.2 allows for time '
                'constants that are 20 % off'
            )

    @property
    def configured(self) -> list[ControlLoop]:
        """The loops, none while there are none."""
        return [] if self.loops is None else list(self.loops.by_name.values())

    def save_estimates(self) -> list[Future[str]]:
        """Begin to save what is worth it; each result says why it failed, empty if it did not."""
        return [saved for joint in self.joints if (saved := joint.save()) is not None]

    def configure(self) -> None:
        before = {joint.name: known_before(joint.p) for joint in self.joints}
        self.loops = JointLoops(
            self.settings, self._io.publish, self._io.now_ns, before, self._counter,
            {joint.name: joint.first_command.v_at_start(joint.p) for joint in self.joints},
            self._io.reports_of, self._executor,
        )
        for joint in self.joints:
            joint.begin(self.loops.by_name[joint.name], before[joint.name])

    def activate(self) -> None:
        self._rivals.begin()
        if self._driver is not None:
            # v goes on from the last command, but what the plant did meanwhile is unknown, and
            # that nobody was listened to is no silence of the driver.
            for loop in self.configured:
                loop.renew(loop.estimate)
                loop.heard_at = None
            return
        if self.settings.lockstep:  # simulated time hurts nobody
            self._await_loop()
        else:
            self.call_when(
                lambda: self._rivals.settled and self._knows_rivals(), self._await_loop,
                f'discovery of another controller of {self._rivals.topic} on this machine: '
                'end that one, or set on_rival: warn',
            )

    def _knows_rivals(self) -> bool:
        """Whether no controller of this machine has still to be found that may be in charge."""
        return self._rivals.complete or self.settings.on_rival == 'warn'

    def _await_loop(self) -> None:
        """Listen to plant_output as soon as everybody is there."""
        needed = self._conditions_of_start()
        self.call_when(
            lambda: all(condition() for condition in needed), self._listen_to_driver,
            f'{self._io.topics.reference} and the listeners of {self._io.topics.control}',
        )

    def deactivate(self) -> None:
        """Send the last command as on_stop says, and save what was learned."""
        loops, p = self.loops, self.settings
        assert loops is not None
        self._last_commands.end()
        if any(loop.last is not None for loop in self.configured):
            # Before a ramp: whoever stops this process may not wait for its end.
            for joint in self.joints:
                joint.save()
            self._last_commands.send_all(
                loops, p.on_stop, p.timeout.ramp, self._diagnose
            )
            for joint in self.joints:
                joint.model.publish(loops.by_name[joint.name])
        self._rivals.end()
        self._diagnose()

    def cleanup(self) -> None:
        for joint in self.joints:
            joint.end()
        for loop in self.configured:
            loop.close()
        self.loops = None
        self._diagnose()

    def finish(self) -> None:
        super().finish()
        self._rivals.close()
        for joint in self.joints:
            joint.saver.close()
            joint.sum_up()
        self._executor.close()

    def _conditions_of_start(self) -> list[Callable[[], bool]]:
        """What has to be there before plant_output is listened to, for that starts the loop."""
        lockstep = self.settings.lockstep
        wanted = max(self.settings.wait_for_subscribers, int(lockstep))
        if not wanted:
            return []
        return [
            lambda: self._io.listeners >= wanted,
            # Beside the driver, those who listen want to hear everything.
            lambda: self._steps.listeners >= wanted - 1,
            (lambda: self.count_publishers(self._io.topics.reference) > 0) if lockstep
            else (lambda: all(joint.reference_at is not None for joint in self.joints)),
        ]

    def _listen_to_driver(self) -> None:
        # Whoever is activated twice before everybody is there has two that wait.
        if self._driver is None:
            self._rivals.look()
            kept = kept_outputs(self.settings.sample_period)
            self._driver = self._io.listen(self._on_output, min(kept, DEPTH))
            emit('ready')

    def _on_reference(self, y_m: Mapping[str, float]) -> None:
        if self.loops is None:
            return
        taken = self.loops.take_references(y_m)
        now = time.monotonic()
        for joint in self.joints:
            if joint.name in taken:
                joint.reference_at = now
        if self.settings.lockstep:
            self._pairs.references.append(self.loops.by_name[''].y_m)
            self._pair()

    def _on_clock(self, message: Clock) -> None:
        self._pairs.ticks.append(stamp_ns_of(message))
        self._pair()

    def _on_output(self, outputs: JointOutputs) -> None:
        loops = self.loops
        if loops is None:
            self._io.forget_reports()
            return
        for loop in loops.by_name.values():
            if loop.begins or not self.active:
                loop.hear_reports()
        if not self.active:
            return
        if self.settings.lockstep:
            self._pairs.outputs.append(outputs)
            self._pair()
            return
        waiting = self._waiting(loops, outputs)
        if waiting >= outputs.y.keys():
            return
        silent = {joint for joint, loop in loops.by_name.items() if loop.silent}
        steps = loops.answer(outputs, waiting)
        if steps:
            self._spare_time.let_the_driver_go_on(outputs.received_ns)
        back = [loops.by_name[joint] for joint in silent if not loops.by_name[joint].silent]
        if back:
            self._last_commands.end(*back)
        if steps:
            self._spare_time.refine(self.configured)
            self._follow_up(loops, steps, silent)

    def _waiting(self, loops: JointLoops, outputs: JointOutputs) -> Set[str]:
        """Joints of a message that are not answered yet: what to begin with is not known."""
        if self.settings.io.together and any(
            loop.silent and not isfinite(outputs.y.get(joint, nan))
            for joint, loop in loops.by_name.items()
        ):
            return outputs.y.keys()
        return {
            joint.name for joint in self.joints
            if (loop := loops.by_name[joint.name]).begins and not loop.standing_down
            and joint.name in outputs.y
            and not (self._knows_rivals() and joint.first_command.may_follow(
                loop, outputs.of(joint.name), joint.p
            ))
        }

    def _pair(self) -> None:
        """Lockstep: answer as soon as tick, reference and output of a sample are there."""
        while self.loops is not None and self.active and all(self._pairs):
            loop = self.loops.by_name['']
            ticks, references, outputs = self._pairs
            arrival = self.loops.counter.count(ticks.popleft())
            step = loop.step(outputs.popleft().of(''), arrival, references.popleft())
            self.loops.send()
            if step is not None:
                loop.core.refine()
                self._follow_up(self.loops, {'': step}, silent=set())

    def _follow_up(
        self, loops: JointLoops, steps: Mapping[str, ControlStep], silent: Set[str],
    ) -> None:
        """Tell of the steps of a sample. silent: joints that were until then."""
        self._steps.publish(loops.by_name, steps)
        for joint in self.joints:
            if joint.name in steps and joint.follow(steps[joint.name], joint.name in silent):
                joint.diagnose(self._rivals, self.active)

    def _check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that the running loops cannot take up."""
        for joint in self.joints:
            joint.check_change(p.of_joint(joint.name))

    def _take_up(self, before: Parameters) -> None:
        """Use the settings, which have changed."""
        p = self.settings
        for joint in self.joints:
            joint.take_up(p.of_joint(joint.name))
        if self.loops is None and p.sample_period != before.sample_period:
            self._counter = SampleCounter(p.sample_period)
            self._spare_time = SpareTime(p.sample_period)
        self._mind_rivals()

    def _mind_rivals(self) -> None:
        """Stand down or command again, as on_rival says, and tell of it."""
        stand_down = self.settings.on_rival == 'stand_down' and not self._rivals.came_first
        changing = [loop for loop in self.configured if loop.standing_down != stand_down]
        if changing and stand_down:
            self._last_commands.end()
            for loop in changing:
                loop.stand_down()
            self._commands_of_rivals = self._io.listen_to_commands(self._hear_rival)
        elif changing:
            assert self._commands_of_rivals is not None
            self.destroy_subscription(self._commands_of_rivals)
            for loop in changing:
                loop.resume()
        self._diagnose()

    def _hear_rival(self, commands: Mapping[str, float]) -> None:
        for joint in self.joints:
            if joint.loop is not None and joint.name in commands:
                joint.loop.hear_other(commands[joint.name])

    def _look_for_silence(self) -> None:
        loops = self.loops
        if loops is None or not self.active:
            return
        for joint in self.joints:
            joint.save_now_and_then()
        overdue = [joint for joint in self.joints if joint.is_overdue()]
        if overdue:
            # An arm of which one joint is lost stops as one, unless told otherwise.
            ending = [
                joint.loop for joint in (self.joints if self.settings.io.together else overdue)
                if joint.loop is not None and not joint.loop.silent
            ]
            for loop in ending:
                loop.give_up()
            self._last_commands.begin(loops, ending, self.settings.on_timeout)
            self._diagnose()

    def _diagnose(self) -> None:
        for joint in self.joints:
            joint.diagnose(self._rivals, self.active)


def _check_style(p: Parameters) -> None:
    """Raise ParameterError where the messages of io.style cannot carry what is asked for."""
    style = p.io.style
    if p.lockstep and style != 'native':
        raise ParameterError('lockstep', True, 'needs io.style: native')
    if p.joints and style == 'native':
        raise ParameterError(
            'io.style', style, 'has messages for one joint only',
            'set joint_state_topic or ros2_control',
        )
    if style == 'joint_state_topic' and not (p.joints or p.io.joint):
        raise ParameterError(JOINTS, (), 'is empty', f'name them, io.style is {style}')


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(CONTROLLER, ControllerNode, args)


if __name__ == '__main__':
    sys.exit(main())
