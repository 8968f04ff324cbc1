"""Least squares over a window of samples for one gap, with all that is not known of G.

The labels of the play operator hold for the gap they were made with. The solution has a gap of its
own, (m c_r - m c_l) / m, because the column of m c_l is free: it carries the derivative of y by the
gap, so that labels made once more with it are a Gauss-Newton step (relabelling.py).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import lru_cache
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import BY_CHANCE, GATE, LAGS, SLOW
from backlash_ros.core.estimation.fit.crossings import crossings_of
from backlash_ros.core.estimation.fit.solution import Around, Solution
from backlash_ros.core.estimation.fit.weighted_samples import WeightedSamples
from backlash_ros.core.estimation.regression.play import NO_PAST, Labels, Start
from backlash_ros.core.estimation.regression.posterior import (
    VAGUE,
    Posterior,
    Triangle,
    mixture,
    with_zero,
)
from backlash_ros.core.estimation.regression.regressors import RAMPS, Regressors
from backlash_ros.core.estimation.regression.residuals import largest_correlation
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

NEXT = (1,)  # lag of successive residuals
PAST = 3  # memories of G for which what its error does may last
STEP_SAMPLES = 64  # samples over which the size of a column is told
# --- guards
ANY_STATE = 1e3  # prior of x0, in units of the largest output and of the noise
NO_RESIDUAL = 1e-10  # share of the largest y below which a residual is rounding


class WindowFit:
    """Takes in samples and solves for all unknowns.

    slope: about m, for the prior of the error of G. extent: largest |y| and |v|. samples: how many
    are expected, for a walk.
    """

    def __init__(
        self, around: Around, start: Start, slope: float, extent: tuple[float, float],
        samples: int = 0,
    ) -> None:
        self.around, self.start, self.slope, self.extent = around, start, slope, extent
        self.model, self._expected = around.model, samples
        ramp = max(-(-samples // RAMPS), SLOW) if around.walk > 0.0 else 0
        past = start.labels(start.past) if len(start.past) else None
        self._before = None if past is None else past.p  # play outputs before the first sample
        self._begun = begun = start if past is None else start.at_end(past)
        self._regressors = Regressors(around.model, around.error, begun.side == 0, ramp)
        if past is not None:
            self._regressors.begin_after(past.p - np.concatenate([[start.p], past.p[:-1]]))
        self.layout = self._regressors.layout
        self.gap_spread = 0.0  # deviation of the gap over all labels, at least
        self.reversals = 0
        self._play = begun
        self._first_v: float | None = None
        self._highest, self._lowest = -inf, inf
        self.samples = WeightedSamples(self._vague(*extent))

    @property
    def length(self) -> int:
        """How many samples."""
        return self.samples.length

    @property
    def swing(self) -> float:
        """Distance between the largest and the smallest v."""
        return max(self._highest - self._lowest, 0.0)

    def _vague(self, y_reach: float, v_reach: float) -> Array:
        """Weights of priors that are no information."""
        n, layout = self.layout.n, self.layout
        weights = np.zeros(layout.unknowns)
        told_std = self.around.told_std
        weights[:n] = told_std / (ANY_STATE * (y_reach + told_std))
        unit = VAGUE * step_norm(self.model)
        weights[n:layout.driven] = unit
        weights[n + 1] = unit * (v_reach or 1.0)
        weights[layout.walk] = unit
        return weights

    def columns(self, v: Array, y: Array) -> Array:
        """Columns for the next v (N,), applied one after the other, and y (N,) after each.

        The samples are to take them in next.
        """
        play = self._play
        labels = play.labels(v)
        if self._first_v is None:
            self._first_v = float(v[0])
        self._advance(labels)
        self._highest = max(self._highest, float(v.max()))
        self._lowest = min(self._lowest, float(v.min()))
        return self._regressors.rows(labels, y)

    def contradiction(
        self, rows: Array, y: Array, solution: Solution,
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Square of y minus its prediction from rows, in units of its variance, shape (N,).

        And which of them are outliers. nan where y was lost.
        """
        posterior = solution.posterior
        var = np.einsum('np,np->n', rows @ posterior.cov, rows) * solution.inflation + 1.0
        squares: Array = (y - rows @ posterior.mean) ** 2 / (var * posterior.noise_std**2)
        return squares, squares > GATE**2

    def _advance(self, labels: Labels) -> None:
        sides = labels.right - labels.left
        before = self._play.side
        changes = np.count_nonzero(sides[1:] != sides[:-1]) + int(sides[0] != before)
        # The first engagement is no reversal.
        self.reversals += changes - int(before == 0 and changes > 0)
        self._play = self._play.at_end(labels)

    def play_output(self, gap: float, solution: Solution) -> float:
        """Play output after the newest sample for a gap close to that of the labels."""
        play = self._play
        if play.side == 0:
            return solution.start
        return play.v_a + (gap if play.side < 0 else 0.0)

    def start_after(self, v: Array) -> Start:
        """Where the play operator stands after v (N,), the first samples of this fit."""
        after = self._begun.after(v)
        if not self.layout.errors or after.side == 0:
            return after
        history = np.concatenate([self.start.past, v])
        gone = max(len(history) - PAST * self.model.memory, 0)
        begin = self.start._replace(past=NO_PAST).after(history[:gone])
        return begin._replace(past=history[gone:])

    def forgotten_after(self, v: Array) -> int:
        """Samples of v (N,) after which u no longer depends on where the play began."""
        return self._begun.forgotten_after(v) if self._begun.side == 0 else 0

    def relabelled(self, start: Start, slope: float) -> WindowFit:
        """A fit of the same samples around the same, with the labels for another start."""
        return WindowFit(self.around, start, slope, self.extent, self._expected)

    def emptied(self) -> WindowFit:
        """This fit after its samples, which are to be taken in once more; their columns stay."""
        other = copy(self)
        other.samples = WeightedSamples(self._vague(*self.extent))
        return other

    def restarted(self, around: Around, start: Start) -> WindowFit:
        """A fit of samples yet to come, with the prior of `around`, after a break."""
        return WindowFit(around, start, self.slope, self.extent)

    def unexplained(self, solution: Solution) -> float:
        """Motion of u behind the correlated part of the residual, over m times the gap."""
        size = step_norm(self.model) / sqrt(STEP_SAMPLES)
        scale = size * abs(solution.m) * max(solution.gap, 0.0)
        motion = sqrt(solution.correlation) * solution.rms
        return motion / scale if scale > 0.0 else inf

    def solve(
        self, walk: float | None = None, leaking: bool = False, alone: bool = False,
    ) -> Solution:
        """The solution for all samples so far.

        walk: instead of that of `around`. leaking: where G integrates, it leaks for sure. alone:
        without the prior of theta.
        """
        layout = self.layout
        triangle, offset, prior = self._with_start(self.samples.triangle), 0.0, self.around.prior
        own: Solution | None = None
        if prior is not None and not alone:
            if self.around.inherited and triangle.count > layout.unknowns:
                own = self.solve(walk, leaking, alone=True)
            # What the model cannot explain of these samples makes the prior no worse.
            cov = prior.cov if own is None else prior.cov / own.inflation
            triangle = triangle.informed(layout.theta, prior.theta, cov, self.around.told_std)
        if layout.ramps:
            step = (walk or self.around.walk) / sqrt(layout.ramps)
            triangle, offset = triangle.with_prior(layout.walk, step, self.around.told_std)
        posterior, leaky = self._posteriors(triangle)
        if offset:
            posterior = replace(posterior, evidence=posterior.evidence + offset)
        return self._solution(leaky() if leaking else posterior, leaky, own)

    def leaking(self, solution: Solution) -> Solution:
        """The same where an integrator of G leaks for sure."""
        if solution.alone is not None:
            return self.solve(leaking=True)  # the samples alone, beside their prior, leak as well
        return self._solution(solution.leaky(), solution.leaky, None)

    def _solution(
        self, posterior: Posterior, leaky: Callable[[], Posterior], own: Solution | None,
    ) -> Solution:
        layout = self.layout
        residual = self.samples.residual(posterior)
        squares = float(residual @ residual)
        count = self.samples.triangle.count
        correlation = 0.0
        if squares > count * (NO_RESIDUAL * self.extent[0]) ** 2 and count > 1.0:
            # A sensor with a resolution repeats its error over some lags as well.
            lags = LAGS if self.around.inherited else NEXT
            correlation = max(0.0, largest_correlation(residual, lags) - BY_CHANCE / sqrt(count))
        rounding = self.samples.rounding
        if rounding is not None:
            # What is within the intervals is no motion of its own.
            noise_squares = count * rounding.together**2
            correlation *= min(squares / noise_squares, 1.0)
            squares = max(squares, noise_squares)
        inflation = own.inflation if own else 1.0 - correlation + count * correlation
        posterior = self._with_other_labels(posterior, inflation)
        theta, cov = self._theta_now(posterior)
        cov = cov * (posterior.noise_std**2 * inflation)
        m = float(theta[0])
        held = float(posterior.mean[layout.n])
        start = self.start.p
        if self._begins_within_the_gap and m != 0.0:
            start = (held + float(posterior.mean[layout.n + 2])) / m
        return Solution(
            posterior, theta, cov, crossings_of(theta, cov),
            float(theta[1] - theta[2]) / m if m != 0.0 else self.start.gap, start, count,
            correlation, inflation, sqrt(squares / max(count, 1.0)), own, leaky,
        )

    def _with_start(self, triangle: Triangle) -> Triangle:
        """The same where p began anywhere within the gap.

        The labels may leave few samples to tell, and u before them would be anything. Where v never
        engaged, u is all there is.
        """
        gap, n, first = self.start.gap, self.layout.n, self._first_v
        if first is None or self._play.side == 0 or not self._begins_within_the_gap:
            return triangle
        # u0 = m (p - c_r), and p = v(0) + g/2 on average.
        row = np.zeros(self.layout.unknowns)
        row[n:n + 4] = 1.0, -first, 0.5, 0.5
        std = abs(self.slope) * gap / sqrt(12.0)  # of what is anywhere in between
        return triangle.with_combination(row, std, self.around.told_std)

    @property
    def _begins_within_the_gap(self) -> bool:
        """Whether the first v leaves the play output where it was; otherwise it tells nothing."""
        begun, first = self._begun, self._first_v
        return begun.side == 0 and first is not None \
            and first < begun.p < first + self.start.gap

    def _posteriors(self, triangle: Triangle) -> tuple[Posterior, Callable[[], Posterior]]:
        """Of all unknowns, and where an integrator of G leaks for sure; it may or may not.

        One is as likely as the other before the data speak.
        """
        layout, around = self.layout, self.around
        spreads: Array = np.ones(layout.unknowns - layout.base)
        # The first jump of p is known no better than the gap.
        spreads[layout.errors:] = max(self.start.gap, 1e-12)

        def of(part: Triangle, base: int) -> Posterior:
            return part.posterior(
                base, self.slope, spreads, around.told_std, around.most
            )

        if not layout.leak:
            posterior = of(triangle, layout.base)
            return posterior, lambda: posterior
        rest, base = triangle.after(layout.driven), layout.base - layout.driven
        leaky, offset = rest.with_prior(slice(0, 1), around.error.leak, around.told_std)
        tight, other = rest.without_first(), of(leaky, base)
        if layout.ramps:
            offset += tight.log_precision(0, base - 1) - leaky.log_precision(1, base)
        both = mixture(with_zero(of(tight, base - 1)), other, offset)
        return triangle.with_first(both), lambda: triangle.with_first(other)

    def _with_other_labels(self, posterior: Posterior, inflation: float) -> Posterior:
        """The same with a gap, and all that goes with it, no better known than over all labels."""
        where, noise_var = self.layout.theta, posterior.noise_std**2 * inflation
        m, product_r, product_l = posterior.mean[where].tolist()
        if self.gap_spread == 0.0 or not m > 0.0 or noise_var == 0.0:
            return posterior
        gradient = np.array([(product_l - product_r) / m, 1.0, -1.0]) / m
        by = posterior.root @ (posterior.root[where].T @ gradient)
        var = float(gradient @ by[where])
        wanted = self.gap_spread**2 / noise_var
        if not 0.0 < var < wanted:
            return posterior
        along = by / var  # by which all unknowns move with the gap
        further = sqrt(wanted - var) * along
        return replace(posterior, root=np.column_stack([posterior.root, further]))

    def _theta_now(self, posterior: Posterior) -> tuple[Array, Array]:
        """Theta (3,) after what a walk has moved it by, and its covariance (3, 3) per sigma^2."""
        layout, where = self.layout, self.layout.theta
        theta, root = posterior.mean[where], posterior.root[where]
        if layout.ramps:
            now = np.eye(3, layout.unknowns, where.start)
            now[1:, layout.walk] = -self._regressors.heights
            theta, root = now @ posterior.mean, now @ posterior.root
        return theta, root @ root.T

    def misfit(self, solution: Solution, since: int) -> float:
        """Mean square of the residual from sample `since` on, over that of all samples."""
        newest = self.samples.residual(solution.posterior, since)
        known = np.count_nonzero(newest)
        if not known or solution.rms == 0.0:
            return 0.0
        return float(newest @ newest) / known / solution.rms**2

    def state(self, solution: Solution) -> tuple[Array, Array]:
        """State of G after the newest sample, shape (n,), and its honest covariance (n, n)."""
        posterior = solution.posterior
        by = self._regressors.state_map()
        variance = posterior.noise_std**2 * solution.inflation
        known = self.layout.base
        cov = by @ posterior.cov[:known, :known] @ by.T
        return by @ posterior.mean[:known], cov * variance

    def input(self, solution: Solution, v: Array) -> Array:
        """u as the fit has it, shape (N,). v: the samples taken in."""
        n = self.layout.n
        labels = self._begun.labels(v)
        mean = solution.posterior.mean
        held, m, right, left = mean[n:n + 4]
        walked = mean[self.layout.walk] @ self._regressors.ramps(0, len(v))
        return np.asarray(
            labels.held * held + labels.v_a * m - labels.right * right - labels.left * left + walked
        )

    def input_before(self, solution: Solution, samples: int) -> Array:
        """u of so many samples before the first one: at rest, as far as none are remembered."""
        p = np.array([solution.start]) if self._before is None else self._before
        m, right = solution.posterior.mean[self.layout.n + 1:self.layout.n + 3]
        return np.pad(m * p - right, (samples, 0), mode='edge')[-samples:]


@lru_cache(maxsize=64)
def step_norm(model: StateModel) -> float:
    """Norm of the first samples of the step response of G."""
    x: Array = np.zeros(model.order)
    total = 0.0
    for _ in range(STEP_SAMPLES):
        x = model.a @ x + model.b
        total += (model.c * float(x[0])) ** 2
    return sqrt(total)
