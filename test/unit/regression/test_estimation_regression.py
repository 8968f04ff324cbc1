"""The regression against the dense Gaussian computation."""

from __future__ import annotations

from math import log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.estimation.regression.posterior import (
    NOISE_WEIGHT,
    SCALES,
    Posterior,
    vague_triangle,
)

BASE, ERRORS, ROWS = 3, 4, 60
VAGUE = 0.05  # weight of the prior of b: wide, yet such that dense matrices are well conditioned
SLOPE = 1.7
SPREADS = np.array([1.0, 0.5, 2.0, 1.0])


class Problem:
    """A regression with everything that there is to know of it."""

    def __init__(self, seed: int, error: float, noise: float, told: float) -> None:
        rng = np.random.default_rng(seed)
        self.told = told
        self.x = rng.standard_normal((ROWS, BASE + ERRORS))
        e = error * SLOPE * SPREADS * rng.standard_normal(ERRORS)
        b = rng.standard_normal(BASE)
        self.y = self.x @ np.append(b, e) + noise * rng.standard_normal(ROWS)

    def posterior(self, pieces: int = 1, most: float = np.inf) -> Posterior:
        """By the code, from rows in pieces."""
        weights = np.append(np.full(BASE, VAGUE), np.zeros(ERRORS))
        triangle = vague_triangle(weights)
        for x, y in zip(
            np.array_split(self.x, pieces), np.array_split(self.y, pieces), strict=True
        ):
            triangle.append(x, y, float(len(y)))
        return triangle.posterior(BASE, SLOPE, SPREADS, self.told, most)

    def ratios(self) -> np.ndarray:
        """Those (scale / noise)^2 that are compared: none, and a grid about the residual."""
        weights = np.diag(np.append(np.full(BASE, VAGUE), np.zeros(ERRORS)))
        x, y = np.concatenate([self.x, weights]), np.append(self.y, np.zeros(BASE + ERRORS))
        residual = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
        squares = residual @ residual + NOISE_WEIGHT * self.told**2
        return np.append(0.0, SCALES**2 * (ROWS - BASE + NOISE_WEIGHT) / squares)

    def given(self, ratio: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean, covariance and variance of the noise for a given ratio, from dense matrices."""
        variance = np.append(np.full(BASE, VAGUE**-2), ratio * (SLOPE * SPREADS) ** 2)
        v = np.eye(ROWS) + (self.x * variance) @ self.x.T
        gain = variance[:, None] * np.linalg.solve(v, self.x).T
        squares = NOISE_WEIGHT * self.told**2 + self.y @ np.linalg.solve(v, self.y)
        noise_var = float(squares) / (ROWS - BASE + NOISE_WEIGHT)
        cov = np.diag(variance) - gain @ self.x * variance
        return gain @ self.y, cov * noise_var, noise_var

    def dense(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean, covariance and variance of the noise over all ratios, each with its evidence."""
        evidence = np.array([self.evidence(ratio) for ratio in self.ratios()])
        # Of a grid of log s each s stands for as much of s as it is large.
        share = np.append(SCALES[0], SCALES) * np.exp(evidence - evidence.max())
        share /= share.sum()
        means, covs, noise = zip(*(self.given(ratio) for ratio in self.ratios()), strict=True)
        mean = share @ np.array(means)
        off = np.array(means) - mean
        cov = np.tensordot(share, np.array(covs), 1) + (off * share[:, None]).T @ off
        return mean, cov, float(share @ np.array(noise))

    def evidence(self, ratio: float) -> float:
        """Log-likelihood of y for (scale / noise)^2 = ratio, its noise integrated out.

        With the prior of the scale: normal, of deviation 1.
        """
        of_b = self.x[:, :BASE] @ self.x[:, :BASE].T / VAGUE**2
        columns = self.x[:, BASE:] * (SLOPE * SPREADS)
        v = np.eye(ROWS) + of_b + ratio * columns @ columns.T
        squares = NOISE_WEIGHT * self.told**2 + self.y @ np.linalg.solve(v, self.y)
        weight = ROWS + NOISE_WEIGHT
        constant = np.linalg.slogdet(np.eye(ROWS) + of_b)[1]
        return 0.5 * float(constant - np.linalg.slogdet(v)[1]) - 0.5 * weight * log(
            squares / weight
        ) - 0.5 * ratio * self.given(ratio)[2]


problems = st.builds(
    Problem, st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.3, 2.0]),
    st.sampled_from([0.01, 0.1, 1.0]), st.sampled_from([0.01, 0.1, 1.0]),
)


