"""Why the loop is not well: one table of conditions over what the controller has counted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite, nan
from typing import Any, NamedTuple, cast

from backlash_ros.core.estimate import Status
from backlash_ros.core.estimates_file import was_given
from backlash_ros.core.law import LawReport, OutOfBounds
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.driver_period import UNKNOWN_PERIOD, Period
from backlash_ros.core.loop.finding import Finding, Level
from backlash_ros.core.loop.loop_statistics import Counts
from backlash_ros.core.parameters import Parameters

LONGEST_TEXT = 99  # `ros2 topic echo` cuts off at 128, and a terminal line holds more besides
# Share of late, lost or bad samples from which on the loop is told to suffer from them, and an
# estimate that does not fit the data is put down to them for PATIENCE_S.
TROUBLE, PATIENCE_S = 0.01, 3.0
UNNAMED = 'a node without a name'
SKEW = 0.5  # of a period: time from stamp to arrival that only a wrong clock or a slow way explains
OK, WARN, ERROR = Level.OK, Level.WARN, Level.ERROR
LATE_KINDS = ('late', 'lost', 'unsent')
# Kinds of findings that pass by themselves as a rule.
PASSING_KINDS = frozenset((
    *LATE_KINDS, 'waiting for output', 'waiting for reference', 'unheard', 'clock',
))
# Kinds of findings about the messages, which are the same for all joints of a controller.
OF_MESSAGES = frozenset((
    'control type', 'control qos', 'rivals', 'second driver', 'second reference', 'unheard', 'rate',
    'stamps', 'clock', 'late', 'unsent', 'lost', 'unreported', 'reference silent', 'worker',
))


def short(name: str) -> str:
    """The end of a long name, so that the cure behind it is not cut off."""
    if len(name) <= 24:
        return name
    last = name.rsplit('/', 1)[-1]
    return f'…/{last}' if len(last) <= 22 else '…' + name[-23:]


class Peer(NamedTuple):
    """Another publisher or subscriber of a topic; unfit: why no message passes, empty if it does.

    kind: its message type without the package. unfit is one of '', 'type', 'reliability', 'qos'.
    """

    name: str
    kind: str
    unfit: str = ''

    def __str__(self) -> str:
        return short(self.name)


@dataclass(frozen=True)
class TopicFigures:
    """A topic of the loop: its name, the wanted type without the package, who else is on it."""

    name: str
    kind: str = 'Float64'
    peers: tuple[Peer, ...] = ()

    def __str__(self) -> str:
        return short(self.name)

    @property
    def heard(self) -> list[Peer]:
        """Those whose messages pass."""
        return [peer for peer in self.peers if not peer.unfit]

    @property
    def fits(self) -> bool:
        """Whether there is nobody whose messages do not pass."""
        return len(self.heard) == len(self.peers)

    def waiting(self, start: str) -> str:
        """Why nothing comes; start: what to do where nobody publishes it."""
        why = f'{self.heard[0]} is there but sends none' if self.heard \
            else f'nobody publishes it, {start}'
        return f'waiting for {self}: {why}'


@dataclass(kw_only=True)
class LoopFigures(Counts):
    """What the controller knows of the last few seconds; the counts are those gained in them.

    output, reference: with those who publish it. control: with those who receive it; rivals: who
    else publishes it. intervals_s: those between messages of y, low, mean and high, of which a
    tenth is shorter and longer [s], nan while they are not known. period: of the driver, by its
    stamps. repeats_stamps: whether it sends some of them twice. still: newest values of y in a row
    that are equal within its noise. v_swing: how far v has moved meanwhile, and gap, nan while it
    is not learned [unit of v].
    """

    sample_period: float
    output: TopicFigures = field(default_factory=lambda: TopicFigures('plant_output'))
    reference: TopicFigures = field(default_factory=lambda: TopicFigures('reference'))
    control: TopicFigures = field(default_factory=lambda: TopicFigures('control'))
    rivals: tuple[str, ...] = ()
    standing_down: bool = False  # because of them
    status: Status | None = None  # None before the first command
    inconsistent_s: float = 0.0  # for how long of samples that status has been INCONSISTENT
    law: LawReport = field(default_factory=LawReport)
    adapting: bool = True
    given: bool = False  # whether the estimates are taken as the parameters give them
    silent_s: float = 0.0  # timeout that has passed without y, 0 if it has not
    on_timeout: str = 'hold'
    referred: bool = True  # whether a y_m has come
    reference_silent_s: float = 0.0
    intervals_s: tuple[float, float, float] = (nan, nan, nan)
    period: Period = UNKNOWN_PERIOD
    repeats_stamps: bool = False
    age_s: float = nan  # median time from the stamp of y to its arrival, nan while not known
    dead_workers: int = 0
    still: int = 0
    v_swing: float = 0.0
    gap: float = nan

    @property
    def heard(self) -> int:
        """Samples that have come, whatever they were worth."""
        return self.used + self.without_reference + self.bad_outputs

    @property
    def is_stretched(self) -> bool:
        """Whether pauses make the period of the driver longer."""
        return self.period.is_stretched(self.sample_period, 0.01)

    @property
    def rate(self) -> float:
        """The rate of y [Hz] where it is not that of the model, else nan.

        Losses and stalls lengthen some of the intervals, messages sent twice shorten some: where
        the period is not known, the rate is wrong only if nearly all intervals are off to the same
        side by a tenth.
        """
        # From 0.5 % on, less what is not known of the period after a second.
        if self.period.differs_from(self.sample_period, 0.0045) or self.is_stretched:
            return 1.0 / self.period.mean
        low, mean, high = self.intervals_s
        off = low > 1.1 * self.sample_period or high < self.sample_period / 1.1
        return 1.0 / mean if off and mean > 0.0 else nan

    @property
    def stands_still(self) -> bool:
        """Whether y does though v moves on: in samples where the gap is known, else in time."""
        if isfinite(self.gap):
            return self.still >= 20 and self.v_swing > self.gap
        return self.still * self.sample_period >= 5.0 and self.v_swing > 0.0

    @property
    def unexplained(self) -> bool:
        """Whether so much motion is explained by nothing that it is worth naming."""
        return 0.05 <= self.law.unexplained < inf


def figures_of_loop(
    loop: ControlLoop, p: Parameters, period: Period, counts: Mapping[str, int],
) -> LoopFigures:
    """What a loop knows by itself, without those who are on its topics.

    counts: gained lately. period: of the driver.
    """
    statistics, estimate, law = loop.statistics, loop.estimate, loop.core.estimator
    lately, timeout = cast(Mapping[str, Any], counts), p.timeout.reference
    return LoopFigures(
        **lately, sample_period=p.sample_period, standing_down=loop.standing_down,
        status=estimate.status if statistics.used else None,
        inconsistent_s=statistics.inconsistent * p.sample_period,
        law=law.report, adapting=law.adapting, given=was_given(estimate),
        silent_s=p.timeout.plant_output if loop.silent else 0.0, on_timeout=p.on_timeout,
        referred=isfinite(loop.heard.y_m),
        reference_silent_s=0.0 if p.lockstep or not 0.0 < timeout < loop.unreferred_s else timeout,
        # In lockstep the outputs come as fast as the machine goes.
        intervals_s=(nan, nan, nan) if p.lockstep else statistics.intervals_s(),
        period=UNKNOWN_PERIOD if p.lockstep else period,
        age_s=nan if p.lockstep else statistics.age_s(),
        still=statistics.still, v_swing=statistics.still_swing,
        gap=estimate.c_r - estimate.c_l if estimate.learned else nan,
    )


Row = tuple[str, Level, bool, str]  # kind, level, whether it holds, text with figure and cure


def findings_of(f: LoopFigures) -> list[Finding]:
    """All that is to be said, the likeliest cause first; never empty.

    The model is blamed only where nothing else explains why y does not follow from v: an estimate
    that is held for a while because samples are late or lost is a warning about these.
    """
    causes = [_finding(row) for row in causes_of(f) if row[2]]
    kinds = {cause.kind for cause in causes}
    state = state_beside(kinds, f)
    if state.kind == 'model':
        # What the fit has found out itself says more than what is late or missing; a wrong sign
        # drives v into its limits besides, and comes of no clock.
        lesser = list(LATE_KINDS)
        if f.law.wrong_sign or f.law.coasts or f.unexplained:
            lesser += ['unreported']
        if f.law.wrong_sign:
            lesser += ['rate', 'stamps', 'clock', 'reference silent', 'limited']
        late = [cause for cause in causes if cause.kind in lesser]
        return [cause for cause in causes if cause not in late] + [state, *late]
    return [*causes, state] if state.level != OK or not causes else causes


def state_beside(causes: set[str], f: LoopFigures) -> Finding:
    """How the learning goes where causes of these kinds were found."""
    return next(_finding(row) for row in _states_beside(causes, f) if row[2])


def _finding(row: Row) -> Finding:
    kind, level, _, text = row
    # Most nodes get their name soon after they are found.
    lasting = kind in PASSING_KINDS or UNNAMED in text
    text = text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT - 1] + '…'
    return Finding(level, kind, text, lasting)


def _percent(count: int, of: int) -> str:
    return f'{100.0 * count / max(of, 1):.3g} %'


def _unheard(f: LoopFigures) -> Iterator[Row]:
    """Who is there on a topic though no message passes."""
    publish = {'output': 'set io.best_effort to true', 'reference': 'publish it reliable'}
    for role, topic in (('output', f.output), ('reference', f.reference), ('control', f.control)):
        for peer in topic.peers:
            texts = {
                'type': f'{topic} is sent as {peer.kind}, {topic.kind} is wanted: change {peer}',
                'reliability': f'{topic} is sent best effort, which does not arrive: '
                               f'{publish.get(role)}',
                'qos': f'{topic} of {peer} does not arrive: its QoS does not fit',
            } if role in publish else {
                'type': f'{topic} is a {topic.kind}, but {peer} wants {peer.kind}: change it',
                'reliability': f'{topic} does not reach {peer}: its QoS does not fit',
                'qos': f'{topic} does not reach {peer}: its QoS does not fit',
            }
            if peer.unfit:
                yield f'{role} {peer.unfit}', ERROR, True, texts[peer.unfit]


def causes_of(f: LoopFigures) -> tuple[Row, ...]:
    """The table of causes, the likeliest first."""
    y, y_m, v = f.output, f.reference, f.control
    due = f.heard + f.lost
    begins = f.status is None and f.silent_s == 0.0
    runs = f.status is not None and f.silent_s == 0.0
    late_ms, clocks = f'{1e3 * abs(f.age_s):.3g} ms', 'set both clocks (chrony, PTP)'
    return (
        *_unheard(f),
        # What comes is of no use.
        ('bad outputs', WARN if f.used else ERROR, f.bad_outputs > TROUBLE * f.heard,
         f'{_percent(f.bad_outputs, f.heard)} of {y} is no finite number: check the sensor'),
        ('bad references', WARN, f.bad_references > 0,
         f'{f.bad_references} {y_m} messages lately were no finite number: the last good one '
         'holds'),
        ('wraps', WARN, f.wraps > 0,
         f'{y} jumps by 2 pi: it is an angle that wraps: let the driver count the turns'),
        # Who else is there.
        ('rivals', ERROR, f.standing_down,
         f'standing down: {(*f.rivals, "another node")[0]} published {v} before: stop one'),
        ('rivals', ERROR, bool(f.rivals) and not f.standing_down,
         f'{1 + len(f.rivals)} publishers of {v}, also {(*f.rivals, "")[0]}: stop one'),
        ('second driver', WARN, len(y.heard) > 1,
         f'{len(y.heard)} publishers of {y}, the first one is used: stop the others'),
        ('second reference', WARN, len(y_m.heard) > 1,
         f'{y_m} is published by {", ".join(map(str, y_m.heard[:2]))}: stop all but one'),
        # What does not come.
        ('silent', WARN, f.silent_s > 0.0,
         f'no {y} for {f.silent_s:g} s: is the driver running? on_timeout: {f.on_timeout}'),
        ('waiting for output', WARN, begins and f.heard == 0 and y.fits,
         y.waiting('start the driver')),
        ('waiting for reference', WARN,
         begins and not f.referred and f.bad_references == 0 and y_m.fits,
         y_m.waiting('start one')),
        ('unheard', WARN, runs and not v.peers,
         f'nobody listens to {v}: is it the name that the driver uses?'),
        # When it comes.
        ('rate', WARN, isfinite(f.rate),
         f'{y} comes at {f.rate:.4g} Hz, sample_period is {f.sample_period:g} s '
         f'({1.0 / f.sample_period:.4g} Hz): '
         + ('is the driver held up?' if f.is_stretched else 'correct one of them')),
        ('stamps', WARN, f.repeats_stamps,
         f'{y} repeats its stamps, so the time of sending counts: stamp each message anew'),
        ('clock', WARN, abs(f.age_s) > SKEW * f.sample_period,
         f'{y} comes {late_ms} before its stamp: {clocks}' if f.age_s < 0.0
         else f'{y} comes {late_ms} after its stamp: {clocks} or shorten the way'),
        ('late', WARN, f.late > TROUBLE * f.used,
         f'{_percent(f.late, f.used)} of {v} came too late: relieve the machine or lengthen '
         'sample_period'),
        ('unsent', WARN, f.unsent > TROUBLE * due and not isfinite(f.rate),
         f'{_percent(f.unsent, due)} of {y} was never sent or much too late: is the driver held '
         'up?'),
        ('lost', WARN, f.lost - f.unsent > TROUBLE * due,
         f'{_percent(f.lost - f.unsent, due)} of {y} was lost on its way: check the network'),
        ('reference silent', WARN, f.reference_silent_s > 0.0,
         f'no {y_m} for more than {f.reference_silent_s:g} s, the last one is held: publish it '
         'every sample'),
        # What becomes of v.
        ('still', WARN, f.stands_still,
         f'{y} stands still while v swings over {f.v_swing:.3g}'
         + (f' ({f.v_swing / f.gap:.3g} gaps)' if f.gap > 0.0 else '')
         + ': check sensor, actuator, its controller'),
        ('limited', WARN, f.limited > 0.5 * f.used
         and f.status in (Status.INCONSISTENT, Status.NOT_EXCITED),
         f'v is limited in {_percent(f.limited, f.used)} of the samples: widen control.min, max or '
         'rate_max'),
        ('unreported', WARN, f.unreported > TROUBLE * f.used,
         f'{_percent(f.unreported, f.used)} of the samples came without applied_control just '
         'before them'),
        ('worker', WARN, f.dead_workers > 0,
         'the process that makes the fits died '
         + ('lately' if f.dead_workers == 1 else f'{f.dead_workers} times lately')
         + '; v is not affected: check the memory'),
    )


def _beyond(found: OutOfBounds | None) -> str:
    if found is None:
        return ''
    name, value, (low, high) = found
    return f'{name} is {value:.4g}, beyond estimator.bounds.{name} [{low:g}, {high:g}]: widen it' \
        + ('' if name == 'm' else ', or correct the zero of y')


def _states_beside(causes: set[str], f: LoopFigures) -> tuple[Row, ...]:
    """The table of states where causes of these kinds were found: the first that holds counts."""
    y, status, share = f.output, f.status, 100.0 * f.law.unexplained
    # Neither rate nor lateness turns a sign.
    held = status == Status.INCONSISTENT and not f.law.wrong_sign
    # Where a tenth is late or lost nobody can tell what else is wrong.
    many = f.late + f.lost > 0.1 * (f.heard + f.lost)
    late = not causes.isdisjoint(LATE_KINDS) and (many or f.inconsistent_s < PATIENCE_S)
    return (
        ('held', WARN, held and 'rate' in causes,
         f'{y} does not follow from v at this rate: estimates held'),
        ('held', WARN, held and late,
         f'{y} does not follow from v while samples are late or lost: estimates held'),
        # What is not there yet is among the causes; else all is about to begin.
        ('begins', OK, status is None, 'the loop begins'),
        ('given', OK, f.given and status == Status.TRACKING,
         'estimates as given: estimator.law fixed learns nothing'),
        ('adaptation off', OK, not f.adapting and status != Status.INCONSISTENT,
         'estimates held as ~/freeze_adaptation asked; v is still answered'),
        ('known', OK, f.law.unconfirmed and status == Status.ACQUIRING,
         'estimates of before hold: only a v at several speeds could confirm them'),
        ('bound', WARN, f.law.forbidden is not None and status == Status.ACQUIRING,
         _beyond(f.law.forbidden)),
        ('undecided', OK, f.law.undecided and status == Status.ACQUIRING,
         'learning: several gaps explain y alike: let v move between more than two values'),
        ('acquiring', OK, status == Status.ACQUIRING,
         'learning: the estimates still move freely'),
        ('learned', OK, status == Status.TRACKING, 'learned: the estimates agree with the data'),
        ('not excited', WARN, status == Status.NOT_EXCITED,
         'estimates held: v did not swing past the gap lately; move it wider'),
        ('no data', WARN, status == Status.NO_DATA, f'estimates held: {y} is missing'),
        ('model', ERROR, f.law.wrong_sign,
         f'{y} moves against v: reverse it, or the sign of plant.numerator'),
        ('model', ERROR, f.law.coasts,
         f'the load coasts in the gap ({share:.2g} % of m*gap): brake it, or move more slowly'),
        ('model', ERROR, f.unexplained,
         f'{share:.3g} % of m*gap of the motion of u fits no G and no backlash: check G(z), load, '
         'sensor'),
        ('model', ERROR, True,
         f'{y} does not follow from v through G(z): check G(z), the sensor, the actuator'),
    )
