"""Why the loop is not well: one table of conditions over what the controller has counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import inf, isfinite, nan
from typing import NamedTuple

from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.figures import Finding, Level, LoopFigures, Peer, TopicFigures

LONGEST_TEXT = 99  # `ros2 topic echo` cuts off at 128, and a terminal line holds more besides
LONGEST_NAME = 24  # of a topic or node within a text, so that its cure is not cut off
# Shares: by which the rate of y may differ from that of the model, by which pauses may stretch it,
# and by which nearly all intervals have to differ where they do not tell the period.
RATE_TOLERANCE, PAUSE_TOLERANCE, PACE_TOLERANCE = 0.005, 0.01, 0.1
# Share of late, lost or bad samples from which on the loop is told to suffer from them, and an
# estimate that does not fit the data is put down to them.
TROUBLE = 0.01
UNEXPLAINED = 0.05  # share of m times the gap from which on unexplained motion is worth naming
LIMITED = 0.5  # share of limited commands that leaves too little motion
UNNAMED = 'a node without a name'
# Equal values of y in a row while v moves on: samples where the gap is known, time where it is not.
STILL_SAMPLES, STILL_S = 20, 5.0
SKEW = 0.5  # of a period: time from stamp to arrival that only a wrong clock or a slow way explains
# A contradiction between y and G(z) that lasts longer is not put down to late or lost samples [s].
PATIENCE_S = 3.0
LATENESS = ('late', 'lost', 'unsent')


class Rule(NamedTuple):
    """A line of the table: what is said at which level where the condition holds.

    kind: the same word for the same cause. text: with the figure and the cure. lasting: as in
    Finding.
    """

    kind: str
    level: Level | Callable[[LoopFigures], Level]
    holds: Callable[[LoopFigures], bool]
    text: Callable[[LoopFigures], str]
    lasting: bool | Callable[[LoopFigures], bool] = False


def findings_of(f: LoopFigures) -> list[Finding]:
    """All that is to be said, the likeliest cause first; never empty.

    The model is blamed only where nothing else explains why y does not follow from v: an estimate
    that is held for a while because samples are late or lost is a warning about these.
    """
    causes = [_finding(rule, f) for rule in CAUSES if rule.holds(f)]
    kinds = {cause.kind for cause in causes}
    state = next(_finding(rule, f) for rule in states_beside(kinds) if rule.holds(f))
    if state.kind == 'model':
        # What the fit has found out itself says more than reports that are missing.
        explained = f.law.wrong_sign or f.law.coasts or _is_unexplained(f)
        lesser = (*LATENESS, 'unreported') if explained else LATENESS
        late = [cause for cause in causes if cause.kind in lesser]
        return [cause for cause in causes if cause not in late] + [state, *late]
    return [*causes, state] if state.level != Level.OK or not causes else causes


def _finding(rule: Rule, f: LoopFigures) -> Finding:
    level, lasting, text = rule.level, rule.lasting, rule.text(f)
    if len(text) > LONGEST_TEXT:
        text = text[:LONGEST_TEXT - 1] + '…'
    return Finding(
        level(f) if callable(level) else level, rule.kind, text,
        lasting(f) if callable(lasting) else lasting,
    )


def _percent(count: int, of: int) -> str:
    return f'{100.0 * count / max(of, 1):.3g} %'


def _name(of: TopicFigures | Peer | str) -> str:
    """A name that leaves room for the rest of a text: the end of a long one."""
    name = of if isinstance(of, str) else of.name
    if len(name) <= LONGEST_NAME:
        return name
    last = name.rsplit('/', 1)[-1]
    return f'…/{last}' if len(last) <= LONGEST_NAME - 2 else '…' + name[1 - LONGEST_NAME:]


def _unfit_rules(role: str, reason: str, text: Callable[[LoopFigures, Peer], str]) -> Rule:
    """Somebody is there on a topic, but no message passes; role: a topic of LoopFigures."""
    def unfit(f: LoopFigures) -> list[Peer]:
        return [peer for peer in getattr(f, role).peers if peer.unfit == reason]

    return Rule(
        f'{role} {reason}', Level.ERROR, lambda f: bool(unfit(f)), lambda f: text(f, unfit(f)[0])
    )


def _rate(f: LoopFigures) -> float:
    """The rate of y [Hz] where it is not that of the model, else nan.

    Losses and stalls lengthen some of the intervals, messages sent twice shorten some: where the
    period is not known, the rate is wrong only if nearly all intervals are off to the same side.
    """
    if f.period.differs_from(f.sample_period, RATE_TOLERANCE) or _is_stretched(f):
        return 1.0 / f.period.mean
    low, mean, high = f.intervals_s
    slow = low > (1.0 + PACE_TOLERANCE) * f.sample_period
    fast = high < f.sample_period / (1.0 + PACE_TOLERANCE)
    return 1.0 / mean if (slow or fast) and mean > 0.0 else nan


def _is_stretched(f: LoopFigures) -> bool:
    return f.period.is_stretched(f.sample_period, PAUSE_TOLERANCE)


def _stands_still(f: LoopFigures) -> bool:
    if isfinite(f.gap):
        return f.still >= STILL_SAMPLES and f.v_swing > f.gap
    return f.still * f.sample_period >= STILL_S and f.v_swing > 0.0


def _is_unexplained(f: LoopFigures) -> bool:
    return UNEXPLAINED <= f.law.unexplained < inf


def _waits_for(f: LoopFigures, topic: TopicFigures, missing: bool) -> bool:
    return f.status is None and f.silent_s == 0.0 and missing \
        and not any(peer.unfit for peer in topic.peers)


def _waiting(topic: TopicFigures, start: str) -> str:
    why = f'{_name(topic.heard[0])} is there but sends none' if topic.heard \
        else f'nobody publishes it, {start}'
    return f'waiting for {_name(topic)}: {why}'


def _age(f: LoopFigures) -> str:
    age, cure = f'{1e3 * abs(f.age_s):.3g} ms', 'set both clocks (chrony, PTP)'
    if f.age_s < 0.0:
        return f'{_name(f.output)} comes {age} before its stamp: {cure}'
    return f'{_name(f.output)} comes {age} after its stamp: {cure} or shorten the way'


def _due(f: LoopFigures) -> int:
    return f.heard + f.lost


CAUSES: tuple[Rule, ...] = (
    # Who is there but not heard.
    _unfit_rules('output', 'type', lambda f, peer: f'{_name(f.output)} is sent as {peer.kind}, '
                 f'{f.output.kind} is wanted: change {_name(peer)}'),
    _unfit_rules('output', 'reliability', lambda f, peer: f'{_name(f.output)} is sent best effort, '
                 'which does not arrive: set io.best_effort to true'),
    _unfit_rules('output', 'qos', lambda f, peer: f'{_name(f.output)} of {_name(peer)} does not '
                 'arrive: its QoS does not fit'),
    _unfit_rules('reference', 'type', lambda f, peer: f'{_name(f.reference)} is sent as '
                 f'{peer.kind}, {f.reference.kind} is wanted: change {_name(peer)}'),
    _unfit_rules('reference', 'reliability', lambda f, peer: f'{_name(f.reference)} is sent best '
                 'effort, which does not arrive: publish it reliable'),
    _unfit_rules('reference', 'qos', lambda f, peer: f'{_name(f.reference)} of {_name(peer)} does '
                 'not arrive: its QoS does not fit'),
    _unfit_rules('control', 'type', lambda f, peer: f'{_name(f.control)} is a {f.control.kind}, '
                 f'but {_name(peer)} wants {peer.kind}: change it'),
    _unfit_rules('control', 'qos', lambda f, peer: f'{_name(f.control)} does not reach '
                 f'{_name(peer)}: its QoS does not fit'),
    _unfit_rules('control', 'reliability', lambda f, peer: f'{_name(f.control)} does not reach '
                 f'{_name(peer)}: its QoS does not fit'),
    # What comes is of no use.
    Rule(
        'bad outputs', lambda f: Level.ERROR if f.used == 0 else Level.WARN,
        lambda f: f.bad_outputs > TROUBLE * f.heard,
        lambda f: f'{_percent(f.bad_outputs, f.heard)} of {_name(f.output)} is no finite number: '
        'check the sensor',
    ),
    Rule(
        'bad references', Level.WARN, lambda f: f.bad_references > 0,
        lambda f: f'{f.bad_references} {_name(f.reference)} messages lately were no finite number: '
        'the last good one holds',
    ),
    Rule(
        'wraps', Level.WARN, lambda f: f.wraps > 0,
        lambda f: f'{_name(f.output)} jumps by 2 pi: it is an angle that wraps: let the driver '
        'count the turns',
    ),
    # Who else is there.
    Rule(
        'rivals', Level.ERROR, lambda f: f.standing_down,
        lambda f: f'standing down: {f.rivals[0] if f.rivals else "another node"} published '
        f'{_name(f.control)} before: stop one',
        lambda f: UNNAMED in f.rivals,  # most get their name soon after they are found
    ),
    Rule(
        'rivals', Level.ERROR, lambda f: bool(f.rivals) and not f.standing_down,
        lambda f: f'{1 + len(f.rivals)} publishers of {_name(f.control)}, also {f.rivals[0]}: '
        'stop one',
        lambda f: UNNAMED in f.rivals,
    ),
    Rule(
        'second driver', Level.WARN, lambda f: len(f.output.heard) > 1,
        lambda f: f'{len(f.output.heard)} publishers of {_name(f.output)}, the first one is used: '
        'stop the others',
    ),
    Rule(
        'second reference', Level.WARN, lambda f: len(f.reference.heard) > 1,
        lambda f: f'{_name(f.reference)} is published by '
        f'{", ".join(_name(peer) for peer in f.reference.heard[:2])}: stop all but one',
    ),
    # What does not come.
    Rule(
        'silent', Level.WARN, lambda f: f.silent_s > 0.0,
        lambda f: f'no {_name(f.output)} for {f.silent_s:g} s: is the driver running? '
        f'on_timeout: {f.on_timeout}',
    ),
    Rule(
        'waiting for output', Level.WARN, lambda f: _waits_for(f, f.output, f.heard == 0),
        lambda f: _waiting(f.output, 'start the driver'), lasting=True,
    ),
    Rule(
        'waiting for reference', Level.WARN,
        lambda f: _waits_for(f, f.reference, not f.referred and f.bad_references == 0),
        lambda f: _waiting(f.reference, 'start one'), lasting=True,
    ),
    Rule(
        'unheard', Level.WARN,
        lambda f: f.status is not None and f.silent_s == 0.0 and not f.control.peers,
        lambda f: f'nobody listens to {_name(f.control)}: is it the name that the driver uses?',
        lasting=True,
    ),
    # When it comes.
    Rule(
        'rate', Level.WARN, lambda f: isfinite(_rate(f)),
        lambda f: f'{_name(f.output)} comes at {_rate(f):.4g} Hz, sample_period is '
        f'{f.sample_period:g} s ({1.0 / f.sample_period:.4g} Hz): '
        + ('is the driver held up?' if _is_stretched(f) else 'correct one of them'),
    ),
    Rule(
        'stamps', Level.WARN, lambda f: f.repeats_stamps,
        lambda f: f'{_name(f.output)} repeats its stamps, so the time of sending counts: stamp '
        'each message anew',
    ),
    Rule('clock', Level.WARN, lambda f: abs(f.age_s) > SKEW * f.sample_period, _age, lasting=True),
    Rule(
        'late', Level.WARN, lambda f: f.late > TROUBLE * f.used,
        lambda f: f'{_percent(f.late, f.used)} of {_name(f.control)} came too late: relieve the '
        'machine or lengthen sample_period', lasting=True,
    ),
    Rule(
        'unsent', Level.WARN,
        lambda f: f.unsent > TROUBLE * _due(f) and not isfinite(_rate(f)),
        lambda f: f'{_percent(f.unsent, _due(f))} of {_name(f.output)} was never sent or much too '
        'late: is the driver held up?', lasting=True,
    ),
    Rule(
        'lost', Level.WARN, lambda f: f.lost - f.unsent > TROUBLE * _due(f),
        lambda f: f'{_percent(f.lost - f.unsent, _due(f))} of {_name(f.output)} was lost on its '
        'way: check the network', lasting=True,
    ),
    Rule(
        'reference silent', Level.WARN, lambda f: f.reference_silent_s > 0.0,
        lambda f: f'no {_name(f.reference)} for more than {f.reference_silent_s:g} s, the last one '
        'is held: publish it every sample',
    ),
    # What becomes of v.
    Rule(
        'still', Level.WARN, _stands_still,
        lambda f: f'{_name(f.output)} stands still while v swings over {f.v_swing:.3g}'
        + (f' ({f.v_swing / f.gap:.3g} gaps)' if f.gap > 0.0 else '')
        + ': check sensor, actuator, its controller',
    ),
    Rule(
        'limited', Level.WARN,
        lambda f: f.status in (Status.INCONSISTENT, Status.NOT_EXCITED)
        and f.limited > LIMITED * f.used,
        lambda f: f'v is limited in {_percent(f.limited, f.used)} of the samples: widen '
        'control.min, max or rate_max',
    ),
    Rule(
        'unreported', Level.WARN, lambda f: f.unreported > TROUBLE * f.used,
        lambda f: f'{_percent(f.unreported, f.used)} of the samples came without applied_control '
        'just before them',
    ),
    Rule(
        'worker', Level.WARN, lambda f: f.dead_workers > 0,
        lambda f: 'the process that makes the fits died '
        + ('lately' if f.dead_workers == 1 else f'{f.dead_workers} times lately')
        + '; v is not affected: check the memory',
    ),
)


def _is(*statuses: Status) -> Callable[[LoopFigures], bool]:
    return lambda f: f.status in statuses


# The first one that holds is the state of the loop.
STATES: tuple[Rule, ...] = (
    # What is not there yet is among the causes; else all is about to begin.
    Rule('begins', Level.OK, lambda f: f.status is None, lambda f: 'the loop begins'),
    Rule(
        'given', Level.OK, lambda f: f.given and f.status == Status.TRACKING,
        lambda f: 'estimates as given: estimator.law fixed learns nothing',
    ),
    Rule(
        'adaptation off', Level.OK,
        lambda f: not f.adapting and f.status != Status.INCONSISTENT,
        lambda f: 'estimates held as ~/freeze_adaptation asked; v is still answered',
    ),
    Rule(
        'known', Level.OK, lambda f: f.law.unconfirmed and f.status == Status.ACQUIRING,
        lambda f: 'estimates of before hold: only a v at several speeds could confirm them',
    ),
    Rule(
        'acquiring', Level.OK, _is(Status.ACQUIRING),
        lambda f: 'learning: the estimates still move freely',
    ),
    Rule(
        'learned', Level.OK, _is(Status.TRACKING),
        lambda f: 'learned: the estimates agree with the data',
    ),
    Rule(
        'not excited', Level.WARN, _is(Status.NOT_EXCITED),
        lambda f: 'estimates held: v did not swing past the gap lately; move it wider',
    ),
    Rule(
        'no data', Level.WARN, _is(Status.NO_DATA),
        lambda f: f'estimates held: {_name(f.output)} is missing',
    ),
    Rule(
        'model', Level.ERROR, lambda f: f.law.wrong_sign,
        lambda f: f'{_name(f.output)} moves against v: reverse it, or the sign of plant.numerator',
    ),
    Rule(
        'model', Level.ERROR, lambda f: f.law.coasts,
        lambda f: f'the load coasts in the gap ({100.0 * f.law.unexplained:.2g} % of m*gap): '
        'brake it, or move more slowly',
    ),
    Rule(
        'model', Level.ERROR, _is_unexplained,
        lambda f: f'{100.0 * f.law.unexplained:.3g} % of m*gap of the motion of u fits no G and no '
        'backlash: check G(z), load, sensor',
    ),
    Rule(
        'model', Level.ERROR, lambda f: True,
        lambda f: f'{_name(f.output)} does not follow from v through G(z): check G(z), the sensor, '
        'the actuator',
    ),
)
HELD_AT_THIS_RATE = Rule(
    'held', Level.WARN, _is(Status.INCONSISTENT),
    lambda f: f'{_name(f.output)} does not follow from v at this rate: estimates held',
)
HELD_WHILE_LATE = Rule(
    # No lateness turns the sign.
    'held', Level.WARN,
    lambda f: f.status == Status.INCONSISTENT and f.inconsistent_s < PATIENCE_S
    and not f.law.wrong_sign,
    lambda f: f'{_name(f.output)} does not follow from v while samples are late or lost: '
    'estimates held',
)


def states_beside(causes: set[str]) -> Iterator[Rule]:
    """The rules of the state where causes of these kinds have been found."""
    if 'rate' in causes:
        yield HELD_AT_THIS_RATE
    if not causes.isdisjoint(LATENESS):
        yield HELD_WHILE_LATE
    yield from STATES
