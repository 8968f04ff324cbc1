"""Bayesian linear regression with learned noise and a learned scale of the error of G.

    y = X_b b + X_e e + noise,  noise ~ N(0, sigma^2),  e ~ N(0, (s m)^2 I)

b has no prior. sigma^2 is inverse gamma with few degrees of freedom around the told one; all scales
s of a grid are weighed by their evidence, with s ~ N(0, 1). X is kept as the triangle of its QR
decomposition, so that rows may come in pieces; all else is one singular value decomposition.

Reference: A. Gelman et al., Bayesian Data Analysis, 3rd ed., ch. 14; the evidence for s: D. MacKay,
Bayesian interpolation, Neural Computation 4 (1992) 415-447.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import exp, inf, isfinite, log, log1p, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]

NOISE_WEIGHT = 1.0  # samples that the told noise level counts for
# Scales s of the error of G that are compared, besides none, in units of the spread of the prior.
SCALES = np.geomspace(1e-4, 10.0, 21)
RATIOS = np.append(0.0, SCALES**2)
STEPS = np.append(SCALES[0], SCALES)
SAME = 0.7  # ratio of scales that the grid does not tell apart
# --- guards
LARGEST_EXPONENT = 700.0  # of a number that still is one
VAGUE = 1e-9  # weight of a prior, as a share of the norm of a column, that is no information


@dataclass(frozen=True)
class Posterior:
    """mean: of b and e, shape (p,). root: L of their covariance L L', in units of sigma^2.

    noise_std: sigma. scale: the most likely s. evidence: log-likelihood of the data with b, e and
    sigma integrated out, comparable between fits of the same data.
    """

    mean: Array
    root: Array  # shape (p, ..)
    noise_std: float
    scale: float
    evidence: float

    @cached_property
    def cov(self) -> Array:
        """Covariance, shape (p, p)."""
        return self.root @ self.root.T


class Triangle:
    """R of the weighted rows [X, y] so far, shape (p + 1, p + 1), and the sum of their weights.

    given: how many other unknowns these p are given.
    """

    def __init__(self, r: Array, count: float = 0.0, given: int = 0) -> None:
        self.r, self.count, self.given = r, count, given

    def append(self, rows: Array, y: Array, count: float) -> None:
        """Take in weighted rows (N, p) with outputs y (N,); count: sum of their weights."""
        self.r, self.count = self._r_with(rows, y), self.count + count

    def informed(self, where: slice, mean: Array, cov: Array, told_std: float) -> Triangle:
        """The same with a prior of these unknowns: mean (k,), covariance (k, k)."""
        root = np.linalg.inv(np.linalg.cholesky(cov)) * self._noise(told_std)
        rows = np.zeros((len(mean), len(self.r) - 1))
        rows[:, where] = root
        return self._with_rows(rows, root @ mean)

    def with_combination(self, row: Array, std: float, told_std: float) -> Triangle:
        """The same where this combination (p,) of the unknowns is 0 but for this deviation."""
        return self._with_rows((row * (self._noise(told_std) / std))[None], np.zeros(1))

    def hold_noise(self, noise_std: float) -> None:
        """Let the residual so far be that of noise of this deviation."""
        size = len(self.r) - 1
        self.r[size, size] = noise_std * sqrt(max(self.count - self.given - size, 0.0))

    def after(self, count: int) -> Triangle:
        """That of the other unknowns given the first `count` ones."""
        return Triangle(self.r[count:, count:], self.count, self.given + count)

    def without_first(self) -> Triangle:
        """The same where the first unknown is 0."""
        return Triangle(_triangular(self.r[:, 1:].copy(order='F')), self.count, self.given)

    def log_precision(self, first: int, last: int) -> float:
        """Of these unknowns given all before them: how sharply the rows tell them."""
        return float(np.log(np.abs(self.r.diagonal()[first:last])).sum())

    def with_prior(self, where: slice, std: float, told_std: float) -> tuple[Triangle, float]:
        """The same with independent priors of these unknowns, and what that adds to the evidence.

        std: their deviation, around 0.
        """
        sigma, count = self._noise(told_std), where.stop - where.start
        rows = np.eye(count, len(self.r) - 1, where.start) * (sigma / std)
        other = self._with_rows(rows, np.zeros(count))
        return other, count * log(sigma / std) - other.log_precision(where.start, where.stop)

    def _noise(self, told_std: float) -> float:
        """Deviation of the noise, as far as the rows tell it without a prior."""
        size = len(self.r) - 1
        squares = float(self.r[size, size]) ** 2 + NOISE_WEIGHT * told_std**2
        return sqrt(squares / (max(self.count - self.given - size, 0.0) + NOISE_WEIGHT))

    def _with_rows(self, rows: Array, y: Array) -> Triangle:
        """The same with rows that count for no sample."""
        return Triangle(self._r_with(rows, y), self.count, self.given)

    def _r_with(self, rows: Array, y: Array) -> Array:
        size = len(self.r)
        stacked = np.empty((size + len(y), size), order='F')
        stacked[:size], stacked[size:, :-1], stacked[size:, -1] = self.r, rows, y
        return _triangular(stacked)

    def posterior(
        self, base: int, slope: float, spreads: Array, told_std: float, most_scale: float,
    ) -> Posterior:
        """Posterior with the first `base` columns as b and the others as e.

        slope: m in the prior of e. spreads: prior deviation of each e at s = 1 and m = 1.
        most_scale: the largest one that is considered. Raises LinAlgError where numbers get too
        large.
        """
        of_errors = self.after(base)._of_errors(
            abs(slope) * spreads, told_std, most_scale
        )
        return self.with_first(of_errors)

    def with_first(self, of_last: Posterior) -> Posterior:
        """Posterior of all unknowns from one of the last ones."""
        first = len(self.r) - 1 - len(of_last.mean)
        if not first:
            return of_last
        inverse = lapack.dtrtri(self.r[:first, :first])[0]
        # How the first ones depend on the last ones, and on y.
        by = inverse @ self.r[:first, first:]
        root = np.zeros((len(self.r) - 1, first + of_last.root.shape[1]))
        root[:first, :first] = inverse
        root[:first, first:] = -by[:, :-1] @ of_last.root
        root[first:, first:] = of_last.root
        mean = np.concatenate([by[:, -1] - by[:, :-1] @ of_last.mean, of_last.mean])
        return replace(of_last, mean=mean, root=root)

    def _of_errors(
        self, weights: Array, told_std: float, most_scale: float,
    ) -> Posterior:
        """Posterior of all unknowns as e. weights: prior deviation of each at s = 1."""
        r, size = self.r, len(self.r) - 1
        weight = self.count + NOISE_WEIGHT
        freedom = max(self.count - self.given, 0.0) + NOISE_WEIGHT
        squares = float(r[size, size]) ** 2 + NOISE_WEIGHT * told_std**2
        if not size:
            evidence = -0.5 * weight * log(squares / weight)
            return Posterior(np.zeros(0), np.zeros((0, 0)), sqrt(squares / freedom), 0.0, evidence)
        u, s, vt, failed = lapack.dgesdd(r[:size, :size] * weights)
        if failed:
            raise np.linalg.LinAlgError('the samples leave no singular values')
        z = r[:size, size] @ u
        # Grid of (s / sigma)^2, the form in which sigma can be integrated out.
        ratios = RATIOS[:, None] * (freedom / squares)
        shrink = 1.0 / (1.0 + ratios * (s * s))
        left = squares + shrink @ (z * z)
        scales2 = RATIOS * left / squares
        # The uncertainty that was told is the deviation of what s = 1 stands for.
        evidence = 0.5 * (np.log(shrink).sum(axis=1) - weight * np.log(left / weight) - scales2)
        # Half a step of the grid beyond is the same. None at all remains.
        if most_scale < inf:
            evidence[1:][scales2[1:] > (most_scale / SAME)**2] = -inf
        best = int(evidence.argmax())
        highest = float(evidence[best])
        if not isfinite(highest):
            raise np.linalg.LinAlgError('the samples leave no finite posterior')
        # The grid is one of the logarithm of s: each scale stands for as much of s as it is large.
        share = STEPS * np.exp(evidence - highest)
        share /= share.sum()
        noise_var = float(share @ left) / freedom
        # The mixture over all scales: its mean, its mean covariance, and that of its means.
        gains = ratios * shrink
        means = gains * (s * z)
        mean = share @ means
        within = (share * left / (freedom * noise_var)) @ gains
        between = (means - mean) * np.sqrt(share / noise_var)[:, None]
        by = weights[:, None] * vt.T
        root = np.concatenate([by * np.sqrt(within), by @ between.T], axis=1)
        return Posterior(by @ mean, root, sqrt(noise_var), sqrt(scales2[best]), highest)


def vague_triangle(weights: Array) -> Triangle:
    """That of a prior at zero, weights (p,), which keeps R regular and is no information."""
    return Triangle(np.diag(np.append(weights, 0.0)))


def _triangular(a: Array) -> Array:
    """R of a (N, n) in Fortran order, which is overwritten."""
    n = a.shape[1]
    return np.where(_upper(n), lapack.dgeqrf(a, overwrite_a=1)[0][:n], 0.0)


@lru_cache(maxsize=64)
def _upper(size: int) -> NDArray[np.bool_]:
    """Where the triangle of a square matrix is."""
    return np.triu(np.ones((size, size), dtype=np.bool_))


def with_zero(posterior: Posterior) -> Posterior:
    """The same with one more unknown before all others, which is known to be 0."""
    root = np.zeros((len(posterior.root) + 1, posterior.root.shape[1]))
    root[1:] = posterior.root
    return replace(posterior, mean=np.concatenate([[0.0], posterior.mean]), root=root)


def mixture(one: Posterior, other: Posterior, bonus: float) -> Posterior:
    """Of two models that were equally likely. bonus: what the evidence of the other leaves out."""
    bonus += other.evidence - one.evidence
    share = 1.0 / (1.0 + exp(-bonus)) if bonus > -LARGEST_EXPONENT else 0.0
    noise_var = (1.0 - share) * one.noise_std**2 + share * other.noise_std**2
    mean, apart = (1.0 - share) * one.mean + share * other.mean, other.mean - one.mean
    noise_std = sqrt(noise_var)
    root = np.concatenate([
        (sqrt(1.0 - share) * one.noise_std / noise_std) * one.root,
        (sqrt(share) * other.noise_std / noise_std) * other.root,
        (sqrt(share * (1.0 - share)) / noise_std) * apart[:, None],
    ], axis=1)
    return Posterior(
        mean, root, noise_std, (one if share < 0.5 else other).scale,
        one.evidence + max(bonus, 0.0) + log1p(exp(-abs(bonus))),
    )
