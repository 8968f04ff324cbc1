"""Which gap, and which start of the play output within it, the samples speak for.

All pairs are compared by the evidence of the regression in which the gap is given: then y depends
on m, m c_r, the state at the start and the error of G alone, and what all pairs have in common is
projected out once. A coarse grid over all gaps comes first, a close one around the best second:
where v moves by half a gap per sample, minima lie some 3 % of the gap apart.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import GAPS, NO_GAP, STARTS, ZOOM
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.regression.error_model import ErrorFilter, ErrorModel
from backlash_ros.core.estimation.regression.play import plays
from backlash_ros.core.estimation.regression.posterior import NOISE_WEIGHT, RATIOS
from backlash_ros.core.estimation.regression.regressors import held
from backlash_ros.core.plant.filtering import lfilter
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

# Places, in standard deviations, at which the likelihood is asked for: around the gap of a fit, and
# around that of a prior.
NEAR: Array = np.outer([-1.0, 1.0], [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0]).ravel()
FAR: Array = 0.5 * np.arange(-8.0, 9.0, dtype=np.float64)


class Candidate(NamedTuple):
    """A gap with the best start for it. evidence: log-likelihood, comparable within a search."""

    evidence: float
    gap: float
    start: float
    m: float


class Found(NamedTuple):
    """Candidates, best first, and the evidence that v never engaged.

    comparison: that further gaps of the same samples may be asked of; None where v rests.
    """

    candidates: list[Candidate]
    null: float
    comparison: Comparison | None = None


def search(
    v: Array, y: Array, weights: Array, model: StateModel, error: ErrorModel, told_std: float,
    widest: float, pace: Pace,
) -> Generator[None, None, Found]:
    """Compare gaps up to `widest` over v (N,) and y (N,), nan where lost; yields between pieces."""
    swing = float(np.ptp(v))
    top = min(swing, widest)
    if not (top > 0.0 and NO_GAP * swing > 0.0) \
            or too_few(y, weights, model):
        return Found([], 0.0)
    comparison = Comparison(v, y, weights, model, error, told_std)
    null = comparison.null
    gaps: Array = np.append(0.0, np.geomspace(min(NO_GAP * swing, top), top, GAPS))
    coarse = yield from comparison.best_per_gap(gaps, STARTS, pace)
    best = max(coarse)
    width, count = ZOOM
    close = np.asarray(best.gap * np.linspace(1.0 - width, 1.0 + width, count))
    fine = yield from comparison.best_per_gap(
        close[close <= top], 2 * STARTS - 1, pace
    )
    found = sorted([*coarse, *fine], reverse=True)
    return Found(found, null, comparison)


def gap_spread(
    comparison: Comparison, known: Sequence[Candidate], gap: float, std: float,
    prior: tuple[float, float] | None, pace: Pace,
) -> Generator[None, None, float]:
    """Root of the mean square distance from this gap over all that explain the samples.

    Each counts by its likelihood. std: of the gap as the labels for it say, which know nothing of
    what other labels would: where few samples tell, the likelihood has several maxima. known: gaps
    that were compared already. prior: gap and its deviation from elsewhere.
    """
    if not 0.0 < std < inf:
        return 0.0
    places = gap + std * NEAR
    if prior is not None:
        places = np.append(places, prior[0] + prior[1] * FAR)
    places = np.unique(places[places > 0.0])
    if len(places) < 2:
        return 0.0
    close = yield from comparison.best_per_gap(places, 2 * STARTS - 1, pace)
    gaps, evidence = np.unique([(one.gap, one.evidence) for one in (*known, *close)], axis=0).T
    if prior is not None:
        evidence = evidence - 0.5 * ((gaps - prior[0]) / prior[1]) ** 2
    share = np.gradient(gaps) * np.exp(evidence - evidence.max())
    return sqrt(float(share @ (gaps - gap) ** 2 / share.sum()))


def too_few(y: Array, weights: Array, model: StateModel) -> bool:
    """Whether so few samples tell nothing of a gap."""
    return float(weights[np.isfinite(y)].sum()) <= model.order + 3


class Comparison:
    """The regression for given gaps, many at once."""

    def __init__(
        self, v: Array, y: Array, weights: Array, model: StateModel, error: ErrorModel,
        told_std: float,
    ) -> None:
        self._v, self._model, self._error = v, model, error
        self._told_std = told_std
        weights = np.where(np.isfinite(y), weights, 0.0)
        self._root = np.sqrt(weights)
        n = model.order
        inputs = np.zeros((n + 1, len(v)))
        inputs[n] = 1.0
        states = np.zeros((n + 1, n))
        states[:n] = model.to_observer.T
        common = self._filtered(inputs, states)
        if error.leak:
            before = np.append(0.0, np.cumsum(held(y, 0.0))[:-1])
            common = np.vstack([common, before * self._root])
        self._basis = np.linalg.qr(common.T)[0]
        self._y = self._projected(np.where(weights > 0.0, y, 0.0) * self._root)
        self._energy = float(self._y @ self._y)
        self._freedom = float(weights.sum()) - len(common) + NOISE_WEIGHT
        self._told = NOISE_WEIGHT * told_std**2
        self.null = float(self._log_likelihood(self._energy + self._told))

    def best_per_gap(
        self, gaps: Array, starts: int, pace: Pace,
    ) -> Generator[None, None, list[Candidate]]:
        """The best start for each gap."""
        counts = np.where(gaps > 0.0, starts, 1)
        ends = np.cumsum(counts)
        shares = np.concatenate([np.linspace(0.0, 1.0, count) for count in counts.tolist()])
        of_pairs = np.repeat(gaps, counts)
        begins = self._v[0] + shares * of_pairs
        evidence, slopes = np.empty(len(begins)), np.empty(len(begins))
        done = 0
        while done < len(begins):
            count = pace.pieces(len(self._v) * max(self._error.count, 1))
            part = slice(done, done + count)
            evidence[part], slopes[part] = self._compare(of_pairs[part], begins[part])
            done += count
            yield
        best = [
            int(end - count + np.argmax(evidence[end - count:end]))
            for end, count in zip(ends, counts, strict=True)
        ]
        table = np.column_stack([evidence, of_pairs, begins, slopes])[best]
        return [Candidate(*row) for row in table.tolist()]

    def _compare(self, gaps: Array, starts: Array) -> tuple[Array, Array]:
        """Evidence and slope of each pair, shape (H,)."""
        p = plays(self._v, gaps, starts)
        moved = self._projected(self._filtered(p))
        if self._error.count:
            columns = self._error_columns(p, starts)
            moved += self._error.told @ columns
        energy = np.einsum('hn,hn->h', moved, moved)
        still = energy <= 0.0  # v never engaged: all is in common
        energy[still] = 1.0
        slopes = np.where(still, 0.0, moved @ self._y / energy)
        squares = np.maximum(self._energy - slopes**2 * energy, 0.0)
        if not self._error.count:
            return self._log_likelihood(squares + self._told), slopes
        # Products of the columns alone would lose in rounding what differs from u and from m.
        along = columns @ moved[:, :, None] / energy[:, None, None]
        columns -= along * moved[:, None, :]
        s, back = np.linalg.eigh(columns @ np.swapaxes(columns, 1, 2))
        target = columns @ self._y
        s = np.maximum(s, 1e-30)
        z2 = (target[:, None, :] @ back)[:, 0] ** 2 / s
        z2 = np.minimum(z2, squares[:, None])
        squares = np.maximum(squares - z2.sum(axis=1), 0.0) + self._told
        s *= (slopes**2 * self._freedom / squares)[:, None]
        shrink = 1.0 / (1.0 + RATIOS[:, None] * s[:, None, :])
        left = squares[:, None] + (shrink @ z2[:, :, None])[..., 0]
        evidence = self._log_likelihood(left) + 0.5 * np.log(shrink).sum(axis=2)
        evidence -= 0.5 * RATIOS  # as posterior.py has it
        return evidence.max(axis=1), slopes

    def _error_columns(self, p: Array, starts: Array) -> Array:
        """Columns of the error of G for play outputs (H, N), shape (H, K, N)."""
        moves = np.diff(p, prepend=starts[:, None])
        columns = ErrorFilter(self._error, len(moves)).responses(moves)
        columns *= self._root
        rows = columns.reshape(-1, columns.shape[2])  # all of them at once: one product of matrices
        rows -= (rows @ self._basis) @ self._basis.T
        return rows.reshape(columns.shape)

    def _log_likelihood(self, squares: Array | float) -> Array:
        return np.asarray(-0.5 * self._freedom * np.log(squares / self._freedom))

    def _answers(self, inputs: Array, states: Array | None = None) -> Array:
        transfer = self._model.transfer_function
        if states is None:
            states = np.zeros((len(inputs), self._model.order))
        late, last = lfilter(transfer.numerator, transfer.denominator, inputs, zi=states)
        answers: Array = np.empty_like(late)
        answers[:, :-1], answers[:, -1] = late[:, 1:], last[:, 0]
        return answers

    def _filtered(self, inputs: Array, states: Array | None = None) -> Array:
        return np.asarray(self._answers(inputs, states) * self._root)

    def _projected(self, rows: Array) -> Array:
        return np.asarray(rows - (rows @ self._basis) @ self._basis.T)
