"""What the controller says about its state in /diagnostics."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from backlash_ros.core.estimation.protocol import Status
from backlash_ros.core.run_record import stated_deviations
from backlash_ros.nodes.control_loop import ControlLoop

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
Finding = tuple[bytes, str]

STATES: dict[Status, Finding] = {
    Status.ACQUIRING: (OK, 'acquiring: the estimate still moves freely'),
    Status.TRACKING: (OK, 'tracking'),
    Status.NOT_EXCITED: (
        WARN, 'frozen: v did not swing past the gap lately; move it wider',
    ),
    Status.NO_DATA: (WARN, 'frozen: plant_output is missing'),
    Status.INCONSISTENT: (
        ERROR,
        'frozen: plant_output does not follow from v through G(z) and a backlash; '
        'check the sensor, G(z), whether v is applied in time, estimator.output_noise_std '
        'and estimator.bounds',
    ),
}


def worst(findings: list[Finding]) -> Finding:
    """The highest level, and all that was found, the worst first."""
    ordered = sorted(findings, key=lambda finding: finding[0], reverse=True)
    troubles = [text for level, text in ordered if level != OK]
    return ordered[0][0], '; '.join(troubles or [ordered[0][1]])


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


def values_of(loop: ControlLoop) -> dict[str, object]:
    """Counts, estimates and what tells how well the loop runs."""
    statistics, e = loop.statistics, loop.estimate
    rate, swing = statistics.since_last_look()
    gap = e.c_r - e.c_l
    return {
        **counts_of(loop),
        'm': e.m, 'c_r': e.c_r, 'c_l': e.c_l, 'f': e.f,
        **dict(zip(('std_m', 'std_c_r', 'std_c_l'), stated_deviations(e), strict=True)),
        'learning': loop.adapting, 'compensating': loop.compensating,
        'using applied_control': loop.commands.uses_reports,
        # Above 1 the gap is crossed, without which nothing can be learned of it.
        'excitation: swing of v / gap': swing / gap if gap > 0.0 else swing,
        'rate [Hz]': rate,
        'latency p50 [ms]': statistics.latency_ms(0.5),
        'latency p99 [ms]': statistics.latency_ms(0.99),
    }
