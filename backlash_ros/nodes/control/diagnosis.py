"""What the controller says about a loop in /diagnostics: figures, findings, values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import isnan, nan
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.diagnosis import (
    LONGEST_TEXT,
    LoopFigures,
    Peer,
    TopicFigures,
    figures_of_loop,
)
from backlash_ros.core.loop.driver_period import Period
from backlash_ros.core.loop.finding import Finding, Level
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import stated_deviations
from backlash_ros.nodes.control.rivals import name_of
from backlash_ros.nodes.runtime.driver_io import DriverIo, output_qos
from backlash_ros.nodes.runtime.messages import DEPTH

# What was counted, as /diagnostics and the last line of the log call it.
COUNTS = {
    'samples': 'used', 'lost': 'lost', 'of these never sent': 'unsent', 'late': 'late',
    'non-finite dropped': 'dropped', 'repeated, too early or from a second driver': 'extra',
    'interruptions': 'interruptions', 'limits hit': 'limited',
    'before the first reference': 'without_reference', 'without applied_control': 'unreported',
}


def publishers_of(node: Node, topic: str, message_type: type[Any], qos: QoSProfile) -> TopicFigures:
    """Those who publish what the node listens to with this quality of service."""
    return TopicFigures(topic, message_type.__name__, tuple(
        _peer(info, message_type, info.qos_profile, qos)
        for info in node.get_publishers_info_by_topic(topic)
    ))


def subscribers_of(node: Node, topic: str, message_type: type[Any]) -> TopicFigures:
    """Those who listen to what the node publishes on this topic."""
    own = node.get_fully_qualified_name()
    # As the middleware has it: rclpy keeps what was asked for, with zeros for "no limit".
    offered = [
        info.qos_profile for info in node.get_publishers_info_by_topic(topic)
        if name_of(info) == own
    ]
    return TopicFigures(topic, message_type.__name__, tuple(
        _peer(info, message_type, offered[0], info.qos_profile)
        for info in node.get_subscriptions_info_by_topic(topic) if offered
    ))


def _peer(
    info: TopicEndpointInfo, message_type: type[Any], offered: QoSProfile, wanted: QoSProfile,
) -> Peer:
    package, unfit = message_type.__module__.split('.')[0], ''
    if info.topic_type != f'{package}/msg/{message_type.__name__}':
        unfit = 'type'
    elif qos_check_compatible(offered, wanted)[0] == QoSCompatibility.ERROR:
        unreliable = offered.reliability == ReliabilityPolicy.BEST_EFFORT \
            and wanted.reliability == ReliabilityPolicy.RELIABLE
        unfit = 'reliability' if unreliable else 'qos'
    return Peer(name_of(info), str(info.topic_type).rsplit('/', 1)[-1], unfit)


def figures_of(
    node: Node, io: DriverIo, loop: ControlLoop, p: Parameters, period: Period,
    counts: Mapping[str, int], rivals: tuple[str, ...],
) -> LoopFigures:
    """What is known of a loop and its neighbours.

    counts: gained lately. period: of the driver.
    """
    to, figures = io.topics, figures_of_loop(loop, p, period, counts)
    if io.simulated_time:
        # Stamps of simulated time have nothing to do with the time of arrival.
        figures.age_s = nan
    if p.io.style == 'joint_state_topic':
        # Hardware on topics falls silent where all joints are where they belong.
        figures.reference_silent_s = 0.0
    return replace(
        figures, rivals=rivals, repeats_stamps=io.stamps.repeated,
        output=publishers_of(node, to.output, to.output_type, output_qos(p, DEPTH)),
        reference=publishers_of(node, to.reference, to.reference_type, io.reference_qos),
        control=subscribers_of(node, to.control, to.control_type),
    )


def missing_joint(io: DriverIo, joint: str, p: Parameters) -> list[Finding]:
    """What is said of a joint that the messages of the driver do not name."""
    if io.skipped[joint] < 5:
        return []
    text = f'{io.topics.output} has no {p.io.field} of joint {p.io.joint!r} but {io.seen}: ' \
        'set io.joint, io.field'
    return [Finding(Level.ERROR, 'joint', text[:LONGEST_TEXT])]


def details_of(findings: list[Finding], figures: LoopFigures) -> dict[str, object]:
    """All findings, and who is on the topics where that matters."""
    details: dict[str, object] = {
        f'finding {i}': finding.text for i, finding in enumerate(findings, start=1)
    }
    for topic, what in (
        (figures.output, 'published by'), (figures.reference, 'published by'),
        (figures.control, 'heard by'),
    ):
        details[f'{topic.name} {what}'] = ', '.join(
            peer.name + (f' ({peer.kind}: does not fit)' if peer.unfit else '')
            for peer in topic.peers
        ) or 'nobody'
    if figures.rivals:
        details[f'{figures.control.name} also published by'] = ', '.join(figures.rivals)
    return details


def worst(findings: list[Finding]) -> Finding:
    """The likeliest cause at the highest level that was found: that of the whole node."""
    first = next((finding for finding in findings if finding.level != Level.OK), findings[0])
    return first._replace(level=max(finding.level for finding in findings))


def counts_of(loop: ControlLoop) -> dict[str, int]:
    """Everything that was counted."""
    return {label: getattr(loop.statistics, name) for label, name in COUNTS.items()}


def values_of(loop: ControlLoop, period: Period) -> dict[str, object]:
    """Counts, estimates and what tells how well the loop runs. period: that of the driver."""
    statistics, e, law = loop.statistics, loop.estimate, loop.core.estimator
    gap, swing = e.c_r - e.c_l, statistics.swing()
    p50_ms, p99_ms = statistics.latencies_ms(0.5, 0.99)
    mean_s = statistics.intervals_s()[1] if isnan(period.mean) else period.mean
    values: dict[str, object] = {
        **counts_of(loop), 'state': e.status.word if law.adapting else 'held',
    }
    if law.learned_model is not None:
        learned, nominal, report = law.learned_model.transfer_function, loop.nominal, law.report
        same = np.array_equal(learned.numerator, nominal.numerator) \
            and np.array_equal(learned.denominator, nominal.denominator)
        values |= {
            'noise: learned / told': report.noise_ratio,
            'unexplained motion / (m * gap)': report.unexplained,
            'samples that wait for a fit': report.waiting,
            'outliers': report.outliers,
            'commands found to be late': report.reattributed,
            'failed fits': report.failed_fits,
            'failed designs': loop.core.redesign.failed if loop.core.redesign else 0,
            'processes for fits that died': loop.executor.restarts,
            'G(z)': 'as told' if same else 'learned',
        }
    return values | {
        'm': e.m, 'c_r': e.c_r, 'c_l': e.c_l, 'f': e.f,
        **dict(zip(('std_m', 'std_c_r', 'std_c_l'), stated_deviations(e), strict=True)),
        'learning': law.adapting, 'compensating': loop.core.compensating,
        'using applied_control': loop.commands.trust.trusted,
        # Above 1 the gap is crossed, without which nothing can be learned of it.
        'excitation: swing of v / gap': swing / gap if gap > 0.0 else swing,
        'rate [Hz]': 0.0 if isnan(mean_s) or mean_s <= 0.0 else 1.0 / mean_s,
        'latency p50 [ms]': p50_ms, 'latency p99 [ms]': p99_ms,
    }
