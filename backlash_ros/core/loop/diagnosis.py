"""Why the loop is not well: one table of conditions over what the controller has counted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import inf, isfinite, nan
from typing import NamedTuple

from backlash_ros.core.estimate import Status
from backlash_ros.core.law import LawReport
from backlash_ros.core.loop.driver_period import UNKNOWN_PERIOD, Period
from backlash_ros.core.loop.finding import Finding, Level
from backlash_ros.core.loop.loop_statistics import Counts

LONGEST_TEXT = 99  # `ros2 topic echo` cuts off at 128, and a terminal line holds more besides
# Share of late, lost or bad samples from which on the loop is told to suffer from them, and an
# estimate that does not fit the data is put down to them for PATIENCE_S.
TROUBLE, PATIENCE_S = 0.01, 3.0
UNNAMED = 'a node without a name'
SKEW = 0.5  # of a period: time from stamp to arrival that only a wrong clock or a slow way explains
LATENESS = ('late', 'lost', 'unsent')
OK, WARN, ERROR = Level.OK, Level.WARN, Level.ERROR
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
    def due(self) -> int:
        """Samples that should have come."""
        return self.heard + self.lost

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
        if self.period.differs_from(self.sample_period, 0.005) or self.is_stretched:
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

    def waits_for(self, topic: TopicFigures, missing: bool) -> bool:
        """Whether the loop cannot begin because a topic that fits says nothing."""
        return self.status is None and self.silent_s == 0.0 and missing \
            and not any(peer.unfit for peer in topic.peers)


Condition = Callable[[LoopFigures], bool]
Text = Callable[[LoopFigures], str]


class Rule(NamedTuple):
    """A line of the table: what is said at which level where the condition holds.

    kind and lasting: as in Finding. text: with the figure and the cure.
    """

    kind: str
    level: Level
    holds: Condition
    text: Text
    lasting: bool = False

    def finding(self, f: LoopFigures) -> Finding:
        """What it says; most nodes get their name soon after they are found."""
        text = self.text(f)
        lasting = self.lasting or UNNAMED in text
        if len(text) > LONGEST_TEXT:
            text = text[:LONGEST_TEXT - 1] + '…'
        return Finding(self.level, self.kind, text, lasting)


def findings_of(f: LoopFigures) -> list[Finding]:
    """All that is to be said, the likeliest cause first; never empty.

    The model is blamed only where nothing else explains why y does not follow from v: an estimate
    that is held for a while because samples are late or lost is a warning about these.
    """
    causes = [rule.finding(f) for rule in CAUSES if rule.holds(f)]
    kinds = {cause.kind for cause in causes}
    state = next(rule.finding(f) for rule in _states_beside(kinds) if rule.holds(f))
    if state.kind == 'model':
        # What the fit has found out itself says more than what is late or missing, and a sign more
        # than the rate of a driver that is held up.
        explained = f.law.wrong_sign or f.law.coasts or f.unexplained
        lesser = (*LATENESS, *(['unreported'] if explained else ()),
                  *(['rate'] if f.law.wrong_sign else ()))
        late = [cause for cause in causes if cause.kind in lesser]
        return [cause for cause in causes if cause not in late] + [state, *late]
    return [*causes, state] if state.level != OK or not causes else causes


def _percent(count: int, of: int) -> str:
    return f'{100.0 * count / max(of, 1):.3g} %'


def _unfit(role: str, reason: str, text: str) -> Rule:
    """Somebody is there on a topic, but no message passes; role: a topic of LoopFigures."""
    def unfit(f: LoopFigures) -> list[Peer]:
        return [peer for peer in getattr(f, role).peers if peer.unfit == reason]

    return Rule(
        f'{role} {reason}', ERROR, lambda f: bool(unfit(f)),
        lambda f: text.format(topic=getattr(f, role), peer=unfit(f)[0]),
    )


def _age(f: LoopFigures) -> str:
    age, cure = f'{1e3 * abs(f.age_s):.3g} ms', 'set both clocks (chrony, PTP)'
    return f'{f.output} comes {age} before its stamp: {cure}' if f.age_s < 0.0 \
        else f'{f.output} comes {age} after its stamp: {cure} or shorten the way'


def _bad_outputs(f: LoopFigures) -> str:
    return f'{_percent(f.bad_outputs, f.heard)} of {f.output} is no finite number: check the sensor'


_WRONG_TYPE = '{topic} is sent as {peer.kind}, {topic.kind} is wanted: change {peer}'
_WRONG_QOS = '{topic} of {peer} does not arrive: its QoS does not fit'
_OWN_QOS = '{topic} does not reach {peer}: its QoS does not fit'
CAUSES: tuple[Rule, ...] = (
    # Who is there but not heard.
    _unfit('output', 'type', _WRONG_TYPE),
    _unfit('output', 'reliability', '{topic} is sent best effort, which does not arrive: '
           'set io.best_effort to true'),
    _unfit('output', 'qos', _WRONG_QOS),
    _unfit('reference', 'type', _WRONG_TYPE),
    _unfit('reference', 'reliability', '{topic} is sent best effort, which does not arrive: '
           'publish it reliable'),
    _unfit('reference', 'qos', _WRONG_QOS),
    _unfit('control', 'type', '{topic} is a {topic.kind}, but {peer} wants {peer.kind}: change it'),
    _unfit('control', 'qos', _OWN_QOS),
    _unfit('control', 'reliability', _OWN_QOS),
    # What comes is of no use.
    Rule('bad outputs', ERROR, lambda f: f.used == 0 < f.bad_outputs, _bad_outputs),
    Rule('bad outputs', WARN, lambda f: f.used > 0 and f.bad_outputs > TROUBLE * f.heard,
         _bad_outputs),
    Rule('bad references', WARN, lambda f: f.bad_references > 0,
         lambda f: f'{f.bad_references} {f.reference} messages lately were no finite number: '
         'the last good one holds'),
    Rule('wraps', WARN, lambda f: f.wraps > 0,
         lambda f: f'{f.output} jumps by 2 pi: it is an angle that wraps: let the driver count the '
         'turns'),
    # Who else is there.
    Rule('rivals', ERROR, lambda f: f.standing_down,
         lambda f: f'standing down: {f.rivals[0] if f.rivals else "another node"} published '
         f'{f.control} before: stop one'),
    Rule('rivals', ERROR, lambda f: bool(f.rivals) and not f.standing_down,
         lambda f: f'{1 + len(f.rivals)} publishers of {f.control}, also {f.rivals[0]}: stop one'),
    Rule('second driver', WARN, lambda f: len(f.output.heard) > 1,
         lambda f: f'{len(f.output.heard)} publishers of {f.output}, the first one is used: '
         'stop the others'),
    Rule('second reference', WARN, lambda f: len(f.reference.heard) > 1,
         lambda f: f'{f.reference} is published by {", ".join(map(str, f.reference.heard[:2]))}: '
         'stop all but one'),
    # What does not come.
    Rule('silent', WARN, lambda f: f.silent_s > 0.0,
         lambda f: f'no {f.output} for {f.silent_s:g} s: is the driver running? '
         f'on_timeout: {f.on_timeout}'),
    Rule('waiting for output', WARN, lambda f: f.waits_for(f.output, f.heard == 0),
         lambda f: f.output.waiting('start the driver'), lasting=True),
    Rule('waiting for reference', WARN,
         lambda f: f.waits_for(f.reference, not f.referred and f.bad_references == 0),
         lambda f: f.reference.waiting('start one'), lasting=True),
    Rule('unheard', WARN,
         lambda f: f.status is not None and f.silent_s == 0.0 and not f.control.peers,
         lambda f: f'nobody listens to {f.control}: is it the name that the driver uses?',
         lasting=True),
    # When it comes.
    Rule('rate', WARN, lambda f: isfinite(f.rate),
         lambda f: f'{f.output} comes at {f.rate:.4g} Hz, sample_period is {f.sample_period:g} s '
         f'({1.0 / f.sample_period:.4g} Hz): '
         + ('is the driver held up?' if f.is_stretched else 'correct one of them')),
    Rule('stamps', WARN, lambda f: f.repeats_stamps,
         lambda f: f'{f.output} repeats its stamps, so the time of sending counts: stamp each '
         'message anew'),
    Rule('clock', WARN, lambda f: abs(f.age_s) > SKEW * f.sample_period, _age, lasting=True),
    Rule('late', WARN, lambda f: f.late > TROUBLE * f.used,
         lambda f: f'{_percent(f.late, f.used)} of {f.control} came too late: relieve the machine '
         'or lengthen sample_period', lasting=True),
    Rule('unsent', WARN, lambda f: f.unsent > TROUBLE * f.due and not isfinite(f.rate),
         lambda f: f'{_percent(f.unsent, f.due)} of {f.output} was never sent or much too late: '
         'is the driver held up?', lasting=True),
    Rule('lost', WARN, lambda f: f.lost - f.unsent > TROUBLE * f.due,
         lambda f: f'{_percent(f.lost - f.unsent, f.due)} of {f.output} was lost on its way: '
         'check the network', lasting=True),
    Rule('reference silent', WARN, lambda f: f.reference_silent_s > 0.0,
         lambda f: f'no {f.reference} for more than {f.reference_silent_s:g} s, the last one is '
         'held: publish it every sample'),
    # What becomes of v.
    Rule('still', WARN, lambda f: f.stands_still,
         lambda f: f'{f.output} stands still while v swings over {f.v_swing:.3g}'
         + (f' ({f.v_swing / f.gap:.3g} gaps)' if f.gap > 0.0 else '')
         + ': check sensor, actuator, its controller'),
    Rule('limited', WARN,
         lambda f: f.status in (Status.INCONSISTENT, Status.NOT_EXCITED)
         and f.limited > 0.5 * f.used,
         lambda f: f'v is limited in {_percent(f.limited, f.used)} of the samples: widen '
         'control.min, max or rate_max'),
    Rule('unreported', WARN, lambda f: f.unreported > TROUBLE * f.used,
         lambda f: f'{_percent(f.unreported, f.used)} of the samples came without applied_control '
         'just before them'),
    Rule('worker', WARN, lambda f: f.dead_workers > 0,
         lambda f: 'the process that makes the fits died '
         + ('lately' if f.dead_workers == 1 else f'{f.dead_workers} times lately')
         + '; v is not affected: check the memory'),
)
# The first one that holds is the state of the loop. What is not there yet is among the causes; else
# all is about to begin.
STATES: tuple[Rule, ...] = (
    Rule('begins', OK, lambda f: f.status is None, lambda f: 'the loop begins'),
    Rule('given', OK, lambda f: f.given and f.status == Status.TRACKING,
         lambda f: 'estimates as given: estimator.law fixed learns nothing'),
    Rule('adaptation off', OK, lambda f: not f.adapting and f.status != Status.INCONSISTENT,
         lambda f: 'estimates held as ~/freeze_adaptation asked; v is still answered'),
    Rule('known', OK, lambda f: f.law.unconfirmed and f.status == Status.ACQUIRING,
         lambda f: 'estimates of before hold: only a v at several speeds could confirm them'),
    Rule('acquiring', OK, lambda f: f.status == Status.ACQUIRING,
         lambda f: 'learning: the estimates still move freely'),
    Rule('learned', OK, lambda f: f.status == Status.TRACKING,
         lambda f: 'learned: the estimates agree with the data'),
    Rule('not excited', WARN, lambda f: f.status == Status.NOT_EXCITED,
         lambda f: 'estimates held: v did not swing past the gap lately; move it wider'),
    Rule('no data', WARN, lambda f: f.status == Status.NO_DATA,
         lambda f: f'estimates held: {f.output} is missing'),
    Rule('model', ERROR, lambda f: f.law.wrong_sign,
         lambda f: f'{f.output} moves against v: reverse it, or the sign of plant.numerator'),
    Rule('model', ERROR, lambda f: f.law.coasts,
         lambda f: f'the load coasts in the gap ({100.0 * f.law.unexplained:.2g} % of m*gap): '
         'brake it, or move more slowly'),
    Rule('model', ERROR, lambda f: f.unexplained,
         lambda f: f'{100.0 * f.law.unexplained:.3g} % of m*gap of the motion of u fits no G and '
         'no backlash: check G(z), load, sensor'),
    Rule('model', ERROR, lambda f: True,
         lambda f: f'{f.output} does not follow from v through G(z): check G(z), the sensor, the '
         'actuator'),
)


def _states_beside(causes: set[str]) -> Iterator[Rule]:
    """The rules of the state where causes of these kinds have been found; none turns a sign."""
    def contradicts(f: LoopFigures) -> bool:
        return f.status == Status.INCONSISTENT and not f.law.wrong_sign

    if 'rate' in causes:
        yield Rule('held', WARN, contradicts, lambda f: f'{f.output} does not follow from v at '
                   'this rate: estimates held')
    if not causes.isdisjoint(LATENESS):
        yield Rule('held', WARN, lambda f: contradicts(f) and f.inconsistent_s < PATIENCE_S,
                   lambda f: f'{f.output} does not follow from v while samples are late or lost: '
                   'estimates held')
    yield from STATES
