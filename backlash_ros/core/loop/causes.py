"""Why the loop is not well: from what the controller has counted to causes, the likeliest first."""

from __future__ import annotations

from math import inf, isfinite, nan

from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.figures import Finding, Level, LoopFigures

LONGEST_TEXT = 99  # `ros2 topic echo` cuts off at 128, and a terminal line holds more besides
# Shares: by which the rate of y may differ from that of the model, by which pauses may stretch it,
# and by which nearly all intervals have to differ where they do not tell the period.
RATE_TOLERANCE, PAUSE_TOLERANCE, PACE_TOLERANCE = 0.005, 0.01, 0.1
# Share of late, lost or bad samples from which on the loop is told to suffer from them, and an
# estimate that does not fit the data is put down to them.
TROUBLE = 0.01
UNEXPLAINED = 0.05  # share of m times the gap from which on unexplained motion is worth naming
LIMITED = 0.5  # share of limited commands that leaves too little motion
UNNAMED = 'a node without a name'
STILL_SAMPLES = 20  # equal values of y in a row, while v moves on
SKEW = 0.5  # of a period: time from stamp to arrival that only a wrong clock or a slow way explains
# A contradiction between y and G(z) that lasts longer is not put down to late or lost samples [s].
PATIENCE_S = 3.0


def findings_of(f: LoopFigures) -> list[Finding]:
    """All that is to be said, the likeliest cause first; never empty.

    The model is blamed only where nothing else explains why y does not follow from v: an estimate
    that is held for a while because samples are late or lost is a warning about these.
    """
    causes = [
        *_unfit_peers(f), *_bad_numbers(f), *_second_senders(f), *_silence(f), *_timing(f),
        *_reference(f), *_actuator(f), *_worker(f),
    ]
    state = _state(f, causes)
    found = causes
    if state.kind == 'model':
        # What the fit has found out itself says more than reports that are missing.
        lesser = LATENESS if state == STATES[Status.INCONSISTENT] else (*LATENESS, 'unreported')
        late = [cause for cause in causes if cause.kind in lesser]
        found = [cause for cause in causes if cause not in late] + [state, *late]
    elif state.level != Level.OK or not causes:
        found = [*causes, state]
    return [finding._replace(text=_short(finding.text)) for finding in found]


STATES: dict[Status, Finding] = {
    Status.ACQUIRING: Finding(Level.OK, 'acquiring', 'learning: the estimates still move freely'),
    Status.TRACKING: Finding(Level.OK, 'learned', 'learned: the estimates agree with the data'),
    Status.NOT_EXCITED: Finding(
        Level.WARN, 'not excited',
        'estimates held: v did not swing past the gap lately; move it wider',
    ),
    Status.NO_DATA: Finding(Level.WARN, 'no data', 'estimates held: plant_output is missing'),
    Status.INCONSISTENT: Finding(
        Level.ERROR, 'model',
        'plant_output does not follow from v through G(z): check G(z), the sensor, the actuator',
    ),
}
HELD = Finding(
    Level.OK, 'adaptation off', 'estimates held as ~/freeze_adaptation asked; v is still answered'
)
KNOWN = Finding(
    Level.OK, 'known', 'estimates of before hold: only a v at several speeds could confirm them'
)
GIVEN = Finding(Level.OK, 'given', 'estimates as given: estimator.law fixed learns nothing')


def _state(f: LoopFigures, causes: list[Finding]) -> Finding:
    if f.status is None:
        # What is not there yet is among the causes; else all is about to begin.
        return Finding(Level.OK, 'begins', 'the loop begins')
    kinds = {cause.kind for cause in causes}
    # No lateness turns the sign.
    briefly = f.inconsistent_s < PATIENCE_S and not kinds.isdisjoint(LATENESS) \
        and not f.law.wrong_sign
    if f.status == Status.INCONSISTENT and (briefly or 'rate' in kinds):
        why = 'at this rate' if 'rate' in kinds else 'while samples are late or lost'
        return Finding(
            Level.WARN, 'held', f'{f.output.name} does not follow from v {why}: estimates held',
        )
    if f.given and f.status == Status.TRACKING:
        return GIVEN
    if not f.adapting and f.status != Status.INCONSISTENT:
        return HELD
    if f.law.unconfirmed and f.status == Status.ACQUIRING:
        return KNOWN
    return _contradiction(f) if f.status == Status.INCONSISTENT else STATES[f.status]


