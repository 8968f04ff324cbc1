"""What a record tells: the backlash, the gain, the model, each with its reason and the cure.

Everything is judged by numbers and signals; nothing here knows how the fit was made.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.not_play import Observed, varies, what_it_is

Array = NDArray[np.float64]

REVERSALS = 3  # changes of the engaged side: fewer leave gap, crossings and start entangled
ROUGHLY, PRECISE = 0.25, 0.1  # relative deviations: of a gap that is known; of gain and G
STARTS = 0.5  # relative deviation of G from which on a controller cannot begin with it
SHOWS = 15.0  # log-likelihood by which the fit must beat a u that stands still
SURE = 3.0  # standard deviations
WHOLE_SWING = 0.95  # of the swing of v: a gap as wide as this was not seen from both sides
SMALL = 0.02  # of the swing of v: bound of a gap that is said not to be there
ROUNDING = 1.5 / 12.0  # mean square of rounding by a quantum of 1, with a margin
UNEXPLAINED = 0.05  # of the motion that the gap makes: less is not worth a word
MOSTLY = 0.5  # of that motion: more leaves no gap that is known
PER_UNEXPLAINED = 0.3  # standard deviations of the gap for one of what moves y otherwise
MISSED = 4.0  # deviations of what moves y otherwise, that a gap may be which was not found
MORE_THAN_NOISE = 2.0  # residual over noise, from which no gap can be ruled out
WORSE_LATER = 2.0  # ratio of the error on held-out samples to that of the fit
ONE_SPEED = 0.05  # relative spread of the speeds of v that are one speed
APART = 0.02  # relative distance of two gaps that are not the same
BEYOND = 5.0  # standard deviations: nearer ones are covered by them
UNDECIDED = 6.0  # log-likelihood by which another gap may fall behind
CHANGES = 0.1  # of the gap, from part to part of a record
PARTS = 3  # of the time, and of the place


class Answer(NamedTuple):
    """Whether something is known; what, or why not; and what to do about it."""

    known: bool
    reason: str
    cure: str = ''

    @property
    def sentence(self) -> str:
        """Reason and cure."""
        return f'{self.reason}: {self.cure}' if self.cure else self.reason


class Verdict(NamedTuple):
    """Answers, and remarks, a sentence each. gap_std: with what no model explains."""

    backlash: Answer
    gain: Answer
    model: Answer
    gap_std: float
    remarks: tuple[str, ...] = ()

    @property
    def lines(self) -> tuple[str, str]:
        """What is known, and what can be done with it."""
        first = f'{"" if self.backlash.known else "not known: "}{self.backlash.reason}'
        if not self.backlash.known:
            return first, f'measure again: {self.backlash.cure}'
        if not self.gain.known:
            first += f'; {self.gain.reason}'
        if not self.model.known:
            return first, f'for a controller measure again: {self.model.sentence}'
        return first, self.model.reason

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why a controller cannot begin with the result; empty where it can."""
        return tuple(
            one.sentence for one in (self.backlash, self.model) if not one.known
        )


class Findings(NamedTuple):
    """What there is to judge by.

    observed: signals of the fitted samples. gap, c_r and their standard deviations [v]. gain: mean
    response of y to v where y moves, static: at rest (negative where y moves against v).
    gain_std, response_std: relative deviations of the gain at rest, and of G where y moves.
    evidence: log-likelihood by which the fit beats a u that stands still. correlation: of
    successive residuals beyond chance. held_out, trained: rms of the errors on the samples held out
    and on the others. rivals: other gaps with the log-likelihood by which they fall behind.
    reversals: of p. quantum: of y, 0 for none. cancelled: poles that zeros cancel. delay [samples],
    delay_open: whether it is the longest that was compared, and a longer one fits as well.
    """

    observed: Observed
    gap: float
    gap_std: float
    c_r: float
    c_r_std: float
    gain: float
    static: float
    gain_std: float
    response_std: float
    evidence: float
    correlation: float
    held_out: float
    trained: float
    rivals: Sequence[tuple[float, float]]
    reversals: int
    quantum: float
    cancelled: Sequence[str]
    delay: int
    delay_open: bool

    @property
    def swing(self) -> float:
        """Of v."""
        return float(np.ptp(self.observed.v))

    @property
    def rms(self) -> float:
        """Of the residual."""
        return float(np.sqrt(np.nanmean(self.observed.residual**2)))

    @property
    def unexplained(self) -> float:
        """Correlated part of the residual, as a motion of v."""
        # What an encoder rounds away repeats itself as well, but is explained.
        excess = self.rms**2 - ROUNDING * self.quantum**2
        # Where no correlation can be told, all of it may be one.
        correlated = self.correlation if np.isfinite(self.correlation) else 1.0
        if correlated <= 0.0 or self.gain <= 0.0 or excess <= 0.0:
            return 0.0
        return float(np.sqrt(excess * correlated) / self.gain)


