"""Diagnosis of the loop: one table of conditions on what was counted, and a log of findings."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from math import inf, isfinite, nan
from typing import TYPE_CHECKING, Any, NamedTuple

from backlash_ros.core.control.limits import LARGEST_SIGNAL
from backlash_ros.core.estimate import Status, was_given
from backlash_ros.core.law import LawReport, OutOfBounds
from backlash_ros.core.loop.loop_statistics import Counts
from backlash_ros.core.loop.sample_counter import Timing
from backlash_ros.core.parameters import Parameters

if TYPE_CHECKING:
    from backlash_ros.core.loop.control_loop import ControlLoop

# A finding that usually passes by itself is logged only after so long: at the third look, as looks
# come once a second, even if that is a little early.
LASTS_S = 1.5
AGAIN_S = 10.0  # before the same cause is logged once more
LONGEST_TEXT = 99  # `ros2 topic echo` cuts off at 128, and a terminal line holds more besides
# Fraction of late, lost or bad samples above which they are a finding.
TROUBLE = 0.01
ENOUGH_REVERSALS = 6  # of the load, that tell its gap unless several explain y
BEHIND_S = 10.0  # delay of a fit that is a finding: its process may pause, but not for so long
UNNAMED = 'a node without a name'
SKEW = 0.5  # of a period from stamp to arrival: only a wrong clock or a slow network takes as long
LATE_KINDS = ('late', 'lost', 'unsent')
# Kinds of findings that usually pass by themselves.
PASSING_KINDS = (*LATE_KINDS, 'waiting for output', 'waiting for reference', 'unheard', 'clock')
# Kinds of findings about the messages, which are the same for all joints of a controller.
OF_MESSAGES = frozenset((
    'control type', 'control qos', 'rivals', 'second driver', 'second reference', 'unheard', 'rate',
    'stamps', 'clock', 'late', 'unsent', 'lost', 'unreported', 'reference silent', 'worker',
))


class Level(IntEnum):
    """Severity, by the numbers of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Finding(NamedTuple):
    """One line of the diagnosis. kind: the same word for the same cause, whatever its figures.

    lasting: logged only once it has lasted, as it usually passes by itself.
    """

    level: Level
    kind: str
    text: str
    lasting: bool = False


class LevelLog:
    """Writes one line when the level or the cause changes, and one when all is well again.

    A cause that comes and goes is written once: all must be well for LASTS_S before that is
    written, and the same cause follows only after AGAIN_S.
    """

    def __init__(self, write: Callable[[Level, str], None]) -> None:
        self._write = write
        self._told: tuple[Level, str] | None = None  # the newest line, None if all is well
        self._told_at: dict[tuple[Level, str], float] = {}  # [s]
        self._seen, self._seen_since = (Level.OK, ''), -inf

    def take(self, finding: Finding, now_s: float) -> None:
        key = (finding.level, finding.kind if finding.level != Level.OK else '')
        if key != self._seen:
            self._seen, self._seen_since = key, now_s
        lasted = now_s - self._seen_since >= LASTS_S
        if finding.level == Level.OK:
            if self._told is not None and lasted:
                self._told = None
                self._write(Level.OK, f'recovered: {finding.text}')
        elif (lasted or not finding.lasting) and key != self._told \
                and now_s >= self._told_at.get(key, -inf) + AGAIN_S:
            self._told, self._told_at[key] = key, now_s
            self._write(finding.level, finding.text)


def short(name: str) -> str:
    """Return the end of a long name, so that the advice after it is not cut off."""
    if len(name) <= 24:
        return name
    last = name.rsplit('/', 1)[-1]
    return f'…/{last}' if len(last) <= 22 else '…' + name[-23:]


class Peer(NamedTuple):
    """Another publisher or subscriber of a topic. kind: its message type without the package.

    unfit: why no messages get through: 'type', 'reliability', 'qos', or empty if they do.
    """

    name: str
    kind: str
    unfit: str = ''

    def __str__(self) -> str:
        return short(self.name)


class TopicFigures(NamedTuple):
    """A topic of the loop: its name, expected type without the package, and other nodes on it."""

    name: str
    kind: str = 'Float64'
    peers: tuple[Peer, ...] = ()

    def __str__(self) -> str:
        return short(self.name)

    @property
    def heard(self) -> tuple[Peer, ...]:
        return tuple(peer for peer in self.peers if not peer.unfit)


class Neighbours(NamedTuple):
    """Who publishes y and y_m, who receives v, and who else publishes it."""

    output: TopicFigures = TopicFigures('plant_output')
    reference: TopicFigures = TopicFigures('reference')
    control: TopicFigures = TopicFigures('control')
    rivals: tuple[str, ...] = ()


