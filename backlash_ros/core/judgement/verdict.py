"""Verdict on a record: whether backlash, gain and model are known, with reasons and cures.

All is judged by numbers and signals; nothing here depends on how the fit was made.
"""

from collections.abc import Iterator, Sequence
from math import log, nan
from typing import NamedTuple

import numpy as np

from backlash_ros.core.judgement.deviations import by_model, effective, lag_one
from backlash_ros.core.judgement.not_play import (
    Answer,
    LinearFamily,
    Observed,
    coasting,
    what_it_is,
)
from backlash_ros.core.records.readings import quantum

PRECISE = 0.1  # relative standard deviation up to which gap, gain and G are known well
CERTAIN = 3.0  # standard deviations from 0 beyond which something is certainly there
ANOTHER = 0.02  # relative distance beyond which two gaps are different
WORTH_A_WORD = 0.05  # share of the gap beyond which an unexplained motion is mentioned
SEVERAL = 'move v at several speeds and amplitudes'


class Verdict(NamedTuple):
    """Answers and remarks, a sentence each. gap_std: standard deviation, with all doubts."""

    backlash: Answer
    gain: Answer
    model: Answer
    gap_std: float
    remarks: tuple[str, ...] = ()

    @property
    def lines(self) -> tuple[str, str]:
        """Two sentences: what is known, and what can be done with it."""
        if not self.backlash.known:
            return f'not known: {self.backlash.reason}', f'measure again: {self.backlash.cure}'
        first = self.backlash.reason + ('' if self.gain.known else f'; {self.gain.reason}')
        if not self.model.known:
            return first, f'for a controller measure again: {self.model.sentence}'
        return first, self.model.reason

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why a controller cannot start with the result, a sentence each; empty if it can."""
        return tuple(one.sentence for one in (self.backlash, self.model) if not one.known)


class Findings(NamedTuple):
    """What the verdict is based on, besides the signals of the fitted samples.

    apart: standard deviation of the gap over other structures. gain: of y over v where y moves.
    gain_std, response_std: relative std of the gain at rest, and of G where y moves. evidence:
    log-likelihood by which the fit beats a u that stands still. rivals: other gaps, and their loss
    of log-likelihood. open_delay: the longest delay that was compared if a longer one fits as well,
    else 0; by_delay: by how much one sample more then moves the gap.
    """

    observed: Observed
    gap_std: float
    apart: float
    c_r_std: float
    gain: float
    gain_std: float
    response_std: float
    evidence: float
    rivals: Sequence[tuple[float, float]]
    open_delay: int
    by_delay: float

    @property
    def gap(self) -> float:
        return self.observed.gap

    @property
    def swing(self) -> float:
        """Peak-to-peak range of v."""
        return float(np.ptp(self.observed.v))

    @property
    def quantum(self) -> float:
        """Step of y, 0 if it is not quantised."""
        return quantum(self.observed.y)

    @property
    def unexplained(self) -> float:
        """Correlated part of the residual, as a motion of v that would cause it."""
        # Rounding, step^2 / 12 and a margin, is correlated too, but explained.
        excess = self.observed.rms**2 - 1.5 / 12.0 * self.quantum**2
        correlation = lag_one(self.observed.residual, certain=True)
        return float(np.sqrt(max(excess * correlation, 0.0)) / max(abs(self.gain), 1e-300))


class Doubt(NamedTuple):
    """A part of the standard deviation of the gap [v], why it is so large, and the cure."""

    deviation: float
    why: str
    cure: str


def judge(f: Findings) -> Verdict:
    """Answer whether backlash, gain and model are known."""
    coasts = [*_coasts(f)]
    other_plays = [*coasts, *_changes(f)]
    doubts = [*_doubts(f), *other_plays]
    spread = float(np.linalg.norm([doubt.deviation for doubt in doubts]))
    told = [doubt for doubt in other_plays if doubt.deviation > WORTH_A_WORD * f.gap]
    far = [doubt for doubt in coasts if doubt.deviation > PRECISE * f.gap]
    # The kind of play is named first: it is why other orders fit as well.
    backlash = what_it_is(f.observed) or _backlash(f, max(far or told or doubts), spread, bool(far))
    remarks = [*_remarks(f), *(doubt.why for doubt in told if backlash.known)]
    return Verdict(backlash, _gain(f), _model(f), spread, tuple(remarks))


def _doubts(f: Findings) -> Iterator[Doubt]:
    """Parts of the standard deviation of the gap; _coasts and _changes yield others."""
    moved, o = abs(f.gain) * f.gap, f.observed
    what, cure = (
        (f'is quantised in steps of {f.quantum:.3g}', 'use a finer sensor, or record for longer')
        if f.quantum > moved else
        (f'has a noise of {o.rms:.2g}', 'record for longer, or turn v more often'))
    yield Doubt(f.gap_std, f'y {what}, and the gap moves it by {moved:.2g}', cure)
    yield Doubt(0.3 * f.unexplained, 'something other than a backlash and a linear G moves y by '
                f'{f.unexplained * abs(f.gain):.2g}', 'see the residual on the page: friction, a '
                'load that moves by itself, or a higher order with --order')
    yield Doubt(f.apart, 'other orders or delays fit nearly as well, with another gap', SEVERAL)
    yield Doubt(f.by_delay, 'the delay may be a longer one', 'compare longer ones with --delay')
    if o.unexplained:
        gap = abs(o.one_play.at[0]) * o.family.swing
        squares, rows = o.one_play.squares / len(o.family.rows), effective(o.residual)
        # As in the BIC of other structures; each of its columns is an unknown.
        unknowns = o.one_play.columns.shape[1] + o.family.common.shape[1]
        behind = rows * log(squares / o.rms**2) + unknowns * log(max(rows, 1.0))
        yield Doubt(by_model(f.gap, [(gap, behind)]),
                    f'with another linear G it would be {gap:.3g}', SEVERAL)
        # Widths spread evenly from 0 to the widest have this standard deviation.
        widest = abs(o.plays.at[0]) * o.family.swing
        yield Doubt(o.share(o.plays) * widest / 12.0**0.5,
                    f'many plays in parallel, up to {widest:.3g} wide, explain y better',
                    'only a single backlash is compensated here')


def _coasts(f: Findings) -> Iterator[Doubt]:
    """The doubt if a load that runs on within the gap explains y better, with another gap."""
    o = f.observed
    if o.rms > 1.1 * o.noise and o.family.enough:
        # The best single play for a load that coasts to rest has no width: other starts as well.
        best = o.family.best(coasting, [
            (start, *brakes) for start in (0.01, 0.03, 0.1, 0.3, 1.3 * o.one_play.at[0])
            for brakes in ((0.0, 0.0), (3e-4, 0.0), (3e-3, 0.0), (0.0, 0.03), (0.0, 0.2))], 100)
        gap = abs(best.at[0]) * o.family.swing
        yield Doubt(o.share(best) * abs(gap - f.gap), 'the load coasts while v crosses the gap, '
                    f'which would be {gap:.3g} with that', 'brake it, or move more slowly')


def _changes(f: Findings) -> Iterator[Doubt]:
    """The doubts if the gap varies with time or with position."""
    half = 0.5  # least share of what a constant gap leaves that a varying one explains
    o = f.observed
    if not o.unexplained and f.unexplained <= WORTH_A_WORD * f.gap:
        return
    family = LinearFamily(o.v, o.y)
    _, one = family.changing(f.gap, np.ones((1, len(o.v))))
    for over, knots, what, cure in (
        (np.arange(len(o.v)), 3, 'within the record', 'take a part of it with --from and --to'),
        (o.v, 5, 'with the place, from left to right', 'move v where it is one and the same'),
    ):
        at = np.linspace(over.min(), over.max(), knots)
        hats = np.array([np.interp(over, at, row) for row in np.eye(knots)])
        gaps, other = family.changing(f.gap, hats)
        if np.ptp(gaps) > 0.1 * f.gap and family.share(other, one, o.noise) >= half:
            # Each place counts equally, however long v was there.
            along = np.interp(np.linspace(at[0], at[-1], 100), at, gaps)
            yield Doubt(float(np.sqrt(np.mean((along - f.gap) ** 2))),
                        f'the gap changes {what}, {along.mean():.3g} in the mean: '
                        + ', '.join(f'{gap:.3g}' for gap in gaps), cure)


def _backlash(f: Findings, most: Doubt, spread: float, coasts: bool) -> Answer:
    """Whether the gap is known, or known to be absent. coasts: whether coasting changes it much."""
    roughly = 0.25  # relative standard deviation up to which the gap is known
    o, way = f.observed, np.sign(np.diff(f.observed.p))
    turns = int(np.count_nonzero(np.diff(way[way != 0.0])))
    rival = next((rival for rival, behind in f.rivals if behind < 6.0
                  and abs(rival - f.gap) > max(5.0 * f.gap_std, ANOTHER * f.gap)), nan)
    unexplained = f.unexplained > 0.5 * max(f.gap, CERTAIN * f.gap_std)
    of_noise = most.deviation <= max(f.gap_std, 0.3 * f.unexplained)
    none = f.gap <= CERTAIN * spread and of_noise and not unexplained
    # A gap that was not found may be four standard deviations of the unexplained motion wide.
    bound = f.gap + CERTAIN * spread + 4.0 * f.unexplained
    may_be = f'a gap of up to {bound:.2g} cannot be ruled out'
    for holds, reason, cure in (
        (f.evidence < 15.0, f'y shows nothing of v, which swung by {f.swing:.4g}',
         'let v swing wider than the gap, and check that v is what the actuator gets'),
        (f.gap >= 0.95 * f.swing, f'the gap is at its bound, the swing of v ({f.swing:.4g})',
         'let v swing wider, past the gap in both directions'),
        # Fewer turns leave gap, crossings and start entangled.
        (turns < 3, f'v went past the gap and back {turns} times, 3 are needed',
         'move it to and fro more often, or record for longer'),
        (np.isfinite(rival), f'two gaps fit alike, {f.gap:.4g} and {rival:.4g}', SEVERAL),
        (none and bound > max(0.02 * f.swing, f.quantum / max(abs(f.gain), 1e-300)), may_be,
         'record for longer, or turn v more often and faster'),
        (none and f.gain_std > PRECISE, f'{may_be}: the gain of G at rest is not known, and a slow '
         'lag looks like a gap', 'move v at several speeds, with rests'),
        # If v is rounded as y is, the residual is a step, and somewhat more while both move.
        (none and o.rms > max(2.0 * o.noise, 1.5 * f.quantum),
         f'{may_be}: the fit leaves {o.rms:.2g}, and the noise of y is {o.noise:.2g}',
         'see the residual on the page'),
    ):
        if holds:
            return Answer(False, reason, cure)
    if none:
        return Answer(True, f'there is no backlash: the gap is below {bound:.2g}')
    if spread <= roughly * f.gap and not unexplained and not coasts:
        rough = f', known to {100.0 * spread / f.gap:.2g} % only' * (spread > PRECISE * f.gap)
        return Answer(True, f'the gap is {f.gap:.4g} ± {spread:.2g}{rough}')
    return Answer(False, f'the gap, about {f.gap:.3g}, is known to ± {spread:.2g} only: {most.why}',
                  most.cure)


def _gain(f: Findings) -> Answer:
    """Whether the gain of G at rest (its static gain) is known, and with it c_r + c_l."""
    if f.gain_std <= PRECISE:
        return Answer(True, f'the gain of G is known to {100.0 * f.gain_std:.2g} %')
    much = f'known to {100.0 * f.gain_std:.2g} % only' if f.gain_std < 1.0 else 'not known at all'
    return Answer(
        False, f'the gain of G at rest is {much}, and the middle of the gap no better',
        'move v further and with rests, or record for longer; a y that drifts hides it')


def _model(f: Findings) -> Answer:
    """Whether G is known well enough for a controller to start with."""
    much = f'{100.0 * f.response_std:.2g} %' if f.response_std < 1.0 else 'nothing'
    if f.c_r_std > f.swing:
        return Answer(
            False, f'the middle of the gap is known to ± {f.c_r_std:.2g} only, further than v '
            'moved', 'move v further and with rests; a y that drifts hides it')
    if f.response_std > 0.5:
        return Answer(False, f'G, where y moves, is known to {much}',
                      'move v at more speeds, record for longer, or limit --order')
    return Answer(True, f'G is known to {much}' + (
        ', good enough to start with' if f.response_std <= PRECISE else
        ': good enough to start the controller with plant.uncertainty as in identified.yaml, '
        'which learns the rest'))


def _remarks(f: Findings) -> Iterator[str]:
    """What else to know, a sentence each."""
    share = f.unexplained / f.gap if f.gap > 0.0 else 0.0
    speeds = np.abs(np.diff(f.observed.v))
    speeds = speeds[speeds > 0.01 * speeds.max(initial=0.0)]
    for holds, text in (
        (f.gain < 0.0 and f.gain_std <= PRECISE, 'y moves against v: the gain of G is negative'),
        (f.open_delay > 0,
         f'the delay of {f.open_delay} samples is the longest that was compared, and the gap may '
         f'have some of a longer one: try --delay {f.open_delay}-{min(2 * f.open_delay + 4, 40)}'),
        (WORTH_A_WORD < share <= 1.0,
         f'no backlash with a linear G explains {share:.0%} of the motion that the gap makes: the '
         'standard deviations include it'),
        (len(speeds) > 0 and np.std(speeds) < 0.05 * np.mean(speeds),
         'v moved at one speed only: a lag before the gap would look like a wider gap; move v at '
         'several speeds'),
    ):
        if holds:
            yield text