def _contradiction(f: LoopFigures) -> Finding:
    """What is known of why y does not follow from v."""
    model = STATES[Status.INCONSISTENT]
    if f.law.wrong_sign:
        return model._replace(
            text=f'{f.output.name} moves against v: reverse it, or the sign of plant.numerator'
        )
    if f.law.coasts:
        return model._replace(
            text=f'the load coasts in the gap ({100.0 * f.law.unexplained:.2g} % of m*gap): '
            'brake it, or move more slowly'
        )
    if UNEXPLAINED <= f.law.unexplained < inf:
        return model._replace(
            text=f'{100.0 * f.law.unexplained:.3g} % of m*gap of the motion of u fits no G and no '
            'backlash: check G(z), load, sensor'
        )
    return model


def _unfit_peers(f: LoopFigures) -> list[Finding]:
    """Those who are there but not heard."""
    found = []
    for topic in (f.output, f.reference):
        for peer in topic.peers:
            if peer.unfit == 'type':
                text = f'{topic.name} is sent as {peer.kind}, {topic.kind} is wanted: ' \
                       f'change {peer.name}'
            elif peer.unfit == 'reliability':
                cure = 'set io.best_effort to true' if topic is f.output else 'publish it reliable'
                text = f'{topic.name} is sent best effort, which does not arrive: {cure}'
            elif peer.unfit:
                text = f'{topic.name} of {peer.name} does not arrive: its QoS does not fit'
            else:
                continue
            found.append(Finding(Level.ERROR, f'{topic.name} {peer.unfit}', text))
    for peer in f.control.peers:
        if peer.unfit == 'type':
            found.append(Finding(
                Level.ERROR, 'control type', f'{f.control.name} is a {f.control.kind}, but '
                f'{peer.name} wants {peer.kind}: change it',
            ))
        elif peer.unfit:
            found.append(Finding(
                Level.ERROR, 'control qos',
                f'{f.control.name} does not reach {peer.name}: its QoS does not fit',
            ))
    return found


def _bad_numbers(f: LoopFigures) -> list[Finding]:
    found = []
    heard = f.heard
    if f.bad_outputs > TROUBLE * heard:
        found.append(Finding(
            Level.ERROR if f.used == 0 else Level.WARN, 'bad outputs',
            f'{_percent(f.bad_outputs, heard)} of {f.output.name} is no finite number: '
            'check the sensor',
        ))
    if f.bad_references:
        found.append(Finding(
            Level.WARN, 'bad references',
            f'{f.bad_references} {f.reference.name} messages lately were no finite number: '
            'the last good one holds',
        ))
    return found


def _second_senders(f: LoopFigures) -> list[Finding]:
    found = []
    unnamed = UNNAMED in f.rivals  # most get their name soon after they are found
    if f.standing_down:
        found.append(Finding(
            Level.ERROR, 'rivals', f'standing down: {f.rivals[0] if f.rivals else "another node"} '
            f'published {f.control.name} before: stop one', lasting=unnamed,
        ))
    elif f.rivals:
        found.append(Finding(
            Level.ERROR, 'rivals', f'{1 + len(f.rivals)} publishers of {f.control.name}, '
            f'also {f.rivals[0]}: stop one', lasting=unnamed,
        ))
    senders = len(f.output.heard)
    if senders > 1:
        found.append(Finding(
            Level.WARN, 'second driver', f'{senders} publishers of {f.output.name}, the first one '
            'is used: stop the others',
        ))
    senders = len(f.reference.heard)
    if senders > 1:
        found.append(Finding(
            Level.WARN, 'second reference', f'{f.reference.name} is published by '
            f'{", ".join(peer.name for peer in f.reference.heard)}: stop all but one',
        ))
    return found


def _silence(f: LoopFigures) -> list[Finding]:
    """What does not come, unless it is known by now why."""
    found = []
    if f.silent_s > 0.0:
        found.append(Finding(
            Level.WARN, 'silent', f'no {f.output.name} for {f.silent_s:g} s: is the driver '
            f'running? on_timeout: {f.on_timeout}',
        ))
        return found
    if f.status is None:
        for topic, missing, starter in (
            (f.output, f.heard == 0, 'start the driver'),
            (f.reference, not f.referred and f.bad_references == 0, 'start one'),
        ):
            if not missing or any(peer.unfit for peer in topic.peers):
                continue
            why = f'{topic.heard[0].name} is there but sends none' if topic.heard \
                else f'nobody publishes it, {starter}'
            found.append(Finding(
                Level.WARN, f'waiting for {topic.name}', f'waiting for {topic.name}: {why}',
                lasting=True,
            ))
    elif not f.control.peers:
        found.append(Finding(
            Level.WARN, 'unheard', f'nobody listens to {f.control.name}: is it the name that the '
            'driver uses?', lasting=True,
        ))
    return found