class Learning(NamedTuple):
    """Progress of learning. given: whether the estimates are constants that no law has learned.

    status: None before the first command. inconsistent_s: for how long it has been INCONSISTENT.
    """

    status: Status | None = None
    law: LawReport = LawReport()
    inconsistent_s: float = 0.0
    adapting: bool = True
    given: bool = False


@dataclass(kw_only=True)
class LoopFigures(Counts):
    """Figures of the loop for the diagnosis; all counts are those of the last few seconds.

    wraps: times that y jumped by 2 pi. dead_workers: processes for fits that died. failed_fits:
    fits without a result, also as their process died. silent_s: timeout that has passed without y,
    0 if it has not; reference_silent_s: the same for y_m, inf before the first one. still: newest
    values of y in a row that are equal within its noise. v_swing: highest minus lowest v meanwhile;
    gap: nan until it is learned [unit of v].
    """

    timing: Timing
    around: Neighbours
    learning: Learning
    wraps: int = 0
    dead_workers: int = 0
    failed_fits: int = 0
    standing_down: bool = False
    silent_s: float = 0.0
    on_timeout: str = 'hold'
    reference_silent_s: float = 0.0
    still: int = 0
    v_swing: float = 0.0
    gap: float = nan


def figures_of_loop(loop: 'ControlLoop', p: Parameters, timing: Timing,
                    gained: Mapping[str, Any], around: Neighbours) -> LoopFigures:
    """Collect the figures of a loop. gained: its counts of the last few seconds."""
    statistics, estimate, law = loop.statistics, loop.estimate, loop.core.estimator
    # With joint_state_topic no references are sent while all joints are where they belong.
    may_be_silent = p.lockstep or p.io.style == 'joint_state_topic'
    unreferred_s = loop.driver.steady_s() - loop.heard.y_m_at
    unreferred = not may_be_silent and 0.0 < p.timeout.reference < unreferred_s
    return LoopFigures(
        **gained, around=around,
        # In lockstep the outputs come as fast as the machine computes.
        timing=Timing(p.sample_period) if p.lockstep else timing,
        learning=Learning(
            estimate.status if statistics.used else None, law.report,
            statistics.inconsistent * p.sample_period, law.adapting, was_given(estimate)),
        standing_down=loop.standing_down, on_timeout=p.on_timeout,
        silent_s=p.timeout.plant_output if loop.silent else 0.0,
        reference_silent_s=p.timeout.reference * unreferred if isfinite(loop.heard.y_m) else inf,
        still=statistics.still, v_swing=statistics.still_swing,
        gap=estimate.c_r - estimate.c_l if estimate.learned else nan,
    )


Row = tuple[str, Level, bool, str]  # kind, level, whether it holds, text with figure and cure


def findings_of(f: LoopFigures) -> list[Finding]:
    """Return all findings, the likeliest cause first; never empty.

    The model is blamed only if nothing else explains why y does not follow from v: an estimate that
    is held for a while because samples are late or lost is a warning about the samples.
    """
    causes = _findings(causes_of(f))
    state, law = state_beside({cause.kind for cause in causes}, f), f.learning.law
    if state.kind == 'model':
        # What the fit itself has found outweighs what is late or missing. A wrong sign also drives
        # v into its limits, and no clock causes it.
        lesser = list(LATE_KINDS)
        if law.wrong_sign or law.coasts or _is_unexplained(law):
            lesser += ['unreported']
        if law.wrong_sign:
            lesser += ['rate', 'stamps', 'clock', 'reference silent', 'limited']
        return sorted([*causes, state], key=lambda each: (each.kind in lesser, each is state))
    return [*causes, state] if state.level != Level.OK or not causes else causes


def _findings(rows: Iterable[Row]) -> list[Finding]:
    # Most nodes get their names soon after they are discovered.
    return [
        Finding(level, kind, text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT - 1] + '…',
                kind in PASSING_KINDS or UNNAMED in text)
        for kind, level, holds, text in rows if holds
    ]


def _is_unexplained(law: LawReport) -> bool:
    return 0.05 <= law.unexplained < inf


def _percent(count: int, of: int) -> str:
    return f'{100.0 * count / max(of, 1):.3g} %'


