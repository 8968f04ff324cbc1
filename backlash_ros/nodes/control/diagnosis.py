"""What the controller says about its state in /diagnostics: figures, findings, values."""

from __future__ import annotations

import time
from math import isfinite, isnan, nan
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimates_file import was_given
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.diagnosis import LONGEST_TEXT, findings_of
from backlash_ros.core.loop.driver_period import UNKNOWN_PERIOD, Period
from backlash_ros.core.loop.figures import (
    OF_MESSAGES,
    Finding,
    Level,
    LoopFigures,
    Peer,
    TopicFigures,
)
from backlash_ros.core.loop.loop_statistics import Lately
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.run_record import stated_deviations
from backlash_ros.nodes.control.rivals import RivalWatch
from backlash_ros.nodes.runtime.driver_io import DriverIo, output_qos
from backlash_ros.nodes.runtime.messages import DEPTH, DiagnosticsPublisher
from backlash_ros.nodes.runtime.process import ProcessNode

ABSENT = 5  # messages in a row without a joint that is not there


def publishers_of(
    node: Node, topic: str, message_type: type[Any], qos: QoSProfile,
) -> TopicFigures:
    """Those who publish what the node listens to with this quality of service."""
    peers = [
        Peer(_name(info), _kind(info), _unfit(info, message_type, info.qos_profile, qos))
        for info in node.get_publishers_info_by_topic(topic)
    ]
    return TopicFigures(topic, message_type.__name__, tuple(peers))


def subscribers_of(node: Node, topic: str, message_type: type[Any]) -> TopicFigures:
    """Those who listen to what the node publishes on this topic."""
    own = node.get_fully_qualified_name()
    # As the middleware has it: rclpy keeps what was asked for, with zeros for "no limit".
    offered = [
        info.qos_profile for info in node.get_publishers_info_by_topic(topic) if _name(info) == own
    ]
    peers = [
        Peer(_name(info), _kind(info), _unfit(info, message_type, offered[0], info.qos_profile))
        for info in node.get_subscriptions_info_by_topic(topic) if offered
    ]
    return TopicFigures(topic, message_type.__name__, tuple(peers))


def _name(info: Any) -> str:
    # Programs without ROS have no node.
    if not info.node_name or info.node_name.startswith('_NODE_NAME_UNKNOWN'):
        return 'an unnamed node'
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def _kind(info: Any) -> str:
    return str(info.topic_type).rsplit('/', 1)[-1]


def _unfit(
    info: Any, message_type: type[Any], offered: QoSProfile, wanted: QoSProfile,
) -> str:
    package = message_type.__module__.split('.')[0]
    if info.topic_type != f'{package}/msg/{message_type.__name__}':
        return 'type'
    compatible, _ = qos_check_compatible(offered, wanted)
    if compatible != QoSCompatibility.ERROR:
        return ''
    unreliable = offered.reliability == ReliabilityPolicy.BEST_EFFORT \
        and wanted.reliability == ReliabilityPolicy.RELIABLE
    return 'reliability' if unreliable else 'qos'


