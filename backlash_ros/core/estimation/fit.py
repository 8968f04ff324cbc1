"""The fit of all unknowns to a record: Gauss-Newton steps with exact derivatives.

    y = G(z; xi) [m p(v; g, p0) - o + d] + X / A(z; xi) + e,   o = m c_r,   xi ~ N(0, s^2)

Unknowns are the state X before the record, the knots of a disturbance d that walks to 0 at its end
(o is that of its end), where the play began (p0), the slope m, the offset o, the gap g, and xi
(plant_family.py). A step solves the linearized least squares by QR; the scale s and the noise are
integrated out in closed form (Normal-Gamma) over a grid of s, whose prior is log-normal around 1:
G is about as wrong as configured. A leak has a prior of its own. The derivatives by g and p0 are
those of the play: 1 where the left side was engaged last, and where none was. What older samples
say is rows (R, d) on theta = (m, o, g, xi).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from math import inf, isfinite, log, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.plant_family import Family, padded, state_columns
from backlash_ros.core.estimation.posterior import (
    Left,
    Likelihood,
    Prior,
    Start,
    WindowFit,
    error_of_plant,
    independence,
    likelihood,
    step_of,
)
from backlash_ros.core.plant.backlash import Region, engaged, play, reversals
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]

STEPS, FIRST_STEPS, FEW_STEPS = 16, 6, 3  # of Gauss-Newton, at most


@dataclass
class _Evaluated:
    """What a record is by the values of a fit: G as b / a, p, u and y (N,), and what was asked."""

    fit: WindowFit
    b: list[float]
    a: list[float]
    p: Array
    u: Array
    y: Array
    independent: tuple[Array, NDArray[np.intp]]
    likelihoods: dict[tuple[float, float], Likelihood] = field(default_factory=dict)


class Problem:
    """A record v, y (N,), y nan where lost, with what is known beside it.

    noise_std: nominal, a weak prior. older: what samples before the record say. start: where the
    play rests, None where unknown. walk_std: of u per square root of a sample, 0 for none. step: of
    the readings, None to be told from them.
    """

    def __init__(
        self, family: Family, v: Array, y: Array, noise_std: float,
        older: Prior | None = None, start: Start | None = None, walk_std: float = 0.0,
        step: float | None = None,
    ) -> None:
        self.family, self.v, self.nominal = family, v, noise_std
        self.older, self.start = older, start
        self.known = np.isfinite(y)
        self.y = np.where(self.known, y, 0.0)
        self.step_of_readings = step_of(y) if step is None else step
        self._newest: list[_Evaluated] = []  # of which nothing is computed again
        self._walk_by(walk_std)

    def walking(self, walk_std: float) -> Problem:
        """The same for another walk of u."""
        other = copy(self)
        other._walk_by(walk_std)
        return other

    def _walk_by(self, walk_std: float) -> None:
        count, self.walk_std = len(self.v), walk_std
        knots = min(max(count // 8, 1), 36) if walk_std else 0  # 8 samples apart, or more
        at = np.linspace(0.0, count - 1.0, knots + 1)
        self._hats = np.array([  # d by each of its knots, and to 0 at the end
            np.interp(np.arange(count), at, row) for row in np.eye(knots, knots + 1)
        ]).reshape(knots, count)

    @property
    def _knot_std(self) -> float:
        return self.walk_std * sqrt(len(self.v) / max(len(self._hats), 1))

    # --- the model -----------------------------------------------------------------------------

    def input(self, f: WindowFit) -> tuple[Array, Array]:
        """p and u = m p - o + d over the record, both (N,)."""
        evaluated = self._evaluated(f)
        return evaluated.p, evaluated.u

    def output(self, f: WindowFit) -> Array:
        """y that is expected (N,)."""
        return self._evaluated(f).y

    def _evaluated(self, f: WindowFit) -> _Evaluated:
        for one in self._newest:
            if (f.x is one.fit.x and f.theta is one.fit.theta and f.knots is one.fit.knots
                    and f.p0 == one.fit.p0):
                return one
        p = play(self.v, max(f.gap, 0.0), f.p0)
        u = f.m * p - f.theta[1]
        if len(f.knots):
            at = np.linspace(0.0, len(self.v) - 1.0, len(f.knots) + 1)
            u += np.interp(np.arange(len(self.v)), at, np.append(f.knots, 0.0))
        b, a = self.family.at(f.xi)
        y = lfilter(b, a, u, padded(f.x, len(a) - 1))
        independent = independence(self.y, self.known, y, self.step_of_readings)
        one = _Evaluated(f, b, a, p, u, y, independent)
        self._newest = [one, *self._newest[:2]]
        return one

    def residual(self, f: WindowFit) -> Array:
        """y minus what is expected (N,), nan where it was lost."""
        return np.where(self.known, self.y - self.output(f), np.nan)

    def weights(self, f: WindowFit) -> Array:
        """How much of an independent reading each one is where y is as f has it (N,)."""
        return self._evaluated(f).independent[0]

    def _likelihood(self, f: WindowFit) -> Likelihood:
        one, how = self._evaluated(f), (f.noise_std, f.step)
        if how not in one.likelihoods:
            found = likelihood(self.y - one.y, *how)
            # In such units that a reading more or less makes no fit the likelier one.
            density = found.log_density + log(self.step_of_readings or self.nominal)
            one.likelihoods[how] = found._replace(log_density=density)
        return one.likelihoods[how]

    def log_posterior(self, f: WindowFit, w: Array | None = None) -> float:
        """Of these values but for constants; -inf where it is no number.

        w: weights of the readings (N,), the same for all that are compared; None: those of f.
        """
        with np.errstate(all='ignore'):
            w = self.weights(f) if w is None else w
            if f.step:
                value = float((self._likelihood(f).log_density * w)[self.known].sum())
            else:
                r = self.y - self.output(f)
                squares, count = float((w * r) @ r), float(w.sum()) + 1.0
                value = -0.5 * count * log((squares + self.nominal**2) / count) \
                    if isfinite(squares) else -inf
            value += f.log_prior(self.older, self.family.leaks)
            if len(self._hats):
                moves = np.diff(self._knots_of(f), append=0.0) / self._knot_std
                value -= 0.5 * float(moves @ moves)
        return value if isfinite(value) else -inf

    # --- a Gauss-Newton step --------------------------------------------------------------------

    def step(
        self, f: WindowFit, most_scale: float = np.inf, held: bool = False, begun: bool = False,
    ) -> WindowFit:
        """The values that the linearization around f makes likeliest, with their posterior.

        held: whether the gap stays, so that all else fits it; begun: whether the beginning does.
        Raises LinAlgError where the numbers get too large.
        """
        from scipy.linalg.lapack import dtrtri  # where fits are made: 31 MB

        r, order = self._triangle(f, held, begun), len(self._evaluated(f).a) - 1
        size = r.shape[1] - 1
        k = self.family.count - self.family.leaks
        n, at = size - k, size - self.family.count - 3  # a leak is one of the first; place of m
        diagonal = np.abs(np.diag(r))[:n]
        if not np.isfinite(r).all():
            raise np.linalg.LinAlgError('the samples leave no finite posterior')
        inverse = dtrtri(r[:n, :n])[0] if diagonal.min() > 0.0 else np.linalg.pinv(r[:n, :n])
        by = inverse @ r[:n, n:]
        freedom = max(float(self.weights(f).sum()) - n, 0.0) + 1.0
        squares = float(r[size, size]) ** 2 + (self.nominal / f.noise_std) ** 2
        xi, cov_xi, scale, volume, noise = error_of_plant(
            f, r[n:, n:], squares, freedom, most_scale)
        cov = np.empty((size, size))
        cov[:n, :n] = noise * inverse @ inverse.T + by[:, :-1] @ cov_xi @ by[:, :-1].T
        cov[:n, n:] = -by[:, :-1] @ cov_xi
        cov[n:, :n], cov[n:, n:] = cov[:n, n:].T, cov_xi
        beta = np.concatenate([by[:, -1] - by[:, :-1] @ xi, xi])
        volume -= float(np.log(np.maximum(diagonal, 1e-300)).sum())
        if len(self._hats):
            volume -= len(self._hats) * log(self._knot_std)
        return replace(
            f, x=beta[:order], knots=beta[order:at - 1], walk_std=self.walk_std,
            p0=float(beta[at - 1]), theta=beta[at:], scale=scale, cov=cov[at:, at:], volume=volume,
        )

    def remembered(self, f: WindowFit) -> Prior:
        """What the record and what is known beside it say of theta, but for the prior of xi."""
        r = self._triangle(f, False, False)
        at = r.shape[1] - 4 - self.family.count
        return Prior(r[at:-1, at:-1], r[at:-1, -1])

    def _triangle(self, f: WindowFit, held: bool, begun: bool) -> Array:
        """R of the rows of a step, (P + 1, P + 1)."""
        from scipy.linalg.lapack import dgeqrf  # as above

        stack = self.rows(f, held, begun)
        scale = np.maximum(np.sqrt(np.einsum('ij,ij->j', stack, stack)), 1e-300)
        scale[-1] = 1.0
        stack /= scale
        return np.asarray(np.triu(dgeqrf(stack, overwrite_a=1)[0][:len(scale)]) * scale)

    def rows(self, f: WindowFit, held: bool = False, begun: bool = False) -> Array:
        """The least squares of a step: a row for each sample, then those beside, the target last.

        Readings have deviation 1 in it, shape (N + B, P + 1). held, begun: as above.
        """
        _, score, information = self._likelihood(f)
        x = padded(f.x, len(self._evaluated(f).a) - 1)
        beta = np.concatenate([x, self._knots_of(f), [f.p0], f.theta])
        beside = self._beside(f, len(x), len(beta), held, begun)
        count = len(self.v)
        stack = np.empty((count + len(beside), len(beta) + 1), order='F')
        rows, stack[count:] = stack[:count], beside
        jacobian = self.jacobian(f, rows[:, :-1])
        rows[:, -1] = jacobian @ beta + score / information
        rows *= np.sqrt(information * self.weights(f))[:, None]
        return stack

    def normalised(self, f: WindowFit) -> Array:
        """Residuals of deviation 1, or what stands for them with intervals (N,); 0 where lost."""
        _, score, information = self._likelihood(f)
        return np.asarray(score * np.sqrt(self.weights(f) / information))

    def _knots_of(self, f: WindowFit) -> Array:
        return f.knots if len(f.knots) == len(self._hats) else np.zeros(len(self._hats))

    def jacobian(self, f: WindowFit, out: Array | None = None) -> Array:
        """Derivatives of y by X, knots, p0, m, o, g, xi: (N, P); out: where they are written."""
        one = self._evaluated(f)
        b, a = one.b, one.a
        side = engaged(self.v, one.p, max(f.gap, 0.0))
        # A side that has not moved p yet leaves it where it began.
        side[:int(np.argmax(np.append(one.p != f.p0, True)))] = Region.GAP
        count, order, walks = len(self.v), len(a) - 1, len(self._hats)
        at = order + walks + 4
        if out is None:
            out = np.empty((count, at + self.family.count), order='F')
        columns = np.zeros((walks + 7, count))
        columns[0], columns[1], columns[2] = side == Region.GAP, one.p, -1.0
        columns[3], columns[4:-3] = side == Region.LEFT, self._hats
        columns[[0, 3]] *= f.m
        columns[-3], columns[-2], columns[-1, 0] = one.u, -one.y, 1.0
        once = lfilter([1.0], a, columns)
        for i in range(order):
            out[:i, i], out[i:, i] = 0.0, once[-1, :count - i]
        forced = lfilter(b, [1.0], once[:-3])
        out[:, order:order + walks], out[:, order + walks:at] = forced[4:].T, forced[:4].T
        if self.family.count:
            slopes = np.stack(self.family.slopes(f.xi), axis=1)
            late = np.zeros((*slopes.shape[1:], count))  # u / A and -y / A, so many samples later
            for i in range(late.shape[1]):
                late[:, i, i:] = once[-3:-1, :count - i]
            out[:, at:] = np.tensordot(late, slopes, ((0, 1), (1, 2)))
        return out

    def _beside(self, f: WindowFit, order: int, size: int, held: bool, begun: bool) -> Array:
        """Rows (B, P + 1) of what is known beside the samples, the target in the last column."""
        vague = 100.0  # prior deviation of the state before a record, over the largest reading
        tight = 1e6  # weight of what is held
        walks, leaks, older = len(self._hats), self.family.leaks, self.older
        first, rows = size - 3 - self.family.count, 0 if older is None else len(older.rows)  # of m
        out = np.zeros((rows + 2 + leaks + order + walks, size + 1))
        if older is not None:
            out[:rows, first:-1], out[:rows, -1] = older.rows, older.values
        of_gap, begin = out[rows], out[rows + 1]
        of_gap[first + 2] = 1.0 / max(float(np.ptp(self.v)), 1e-300)  # the gap is within the swing
        if held:
            of_gap[first + 2], of_gap[-1] = tight, tight * f.gap
        begin[first - 1] = tight
        if begun:
            begin[-1] = tight * f.p0
        elif self.start is None:  # anywhere within the gap of now
            begin[first - 1] = sqrt(12.0) / max(f.gap, 1e-9)
            begin[-1] = (self.v[0] + 0.5 * f.gap) * begin[first - 1]
        else:
            begin[first + 2], begin[-1] = -tight * self.start.left, tight * self.start.v
        rows += 2
        out[rows:rows + leaks] = np.eye(leaks, size + 1, first + 3)
        # What no reading tells, as where the first ones were lost, would grow without bounds.
        state = 1.0 / (vague * max(float(np.abs(self.y).max()), 1e-300))
        out[rows + leaks:rows + leaks + order] = state * np.eye(order, size + 1)
        if walks:
            between = (np.eye(walks) - np.eye(walks, k=1)) / self._knot_std
            out[-walks:, first - 1 - walks:first - 1] = between
        return out

    # --- the fit --------------------------------------------------------------------------------

    def fitted(self, f: WindowFit, steps: int = STEPS) -> WindowFit:
        """Gauss-Newton steps from f until they move nothing, halved where they go too far."""
        least_move = 0.02  # deviations of the gap that a step may still move it by at the end
        far_steps = 4  # the first of them, over which G is no further off than configured
        for k in range(steps):
            weights = self.weights(f)
            best = self.log_posterior(f, weights)
            # Far from the optimum the error of the linearization passes for one of G.
            most = 1.0 if k < far_steps < steps else np.inf
            new, there, value = self._stepped(f, best, weights, most)
            if not value > best - 0.5:
                # A kink where the play began bars the way to all else: held there, it does not.
                # The posterior stays that of a step that holds nothing.
                _, begun, of_begun = self._stepped(f, best, weights, most, begun=True)
                if of_begun > value:
                    there = replace(begun, cov=new.cov, scale=new.scale, volume=new.volume)
                    value = of_begun
            if not value > best - 50.0:  # f stands: only its posterior is new, and its noise
                f = replace(f, cov=new.cov, scale=new.scale, volume=new.volume)
                noise_std = f.noise_std if f.step else self._noise_of(f)
                if noise_std > 0.9 * f.noise_std:
                    return f
                f = replace(f, noise_std=noise_std)
                continue
            moved = abs(there.gap - f.gap) / max(sqrt(max(new.cov[2, 2], 0.0)), 1e-300)
            f = there if there.step else replace(there, noise_std=self._noise_of(there))
            if moved < least_move * (1 if steps > FEW_STEPS else 10) and value - best < 1.0:
                break
        return f

    def _stepped(
        self, f: WindowFit, best: float, weights: Array, most_scale: float, begun: bool = False,
    ) -> tuple[WindowFit, WindowFit, float]:
        """What a step leads to, where it goes as far as that helps, and its log-posterior."""
        shortest_step = 0.05  # share of a Gauss-Newton step that is tried
        new = self.kept(self.step(f, most_scale, begun=begun))
        there = _towards(f, new)
        value = self.log_posterior(there, weights)
        if -inf < value <= best - 0.5:
            # Beyond a kink of the play, where another side was engaged, it may be better.
            again = _towards(there, self.kept(self.step(there, most_scale, begun=begun)))
            of_again = self.log_posterior(again, weights)
            if of_again > best:
                there, value = again, of_again
        length = 1.0
        while not value > best - 0.5 and length > shortest_step:
            length *= 0.3
            there = _towards(f, new, length)
            value = self.log_posterior(there, weights)
        return new, there, value

    def kept(self, f: WindowFit) -> WindowFit:
        """The same with its gap and its beginning where they can be."""
        least = 1e-9  # gap over the swing of v: with none at all, neither side would be told
        swing, first = float(np.ptp(self.v)), float(self.v[0])
        gap = min(max(f.gap, least * swing), 2.0 * swing)
        theta = np.concatenate([f.theta[:2], [gap], f.theta[3:]])
        p0 = f.p0 if self.start is not None else min(max(f.p0, first), first + gap)
        return replace(f, theta=theta, p0=p0)

    def _noise_of(self, f: WindowFit) -> float:
        r = np.where(self.known, self.y - self.output(f), 0.0)
        w = self.weights(f)
        free = max(float(w.sum()) - len(f.x) - len(f.knots) - 4.0, 0.0)
        return sqrt((float((w * r) @ r) + self.nominal**2) / (free + 1.0))

    def finished(self, f: WindowFit) -> WindowFit:
        """The same with what it leaves."""
        known, evaluated = self.known, self._evaluated(f)
        r = np.where(known, self.y - evaluated.y, 0.0)
        w, begins = evaluated.independent
        log_density, score, information = self._likelihood(f)
        count = float(len(begins))
        whole = score / sqrt(float(information[known].mean())) if f.step else r / f.noise_std
        e = np.add.reduceat((whole * w)[known], begins)  # of what counts as one reading
        squares = max(float(e @ e), 1e-300)
        rho = max(float(e[lag:] @ e[:-lag]) / squares for lag in (1, 2, 4, 8) if lag < len(e))
        rho = max(0.0, rho - 3.0 / sqrt(max(count, 1.0)))
        rho *= min(1.0, squares / max(count, 1.0))  # below the noise there may be anything
        turns = reversals(engaged(self.v, evaluated.p, max(f.gap, 0.0)))
        return replace(f, left=Left(
            float((log_density * w)[known].sum()), sqrt(float(r @ r) / max(int(known.sum()), 1)),
            rho, count, len(turns),
        ))

    def explained(self, f: WindowFit) -> Array:
        """y that is expected (N,) with the state before the record and the offset at their best."""
        return self.output(self.begun(f, True))

    def begun(self, f: WindowFit, offset: bool = False) -> WindowFit:
        """The same with the state before the record, and o if that is asked, at their best."""
        there = self._evaluated(replace(f, x=np.zeros(1)))
        columns = state_columns(there.a, len(self.v))
        if offset:
            of_o = lfilter(there.b, there.a, np.full(len(self.v), -1.0))
            columns = np.column_stack([columns, of_o])
        columns = columns[self.known]
        best = np.linalg.lstsq(columns, (self.y - there.y)[self.known], rcond=1e-12)[0]
        theta = f.theta + np.eye(len(f.theta))[1] * (best[-1] if offset else 0.0)
        return replace(f, x=best[:len(there.a) - 1], theta=theta)


def _towards(f: WindowFit, new: WindowFit, share: float = 1.0) -> WindowFit:
    """The values this share of the way from f to new, with the posterior of new."""
    longest = 2.0  # prior deviations by which G moves at once
    furthest = float(np.abs(new.theta[3:] - f.theta[3:]).max(initial=0.0))
    length = share * (min(longest / furthest, 1.0) if furthest else 1.0)
    order = max(len(f.x), len(new.x))
    old, x = padded(f.x, order), padded(new.x, order)
    knots = f.knots if len(f.knots) == len(new.knots) else np.zeros(len(new.knots))
    return replace(
        new, x=old + length * (x - old), knots=knots + length * (new.knots - knots),
        p0=f.p0 + length * (new.p0 - f.p0), theta=f.theta + length * (new.theta - f.theta),
    )
