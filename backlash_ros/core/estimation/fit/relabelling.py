"""The fit of a record: labels, least squares, gap; new labels with that gap, until it stands.

Every solve is a Gauss-Newton step in the gap and the start of the play output, as window_fit.py
explains. The G that is fitted around moves as well: to the one of low order that does what
G (1 + Delta) does, where the data speak for it.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import (
    BY_CHANCE,
    CANDIDATES,
    ENGAGED,
    FAR_CANDIDATES,
    GROWTH,
    NO_GAP,
    STANDS,
    UNDECIDED_BY,
    WALKS,
    ZOOM,
)
from backlash_ros.core.estimation.fit.crossings import crossings_of
from backlash_ros.core.estimation.fit.learned_error import moved_error
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.fit.prior import Prior, beyond_chance, contradicts
from backlash_ros.core.estimation.fit.search import (
    Candidate,
    Comparison,
    gap_spread,
    search,
    too_few,
)
from backlash_ros.core.estimation.fit.solution import Around, Solution
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.estimation.regression.readings import weights_of

Array = NDArray[np.float64]

RELABELLINGS = 12  # Gauss-Newton steps, at most
SHORTER = 0.3  # share of a step of G that is tried where the whole one makes it less likely
AS_LIKELY = 1.0  # log-likelihood by which one G may fall behind another that is no better
NEIGHBOURS = 0.02  # relative distance of gaps that lead to the same fit
SAME = 1.5  # ratio of deviations of the gap up to which they say the same


class Fitted(NamedTuple):
    """A fit of a record with its solution. decided: whether no other gap is nearly as likely."""

    fit: WindowFit
    solution: Solution
    decided: bool = True

    @property
    def around(self) -> Around:
        """What it was made around."""
        return self.fit.around

    @property
    def evidence(self) -> float:
        """Log-likelihood, comparable between fits of the same samples."""
        return self.solution.posterior.evidence

    @property
    def keeps_prior(self) -> bool:
        """Whether the samples do not deny what was known from elsewhere."""
        prior = self.around.prior
        return prior is None or not beyond_chance(self.solution.theta - prior.theta, prior.cov)

    @property
    def contested(self) -> bool:
        """Whether the samples alone contradict what is known from elsewhere."""
        prior, alone = self.around.prior, self.solution.alone
        return prior is not None and alone is not None and contradicts(alone.of_theta, prior)

    def with_gap_spread(self, spread: float) -> Fitted:
        """The same with a gap that is no better known than by this deviation.

        One that the labels leave anyhow says nothing of other gaps.
        """
        spread = spread if spread > SAME * self.solution.std_gap else 0.0
        if spread == self.fit.gap_spread:
            return self
        self.fit.gap_spread = spread
        return self._replace(solution=self.fit.solve())

    def beginning(self, v: Array) -> Start:
        """Where another fit of v (N,) is to begin."""
        solution = self.solution
        return self.fit.start._replace(p=solution.start).with_gap(solution.gap, v)


def fitted(
    v: Array, y: Array, around: Around, start: Start, slope: float, pace: Pace,
) -> Generator[None, None, Fitted]:
    """Fit v (N,) and y (N,), nan where lost, from labels for `start` on; yields between pieces."""
    best: Fitted | None = None
    share = 1.0
    for _ in range(RELABELLINGS):
        result = yield from labelled(v, y, around, start, slope, pace)
        if best is not None and around.error is not best.around.error \
                and result.evidence < best.evidence - AS_LIKELY:
            # G was moved too far.
            share, result = SHORTER * share, best
        else:
            share = 1.0
            if best is None or result.evidence >= best.evidence - AS_LIKELY:
                best = result
        fit, solution = result.fit, result.solution
        if fit.layout.leak:
            # Without a leak an offset of u explains one as long as the labels are wrong.
            solution = fit.leaking(solution)
        after = Fitted(fit, solution).beginning(v)
        error = moved_error(fit, solution, share)
        stands = (
            error is fit.around.error
            and abs(solution.gap - fit.start.gap) <= STANDS * solution.std_gap
            and abs(after.p - fit.start.p) <= STANDS * after.gap
        )
        if stands or solution.m == 0.0:
            break
        slope, start, around = solution.m, after, around._replace(error=error)
        yield
    assert best is not None
    return best


def labelled(
    v: Array, y: Array, around: Around, start: Start, slope: float, pace: Pace,
) -> Generator[None, None, Fitted]:
    """The solution with the labels for this start."""
    weights = weights_of(y)
    extent = (float(np.nanmax(np.abs(y), initial=0.0)), float(np.abs(v).max(initial=0.0)))
    fit = WindowFit(around, start, slope, extent, int(GROWTH * len(v)))
    while fit.length < len(v):
        part = slice(fit.length, fit.length + pace.pieces(fit.layout.unknowns))
        fit.samples.take(fit.columns(v[part], y[part]), y[part], weights[part])
        yield
    return Fitted(fit, fit.solve())


def searched(
    v: Array, y: Array, around: Around, widest: float, pace: Pace,
) -> Generator[None, None, Fitted | None]:
    """Search the gap and fit around the best candidates.

    None where a constant u explains y as well: v never engaged.
    """
    found = yield from search(
        v, y, weights_of(y), around.model, around.error, around.told_std, widest,
        pace,
    )
    if not found.candidates or found.candidates[0].evidence < found.null + ENGAGED:
        return None
    # Those far away only tell whether the choice is clear. With an error of G the evidence is that
    # of the best error for each gap: too flat to tell.
    tells = around.error.count == 0
    fits = []
    for candidate in _apart(found.candidates, FAR_CANDIDATES if tells else 0):
        start = Start(candidate.gap, candidate.start)
        fits.append((yield from fitted(v, y, around, start, candidate.m, pace)))
    best = most_likely(fits[:CANDIDATES])
    if tells:
        best = best._replace(decided=not any(_rivals(best, other) for other in fits))
    assert found.comparison is not None
    spread = yield from gap_spread(
        found.comparison, found.candidates, best.solution.gap, best.solution.std_gap,
        _gap_of(around.prior), pace,
    )
    return best.with_gap_spread(spread)


def with_other_gaps(
    v: Array, y: Array, result: Fitted, prior: Prior, pace: Pace,
) -> Generator[None, None, Fitted]:
    """A fit with a prior whose gap is no better known than over all that explain the samples."""
    known, around = _gap_of(prior), result.around
    gap, std = result.solution.gap, result.solution.std_gap
    weights = weights_of(y)
    if known is None or not known[1] > std or too_few(y, weights, around.model):
        return result
    comparison = Comparison(v, y, weights, around.model, around.error, around.told_std)
    spread = yield from gap_spread(comparison, (), gap, std, known, pace)
    return result.with_gap_spread(spread)


def _gap_of(prior: Prior | None) -> tuple[float, float] | None:
    """Gap and its deviation as known from elsewhere."""
    known = None if prior is None else crossings_of(prior.theta, prior.cov)
    return None if known is None else (known.gap, known.std_gap)


def _rivals(best: Fitted, other: Fitted) -> bool:
    """Whether the gap of another fit is nearly as likely, and not the same."""
    behind = best.evidence - other.evidence
    apart = abs(other.solution.gap - best.solution.gap)
    return behind < UNDECIDED_BY and apart > BY_CHANCE * best.solution.std_gap + ZOOM[0] * abs(
        best.solution.gap
    )


def _apart(candidates: list[Candidate], far: int) -> list[Candidate]:
    """The best candidates whose gaps are no neighbours, and `far` of those far from them."""
    chosen: list[Candidate] = []
    for least, count in ((NEIGHBOURS, CANDIDATES), (ZOOM[0], CANDIDATES + far)):
        for candidate in candidates:
            if len(chosen) == count:
                break
            if all(abs(candidate.gap - other.gap) > least * other.gap for other in chosen):
                chosen.append(candidate)
    return chosen


def motionless(
    v: Array, y: Array, around: Around, slope: float, swing: float, pace: Pace,
) -> Generator[None, None, Fitted]:
    """The fit of a constant u: that of a gap wider than all of v, which moves by `swing`."""
    start = Start(3.0 * swing, float(v[0]) + 1.5 * swing)
    return (yield from fitted(v, y, around, start, slope, pace))


def most_likely(results: Sequence[Fitted]) -> Fitted:
    """The one with the largest evidence, the first of equals."""
    return max(results, key=lambda result: result.evidence)


def with_walk(
    v: Array, y: Array, result: Fitted, pace: Pace,
) -> Generator[None, None, Fitted]:
    """Let a disturbance of u walk where the residual hints at it and the evidence is for it."""
    solution, around = result.solution, result.around
    if not solution.m > 0.0 or (solution.correlation == 0.0 and around.walk == 0.0):
        return result
    start = result.beginning(v)
    still = around._replace(walk=0.0)
    if around.walk > 0.0:
        result = yield from fitted(v, y, still, start, solution.m, pace)
    size = solution.m * max(solution.gap, NO_GAP * result.fit.swing)
    tried = still._replace(walk=size)
    walking = yield from fitted(v, y, tried, start, solution.m, pace)
    evidence = [
        walking.fit.solve(share * size).posterior.evidence for share in WALKS
    ]
    best = int(np.argmax(evidence))
    if evidence[best] <= result.evidence:
        return result
    around = still._replace(walk=WALKS[best] * size)
    return (yield from fitted(v, y, around, walking.fit.start, solution.m, pace))
