"""Fits all unknowns to a record by Gauss-Newton steps with exact derivatives, one QR per step.

    y = G(z; xi) [m p(v; g, p0) - o + d] + X / A(z; xi) + e,   o = m c_r,   xi ~ N(0, s^2)
    or, with the play behind G, G(1) [m p((G v + X / A) / G(1); g, p0) - o + d] + e (Wiener model)

X: state of G before the record. p0, g: play output before it, and gap. d: disturbance of u, a walk
that ends at 0. The noise is integrated out in closed form (Normal-Gamma), the scale s over a grid;
the prior of s is log-normal around 1: G is expected to be about as wrong as configured.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from math import inf, isfinite, isnan, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation import posterior
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant import numerics, quantized
from backlash_ros.core.plant.backlash import Region, engaged, play, reversals, strokes_of
from backlash_ros.core.plant.numerics import lfilter, padded, sensitivities, shifted, triangle
from backlash_ros.core.plant.transfer_function import Array, Family

STEPS, FIRST_STEPS, FEW_STEPS = 16, 6, 3  # limits on the number of Gauss-Newton steps
NEAR = 0.1, 0.3, 1.0, 1.0  # how far xi moves in the first steps, where the linearization is bad
TIGHT = 1e6  # weight by which an unknown keeps its value


class Run(NamedTuple):
    """A record simulated with the values of a fit: input of the play v, its output p, u, y, (N,).

    b, a: of G. gain: G(1) if the play is behind G, else 1. error: readings minus y (N,), 0 where
    lost. weights, number: see `quantized.independence`.
    """

    v: Array
    gain: float
    b: list[float]
    a: list[float]
    p: Array
    u: Array
    y: Array
    error: Array
    likelihood: quantized.Likelihood
    weights: Array
    number: NDArray[np.intp]


class Problem:
    """A record to be fitted: v and y (N,), y nan where lost, and what is known beforehand.

    noise_std: nominal, a weak prior. step: quantization of y, 0 for none; None to detect it.
    knots: of a walk of u, 1 for a steady drift; 0 for as many as suit the record.
    """

    def __init__(
        self, family: Family, v: Array, y: Array, noise_std: float, older: Prior | None = None,
        step: float | None = None, knots: int = 0,
    ) -> None:
        self.family, self.v, self.nominal, self.strokes = family, v, noise_std, strokes_of(v)
        self.older = older or Prior(np.zeros((0, 3 + family.count)), np.zeros(0))
        self._leaks = 0 if self.older.rows[:, 3:].any() else family.leaks  # prior not counted yet
        self.known, self._knots = np.isfinite(y), knots
        self.y = np.where(self.known, y, 0.0)
        self.step_of_readings = quantized.step_of(y) if step is None else step
        self._runs: dict[WindowFit, Run] = {}

    def at(self, f: WindowFit) -> Run:
        """The record simulated with the values of this fit; the last three results are kept."""
        if f not in self._runs:
            b, a = self.family.at(f.xi)
            x, gain = padded(f.x, len(a) - 1), sum(b) / sum(a) if f.wiener else 1.0
            v = lfilter(b, a, self.v, x) / gain if f.wiener else self.v
            p = play(v, max(f.gap, 0.0), f.p0, strokes_of(v) if f.wiener else self.strokes)
            hats, knots, _ = self._walk_of(f)
            u = f.m * p - f.theta[1] + knots @ hats
            y = gain * u if f.wiener else lfilter(b, a, u, x)
            error = (self.y - y) * self.known
            weights, number = quantized.independence(
                self.y, self.known, y, self.step_of_readings, inf if f.step else f.noise_std)
            likelihood = quantized.likelihood(error, f.noise_std, f.step, weights)
            run = Run(v, gain, b, a, p, u, y, error, likelihood, weights, number)
            self._runs = dict([*self._runs.items(), (f, run)][-3:])
        return self._runs[f]

    def holding(self, m: float, c_r: float, c_l: float) -> Problem:
        """The same problem with this backlash, as if known to a millionth."""
        gap, older = max(c_r - c_l, 1e-9 * float(np.ptp(self.v))), self.older
        known = TIGHT / np.array([m, m * gap, gap])
        rows = np.vstack([older.rows, np.eye(3, 3 + self.family.count) * known[:, None]])
        older = older._replace(rows=rows, values=np.append(older.values, known * [m, m * c_r, gap]))
        return Problem(self.family, self.v, np.where(self.known, self.y, np.nan), self.nominal,
                       older, self.step_of_readings)

    def residual(self, f: WindowFit) -> Array:
        """Readings minus the simulated output (N,), nan where y was lost."""
        return np.where(self.known, self.at(f).error, np.nan)

    @cached_property
    def _walk(self) -> Array:
        """Basis of d: hat functions (W, N), knots some 8 samples apart or more, 0 at the end."""
        return numerics.hats(len(self.v), self._knots or min(max(len(self.v) // 8, 1), 36))

    def _walk_of(self, f: WindowFit) -> tuple[Array, Array, float]:
        """Hats, knot values, standard deviation of their differences; no hats unless u walks."""
        if not f.walk_std:
            return np.zeros((0, len(self.v))), np.zeros(0), 1.0
        knots = f.knots if len(f.knots) == len(self._walk) else np.zeros(len(self._walk))
        return self._walk, knots, f.walk_std * sqrt(len(self.v) / len(self._walk))

    def log_posterior(self, f: WindowFit, w: Array) -> float:
        """Log-posterior up to a constant; w: weights of the readings (N,). -inf if not finite."""
        leak, xi = f.theta[3:3 + self._leaks], f.theta[3 + self.family.leaks:]
        with np.errstate(all='ignore'):
            run = self.at(f)
            squares = float(xi @ xi) / f.scale**2 + float(leak @ leak)
            squares += float(np.sum((self.older.rows @ f.theta - self.older.values) ** 2))
            value = -0.5 * (squares + log(f.scale) ** 2) - len(xi) * log(f.scale)
            if f.step:
                value += float(w @ run.likelihood.log_density)
            else:
                squares, count = float((w * run.error) @ run.error), float(w.sum()) + 1.0
                value -= 0.5 * count * log((squares + self.nominal**2) / count)
            _, knots, knot_std = self._walk_of(f)
            moves = np.diff(knots, append=0.0) / knot_std
            value -= 0.5 * float(moves @ moves)
        return value if isfinite(value) else -inf

    def step(
        self, f: WindowFit, reach: float = inf, held: bool = False, begun: bool = False,
    ) -> WindowFit:
        """One Gauss-Newton step: posterior mean and covariance of the model linearized around f.

        reach: how far xi moves. held, begun: keep gap, p0. Raises LinAlgError if not finite.
        """
        from scipy.linalg.lapack import dtrtri  # late: 31 MB that only fits need

        r, run = triangle(self.rows(f, reach, held, begun)), self.at(f)
        if not np.isfinite(r).all():
            raise np.linalg.LinAlgError('the samples leave no finite posterior')
        # eta, all unknowns but the error of G, is R11^-1 (d1 - R12 xi) + R11^-1 noise.
        size, k = len(r) - 1, self.family.count - self.family.leaks  # a leak is part of eta
        n, order, at = size - k, len(run.a) - 1, size - self.family.count - 3  # at: index of m
        diagonal = np.abs(np.diag(r))[:n]
        of_eta, of_xi = np.zeros((size, n)), np.eye(size, k, -n)
        of_eta[:n] = dtrtri(r[:n, :n])[0] if diagonal.min() > 0.0 else np.linalg.pinv(r[:n, :n])
        of_xi[:n] = -of_eta[:n] @ r[:n, n:-1]
        freedom = max(float(run.weights.sum()) - n, 0.0) + 1.0
        squares = float(r[size, size]) ** 2 + (self.nominal / f.noise_std) ** 2
        xi, cov_xi, scale, volume, noise = posterior.error_of_plant(f, r[n:, n:], squares, freedom)
        beta = of_eta @ r[:n, -1] + of_xi @ xi
        swing, first = float(np.ptp(self.v)), float(run.v[0])
        # With a gap of exactly 0, both sides would be engaged at once.
        beta[at + 2] = gap = min(max(beta[at + 2], 1e-9 * swing), 2.0 * swing)
        p0 = float(beta[at - 1])
        cov = noise * of_eta @ of_eta.T + of_xi @ cov_xi @ of_xi.T
        volume -= float(np.log(np.maximum(diagonal, 1e-300)).sum())
        _, knots, knot_std = self._walk_of(f)
        return replace(f, x=beta[:order], knots=beta[order:at - 1], theta=beta[at:],
                       p0=min(max(p0, first), first + gap) if isnan(self.older.v) else p0,
                       scale=scale, cov=cov[at:, at:], volume=volume - len(knots) * log(knot_std))

    def remembered(self, f: WindowFit, count: int) -> Prior:
        """What the first `count` samples and older ones say of theta, without the prior of xi."""
        number = np.full(len(self.v), -1)
        number[self.known] = self.at(f).number
        unrepeated = ~np.isin(number[:count], number[count:])  # the rest of the record tells others
        rows = self.rows(f)
        r = triangle(np.vstack([rows[:count][unrepeated], rows[len(self.v):]]))
        at = len(r) - 4 - self.family.count
        return Prior(r[at:-1, at:-1], r[at:-1, -1])

    def rows(
        self, f: WindowFit, reach: float = inf, held: bool = False, begun: bool = False,
    ) -> Array:
        """Least-squares rows of a step: N samples, B priors; target last, (N + B, P + 1)."""
        vague = 100.0  # prior standard deviation of X, over the largest reading
        run, jacobian, first = self.at(f), self.jacobian(f), self.at(f).v[0]
        _, score, information = run.likelihood
        (_, knots, knot_std), x = self._walk_of(f), padded(f.x, len(run.a) - 1)
        beta = np.concatenate([x, knots, [f.p0], f.theta])
        of_samples = np.vstack([jacobian.T, jacobian @ beta + score / information])
        of_samples *= np.sqrt(information * run.weights)
        at = len(x) + len(knots) + 1  # index of m
        *unit, target, none = np.eye(len(beta) + 2, len(beta) + 1)
        p0, gap, older = unit[at - 1], unit[at + 2], self.older
        near = zip(unit[at + 3:], f.xi, strict=True) if reach < inf else ()
        begin = sqrt(12.0) / max(f.gap, 1e-9) * (p0 + (first + 0.5 * f.gap) * target) \
            if isnan(older.v) else TIGHT * (p0 - older.left * gap + older.v * target)
        beside = [
            # Weak priors: a gap of the size of the swing of v, p0 anywhere in the present gap.
            TIGHT * (gap + f.gap * target) if held else gap / max(float(np.ptp(self.v)), 1e-300),
            TIGHT * (p0 + f.p0 * target) if begun else begin, *unit[at + 3:at + 3 + self._leaks],
            *((row + x * target) / reach for row, x in near),
            # Keeps X finite where no reading determines it, as when the first ones were lost.
            *(row / (vague * max(float(np.abs(self.y).max()), 1e-300)) for row in unit[:len(x)]),
            *((one - other) / knot_std for one, other in pairwise([*unit[len(x):at - 1], none])),
            *np.column_stack([np.zeros((len(older.rows), at)), older.rows, older.values])]
        return np.hstack([of_samples, np.array(beside).T]).T

    def jacobian(self, f: WindowFit) -> Array:
        """Derivatives of the simulated y by X, knots, p0, m, o, g and xi, in this order: (N, P)."""
        run, count, gap = self.at(f), len(self.v), max(f.gap, 0.0)
        side, order = engaged(run.v, run.p, gap), len(run.a) - 1
        # Until p first moves it is p0, whichever side is engaged.
        side[:int(np.argmax(np.append(run.p != f.p0, True)))] = Region.GAP
        of_play = np.vstack([self._walk_of(f)[0], f.m * (side == Region.GAP), run.p,
                             np.full(count, -1.0), f.m * (side == Region.LEFT)])
        of_play = run.gain * of_play if f.wiener else lfilter(run.b, run.a, of_play)
        into, out = (self.v, run.gain * run.v) if f.wiener else (run.u, run.y)  # of G
        u, y, impulse = lfilter([1.0], run.a, np.vstack([into, out, np.eye(1, count)]))
        of_plant = np.vstack([shifted(impulse, order), sensitivities(self.family, f.xi, u, y)])
        if f.wiener:  # p moves with its input, but not within the gap
            moves = (run.p == run.v) | (run.p == run.v + gap)
            newest = np.maximum.accumulate(np.where(moves, np.arange(count), -1))
            of_plant = f.m * np.where(newest < 0, 0.0, of_plant[:, newest])
        return np.vstack([of_plant[:order], of_play, of_plant[order:]]).T

    def fitted(self, f: WindowFit, steps: int = STEPS, least_gain: float = 0.0) -> WindowFit:
        """Take Gauss-Newton steps from f until they converge or gain under `least_gain` nats."""
        # A gap that moves by fewer standard deviations has converged, unless 1 nat is still gained.
        near, least_move = (iter(NEAR), 0.02) if steps > FEW_STEPS else (iter(()), 0.2)
        for _ in range(steps):
            weights, reach = self.at(f).weights, next(near, inf) if self.family.count else inf
            best = self.log_posterior(f, weights)
            new, there, value = self._stepped(f, best, weights, reach, False, False)
            if not value > best - 0.5:
                # A kink at p0, or an undetermined gap, may block progress: hold p0, or the gap.
                for held in (False, True):
                    _, beside, of_it = self._stepped(f, best, weights, reach, held, not held)
                    if of_it > value:
                        there, value = beside.known_as(new), of_it
            if not value > best - 50.0:  # f stays, and is known no better than before
                if reach < inf:  # but it may move if xi is free to
                    near = iter(())
                    continue
                return replace(f.known_as(new), cov=f.cov if f.cov.size else new.cov)
            moved = abs(there.gap - f.gap) / max(sqrt(max(new.cov[2, 2], 0.0)), 1e-300)
            f = there if there.step else self._with_noise(there)
            if value - best < (1.0 if moved < least_move else least_gain):
                if reach == inf:
                    break
                near = iter(())
        return f

    def _stepped(
        self, f: WindowFit, best: float, w: Array, reach: float, held: bool, begun: bool,
    ) -> tuple[WindowFit, WindowFit, float]:
        new = self.step(f, reach, held, begun)
        for length in (1.0, 0.3, 0.09, 0.027):
            there = self.towards(f, new, length)
            value = self.log_posterior(there, w)
            # Variable projection: another xi needs another X, d, m and o, in which y is linear. And
            # beyond a kink, where the other side is engaged, a second step may succeed.
            for more in ((1.0 / TIGHT, True, True), (reach, held, begun))[:1 + (length == 1.0)]:
                if -inf < value <= best - 0.5:
                    with suppress(np.linalg.LinAlgError):
                        beside = self.towards(there, self.step(there, *more))
                        of_beside = self.log_posterior(beside, w)
                        if of_beside > value:
                            there, value = beside.known_as(new), of_beside
            if value > best - 0.5:
                break
        return new, there, value

    def towards(self, f: WindowFit, new: WindowFit, share: float = 1.0) -> WindowFit:
        """The fit at this share of the way from f to new, or beyond it."""
        furthest = float(np.abs(new.theta[3:] - f.theta[3:]).max(initial=0.0))
        share *= 2.0 / max(furthest, 2.0)  # xi: two prior deviations a step, at most
        order, knots = max(len(f.x), len(new.x)), self._walk_of(f)[1]
        old, x = padded(f.x, order), padded(new.x, order)
        return replace(new, x=old + share * (x - old), knots=knots + share * (new.knots - knots),
                       p0=f.p0 + share * (new.p0 - f.p0),
                       theta=f.theta + share * (new.theta - f.theta))

    def _with_noise(self, f: WindowFit) -> WindowFit:
        """This fit with the noise_std that its residuals show."""
        run = self.at(f)
        free = max(float(run.weights.sum()) - len(f.x) - len(f.knots) - 4.0, 0.0)
        squares = (run.weights * run.error) @ run.error + self.nominal**2
        out = replace(f, noise_std=sqrt(squares / (free + 1.0)))
        likelihood = quantized.likelihood(run.error, out.noise_std, 0.0, run.weights)
        self._runs[out] = run._replace(likelihood=likelihood)
        return out

    def finished(self, f: WindowFit) -> WindowFit:
        """This fit with `left`, the statistics of its residuals and reversals, filled in."""
        run = self.at(f)
        w, count = run.weights, float(run.weights.sum())
        density, score, information = run.likelihood
        e = np.bincount(run.number, (score * w)[self.known])  # one score per independent reading
        squares, expected = max(float(e @ e), 1e-300), max(float(w @ information), 1e-300)
        rho = max(float(e[lag:] @ e[:-lag]) / squares for lag in (1, 2, 4, 8))
        dispersion = squares / expected  # below 1, rho is unreliable
        rho = max(rho - 3.0 / sqrt(max(count, 1.0)), 0.0) * min(dispersion, 1.0)
        near = expected * f.noise_std**2  # readings near an edge; unknowns take some
        dispersion *= near / max(near - len(f.x) - 1.0 - len(f.theta), 1.0)
        # Scaled so that merely counting more or fewer readings makes no fit likelier.
        value = float(w @ density) + count * log(self.step_of_readings or self.nominal)
        turns = len(reversals(engaged(run.v, run.p, max(f.gap, 0.0))))
        rms = sqrt(float(run.error @ run.error) / max(int(self.known.sum()), 1) + 1e-300)
        gain = max(float(np.std(run.y)), 1e-300) / max(float(np.std(run.u)), 1e-300)
        return replace(f, left=posterior.Left(
            value, rms, rho, dispersion if f.step else 1.0, count, turns, gain))

    def begun(self, f: WindowFit, offset: bool = False) -> WindowFit:
        """This fit with X, `offset`: o and d, too, by linear least squares; f if y overflows."""
        if f.wiener:  # y is not linear in X: if there is none yet, G was at rest
            return f if f.x.any() else replace(
                f, x=self.v[0] * numerics.rest_of(*self.family.at(f.xi)))
        run, (hats, knots, _) = self.at(replace(f, x=np.zeros(1), step=0.0)), self._walk_of(f)
        columns = [*numerics.state_responses(run.a, len(self.v))]
        if offset:
            of_u = np.vstack([*hats, np.full(len(self.v), -1.0)])
            columns += [*lfilter(run.b, [1.0], lfilter([1.0], run.a, of_u))]
        rows = np.column_stack([*columns, run.error])[self.known]
        if not np.isfinite(rows).all():
            return f
        best = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-12)[0]
        n, theta = len(run.a) - 1, f.theta.copy()
        if offset:
            theta[1], knots = theta[1] + best[-1], knots + best[n:-1]
        return replace(f, x=best[:n], knots=knots, theta=theta)

    def likelier_as_told(self, f: WindowFit) -> WindowFit:
        """This finished fit or, if that is likelier, the one with G as told."""
        told = self.anew(f, f.wiener, True)
        return told if f.odds_over(told) < 0.0 else f

    def anew(self, f: WindowFit, wiener: bool, told: bool) -> WindowFit:
        """A finished fit that begins with m, o and gap of f, and with G as told."""
        begin = replace(f.without_intervals(f.walk_std), x=np.zeros(1), wiener=wiener, told=told,
                        theta=np.append(f.theta[:3], 0.0 * f.theta[3:]))
        return self.finished(self.fitted(self.begun(begin)))

    def with_intervals(self, f: WindowFit) -> WindowFit:
        """The finished fit, by the interval likelihood unless noise hides the quantization."""
        # noise_std is the likeliest of a grid, but large enough that there is a reading near an
        # edge of its interval for every unknown: with fewer, the posterior would not be normal.
        step, unknowns = self.step_of_readings, len(f.x) + len(f.knots) + 1 + len(f.theta)
        largest, edges = 0.5 * step, unknowns / max(float(self.at(f).weights.sum()), 1.0)
        least = min(step * max(1.0 / 64.0, edges), largest)
        if not step or f.wiener or f.m <= 0.0 or (not f.step and f.noise_std > 0.75 * step):
            return self.finished(f)

        def at(level: float, begin: WindowFit) -> WindowFit:
            return self.finished(self.fitted(replace(begin, step=step, noise_std=level), FEW_STEPS))

        first = max(min(f.noise_std if f.step else 0.25 * step, largest), least)
        best = at(first, f)
        for factor in (0.5, 2.0):
            if best.noise_std < first:
                break
            while least <= factor * best.noise_std <= largest:
                other = at(factor * best.noise_std, best)
                if other.evidence <= best.evidence:
                    break
                best = other
        if best.left.rms < 1.5 * max(f.noise, step / sqrt(12.0)):
            return best
        return self.finished(self.fitted(f.without_intervals(f.walk_std)))