@given(problems)
def test_mean_and_covariance_are_those_of_the_dense_gaussians(problem: Problem) -> None:
    found = problem.posterior()
    mean, cov, noise_var = problem.dense()
    std = np.sqrt(np.diag(cov))
    assert np.abs(found.mean - mean).max() <= 1e-5 * std.max() + 1e-9
    assert found.noise_std**2 == pytest.approx(noise_var, rel=1e-6)
    assert found.cov * found.noise_std**2 == pytest.approx(cov, abs=1e-5 * np.abs(cov).max())


@given(problems)
def test_evidence_is_the_largest_of_those_of_the_dense_gaussians(problem: Problem) -> None:
    found = problem.posterior()
    evidence = [problem.evidence(ratio) for ratio in problem.ratios()]
    assert found.evidence == pytest.approx(max(evidence), abs=1e-5)
    best = problem.ratios()[int(np.argmax(evidence))]
    assert found.scale == pytest.approx((best * problem.given(best)[2]) ** 0.5, rel=1e-6)


@given(problems, st.integers(2, 20))
def test_rows_in_pieces_are_as_good_as_in_one(problem: Problem, pieces: int) -> None:
    whole, parts = problem.posterior(), problem.posterior(pieces)
    assert parts.mean == pytest.approx(whole.mean, abs=1e-9)
    assert parts.evidence == pytest.approx(whole.evidence, abs=1e-7)


@pytest.mark.parametrize('error', [0.03, 0.3, 1.0])
def test_scale_and_noise_are_learned(error: float) -> None:
    found = [Problem(seed, error, 0.01, 0.3).posterior() for seed in range(40)]
    scales = np.array([posterior.scale for posterior in found])
    assert np.median(scales) == pytest.approx(error, rel=0.4)
    assert np.median([p.noise_std for p in found]) == pytest.approx(
        # The told noise counts for a few samples.
        np.sqrt((ROWS * 0.01**2 + NOISE_WEIGHT * 0.3**2) / (ROWS + NOISE_WEIGHT)), rel=0.1
    )


def test_an_error_that_is_not_there_is_not_learned() -> None:
    found = [Problem(seed, 0.0, 0.01, 0.01).posterior() for seed in range(40)]
    assert np.mean([p.scale == 0.0 for p in found]) >= 0.5
    assert max(p.scale for p in found) <= 0.01


def test_limits_of_the_scale_are_kept() -> None:
    problem = Problem(1, 0.3, 0.01, 0.01)
    assert problem.posterior(most=0.01).scale <= 0.01 / 0.7


def test_a_prior_is_one_more_measurement() -> None:
    problem = Problem(5, 0.0, 0.1, 0.1)
    rng = np.random.default_rng(6)
    root = rng.standard_normal((2, 2))
    mean, cov = rng.standard_normal(2), 1e-3 * (root @ root.T + np.eye(2))
    triangle = vague_triangle(np.full(BASE, VAGUE))
    triangle.append(problem.x[:, :BASE], problem.y, float(ROWS))
    # In units of the noise that the rows tell, whatever was told.
    noise = triangle.posterior(BASE, SLOPE, np.zeros(0), problem.told, np.inf).noise_std
    informed = triangle.informed(slice(1, 3), mean, cov, problem.told)
    found = informed.posterior(BASE, SLOPE, np.zeros(0), problem.told, np.inf)
    information = problem.x[:, :BASE].T @ problem.x[:, :BASE] + VAGUE**2 * np.eye(BASE)
    target = problem.x[:, :BASE].T @ problem.y
    of_prior = np.linalg.inv(cov) * noise**2
    information[1:, 1:] += of_prior
    target[1:] += of_prior @ mean
    assert found.mean == pytest.approx(np.linalg.solve(information, target), abs=1e-9)
    assert found.cov == pytest.approx(np.linalg.inv(information), abs=1e-9)
