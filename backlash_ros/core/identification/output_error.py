"""Output error: the simulated y of B(z)/A(z), fitted to the measured one for one structure.

With the play output p, u = m (p - c_r) and y = G u, all that is linear in

    A y = z^-(1+d) B p + e + X,    e = -c_r B(1),  X: the state at the start

is solved for exactly (variable projection); A, the gap and the start of p take Levenberg-Marquardt
steps on what is left, by the triangle R of one QR of all columns. m is in B: it cannot be told from
the gain of G.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from backlash_ros.core.estimation.play import LEFT, NEITHER, Sides, play, plays, reversals
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

TOLERANCE = 1e-7  # relative fall of the squares below which a fit is done
# Of Levenberg and Marquardt: at first, times after a step down and one up, where a fit gives up.
FIRST_DAMPING, LESS, MORE, MOST_DAMPING = 1e-3, 0.2, 5.0, 1e8
HEAD = 30  # readings at the begin that are not averaged
SINGULAR = 1e-13  # of columns of length 1


class Structure(NamedTuple):
    """Number of poles, of which one may be an integrator; samples of v before it acts, less one.

    taps: coefficients of B; where 0 as many as poles, one of G that is a gain (order 0).
    """

    order: int
    delay: int
    integrator: bool
    taps: int = 0

    @property
    def free_poles(self) -> int:
        """Poles that are fitted."""
        return self.order - self.integrator

    @property
    def numerator_taps(self) -> int:
        """Coefficients of B."""
        return self.taps or max(self.order, 1)

    @property
    def state_terms(self) -> int:
        """Coefficients of X: the state at the start, and what p was before it."""
        return max(self.order, self.numerator_taps - 1)

    @property
    def unknowns(self) -> int:
        """Numbers that are fitted, with the gap, the start, e and the state at the start."""
        return self.free_poles + self.numerator_taps + self.state_terms + 3


class Samples:
    """v (N,) and y (N,), nan where lost, and the part of y (M,) that is fitted.

    first: index of the first fitted y; v before it covers the longest delay. most: rows that are
    fitted, at most; of more readings, neighbours are averaged. y is fitted without its middle, so
    that a large offset takes no digits from it.
    """

    def __init__(
        self, v: Array, y: Array, first: int, last: int | None = None, most: int = 0,
        middle: float | None = None,
    ) -> None:
        self.v, self.whole_y = v, y
        self.first, self.last = first, len(v) if last is None else last
        self.y = y[self.first:self.last]
        self.middle = float(np.nanmedian(self.y)) if middle is None else middle
        self.known = np.flatnonzero(np.isfinite(self.y))
        self.count, self.most = self.last - self.first, most
        self.swing = float(np.ptp(v))
        self.centre = float(v.mean())
        self._each = ceil(max(self.count - HEAD, 1) / most) if most else 1
        self._lost = None if len(self.known) == self.count else np.isnan(self.y)
        if self._each > 1:
            readings = self._summed(np.isfinite(self.y).astype(float))
            self._read = np.flatnonzero(readings)
            self._weights = 1.0 / np.sqrt(readings[self._read])
        self.target = self.reduced(np.where(np.isfinite(self.y), self.y - self.middle, 0.0))

    def reduced(self, signals: Array) -> Array:
        """The rows (..., R) that are fitted of signals (..., M)."""
        if self._each > 1:
            known = signals if self._lost is None else np.where(self._lost, 0.0, signals)
            summed = self._summed(known)
            if len(self._read) < summed.shape[-1]:
                summed = summed[..., self._read]
            return np.asarray(summed * self._weights)
        return signals if self._lost is None else signals[..., self.known]

    def _summed(self, signals: Array) -> Array:
        """Sums over neighbours; the state at the start takes the first readings alone."""
        body, each = signals[..., HEAD:], self._each
        summed = body[..., ::each].copy()
        for k in range(1, each):
            part = body[..., k::each]
            summed[..., :part.shape[-1]] += part
        return np.concatenate([signals[..., :HEAD], summed], axis=-1)

    def part(self, first: int, last: int) -> Samples:
        """The same record, with the y from first to last only."""
        return Samples(self.v, self.whole_y, first, last, self.most, self.middle)

    def coarse(self, most: int) -> Samples:
        """The same with no more than so many rows, about."""
        return Samples(self.v, self.whole_y, self.first, self.last, most, self.middle)

    def without(self, rows: NDArray[np.bool_]) -> Samples:
        """The same without the y of these rows (of the fitted ones)."""
        y = self.whole_y.copy()
        y[self.first:self.last][rows] = np.nan
        return Samples(self.v, y, self.first, self.last, self.most, self.middle)

    def delayed(self, signal: Array, delay: int) -> Array:
        """What of a signal (N,) of v acts on each fitted y, one sample and the delay later."""
        begin = self.first - 1 - delay
        return signal[begin:begin + self.count]

    def played(self, gap: float, start: float) -> Array:
        """p (N,) for a gap and p before the first sample."""
        return play(self.v, gap, start)


class Point(NamedTuple):
    """What is not linear: free coefficients of A (after the leading 1), gap, start of p."""

    a: Array
    gap: float
    start: float


@dataclass(frozen=True)
class Fit:
    """A fit of one structure. linear: B, e, X. simulated: y (M,) of the model at every sample.

    p: play output (N,). centre, middle: of v and y, which linear is without. squares: of the
    residual over the rows that were fitted.
    """

    structure: Structure
    point: Point
    linear: Array
    simulated: Array
    p: Array
    centre: float
    middle: float
    squares: float
    rows: int

    @property
    def rms(self) -> float:
        """Of the residual."""
        return float(np.sqrt(self.squares / max(self.rows, 1)))

    @property
    def denominator(self) -> Array:
        """A, descending powers of z, without the delay."""
        return full_denominator(self.structure, self.point.a)

    @property
    def numerator(self) -> Array:
        """B of m G: taps coefficients, the first of them delay + 1 samples after v."""
        return self.linear[:self.structure.numerator_taps]

    @property
    def offset(self) -> float:
        """e, with the middle of y."""
        e = float(self.linear[self.structure.numerator_taps])
        return e + self.middle * float(self.denominator.sum())

    @property
    def c_r(self) -> float:
        """Right crossing [v]; nan where G has no gain at rest."""
        total = float(self.numerator.sum())
        return self.centre - self.offset / total if total != 0.0 else nan

    @property
    def sides(self) -> Sides:
        """Side of the gap that was engaged last, (N,): p went its way, where the gap is 0 as well.

        NEITHER before the first: p is where it began.
        """
        way = np.sign(np.diff(self.p, prepend=self.point.start)).astype(np.int8)
        newest = np.maximum.accumulate(np.where(way != NEITHER, np.arange(len(way)), 0))
        return np.asarray(way[newest])

    @property
    def reversals(self) -> int:
        """How often the other side engaged."""
        return len(reversals(self.sides))


def full_denominator(structure: Structure, a: Array) -> Array:
    """A with its leading 1 and the integrator."""
    free = np.append(1.0, a)
    return np.convolve(free, (1.0, -1.0)) if structure.integrator else free


def triangle(rows: Array) -> tuple[Array, Array]:
    """R (P, P) of the QR of columns, given as rows (P, R), and their lengths, which are taken out.

    A column of zeros has length 1.
    """
    scale = np.sqrt(np.einsum('ij,ij->i', rows, rows))
    scale[scale == 0.0] = 1.0
    if not np.isfinite(scale).all():
        return np.full((len(rows), len(rows)), nan), scale
    r = lapack.dgeqrf((rows / scale[:, None]).T, overwrite_a=1)[0][:len(rows)]
    if len(r) < len(rows):
        r = np.pad(r, ((0, len(rows) - len(r)), (0, 0)))
    return np.triu(r), scale


def solved(upper: Array, target: Array) -> Array:
    """The solution of a triangular system, the least one where it is singular."""
    if len(upper) and np.abs(np.diag(upper)).min() > SINGULAR:
        return np.asarray(lapack.dtrtrs(upper, target)[0])
    return np.asarray(np.linalg.lstsq(upper, target, rcond=SINGULAR)[0])


def linear_rows(samples: Samples, structure: Structure, a: Array, p: Array) -> Array:
    """What multiplies B, e and X in the simulated y, shape (L, M)."""
    count, taps = samples.count, structure.numerator_taps
    inputs = np.zeros((2, count))
    inputs[0] = samples.delayed(p, structure.delay) - samples.centre
    inputs[1, 0] = 1.0
    moved, impulse = lfilter([1.0], full_denominator(structure, a), inputs)
    rows = np.zeros((taps + 1 + structure.state_terms, count))
    for i in range(taps):
        rows[i, i:] = moved[:count - i]
    rows[taps] = np.cumsum(impulse)
    for i in range(structure.state_terms):
        rows[taps + 1 + i, i:] = impulse[:count - i]
    return rows


def slope_rows(samples: Samples, found: Fit) -> Array:
    """Derivatives of the simulated y by the free coefficients of A, gap and start, shape (K, M)."""
    count, a, delay = samples.count, found.point.a, found.structure.delay
    rows = np.zeros((len(a) + 2, count))
    if len(a):
        # What is simulated is y without its middle.
        back = -lfilter([1.0], np.append(1.0, a), found.simulated - found.middle)
        for j in range(len(a)):
            rows[j, j + 1:] = back[:count - j - 1]
    sides = found.sides
    inputs = np.stack([
        samples.delayed(side, delay) for side in ((sides == LEFT) * 1.0, (sides == NEITHER) * 1.0)
    ])
    rows[len(a):] = lfilter(found.numerator, found.denominator, inputs)
    return rows


def evaluate(
    samples: Samples, structure: Structure, point: Point, penalty: Array | None = None,
) -> tuple[Fit, Array]:
    """The fit with all that is linear at its best, and the rows of that, shape (L, R)."""
    p = samples.played(point.gap, point.start)
    rows = linear_rows(samples, structure, point.a, p)
    reduced, target = _with_penalty(samples.reduced(rows), samples.target, penalty)
    r, scale = triangle(np.vstack([reduced, target]))
    linear = solved(r[:-1, :-1], r[:-1, -1]) * scale[-1] / scale[:-1]
    simulated = linear @ rows
    squares = float(r[-1, -1] * scale[-1]) ** 2
    if penalty is not None:
        squares = float(np.sum((samples.target - samples.reduced(simulated)) ** 2))
    return Fit(
        structure, point, linear, simulated + samples.middle, p, samples.centre, samples.middle,
        squares if np.isfinite(squares) else inf, len(samples.target),
    ), reduced


def _as_long(rows: Array, count: int) -> Array:
    """Rows (..., R) with zeros for those of a penalty."""
    more = count - rows.shape[-1]
    return np.concatenate([rows, np.zeros((*rows.shape[:-1], more))], -1) if more else rows


def _with_penalty(rows: Array, target: Array, penalty: Array | None) -> tuple[Array, Array]:
    """Rows and target with those whose product with B is to be small as well."""
    if penalty is None:
        return rows, target
    more = np.zeros((len(rows), len(penalty)))
    more[:penalty.shape[1]] = penalty.T
    return np.hstack([rows, more]), _as_long(target, len(target) + len(penalty))


def squares_of(samples: Samples, structure: Structure, a: Array, p: Array) -> float:
    """What is left over for a and p (N,), with all that is linear at its best."""
    rows = linear_rows(samples, structure, a, p)
    r, scale = triangle(np.vstack([samples.reduced(rows), samples.target]))
    squares = float(r[-1, -1] * scale[-1]) ** 2
    return squares if np.isfinite(squares) else inf


def best_start(
    samples: Samples, structure: Structure, models: Sequence[Array], gap: float,
    starts: Sequence[float],
) -> Point:
    """Of models and starts of p the pair that leaves least over, without any step."""
    played = plays(samples.v, np.full(len(starts), gap), np.array(starts))
    _, i, j = min(
        (squares_of(samples, structure, a, p), i, j)
        for i, a in enumerate(models) for j, p in enumerate(played)
    )
    return Point(models[i], gap, starts[j])


def fit(
    samples: Samples, structure: Structure, start: Point, gap_free: bool = True,
    iterations: int = 40, penalty: Array | None = None,
) -> Fit:
    """The least squares nearest to a start. gap_free: whether the gap moves as well.

    penalty: rows (K, taps) whose product with B is to be small as well; the squares of the fit are
    without it.
    """
    found, rows = evaluate(samples, structure, start, penalty)
    damping = FIRST_DAMPING
    for _ in range(iterations):
        free = samples.reduced(slope_rows(samples, found))
        if not gap_free:
            free = np.delete(free, -2, axis=0)
        free, target = _as_long(free, rows.shape[1]), _as_long(samples.target, rows.shape[1])
        r, scale = triangle(np.vstack([rows, free, target]))
        first = len(rows)
        upper, downhill = r[first:-1, first:-1], r[first:-1, -1] * scale[-1]
        # What the linear unknowns take over leaves these columns shorter than 1.
        size = np.sqrt(np.einsum('ij,ij->j', upper, upper))
        size[size == 0.0] = 1.0
        upper, size = upper / size, size * scale[first:-1]
        before = _penalised(found, penalty)
        best = before
        while damping < MOST_DAMPING and np.isfinite(upper).all():
            damped = np.vstack([upper, sqrt(damping) * np.eye(len(size))])
            step = np.linalg.lstsq(damped, np.append(downhill, np.zeros(len(size))), rcond=None)[0]
            new = _moved(found.point, step / size, gap_free, samples)
            if largest_pole(new.a) <= 1.0:
                tried, new_rows = evaluate(samples, structure, new, penalty)
                if _penalised(tried, penalty) < before:
                    found, rows, best = tried, new_rows, _penalised(tried, penalty)
                    damping = max(damping * LESS, 1e-12)
                    break
            damping *= MORE
        if not best < before * (1.0 - TOLERANCE):
            break
    return found


def _penalised(found: Fit, penalty: Array | None) -> float:
    if penalty is None:
        return found.squares
    return found.squares + float(np.sum((penalty @ found.numerator) ** 2))


def _moved(point: Point, step: Array, gap_free: bool, samples: Samples) -> Point:
    count, v0 = len(point.a), float(samples.v[0])
    gap = min(max(point.gap + float(step[count]), 0.0), samples.swing) if gap_free else point.gap
    start = min(max(point.start + float(step[-1]), v0), v0 + gap)
    return Point(point.a + step[:count], gap, start)


def largest_pole(a: Array) -> float:
    """Magnitude of the largest root of z^n + a[0] z^(n-1) + ..., 0 for none; inf for no number."""
    if not np.isfinite(a).all():
        return inf
    if not len(a):
        return 0.0
    companion = np.diag(np.ones(len(a) - 1), -1)
    companion[0] = -a
    return float(np.abs(np.linalg.eigvals(companion)).max())