class Diagnosis:
    """Collects what is known of a loop and its neighbours, and says what is wrong with it.

    joint: of the loop. about: what the messages are about, empty for the command. references: with
    which quality of service the controller listens to them.
    """

    def __init__(
        self, node: ProcessNode, io: DriverIo, joint: str, about: str, references: QoSProfile,
    ) -> None:
        self._node, self._io, self._joint, self._references = node, io, joint, references
        self._lately = Lately()
        self._consistent_at = time.monotonic()  # the newest look at which it was, or there was none
        self._publisher = DiagnosticsPublisher(node, about or io.publisher.topic_name, part=joint)

    def tell(
        self, loop: ControlLoop | None, p: Parameters, reference_at_s: float | None,
        rivals: RivalWatch, active: bool,
    ) -> None:
        """Publish what is going on. reference_at_s: when the newest y_m came, steady clock."""
        claim = rivals.claim
        period = UNKNOWN_PERIOD if loop is None else loop.counter.sender.newest()
        if loop is None:
            self._publisher.publish(Finding(Level.OK, 'unconfigured', 'unconfigured'), claim)
        elif not active:
            text = f'inactive: no {self._io.topics.control} is published'
            values = values_of(loop, period)
            self._publisher.publish(Finding(Level.OK, 'inactive', text), {**values, **claim})
        else:
            figures = self._figures(
                loop, p, period, reference_at_s, tuple(rival.name for rival in rivals.found)
            )
            findings = [*self._of_messages(p), *findings_of(figures)]
            finding, values = worst(findings), values_of(loop, period)
            # What is true of all joints the first one says in the log.
            speaks = self._joint == self._io.joint_names[0] or finding.kind not in OF_MESSAGES
            self._publisher.publish(
                finding, {**_details(findings, figures), **values, **claim}, logs=speaks
            )

    def _figures(
        self, loop: ControlLoop, p: Parameters, period: Period, reference_at_s: float | None,
        rivals: tuple[str, ...],
    ) -> LoopFigures:
        statistics, io, node = loop.statistics, self._io, self._node
        lately = self._lately.gained({
            'used': statistics.used, 'without_reference': statistics.without_reference,
            'lost': statistics.lost, 'unsent': statistics.unsent, 'late': loop.commands.late,
            'bad_outputs': statistics.bad_outputs,
            'bad_references': statistics.bad_references, 'limited': statistics.limited,
            'unreported': loop.commands.unreported, 'dead_workers': loop.executor.restarts,
            'wraps': statistics.wraps,
        }, time.monotonic())
        status = None if loop.last is None else loop.last.estimate.status
        if status != Status.INCONSISTENT:
            self._consistent_at = time.monotonic()
        gap = loop.estimate.c_r - loop.estimate.c_l
        timeout = p.timeout.reference
        # Hardware on topics falls silent where all joints are where they belong.
        needed = not (p.lockstep or self._io.in_joint_space)
        overdue = reference_at_s is not None and needed \
            and 0.0 < timeout < time.monotonic() - reference_at_s
        control = io.topics.control
        return LoopFigures(
            p.sample_period,
            publishers_of(node, io.topics.output, io.topics.output_type, output_qos(p, DEPTH)),
            publishers_of(
                node, io.topics.reference, io.topics.reference_type, self._references
            ),
            subscribers_of(node, control, io.topics.control_type), rivals,
            standing_down=loop.standing_down,
            status=status, inconsistent_s=time.monotonic() - self._consistent_at,
            law=loop.core.estimator.report, adapting=loop.adapting,
            given=was_given(loop.estimate),
            silent_s=p.timeout.plant_output if loop.silent else 0.0,
            on_timeout=p.on_timeout,
            referred=isfinite(loop.y_m),
            reference_silent_s=timeout if overdue else 0.0,
            # In lockstep the outputs come as fast as the machine goes.
            intervals_s=(nan, nan, nan) if p.lockstep else statistics.intervals_s(),
            period=UNKNOWN_PERIOD if p.lockstep else period,
            repeats_stamps=io.stamps.repeated,
            # Stamps of simulated time have nothing to do with the time of arrival.
            age_s=nan if p.lockstep or io.simulated_time else statistics.age_s(),
            still=statistics.still,
            v_swing=statistics.still_swing,
            gap=gap if loop.estimate.learned else nan,
            **lately,
        )

    def _of_messages(self, p: Parameters) -> list[Finding]:
        io = self._io
        if io.skipped[self._joint] < ABSENT:
            return []
        text = (
            f'{io.topics.output} has no {p.io.field} of joint {p.io.joint!r} '
            f'but {io.seen}: set io.joint, io.field'
        )
        return [Finding(Level.ERROR, 'joint', text[:LONGEST_TEXT])]


