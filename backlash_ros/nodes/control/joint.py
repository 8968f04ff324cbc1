"""Joints of the controller: diagnostics of their loops, the learned G, and services."""

import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from concurrent import futures
from itertools import chain
from math import inf, isnan
from pathlib import Path
from typing import Any, cast

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray, MultiArrayDimension
from std_srvs.srv import SetBool, Trigger

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller, first_guess
from backlash_ros.core.estimate import save_estimate, worth_saving
from backlash_ros.core.loop import diagnosis
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.loop_statistics import Lately
from backlash_ros.core.loop.sample_counter import Timing
from backlash_ros.core.parameters import NOISE, ParameterError, Parameters
from backlash_ros.core.plant.transfer_function import StateModel
from backlash_ros.core.simulation.run_record import learned_model_of, stated_deviations
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.messages import NO_EVENTS, DiagnosticsPublisher, line_of
from backlash_ros.nodes.runtime.process import ProcessNode


class Joint:
    """What the controller has for each joint; a single one is nameless.

    loop: the newest one, not in use while the node is unconfigured. told: the state last published
    to /diagnostics. saved_at: when estimates were last saved, on the steady clock [s].
    """

    def __init__(self, node: ProcessNode, name: str, io: DriverIo, loop: ControlLoop) -> None:
        self.name, self.loop = name, loop
        self._node, self._io = node, io
        # Late subscribers get the newest messages, as G may never change again: several, for one of
        # each joint, and so that a subscriber that is held up misses none.
        newest = QoSProfile(depth=20, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._model = node.create_publisher(
            Float64MultiArray, topics.of_node(topics.MODEL), newest, event_callbacks=NO_EVENTS
        )
        # The last model published after a sample, and the index of that sample.
        self._told_model: tuple[StateModel | None, float] = None, -inf
        self.told: object = None
        self._lately = Lately()
        self._diagnostics = DiagnosticsPublisher(
            node, node.settings.of_joint(name).io.joint or io.publisher.topic_name, part=name
        )
        # In a thread, as a slow disk would cost samples; files are written one after the other.
        self._writer = futures.ThreadPoolExecutor(1, thread_name_prefix='estimates')
        self.saved_at = time.monotonic()

    @property
    def p(self) -> Parameters:
        return self._node.settings.of_joint(self.name)

    @property
    def state(self) -> object:
        return self.loop.phase, self.loop.estimate.status

    def check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that cannot be used now."""
        build_controller(p, first_guess(p))
        if not self._node.configured:
            return
        core = self.loop.core
        fixed = dict.fromkeys(core.structure.NOT_RETUNED, p.structure)
        if NOISE not in core.estimator.RETUNED:
            fixed[NOISE] = p.estimator.law
        for name, by in fixed.items():
            if p[name] != self.p[name]:
                raise ParameterError(
                    name, p[name], f'is not taken up live by {by}',
                    'clean the node up, set it, and configure again',
                )

    def follow_model(self) -> None:
        """Publish ~/model if G has changed, or if a second's worth of samples has passed.

        Samples are counted instead of time, so that runs in lockstep are repeatable.
        """
        learned, index = self.loop.core.estimator.learned_model, self.loop.counter.index
        told, told_index = self._told_model
        # Standard deviations and noise change every few samples, and are of use as well.
        if learned is not told or (index - told_index) * self.p.sample_period >= 1.0:
            self._told_model = learned, index
            self.publish_model()

    def publish_model(self, wait_s: int = 0) -> None:
        """Publish ~/model now. wait_s: how long to wait for subscribers to confirm it, at most."""
        fields = learned_model_of(self.loop.core.estimator, self.p)
        message = Float64MultiArray(data=array('d', chain(*fields.values())))
        message.layout.dim = [
            MultiArrayDimension(label=topics.of_joint(label, self.name), size=len(values))
            for label, values in fields.items()
        ]
        self._model.publish(message)
        if wait_s:
            self._model.wait_for_all_acked(Duration(seconds=wait_s))

    def save(self) -> futures.Future[str] | None:
        """Start saving the estimates, if worthwhile; the result is '' or why it has failed."""
        p, estimate = self.p, self.loop.estimate
        if not p.estimates.file or not worth_saving(estimate):
            return None
        self.saved_at = time.monotonic()

        def write() -> str:
            try:
                save_estimate(Path(p.estimates.file), estimate, p)
            except OSError as error:
                text = f'estimates.file={p.estimates.file!r} cannot be written: {error.strerror}'
                self._node.log.error(text)
                return text
            return ''

        return self._writer.submit(write)

    def diagnose(
        self, around: diagnosis.Neighbours, timing: Timing, claim: Mapping[str, object],
        active: bool,
    ) -> None:
        """Publish the state of the joint to /diagnostics. claim: entries that identify the node."""
        loop, p, io, publish = self.loop, self.p, self._io, self._diagnostics.publish
        level, finding_of = diagnosis.Level, diagnosis.Finding
        if not self._node.configured:
            publish(finding_of(level.OK, 'unconfigured', 'unconfigured'), claim)
            return
        values = {**values_of(loop, timing), **claim}
        if not active:
            text = f'inactive: no {io.topics.control} is published'
            publish(finding_of(level.OK, 'inactive', text), values)
            return
        gained = self._lately.gained(loop.counted, time.monotonic())
        findings = diagnosis.findings_of(
            diagnosis.figures_of_loop(loop, p, timing, gained, around)
        )
        if io.skipped[self.name] >= 5:
            text = f'{io.topics.output} has no {p.io.field} of joint {p.io.joint!r} but ' \
                f'{io.seen}: set io.joint, io.field'
            findings.insert(0, finding_of(level.ERROR, 'joint', text[:diagnosis.LONGEST_TEXT]))
        # The likeliest cause, with the highest level of all findings.
        worst = max(findings, key=lambda finding: finding.level > level.OK)
        worst = worst._replace(level=max(finding.level for finding in findings))
        details = {f'finding {i}': finding.text for i, finding in enumerate(findings, start=1)}
        for topic, what in zip(around[:3], ('published', 'published', 'heard'), strict=True):
            details[f'{topic.name} {what} by'] = ', '.join(
                peer.name + (f' ({peer.kind}: does not fit)' if peer.unfit else '')
                for peer in topic.peers
            ) or 'nobody'
        if around.rivals:
            details[f'{around.control.name} also published by'] = ', '.join(around.rivals)
        # Findings that all joints share are logged by the first one alone.
        first = self._node.settings.joint_names[0]
        logs = self.name == first or worst.kind not in diagnosis.OF_MESSAGES
        publish(worst, {**details, **values}, logs)

    def close(self) -> None:
        self._writer.shutdown()
        if self._node.configured:
            self._node.log.info(line_of(self.name, ', '.join(
                f'{key}: {count}' for key, count in counts_of(self.loop).items()
                if count or key == 'samples'
            )))


def counts_of(loop: ControlLoop) -> dict[str, int]:
    n = loop.statistics
    return {
        'samples': n.used, 'lost': n.lost, 'of these never sent': n.unsent, 'late': n.late,
        'non-finite dropped': n.dropped,
        'repeated, too early or from a second driver': n.extra,
        'interruptions': n.interruptions, 'limits hit': n.limited,
        'before the first reference': n.without_reference, 'without applied_control': n.unreported,
    }


def values_of(loop: ControlLoop, timing: Timing) -> dict[str, object]:
    e, law, swing = loop.estimate, loop.core.estimator, loop.statistics.swing()
    gap, report, redesign = e.c_r - e.c_l, law.report, loop.core.redesign
    p50_ms, p99_ms = loop.statistics.latencies_ms(0.5, 0.99)
    mean_s = timing.intervals_s[1] if isnan(timing.period.mean) else timing.period.mean
    return {
        **counts_of(loop), 'state': e.status.word if law.adapting else 'held',
        **({} if law.learned_model is None else {
            'noise: learned / told': report.noise_ratio,
            'unexplained motion / (m * gap)': report.unexplained,
            'samples that wait for a fit': report.waiting, 'outliers': report.outliers,
            'commands found to be late': report.reattributed, 'failed fits': report.failed_fits,
            'failed designs': redesign.failed if redesign else 0,
            'processes for fits that died': loop.executor.restarts,
        }),
        'm': e.m, 'c_r': e.c_r, 'c_l': e.c_l, 'f': e.f,
        **dict(zip(('std_m', 'std_c_r', 'std_c_l'), stated_deviations(e), strict=True)),
        'learning': law.adapting, 'compensating': loop.core.compensating,
        'using applied_control': loop.commands.trust.trusted,
        # The gap is crossed, and can be learned, only above 1.
        'excitation: swing of v / gap': swing / gap if gap > 0.0 else swing,
        'rate [Hz]': 0.0 if isnan(mean_s) or mean_s <= 0.0 else 1.0 / mean_s,
        'latency p50 [ms]': p50_ms, 'latency p99 [ms]': p99_ms,
    }


def offer_services(node: ProcessNode, joints: Sequence[Joint]) -> None:
    """Create ~/freeze_adaptation, ~/enable_compensation, ~/reset_estimates, ~/save_estimates."""
    unconfigured = 'the controller is unconfigured: configure it first'

    def offer(
        kind: type[SetBool] | type[Trigger], name: str,
        act: Callable[[ControlLoop, bool], None], done: tuple[str, str],
    ) -> None:
        """Create a service that acts on all loops. done: answers to a request for False, True."""
        def serve(request: Any, response: Any) -> Any:
            wanted = getattr(request, 'data', True)
            if node.configured:
                for joint in joints:
                    act(joint.loop, wanted)
            response.success = node.configured
            response.message = done[wanted] if node.configured else unconfigured
            node.log.info(response.message)
            return response

        node.create_service(kind, name, serve)

    async def save(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        files = [joint.p.estimates.file for joint in joints]
        if not node.configured:
            response.message = unconfigured
        elif not any(files):
            response.message = 'estimates.file is empty, so there is nowhere to save: start with ' \
                '-p estimates.file:=PATH, or set it while unconfigured'
        elif not (writings := [each for joint in joints if (each := joint.save())]):
            response.message = 'nothing was learned yet'
        else:
            for writing in writings:
                # The loop goes on while the file is written.
                written: Future = Future()
                writing.add_done_callback(written.set_result)
                await written
            why = '; '.join(filter(None, [writing.result() for writing in writings]))
            response.success = not why
            response.message = why or f'saved in {", ".join(files)}'
        return response

    offer(SetBool, '~/freeze_adaptation', lambda loop, frozen: loop.adapt(not frozen),
          ('the controller learns', 'estimates are held'))
    offer(SetBool, '~/enable_compensation', lambda loop, on: loop.compensate(on),
          ('the gap is not compensated', 'the gap is compensated'))
    offer(Trigger, '~/reset_estimates', lambda loop, _: loop.reset(),
          ('', 'the estimates are those of estimator.initial'))
    # In a group of its own, so that it does not hold up the other services.
    node.create_service(
        Trigger, '~/save_estimates', cast(Callable[..., Trigger.Response], save),
        callback_group=MutuallyExclusiveCallbackGroup(),
    )
