"""The result of a fit: values, posterior, evidence; and the error of G that it leaves open."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np

from backlash_ros.core.estimation.settings import CHANCE
from backlash_ros.core.plant.backlash import gap_variance
from backlash_ros.core.plant.numerics import agree
from backlash_ros.core.plant.transfer_function import Array

SCALES = np.asarray(np.geomspace(3e-4, 10.0, 14), np.float64)  # grid of s


class Prior(NamedTuple):
    """What older samples say: rows @ theta = values + white noise of standard deviation 1."""

    rows: Array  # (r, 3 + K)
    values: Array  # (r,)
    v: float = nan  # at the last engagement, nan if unknown
    left: bool = False  # whether the left side was engaged then


class Left(NamedTuple):
    """Statistics of a finished fit: of its residuals, and of the play in the record."""

    likelihood: float = -inf  # log-likelihood
    rms: float = inf  # of the residuals
    correlation: float = 0.0  # of the residuals, beyond chance
    dispersion: float = 1.0  # mean square of the scores of intervals, over their information
    readings: float = 0.0  # number of independent readings
    turns: int = 0  # reversals of the play
    gain: float = 1.0  # of G for this motion: standard deviation of y over that of u


@dataclass(frozen=True, eq=False)
class WindowFit:
    """A fit: values of all unknowns, with their posterior."""

    x: Array  # state of G before the record
    p0: float  # p before the record
    theta: Array  # m, o, g, xi (3 + K,)
    noise_std: float  # of y; without quantization if step > 0
    knots: Array = field(default_factory=lambda: np.zeros(0))  # values of d (W,)
    walk_std: float = 0.0  # of u per square root of a sample, 0: no walk
    step: float = 0.0  # quantization step if readings are taken as intervals, else 0
    scale: float = 1.0  # most probable s
    wiener: bool = False  # whether the play is behind G
    told: bool = False  # whether G is taken as told, xi = 0
    cov: Array = field(default_factory=lambda: np.zeros((0, 0)))  # of theta, if residuals are white
    volume: float = 0.0  # log volume of the posterior (Occam factor)
    spread: Array = field(default_factory=lambda: np.zeros(()))  # of m, c_r, c_l, xi by other gaps
    left: Left = field(default_factory=Left)

    @property
    def m(self) -> float:
        return float(self.theta[0])

    @property
    def gap(self) -> float:
        return float(self.theta[2])

    @property
    def xi(self) -> list[float]:
        return list(map(float, self.theta[3:]))

    @property
    def evidence(self) -> float:
        """Log-likelihood with all unknowns integrated out."""
        return self.left.likelihood + self.volume

    @property
    def inflation(self) -> float:
        """Factor on cov: N correlated residuals count as N / (1 - rho + N rho) independent ones."""
        return self.left.dispersion + (self.left.readings - 1.0) * self.left.correlation

    @property
    def cov_xi(self) -> Array:
        cov = self.cov[3:, 3:] * self.inflation
        return np.asarray(cov + self.spread[3:, 3:] if self.spread.ndim else cov)

    @property
    def prior_of_xi(self) -> Prior:
        """Its posterior of xi alone, as the prior of another fit."""
        root = np.linalg.inv(np.linalg.cholesky(self.cov_xi + 1e-12 * np.eye(len(self.cov_xi))))
        return Prior(np.hstack([np.zeros((len(root), 3)), root]), root @ self.theta[3:])

    def odds_over(self, other: WindowFit) -> float:
        """Log-odds, by the independent residuals and the priors of xi with the likeliest s >= 1."""
        k = max(len(self.theta) - 3, 1)
        own, its = (0.5 * k * min(f.error_of_G, 1.0) ** 2 + k * log(max(f.error_of_G, 1.0))
                    for f in (self, other))
        return its - own + self.left.readings / self.inflation * log(other.left.rms / self.left.rms)

    @property
    def error_of_G(self) -> float:
        """RMS of xi, in prior standard deviations."""
        return float(np.linalg.norm(self.theta[3:])) / sqrt(max(len(self.theta) - 3, 1))

    def behind(self, xi: Array) -> float:
        """Log-likelihood by which another xi (K,) is worse than that of this fit."""
        apart = self.theta[3:] - xi
        cov = self.cov_xi + 1e-16 * np.eye(len(apart))
        return 0.5 * float(apart @ np.linalg.solve(cov, apart))

    @property
    def crossings(self) -> Array:
        """m, c_r, c_l, shape (3,)."""
        m, o, g = self.theta[:3].tolist()
        return np.array([m, o / m, o / m - g])

    @property
    def crossings_cov(self) -> Array:
        """Covariance of m, c_r, c_l, shape (3, 3)."""
        m, o, _ = self.theta[:3].tolist()
        by = np.array([[1.0, 0.0, 0.0], [-o / m**2, 1.0 / m, 0.0], [-o / m**2, 1.0 / m, -1.0]])
        cov = by @ self.cov[:3, :3] @ by.T * self.inflation
        return np.asarray(cov + self.spread[:3, :3] if self.spread.ndim else cov)

    def apart(self, other: WindowFit) -> Array:
        """Outer product (3 + K, 3 + K) of the differences between two fits in m, c_r, c_l, xi."""
        by = np.append(self.crossings - other.crossings, self.theta[3:] - other.theta[3:])
        return np.asarray(np.outer(by, by))

    def alike(self, other: WindowFit) -> bool:
        """Whether the backlashes of two fits differ by no more than chance."""
        cov = self.crossings_cov + other.crossings_cov
        return agree(self.crossings, other.crossings, cov, CHANCE)

    @property
    def gap_std(self) -> float:
        return sqrt(gap_variance(self.crossings_cov))

    @property
    def noise(self) -> float:
        """Standard deviation of a reading, quantization included."""
        return sqrt(self.noise_std**2 + self.step**2 / 12.0)

    @property
    def unexplained(self) -> float:
        """RMS of the correlated part of the residuals, as motion of u over m times the gap."""
        moves = sqrt(self.left.correlation) * self.left.rms / self.left.gain
        return moves / (abs(self.m) * max(self.gap, 1e-12))

    @property
    def systematic(self) -> bool:
        """Whether residuals are correlated beyond chance and larger than quantization errors."""
        rounding = 1.1 * self.step / sqrt(12.0)
        return self.left.readings * self.left.correlation > 1.0 and self.left.rms > rounding

    def without_intervals(self, walk_std: float) -> WindowFit:
        """The same values with quantization as a part of normal noise, spread and d forgotten."""
        return replace(self, step=0.0, noise_std=self.noise, walk_std=walk_std, knots=np.zeros(0),
                       spread=np.zeros(()))

    def known_as(self, step: WindowFit) -> WindowFit:
        """These values with the posterior of a step."""
        return replace(self, cov=step.cov, scale=step.scale, volume=step.volume)

    @property
    def valid(self) -> bool:
        """Whether the slope is positive and the covariance finite."""
        return self.m > 0.0 and self.cov.size > 0 and bool(np.isfinite(self.cov).all())


def error_of_plant(
    f: WindowFit, r: Array, squares: float, freedom: float,
) -> tuple[Array, Array, float, float, float]:
    """Posterior of xi, over a grid of s: mean, covariance, most probable s, its share of `volume`,
    and noise variance over that of f. r: triangle of xi, (K + 1, K + 1); squares: of residuals."""
    k, variance = len(r) - 1, 1.0 if f.step else squares / freedom
    if not k:
        return np.zeros(0), np.zeros((0, 0)), f.scale, 0.0, variance
    u, singular, vt = np.linalg.svd(r[:k, :k])
    z, scales = u.T @ r[:k, k], SCALES[:1 if f.told else None, None]
    noise, seen, power = np.full((len(scales), 1), variance), (scales * singular) ** 2, z**2
    for _ in range(1 if f.step else 4):  # noise and shrinkage depend on each other
        shrink = 1.0 / (1.0 + seen / noise)
        left = squares + (shrink * power).sum(axis=1, keepdims=True)
        noise = noise if f.step else left / freedom
    volumes = 0.5 * (np.log(shrink).sum(axis=1) - np.log(scales[:, 0]) ** 2)
    each = volumes - 0.5 * (left if f.step else freedom * np.log(left))[:, 0]
    share = np.exp(each - each.max())
    share /= share.sum()
    means = scales**2 * singular * z / (noise + seen)  # shrink is of the noise before
    mean = share @ means
    spread = np.diag(share @ (scales**2 * shrink)) + (means - mean).T * share @ (means - mean)
    best = int(each.argmax())
    return (vt.T @ mean, vt.T @ spread @ vt, float(scales[best, 0]), float(volumes[best]),
            float(share @ noise[:, 0]))
