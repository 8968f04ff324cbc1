"""Finds the backlash that explains a record best, and judges whether it counts as known."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import exp, inf, isnan, sqrt

import numpy as np

from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.fit import FEW_STEPS, FIRST_STEPS, NEAR, Problem
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import SCALES, Prior, WindowFit
from backlash_ros.core.estimation.search import search
from backlash_ros.core.estimation.unmodelled import coasting_score, with_walk
from backlash_ros.core.law import OutOfBounds
from backlash_ros.core.parameters import Bounds
from backlash_ros.core.plant.backlash import gap_variance, play
from backlash_ros.core.plant.numerics import std_of
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.window import Window


@dataclass(frozen=True)
class Setup:
    """What is assumed before the first sample, and the criteria by which a fit counts as known."""

    family: PlantFamily
    noise_std: float  # nominal standard deviation of the noise on y
    bounds: Bounds
    widest: float  # largest gap considered
    guess: float  # gap of the first guess
    walk_std: float  # standard deviation by which u walks, per square root of a sample
    drift: Array  # the same for m, c_r, c_l (3,)

    def problem(self, record: Window, older: Prior | None = None) -> Problem:
        return Problem(self.family, record.v, record.y, self.noise_std, older)

    def is_known(self, f: WindowFit, turns: int | None = None) -> bool:
        """Whether m and the gap are known well enough to be published, and lie within bounds."""
        return self.is_precise(f, turns) and not self.outside_bounds(f)

    def is_precise(self, f: WindowFit, turns: int | None = None) -> bool:
        """The same, regardless of the bounds. turns: reversals seen; None: those of its record."""
        enough = (f.left.turns if turns is None else turns) >= self.turns_needed
        return f.valid and enough and not self.moves_unexplained(f) and \
            self.are_precise(f.crossings, f.crossings_cov, f.systematic)

    @property
    def turns_needed(self) -> int:
        return settings.REVERSALS if self.family.count else 1

    def are_precise(self, crossings: Array, cov: Array, systematic: bool) -> bool:
        """Whether m, c_r, c_l (3,) of this covariance (3, 3) are known well enough."""
        factor = 1.0 / settings.BY_CHANCE if systematic else 1.0  # these do not average out
        m, c_r, c_l = map(float, crossings)
        std_m, *std = std_of(cov).tolist()
        gap, gap_std = c_r - c_l, sqrt(gap_variance(cov))
        gap_known = max(gap_std, *std) < factor * settings.STD_GAP * gap
        chance = settings.BY_CHANCE * gap_std
        no_gap = gap < chance and gap + chance < settings.NEGLIGIBLE * self.guess
        return std_m < factor * settings.STD_SLOPE * m and (gap_known or no_gap)

    def moves_unexplained(self, f: WindowFit) -> bool:
        """Whether correlated residuals exceed what is tolerated; never if G is taken for exact."""
        return f.systematic and f.unexplained > settings.NEGLIGIBLE and self.family.count > 0

    def moves_against(self, f: WindowFit) -> bool:
        """Whether y moves against v: m is negative for certain, with a size within its bounds."""
        certain = -f.m > settings.BY_CHANCE * float(std_of(f.crossings_cov)[0])
        return certain and self.bounds.m[0] <= -f.m <= self.bounds.m[1]

    def noisier(self, f: WindowFit) -> bool:
        """Whether readings are noisier than nominal noise or quantization makes them."""
        return f.noise > settings.AS_GOOD * max(self.noise_std, f.step / sqrt(12.0))

    def outside_bounds(self, f: WindowFit) -> list[OutOfBounds]:
        """Those of m, c_r, c_l that lie outside their bounds by more than chance."""
        values = f.crossings
        apart = np.abs(values - self.bounds.project(*values.tolist()))
        outside = apart > settings.BY_CHANCE * std_of(f.crossings_cov) + 1e-9 * np.abs(values)
        return [OutOfBounds(name, float(value), getattr(self.bounds, name)) for name, value, out
                in zip(('m', 'c_r', 'c_l'), values, outside, strict=True) if out]


def afresh(
    setup: Setup, record: Window, like: WindowFit | None = None, older: Prior | None = None,
    also: WindowFit | None = None, walks: bool = False,
) -> WindowFit | None:
    """The best fit of a search over all gaps, with the spread of rivals; None if none explains y.

    like: fit around whose G the search begins, instead of the nominal one. also: another fit to
    start from; if it knows its gap, others are looked for around its G. walks: try walks of u.
    """
    family, swing, first = setup.family, float(np.ptp(record.v)), float(record.v[0])
    if np.isfinite(record.y).sum() < 15 + 2 * family.count or not swing:
        return None
    p = setup.problem(record, older)
    # In the first step the noise is taken to be at least a twentieth of the motion of y.
    noise = max(setup.noise_std, 0.05 * float(np.nanstd(record.y)))
    xi = np.zeros(family.count) if like is None else like.theta[3:]
    # If v has not reversed often enough whatever the gap, the fit will hardly be used: be brief.
    hopeless = record.turns(0.01 * swing, first) < setup.turns_needed
    fits, candidates = list[WindowFit](), 1 if hopeless else 3  # number of gaps to fit
    if also is not None and also.m > 0.0:
        begin = also.without_intervals(setup.walk_std)
        # The second one leaves the optimum that `also` is in.
        fits += [p.finished(p.fitted(f, FIRST_STEPS))
                 for f in (p.begun(begin), replace(begin, x=np.zeros(1)))]
    known = [f for f in fits if setup.is_known(f, settings.REVERSALS)]
    for _ in range(1 if hopeless else 2):  # the second time around the G of the best fit
        found, null = search(family, record.v, record.y, setup.noise_std, setup.widest, xi)
        if not found or found[0].evidence < null + settings.ENGAGED:
            return None
        gaps = [f.gap for f in known if f.behind(xi) < 1.0]  # another G, another optimum
        for evidence, gap, p0, m, peak in found:
            # Around the wrong G, the evidence of another optimum may be far too low.
            near = peak or evidence > found[0].evidence - settings.FAR_BEHIND
            differs = 0.2 if peak else 0.5  # of a gap by at least so much; 0.16: next in the grid
            if near and m * found[0].m > 0.0 and len(gaps) < candidates and \
                    all(abs(gap - other) > differs * max(gap, other) for other in gaps):
                gaps.append(gap)
                theta = np.concatenate([[m, m * (p0 - first), gap], xi])
                begin = WindowFit(np.zeros(1), p0, theta, noise, walk_std=setup.walk_std)
                begin = p.step(begin, NEAR[0], held=True, begun=True)
                fits.append(p.finished(p.fitted(begin, FIRST_STEPS)))
        best = max(fits, key=lambda f: f.evidence, default=None)
        if best is None or (best.valid and best.behind(xi) < 1.0):
            break
        xi = best.theta[3:]
    fits = sorted((f for f in fits if np.isfinite(f.evidence)), key=lambda f: -f.evidence)
    different = [f for i, f in enumerate(fits) if all(
        abs(f.gap - g.gap) >= 0.1 * sqrt(max(float(g.cov[2, 2]), 0.0)) for g in fits[:i])]
    if not different:  # slopes of 0, or even the best one has diverged
        return None
    likely = different[0].evidence - settings.FAR_BEHIND
    fits = [p.finished(p.fitted(f)) for f in different if f.evidence >= likely]
    best = max(fits, key=lambda f: f.evidence)
    if best.m < 0.0 or (older is None and best.left.turns < setup.turns_needed):
        return best  # not known, however precise it is
    best = mixed(p, p.with_intervals(best), fits)
    return with_walk(p, best, setup.walk_std) if walks else best


def mixed(p: Problem, best: WindowFit, others: Sequence[WindowFit] = ()) -> WindowFit:
    """The likeliest of these fits and of others nearby, with the spread of the mixture."""
    if best.error_of_G > SCALES[-1] and coasting_score(p, best) < settings.BY_CHANCE:
        best, others = p.likelier_as_told(best), ()
    rival, chance = _wiener(p, best)
    if chance > 0.5:
        best, rival, chance, others = rival, best, 1.0 - chance, ()
    wider, beyond = _along_the_gap(p, best)
    # Only between fits that take readings in the same way can evidences be compared.
    alike_read = (f if bool(f.step) == bool(best.step) else p.finished(p.fitted(replace(
        f, step=best.step, noise_std=best.noise_std), FEW_STEPS)) for f in others)
    fits = [f for f in (best, *alike_read, *beyond, *_begun_elsewhere(p, best)) if f.valid]
    likeliest = max(fits, key=lambda f: f.evidence, default=best)
    if likeliest.evidence > best.evidence + 0.5:  # else it is the same optimum
        return mixed(p, likeliest, fits)
    # A rival that explains the readings as well is not ruled out by what it leaves undetermined.
    w = p.at(best).weights
    value = p.log_posterior(best, w)
    odds = np.array([max(f.evidence - best.evidence, p.log_posterior(f, w) - value) for f in fits])
    share = np.exp(odds - odds.max(initial=-inf))
    for each, f in zip(share / share.sum(), fits, strict=True):
        wider += each * f.apart(best)
    return replace(best, spread=wider + chance * rival.apart(best))


def _wiener(p: Problem, best: WindowFit) -> tuple[WindowFit, float]:
    """The fit of a play behind G, which xi and a wrong gap can imitate, and its probability.

    `best` and 0 if out of question: white residuals and a small xi, an integrator, coasting.
    """
    white = not best.left.correlation and np.linalg.norm(best.theta[3:]) < settings.BY_CHANCE
    if white or best.wiener or not best.valid or p.family.leaks or not p.family.count:
        return best, 0.0
    with suppress(np.linalg.LinAlgError):
        f = p.likelier_as_told(p.anew(best, True, False))
        if f.valid and (f.left.rms < best.left.rms or coasting_score(p, best) < settings.BY_CHANCE):
            return f, 1.0 / (1.0 + exp(min(best.odds_over(f), 700.0)))
    return best, 0.0


def _begun_elsewhere(p: Problem, best: WindowFit) -> list[WindowFit]:
    """Fits in which another stroke of v is the first to move p: there, p0 has another optimum."""
    fits = list[WindowFit]()
    if best.left.turns >= settings.HELD_REVERSALS or not isnan(p.older.v) or not best.valid:
        return fits  # many reversals leave a single one
    begins = np.append(best.p0, p.v[0] + best.gap * np.arange(5.0) / 4.0)
    moved = play(p.v, np.full(len(begins), best.gap), begins, p.strokes) != begins[:, None]
    stroke = np.repeat(np.arange(len(p.strokes.ends)), p.strokes.lengths)
    first = np.unique(stroke[moved.argmax(axis=1)], return_index=True)[1]
    with suppress(np.linalg.LinAlgError):
        for p0 in begins[first[first > 0]].tolist():
            held = p.step(replace(best, p0=p0), held=True, begun=True)
            fits.append(p.finished(p.fitted(held, FIRST_STEPS)))
    return fits


def _along_the_gap(p: Problem, best: WindowFit) -> tuple[Array, list[WindowFit]]:
    """Follow the profile likelihood of the gap, r standard deviations to either side.

    Returns the covariance of m, c_r, c_l, xi (3 + K, 3 + K) beyond a normal posterior, which
    falls by r^2 / 2, and the fits of other optima, met where it falls by less than half of that.
    """
    none, beyond = np.zeros((len(best.theta),) * 2), list[WindowFit]()
    if not (best.valid and best.gap > 0.0 and best.cov[2, 2] > 0.0):
        return none, beyond
    weights, std = p.at(best).weights, sqrt(best.cov[2, 2])
    likeliest, widest = p.log_posterior(best, weights), 2.0 * float(np.ptp(p.v))
    widths, sides = list[float](), list[Array]()
    for away in (-3.0, 3.0):
        wider, nearer, beside, last, there = none, 0.0, None, best, best
        for reach in away * 3.0 ** np.arange(6.0):
            gap = best.gap + reach * std
            if not 0.0 < gap < widest:
                break
            normal = likeliest - 0.5 * reach**2
            # After many reversals a likelihood that begins to fall like a normal one goes on so.
            close = 0.1 * reach**2 * (not nearer and best.left.turns >= settings.HELD_REVERSALS)
            # Continuation: from where the last two points lead, as p0 and o change with the gap.
            near = p.towards(last, there, (gap - last.gap) / (there.gap - last.gap or 1.0))
            last, (value, there) = there, _with_gap(p, near, gap, weights, normal, close)
            if not there.m > 0.0 or abs(value - normal) < close:
                break
            behind = max(likeliest - value, 1.0)
            if nearer <= 2.0:  # else the last likely gap may lie far short of this one
                more = max(0.5 / behind - reach**-2, 0.0) * there.apart(best)
                wider = max(wider, more, key=np.trace)
            beside = there if behind < 0.25 * reach**2 else None
            if nearer and behind > 2.0:
                break
            nearer = behind
        if beside is not None:
            beyond.append(p.finished(p.fitted(beside)))
        widths.append(sqrt(best.cov[2, 2] + gap_variance(wider)))
        sides.append(wider)
    # A two-piece normal: each side is as probable as it is wide.
    return np.average(sides, axis=0, weights=widths), beyond


def _with_gap(
    p: Problem, near: WindowFit, gap: float, weights: Array, normal: float, close: float,
) -> tuple[float, WindowFit]:
    """The highest log-posterior with this gap, and its fit, starting from a fit near it; other p0
    are only tried if it is not within `close` of `normal`."""
    v, best, theta = float(p.at(near).v[0]), (-inf, near), near.theta.copy()
    theta[2] = gap
    # p0 may block the way to another gap: if it is unknown, also start from both of its ends.
    ends = [(0.0, True), (1.0, True)] * isnan(p.older.v)
    for share, begun in [((near.p0 - v) / near.gap, False), *ends]:
        f, value = replace(near, p0=v + share * gap, theta=theta), -inf
        with suppress(np.linalg.LinAlgError):  # y overflows so far away
            for _ in range(FIRST_STEPS):
                f, before = p.step(f, held=True, begun=begun), value
                value = p.log_posterior(f, weights)
                best = max(best, (value, f), key=lambda one: one[0])
                if value < before + 0.1:
                    break
        if abs(best[0] - normal) < close:
            break
    return best
