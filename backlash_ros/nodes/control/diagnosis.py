"""What the controller says about its loops in /diagnostics: who is there, findings, values."""

from __future__ import annotations

from math import isnan
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.diagnosis import (
    LONGEST_TEXT,
    Finding,
    Level,
    Neighbours,
    Peer,
    TopicFigures,
)
from backlash_ros.core.loop.sample_counter import Timing
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import stated_deviations
from backlash_ros.nodes.control.rivals import name_of
from backlash_ros.nodes.runtime.driver_io import DriverIo, output_qos
from backlash_ros.nodes.runtime.messages import DEPTH


def neighbours_of(node: Node, io: DriverIo, p: Parameters, rivals: tuple[str, ...]) -> Neighbours:
    """Who is on the topics of the controller. rivals: who else publishes v."""
    to, own, publishers = io.topics, node.get_fully_qualified_name(), \
        node.get_publishers_info_by_topic
    # As the middleware has it: rclpy keeps what was asked for, with zeros for "no limit".
    offered = [i.qos_profile for i in publishers(to.control) if name_of(i) == own]
    heard = node.get_subscriptions_info_by_topic(to.control) if offered else []
    return Neighbours(
        _figures(to.output, to.output_type, publishers(to.output), wanted=output_qos(p, DEPTH)),
        _figures(to.reference, to.reference_type, publishers(to.reference),
                 wanted=io.reference_qos),
        _figures(to.control, to.control_type, heard, *offered[:1]), rivals,
    )


def _figures(
    topic: str, message_type: type[Any], infos: list[TopicEndpointInfo],
    offered: QoSProfile | None = None, wanted: QoSProfile | None = None,
) -> TopicFigures:
    """Who is on a topic, and what the node itself offers to them or wants of them."""
    wanted_type = f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}'

    def peer(info: TopicEndpointInfo) -> Peer:
        offers, wants, unfit = offered or info.qos_profile, wanted or info.qos_profile, ''
        if info.topic_type != wanted_type:
            unfit = 'type'
        elif qos_check_compatible(offers, wants)[0] == QoSCompatibility.ERROR:
            unreliable = offers.reliability == ReliabilityPolicy.BEST_EFFORT \
                and wants.reliability == ReliabilityPolicy.RELIABLE
            unfit = 'reliability' if unreliable else 'qos'
        return Peer(name_of(info), str(info.topic_type).rsplit('/', 1)[-1], unfit)

    return TopicFigures(topic, message_type.__name__, tuple(map(peer, infos)))


def missing_joint(io: DriverIo, joint: str, p: Parameters) -> list[Finding]:
    """What is said of a joint that the messages of the driver do not name."""
    if io.skipped[joint] < 5:
        return []
    text = f'{io.topics.output} has no {p.io.field} of joint {p.io.joint!r} but {io.seen}: ' \
        'set io.joint, io.field'
    return [Finding(Level.ERROR, 'joint', text[:LONGEST_TEXT])]


def details_of(findings: list[Finding], around: Neighbours) -> dict[str, object]:
    """All findings, and who is on the topics where that matters."""
    details: dict[str, object] = {f'finding {i}': each.text for i, each in enumerate(findings, 1)}
    for topic, what in zip(around[:3], ('published', 'published', 'heard'), strict=True):
        details[f'{topic.name} {what} by'] = ', '.join(
            peer.name + (f' ({peer.kind}: does not fit)' if peer.unfit else '')
            for peer in topic.peers
        ) or 'nobody'
    if around.rivals:
        details[f'{around.control.name} also published by'] = ', '.join(around.rivals)
    return details


def counts_of(loop: ControlLoop) -> dict[str, int]:
    """What was counted, as /diagnostics and the last line of the log call it."""
    n = loop.statistics
    return {
        'samples': n.used, 'lost': n.lost, 'of these never sent': n.unsent, 'late': n.late,
        'non-finite dropped': n.dropped,
        'repeated, too early or from a second driver': n.extra,
        'interruptions': n.interruptions, 'limits hit': n.limited,
        'before the first reference': n.without_reference, 'without applied_control': n.unreported,
    }


def values_of(loop: ControlLoop, timing: Timing) -> dict[str, object]:
    """Counts, estimates and what tells how well the loop runs."""
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
        # Above 1 the gap is crossed, without which nothing can be learned of it.
        'excitation: swing of v / gap': swing / gap if gap > 0.0 else swing,
        'rate [Hz]': 0.0 if isnan(mean_s) or mean_s <= 0.0 else 1.0 / mean_s,
        'latency p50 [ms]': p50_ms, 'latency p99 [ms]': p99_ms,
    }