def _unheard(around: Neighbours) -> list[Row]:
    sent = '{0} is sent as {1.kind}, {0.kind} is wanted: change {1}'
    best_effort = '{0} is sent best effort, which does not arrive: '
    texts = {
        'output type': sent, 'output reliability': best_effort + 'set io.best_effort to true',
        'reference type': sent, 'reference reliability': best_effort + 'publish it reliable',
        'control type': '{0} is a {0.kind}, but {1} wants {1.kind}: change it',
        'control qos': '{0} does not reach {1}: its QoS does not fit',
    }
    other = '{0} of {1} does not arrive: its QoS does not fit'
    return [
        (kind, Level.ERROR, True, texts.get(kind, other).format(topic, peer))
        for role, topic in zip(('output', 'reference', 'control'), around[:3], strict=True)
        for peer in topic.peers if peer.unfit for kind in [f'{role} {peer.unfit}']
    ]


def causes_of(f: LoopFigures) -> tuple[Row, ...]:
    """Return the table of causes, the likeliest first."""
    _, warn, error = Level
    y, y_m, v, rivals = f.around
    timing, status = f.timing, f.learning.status
    rate, age_s, period_s = timing.rate, timing.age_s, timing.nominal_s
    heard, due = f.heard, f.heard + f.lost
    begins, overdue_s = status is None and f.silent_s == 0.0, f.learning.law.overdue * period_s

    def waiting(topic: TopicFigures, start: str) -> str:
        return f'waiting for {topic}: ' + (f'{topic.heard[0]} is there but sends none'
                                           if topic.heard else f'nobody publishes it, {start}')

    valid = f'±{LARGEST_SIGNAL:g}'
    # By samples and the gap if that is known, else by time.
    stands_still = f.still >= 20 and f.v_swing > f.gap if isfinite(f.gap) \
        else f.still * period_s >= 5.0 and f.v_swing > 0.0
    return (
        *_unheard(f.around),
        # Useless messages.
        ('bad outputs', warn if f.used else error, f.bad_outputs > TROUBLE * heard,
         f'{_percent(f.bad_outputs, heard)} of {y} is no number within {valid}: check the sensor'),
        ('bad references', warn, f.bad_references > 0, f'{f.bad_references} {y_m} messages '
         f'lately were no numbers within {valid}: the last good one holds'),
        ('wraps', warn, f.wraps > 0,
         f'{y} jumps by 2 pi: it is an angle that wraps: let the driver count the turns'),
        # Other nodes.
        ('rivals', error, f.standing_down,
         f'standing down: {(*rivals, "another node")[0]} published {v} before: stop one'),
        ('rivals', error, bool(rivals) and not f.standing_down,
         f'{1 + len(rivals)} publishers of {v}, also {(*rivals, "")[0]}: stop one'),
        ('second driver', warn, len(y.heard) > 1,
         f'{len(y.heard)} publishers of {y}, the first one is used: stop the others'),
        ('second reference', warn, len(y_m.heard) > 1,
         f'{y_m} is published by {", ".join(map(str, y_m.heard[:2]))}: stop all but one'),
        # Missing messages.
        ('silent', warn, f.silent_s > 0.0,
         f'no {y} for {f.silent_s:g} s: is the driver running? on_timeout: {f.on_timeout}'),
        ('waiting for output', warn, begins and heard == 0 and y.heard == y.peers,
         waiting(y, 'start the driver')),
        ('waiting for reference', warn, begins and f.reference_silent_s == inf
         and f.bad_references == 0 and y_m.heard == y_m.peers, waiting(y_m, 'start one')),
        ('unheard', warn, f.silent_s == 0.0 and not begins and not v.peers,
         f'nobody listens to {v}: is it the name that the driver uses?'),
        # Timing.
        ('rate', warn, isfinite(rate), f'{y} comes at {rate:.4g} Hz, sample_period is '
         f'{period_s:g} s ({1.0 / period_s:.4g} Hz): '
         + ('is the driver held up?' if timing.is_stretched else 'correct one of them')),
        ('stamps', warn, timing.repeats_stamps,
         f'{y} repeats its stamps, so the time of sending counts: stamp each message anew'),
        ('clock', warn, abs(age_s) > SKEW * period_s,
         f'{y} comes {1e3 * abs(age_s):.3g} ms {"before" if age_s < 0.0 else "after"} its stamp: '
         'set both clocks (chrony, PTP)' + (' or shorten the path' if age_s > 0.0 else '')),
        ('late', warn, f.late > TROUBLE * f.used, f'{_percent(f.late, f.used)} of {v} came too '
         'late: relieve the machine or lengthen sample_period'),
        ('unsent', warn, f.unsent > TROUBLE * due and not isfinite(rate),
         f'{_percent(f.unsent, due)} of {y} was never sent or much too late: is it held up?'),
        ('lost', warn, f.lost - f.unsent > TROUBLE * due,
         f'{_percent(f.lost - f.unsent, due)} of {y} was lost on its way: check the network'),
        ('reference silent', warn, 0.0 < f.reference_silent_s < inf, f'no {y_m} for more than '
         f'{f.reference_silent_s:g} s, the last one is held: publish it every sample'),
        # The effect of v, and the fits.
        ('still', warn, stands_still,
         f'{y} stands still while v swings over {f.v_swing:.3g}'
         + (f' ({f.v_swing / f.gap:.3g} gaps)' if f.gap > 0.0 else '')
         + ': check sensor, actuator, its controller'),
        ('limited', warn, f.limited > 0.5 * f.used and status in (
            Status.INCONSISTENT, Status.NOT_EXCITED), f'v is limited in '
         f'{_percent(f.limited, f.used)} of the samples: widen control.min, max or rate_max'),
        ('unreported', warn, f.unreported > TROUBLE * f.used, f'{_percent(f.unreported, f.used)} '
         'of the samples came without applied_control just before them'),
        ('worker', warn, f.dead_workers > 0, 'the process that makes the fits died '
         + (f'{f.dead_workers} times ' if f.dead_workers > 1 else '')
         + 'lately; v is not affected: check the memory'),
        ('fits', warn, f.failed_fits > f.dead_workers, 'the newest fits failed, so the estimates '
         'may be old; v is not affected: report it, with a bag'),
        ('behind', warn, overdue_s > BEHIND_S, f'the fits are {overdue_s:.0f} s behind; v is not '
         'affected: leave more of the machine to their process'),
    )