def judge(f: Findings) -> Verdict:
    """The answers to three questions."""
    others = [_parted(text) for text in what_it_is(f.observed)]
    spread = float(np.hypot(f.gap_std, PER_UNEXPLAINED * f.unexplained))
    if f.delay_open:
        # A delay that is too short by a sample looks like a gap that is wider by its motion of v.
        spread = float(np.hypot(spread, np.abs(np.diff(f.observed.v)).mean()))
    remarks = list(_remarks(f))
    backlash = _backlash(f, others, spread)
    if backlash.known and f.gap > SURE * spread:
        changes, half = _changes(f)
        remarks += changes
        if half > spread:
            spread = half
            backlash = backlash._replace(reason=_gap_text(f.gap, spread))
    if backlash.known:
        remarks += [f'{one.reason}: {one.cure}' for one in others]
    return Verdict(backlash, _gain(f), _model(f), spread, tuple(remarks))


def _backlash(f: Findings, others: Sequence[Answer], spread: float) -> Answer:
    """Whether the gap is known, or that there is none."""
    named = [one for one in others if not one.known]
    checks = (
        named[0] if named else None, _too_little_motion(f), _rival(f), _imprecise(f, spread),
    )
    for answer in checks:
        if answer is not None:
            return answer
    if f.gap > SURE * spread:
        return Answer(True, _gap_text(f.gap, spread))
    bound = _bound(f, spread)
    return Answer(True, f'there is no backlash: the gap is below {bound:.2g}')


def _gap_text(gap: float, spread: float) -> str:
    return f'the gap is {gap:.4g} ± {spread:.2g}'


def _bound(f: Findings, spread: float) -> float:
    return f.gap + SURE * spread + MISSED * f.unexplained


def _too_little_motion(f: Findings) -> Answer | None:
    if f.evidence < SHOWS:
        return Answer(
            False, f'y shows nothing of v, which swung by {f.swing:.4g}',
            'let v swing wider than the gap, and see that v is what the actuator gets',
        )
    if f.gap >= WHOLE_SWING * f.swing:
        return Answer(
            False, f'the gap is at its bound, the swing of v ({f.swing:.4g})',
            'let v swing wider, past the gap in both directions',
        )
    if f.reversals < REVERSALS:
        return Answer(
            False, f'v went past the gap and back {f.reversals} times, {REVERSALS} are needed',
            'move it to and fro more often, or record for longer',
        )
    return None


def _rival(f: Findings) -> Answer | None:
    for rival, behind in f.rivals:
        if behind < UNDECIDED and abs(rival - f.gap) > max(BEYOND * f.gap_std, APART * f.gap):
            return Answer(
                False, f'two gaps fit alike, {f.gap:.4g} and {rival:.4g}',
                'move v at several speeds and amplitudes',
            )
    return None


def _imprecise(f: Findings, spread: float) -> Answer | None:
    text = f'the gap, about {f.gap:.3g}, is known to ± {spread:.2g} only'
    found = f.gap > SURE * spread
    if f.unexplained > MOSTLY * max(f.gap, SURE * f.gap_std):
        return Answer(
            False, f'{text}: something else than a backlash and a linear G moves y by '
            f'{f.unexplained * f.gain:.2g}', 'see the residual on the page: friction, a load that '
            'moves by itself, or a higher order with --order',
        )
    if found and spread <= ROUGHLY * f.gap:
        return None
    if not found:
        return _no_gap_shown(f, spread)
    moved = f.gain * f.gap
    if f.quantum > moved:
        return Answer(
            False, f'{text}: y is quantised in steps of {f.quantum:.3g}, and the gap moves it by '
            f'{moved:.2g}', 'use a finer sensor, or record for longer',
        )
    return Answer(
        False, f'{text}: y has a noise of {f.rms:.2g}, and the gap moves it by {moved:.2g}',
        'record for longer, or turn v more often',
    )


def _no_gap_shown(f: Findings, spread: float) -> Answer | None:
    """Where 0 lies within the deviations of the gap: why that is not yet a gap of 0."""
    bound = _bound(f, spread)
    text = f'a gap of up to {bound:.2g} cannot be ruled out'
    if bound > max(SMALL * f.swing, f.quantum / max(f.gain, 1e-300)):
        return Answer(False, text, 'record for longer, or turn v more often and faster')
    if f.gain_std > PRECISE:
        return Answer(
            False, f'{text}: the gain of G at rest is not known, and a slow lag looks like a gap',
            'move v at several speeds, with rests',
        )
    if f.rms > MORE_THAN_NOISE * f.observed.noise:
        return Answer(
            False, f'{text}: the fit leaves {f.rms:.2g}, and the noise of y is '
            f'{f.observed.noise:.2g}', 'see the residual on the page',
        )
    return None