def _details(findings: list[Finding], figures: LoopFigures) -> dict[str, object]:
    """All findings, and who is on the topics where that matters."""
    details: dict[str, object] = {
        f'finding {i}': finding.text for i, finding in enumerate(findings, start=1)
    }
    for topic, what in (
        (figures.output, 'published by'), (figures.reference, 'published by'),
        (figures.control, 'heard by'),
    ):
        details[f'{topic.name} {what}'] = _names(topic.peers)
    if figures.rivals:
        details[f'{figures.control.name} also published by'] = ', '.join(figures.rivals)
    return details


def _names(peers: tuple[Peer, ...]) -> str:
    return ', '.join(
        peer.name + (f' ({peer.kind}: does not fit)' if peer.unfit else '') for peer in peers
    ) or 'nobody'


def worst(findings: list[Finding]) -> Finding:
    """The likeliest cause at the highest level that was found: that of the whole node."""
    first = next((finding for finding in findings if finding.level != Level.OK), findings[0])
    return first._replace(level=max(finding.level for finding in findings))


def counts_of(loop: ControlLoop) -> dict[str, int]:
    """Everything that was counted."""
    statistics, commands = loop.statistics, loop.commands
    return {
        'samples': statistics.used, 'lost': statistics.lost,
        'of these never sent': statistics.unsent, 'late': commands.late,
        'non-finite dropped': statistics.dropped,
        'repeated or from a second driver': statistics.extra,
        'interruptions': statistics.interruptions, 'limits hit': statistics.limited,
        'before the first reference': statistics.without_reference,
        'without applied_control': commands.unreported,
    }


def values_of(loop: ControlLoop, period: Period) -> dict[str, object]:
    """Counts, estimates and what tells how well the loop runs. period: that of the driver."""
    statistics, e = loop.statistics, loop.estimate
    gap, swing = e.c_r - e.c_l, statistics.swing()
    p50_ms, p99_ms = statistics.latencies_ms(0.5, 0.99)
    mean_s = period.mean
    if isnan(mean_s):
        _, mean_s, _ = statistics.intervals_s()
    return {
        **counts_of(loop),
        'state': e.status.word if loop.adapting else 'held',
        **_of_the_fit(loop),
        'm': e.m, 'c_r': e.c_r, 'c_l': e.c_l, 'f': e.f,
        **dict(zip(('std_m', 'std_c_r', 'std_c_l'), stated_deviations(e), strict=True)),
        'learning': loop.adapting, 'compensating': loop.compensating,
        'using applied_control': loop.commands.uses_reports,
        # Above 1 the gap is crossed, without which nothing can be learned of it.
        'excitation: swing of v / gap': swing / gap if gap > 0.0 else swing,
        'rate [Hz]': 0.0 if isnan(mean_s) or mean_s <= 0.0 else 1.0 / mean_s,
        'latency p50 [ms]': p50_ms, 'latency p99 [ms]': p99_ms,
    }


def _of_the_fit(loop: ControlLoop) -> dict[str, object]:
    """What a law that learns G knows of its own fit."""
    learned, report = loop.core.estimator.learned_model, loop.core.estimator.report
    if learned is None:
        return {}
    return {
        'noise: learned / told': report.noise_ratio,
        'unexplained motion / (m * gap)': report.unexplained,
        'samples that wait for a fit': report.waiting,
        'outliers': report.outliers,
        'commands found to be late': report.reattributed,
        'failed fits': report.failed_fits,
        'failed designs': loop.core.failed_designs,
        'processes for fits that died': loop.executor.restarts,
        'G(z)': 'as told' if _same(learned.transfer_function, loop.told) else 'learned',
    }


def _same(a: TransferFunction, b: TransferFunction) -> bool:
    return np.array_equal(a.numerator, b.numerator) \
        and np.array_equal(a.denominator, b.denominator)