LATENESS = ('late', 'lost', 'unsent')


def _timing(f: LoopFigures) -> list[Finding]:
    found = []
    rate = _wrong_rate(f)
    if isfinite(rate):
        stretched = f.period.is_stretched(f.sample_period, PAUSE_TOLERANCE)
        cure = 'is the driver held up?' if stretched else 'correct one of them'
        found.append(Finding(
            Level.WARN, 'rate', f'{f.output.name} comes at {rate:.4g} Hz, sample_period is '
            f'{f.sample_period:g} s ({1.0 / f.sample_period:.4g} Hz): {cure}',
        ))
    if f.repeats_stamps:
        found.append(Finding(
            Level.WARN, 'stamps', f'{f.output.name} repeats its stamps, so the time of sending '
            'counts: stamp each message anew',
        ))
    if abs(f.age_s) > SKEW * f.sample_period:
        age = f'{1e3 * abs(f.age_s):.3g} ms'
        cure = 'set both clocks (chrony, PTP)'
        found.append(Finding(
            Level.WARN, 'clock', f'{f.output.name} comes {age} before its stamp: {cure}'
            if f.age_s < 0.0 else
            f'{f.output.name} comes {age} after its stamp: {cure} or shorten the way', lasting=True,
        ))
    if f.late > TROUBLE * f.used:
        found.append(Finding(
            Level.WARN, 'late', f'{_percent(f.late, f.used)} of {f.control.name} came too late: '
            'relieve the machine or lengthen sample_period', lasting=True,
        ))
    due = f.heard + f.lost
    if f.unsent > TROUBLE * due and not any(finding.kind == 'rate' for finding in found):
        found.append(Finding(
            Level.WARN, 'unsent', f'{_percent(f.unsent, due)} of {f.output.name} was never sent '
            'or much too late: is the driver held up?', lasting=True,
        ))
    if f.lost - f.unsent > TROUBLE * due:
        found.append(Finding(
            Level.WARN, 'lost', f'{_percent(f.lost - f.unsent, due)} of {f.output.name} was lost '
            'on its way: check the network', lasting=True,
        ))
    return found


def _wrong_rate(f: LoopFigures) -> float:
    """The rate of y [Hz] where it is not that of the model, else nan.

    Losses and stalls lengthen some of the intervals, messages sent twice shorten some: where the
    period is not known, the rate is wrong only if nearly all intervals are off to the same side.
    """
    if f.period.differs_from(f.sample_period, RATE_TOLERANCE) \
            or f.period.is_stretched(f.sample_period, PAUSE_TOLERANCE):
        return 1.0 / f.period.mean
    low, mean, high = f.intervals_s
    slow = low > (1.0 + PACE_TOLERANCE) * f.sample_period
    fast = high < f.sample_period / (1.0 + PACE_TOLERANCE)
    return 1.0 / mean if (slow or fast) and mean > 0.0 else nan


def _reference(f: LoopFigures) -> list[Finding]:
    if f.reference_silent_s <= 0.0:
        return []
    return [Finding(
        Level.WARN, 'reference silent', f'no {f.reference.name} for more than '
        f'{f.reference_silent_s:g} s, the last one is held: publish it every sample',
    )]


def _actuator(f: LoopFigures) -> list[Finding]:
    found = []
    if f.still >= STILL_SAMPLES and f.v_swing > 1.0:
        found.append(Finding(
            Level.WARN, 'still', f'{f.output.name} stands still while v swings over '
            f'{f.v_swing:.3g} gaps: check sensor and actuator',
        ))
    held = f.status in (Status.INCONSISTENT, Status.NOT_EXCITED)
    if held and f.limited > LIMITED * f.used:
        found.append(Finding(
            Level.WARN, 'limited', f'v is limited in {_percent(f.limited, f.used)} of the samples: '
            'widen control.min, max or rate_max',
        ))
    if f.unreported > TROUBLE * f.used:
        found.append(Finding(
            Level.WARN, 'unreported', f'{_percent(f.unreported, f.used)} of the samples came '
            'without applied_control just before them',
        ))
    return found


def _worker(f: LoopFigures) -> list[Finding]:
    if not f.dead_workers:
        return []
    died = 'died lately' if f.dead_workers == 1 else f'died {f.dead_workers} times lately'
    return [Finding(
        Level.WARN, 'worker', f'the process that makes the fits {died}; v is not affected: '
        'check the memory',
    )]


def _percent(count: int, of: int) -> str:
    return f'{100.0 * count / max(of, 1):.3g} %'


def _short(text: str) -> str:
    return text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT - 1] + '…'