def _gain(f: Findings) -> Answer:
    """Whether the gain of G at rest is known, and with it c_r + c_l."""
    if f.gain_std <= PRECISE:
        return Answer(True, f'the gain of G is known to {f.gain_std:.2g} of itself')
    much = f'to {f.gain_std:.0%} only' if f.gain_std < 1.0 else 'not at all'
    return Answer(
        False, f'the gain of G at rest is known {much}, and with it the middle of the gap',
        'move v further and with rests, or record for longer; a y that drifts hides it',
    )


def _model(f: Findings) -> Answer:
    """Whether G is known well enough to begin with."""
    spread = f.response_std
    if f.c_r_std > f.swing:
        return Answer(
            False, f'the middle of the gap is known to ± {f.c_r_std:.2g} only, further than v '
            'moved', 'move v further and with rests; a y that drifts hides it',
        )
    if spread <= PRECISE:
        return Answer(True, f'G is known to {spread:.2g} of itself, good enough to start with')
    if spread <= STARTS:
        return Answer(
            True, f'G is known to {spread:.0%}: good enough to start the controller with '
            'plant.uncertainty as in identified.yaml, which learns the rest',
        )
    much = f'{spread:.0%} of itself' if spread < 1.0 else 'nothing'
    return Answer(
        False, f'G, where y moves, is known to {much}',
        'move v at more speeds, record for longer, or limit --order',
    )


def _remarks(f: Findings) -> list[str]:
    found = []
    if f.static < 0.0 and f.gain_std <= PRECISE:
        found.append('y moves against v: the gain of G is negative')
    if f.delay_open:
        found.append(
            f'the delay of {f.delay} samples is the longest that was compared, and the gap may '
            f'have some of a longer one: try --delay {f.delay}-{min(2 * f.delay + 4, 40)}'
        )
    share = f.unexplained / f.gap if f.gap > 0.0 else 0.0
    if UNEXPLAINED < share <= 1.0:
        found.append(
            f'{share:.0%} of the motion that the gap makes follows from no backlash and no linear '
            'G: the deviations tell of it'
        )
    if _one_speed(f.observed.v):
        found.append(
            'v moved at one speed only: a lag before the gap would look like a wider gap; move v '
            'at several speeds'
        )
    if f.cancelled:
        found.append(
            f'the pole {f.cancelled[0]} is cancelled by a zero: a lower order does as well; '
            'limit --order'
        )
    if f.held_out > WORSE_LATER * f.trained and f.rms > f.observed.noise:
        found.append(
            f'the last part of the record is predicted {f.held_out / f.trained:.2g} times worse '
            'than the rest is fitted: the plant changed on the way, or the record is short'
        )
    return found


def _changes(f: Findings) -> tuple[list[str], float]:
    """Where the gap is another one from part to part, and half of what it changes by."""
    o = f.observed
    if not o.unexplained and f.unexplained < UNEXPLAINED * f.gap:
        return [], 0.0
    place = np.searchsorted(np.quantile(o.p, np.arange(1, PARTS) / PARTS), o.p)
    time = PARTS * np.arange(len(o.v)) // len(o.v)
    found, half = [], 0.0
    for part, what in ((time, 'within the record'), (place, 'with the place, from left to right')):
        gaps, std = varies(o, [part == k for k in range(PARTS)])
        apart = float(np.ptp(gaps))
        if apart > max(CHANGES * f.gap, BEYOND * float(std.max())) and gaps.min() > -std.max():
            found.append(f'the gap changes {what}: ' + ', '.join(f'{gap:.3g}' for gap in gaps))
            half = max(half, 0.5 * apart)
    return found, half


def _one_speed(v: Array) -> bool:
    speeds = np.abs(np.diff(v))
    speeds = speeds[speeds > 0.01 * speeds.max(initial=0.0)]
    return bool(len(speeds) and np.std(speeds) < ONE_SPEED * np.mean(speeds))


def is_no_play(o: Observed) -> bool:
    """Whether it is something else than a play."""
    return any(not _parted(text).known for text in what_it_is(o))


def _parted(text: str) -> Answer:
    """A sentence like `reason; cure` about what is no play; a load that coasts leaves one."""
    reason, _, cure = text.partition('; ')
    return Answer('while v crosses the gap' in reason, reason, cure)