def state_beside(causes: set[str], f: LoopFigures) -> Finding:
    """Return the finding about learning, beside causes of these kinds: the first row that holds."""
    ok, warn, error = Level
    y, (status, law, inconsistent_s, adapting, given) = f.around.output, f.learning
    share = 100.0 * law.unexplained
    name, value, (low, high) = law.forbidden or OutOfBounds('', nan, (nan, nan))
    # Neither a wrong rate nor lateness can flip a sign.
    held = status == Status.INCONSISTENT and not law.wrong_sign
    # If a tenth is late or lost, other faults cannot be told; if less, not for some seconds.
    many = f.late + f.lost > 0.1 * (f.heard + f.lost)
    late = not causes.isdisjoint(LATE_KINDS) and (many or inconsistent_s < 3.0)
    return _findings((
        ('held', warn, held and ('rate' in causes or late), f'{y} does not follow from v '
         + ('at this rate' if 'rate' in causes else 'while samples are late or lost')
         + ': estimates held'),
        # If something is missing, that is among the causes; else the loop is about to begin.
        ('begins', ok, status is None, 'the loop begins'),
        ('given', ok, given and status == Status.TRACKING,
         'estimates as given: estimator.law fixed learns nothing'),
        ('adaptation off', ok, not adapting and status != Status.INCONSISTENT,
         'estimates held by ~/freeze_adaptation; outputs are still answered'),
        ('known', ok, law.unconfirmed and status == Status.ACQUIRING,
         'earlier estimates hold, not confirmed by newer samples: move v at several speeds'),
        ('bound', warn, law.forbidden is not None and status == Status.ACQUIRING,
         f'{name} is {value:.4g}, beyond estimator.bounds.{name} [{low:g}, {high:g}]: widen it'
         + (', or correct the zero of y' if name != 'm' else '')),
        ('undecided', ok, status == Status.ACQUIRING and law.reversals >= ENOUGH_REVERSALS,
         'learning: several gaps explain y equally well: move v between more than two values'),
        ('one way', ok, status == Status.ACQUIRING and law.reversals == 0.0,
         'learning: v has moved the load one way only so far: swing it past the gap'),
        ('acquiring', ok, status == Status.ACQUIRING, 'learning: the estimates still move freely'),
        ('learned', ok, status == Status.TRACKING, 'learned: the estimates agree with the data'),
        ('not excited', warn, status == Status.NOT_EXCITED,
         'estimates held: v has not swung past the gap lately; move it further'),
        ('no data', warn, status == Status.NO_DATA, f'estimates held: {y} is missing'),
        ('model', error, law.wrong_sign,
         f'{y} moves against v: reverse it, or the sign of plant.numerator'),
        ('model', error, law.coasts,
         f'the load coasts in the gap ({share:.2g} % of m*gap): brake it, or move more slowly'),
        ('model', error, _is_unexplained(law), f'{share:.3g} % of m*gap of the motion of u fits '
         'no G and no backlash: check G(z), load, sensor'),
        ('model', error, True,
         f'{y} does not follow from v through G(z): check G(z), the sensor, the actuator'),
    ))[0]
