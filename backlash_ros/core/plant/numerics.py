"""Filters and their fit, Riccati and Lyapunov equations, gains, poles, noise, covariances.

lfilter is not that of scipy.signal, which costs 0.3 s and 40 MB; scipy.linalg (31 MB) loads late.
Reference: E. K.-W. Chu et al., Structure-preserving algorithms for periodic discrete-time algebraic
Riccati equations, Int. J. Control 77 (2004) 767-788.
"""

import cmath
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from math import lgamma, sqrt
from operator import mul
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.transfer_function import (
    Array,
    Family,
    StateModel,
    TransferFunction,
    powers,
)


def lfilter(
    b: Sequence[float] | Array, a: Sequence[float] | Array, x: ArrayLike,
    state: ArrayLike | None = None,
) -> Array:
    """Return y of a(z) y = b(z) x along the last axis.

    b, a: coefficients in descending powers of z, from z^0 on. x: shape (..., N). state: of the
    filter before x, the zi of scipy.signal.lfilter, shape (..., max(len(a), len(b)) - 1).
    """
    x = np.asarray(x, dtype=np.float64)
    first, count = float(a[0]), x.shape[-1]
    taps, poles = [float(value) / first for value in b], [float(value) / first for value in a]
    y = taps[0] * x
    for delay, tap in enumerate(taps[1:], start=1):
        if tap and delay < count:
            y[..., delay:] += tap * x[..., :count - delay]
    if state is not None:
        before = np.asarray(state, dtype=np.float64)[..., :count]
        y[..., :before.shape[-1]] += before
    if len(poles) == 1 or not y.size:  # of no rows, LAPACK would write beyond them
        return y
    from scipy.linalg import lapack  # where it is needed: 31 MB

    # The recursion is a triangular system: its lower band, a column per sample.
    band = np.repeat([poles], count, axis=0).T
    solved, _ = lapack.dtbtrs(band, y.reshape(-1, count).T, uplo='L', diag='U', overwrite_b=1)
    return np.ascontiguousarray(solved.T).reshape(y.shape)


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Inner product of two states: for so few numbers faster than NumPy."""
    product: float = sum(map(mul, a, b))
    return product


def padded(x: Array, length: int) -> Array:
    """Return x truncated to this length, or followed by zeros up to it."""
    return np.append(x, np.zeros(max(length - len(x), 0)))[:length]


def hats(count: int, knots: int) -> Array:
    """Hat functions around equally spaced knots, (knots, count); all are 0 at the last sample."""
    place = np.arange(count) * knots / max(count - 1, 1)
    return np.asarray(np.maximum(1.0 - np.abs(place - np.arange(knots)[:, None]), 0.0))


def shifted(x: Array, count: int) -> Array:
    """Return x (..., N) delayed by 0, 1, ... samples, with zeros before it: (..., count, N)."""
    out = np.zeros((*x.shape[:-1], count, x.shape[-1]))
    for late in range(min(count, x.shape[-1])):
        out[..., late, late:] = x[..., :x.shape[-1] - late]
    return out


def state_responses(a: Sequence[float], count: int) -> Array:
    """Derivatives of the response X/A(z) to the state before a record by each value of X, (n, N).

    a: coefficients of A (n + 1,). count: N.
    """
    return shifted(lfilter([1.0], a, np.eye(1, count)[0]), len(a) - 1)


def rest_of(b: Sequence[float], a: Sequence[float]) -> Array:
    """State of b/a, as `lfilter` takes it, after an input of 1 for ever, (n,)."""
    taps, poles = np.array(b), np.array(a)
    return np.asarray(np.cumsum((taps - poles * taps.sum() / poles.sum())[:0:-1])[::-1])


def sensitivities(family: Family, xi: list[float], u: Array, y: Array) -> Array:
    """Derivatives of y by each xi, (..., K, N); u, y: input and output filtered by 1/A."""
    of_b, of_a = family.slopes(xi)
    taps = of_b.shape[1]
    return np.asarray(of_b @ shifted(u, taps) - of_a @ shifted(y, taps))


def response_std(family: Family, xi: list[float], cov: Array, z: NDArray[np.complex128]) -> Array:
    """Relative std of G(z; xi) at the points z (M,), for the covariance of xi (K, K)."""
    db, da = family.slopes(xi)
    powers_of_z = 1.0 / z[:, None] ** np.arange(db.shape[1])
    of_b, of_a = (powers_of_z[:, :len(x)] @ np.array(x) for x in family.at(xi))
    # Derivatives of ln G by each xi (M, K).
    slopes = powers_of_z @ db.T / of_b[:, None] - powers_of_z @ da.T / of_a[:, None]
    variance = np.einsum('ij,jk,ik->i', slopes, cov, slopes.conj()).real
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def multiplied(*factors: Sequence[complex]) -> list[complex]:
    """Product of polynomials; with so few coefficients faster than np.convolve."""
    result = [1.0 + 0j]
    for factor in factors:
        out = [0j] * (len(result) + len(factor) - 1)
        for i, x in enumerate(result):
            for j, y in enumerate(factor):
                out[i + j] += x * y
        result = out
    return result


def sections_of(poles: NDArray[np.complex128]) -> tuple[int, list[float]]:
    """Number of pairs among these poles of z (n,), s^2 + 2 D Omega s + Omega^2 at sample period 1;
    ln Omega, ln D of each pair, then ln of the rate of a real pole left over."""
    s = np.log(poles.astype(complex))
    pairs = [(abs(x), -x.real / abs(x)) for x in s if x.imag > 1e-9]
    real = sorted(-x.real for x in s if abs(x.imag) <= 1e-9)
    while len(real) > 1:
        fast, next_to_it = real.pop(), real.pop()
        omega = np.sqrt(fast * next_to_it)
        pairs.append((omega, (fast + next_to_it) / 2.0 / omega))
    return len(pairs), np.log([*(q for pair in pairs for q in pair), *real]).tolist()


@lru_cache(maxsize=64)  # few of many variations of a G change its poles
def denominator_of(pairs: int, *logs: complex) -> tuple[complex, ...]:
    """The polynomial (n + 1,) whose roots are the poles with these `sections_of` them."""
    values, a = list(map(cmath.exp, logs)), [1.0 + 0j]
    for omega, damping in zip(values[:2 * pairs:2], values[1:2 * pairs:2], strict=True):
        r, square = cmath.exp(-omega * damping), omega * omega * (1.0 - damping * damping)
        both = 2.0 * r * cmath.cos(cmath.sqrt(square)) if square.real > -1e5 else \
            cmath.exp(cmath.sqrt(-square) - omega * damping)  # one pole is 0; cos may overflow
        a = multiplied(a, [1.0, -both, r * r])
    return tuple(multiplied(a, *([1.0, -cmath.exp(-rate)] for rate in values[2 * pairs:])))


def is_stable(a: list[float]) -> bool:
    """Whether all roots lie within the unit circle: Schur-Cohn test, faster than finding them."""
    while len(a) > 1:
        k = a[-1] / a[0]
        if not abs(k) < 1.0:
            return False
        a = [one - k * other for one, other in zip(a[:-1], a[:0:-1], strict=True)]
    return True


def steiglitz_mcbride(
    y: Array, follows: Callable[[Array], Array], poles: int, rows: NDArray[Any], steps: int = 3,
) -> Iterator[tuple[Array, Array]]:
    """Yield A with so many poles and weights (C,) of A y = weights' inputs, from two first filters.

    Each step is least squares over these rows, with y (N,) and the inputs filtered by 1/A of the
    step before. follows: takes A and returns the inputs (C, N), filtered so.
    """
    inside = 0.999  # magnitude that poles beyond it are moved to
    for pole in (0.6, 0.95) if poles else (0.0,):
        a: Array = np.atleast_1d(np.poly([pole] * poles))
        for _ in range(steps if poles else 1):
            filtered = lfilter([1.0], a, y)
            columns = np.vstack([-shifted(filtered, poles + 1)[1:], follows(a), filtered])
            r = np.asarray(np.linalg.qr(columns[:, rows].T, mode='r'))
            solution = np.linalg.lstsq(r[:, :-1], r[:, -1], rcond=1e-13)[0]
            a = np.append(1.0, solution[:poles])
            roots = np.roots(a)
            size = np.abs(roots)
            if size.max(initial=0.0) > inside:
                a = np.real(np.poly(roots * np.minimum(inside / np.maximum(size, inside), 1.0)))
        yield a, solution[poles:]


def riccati(a: Array, b: Array, q: Array) -> Array:
    """Return the stabilising P = A'PA - A'PB (1 + B'PB)^-1 B'PA + Q, shape (n, n).

    a: (n, n). b: (n,). q: (n, n), positive semidefinite. The gain (1 + B'PB)^-1 B'PA stabilises
    (A, B). With (A', C') and Q of the process noise, P is the covariance of a Kalman prediction.
    Raises numpy.linalg.LinAlgError if there is none.
    """
    transition, g, p = a.copy(), np.outer(b, b), np.array(q, np.float64)
    unit = np.eye(len(a))
    with np.errstate(over='ignore', invalid='ignore'):
        for _ in range(60):  # each step doubles the number of samples that P covers
            inner = np.linalg.solve(unit + g @ p, np.hstack([transition, g]))
            more = transition.T @ p @ inner[:, :len(a)]
            g += transition @ inner[:, len(a):] @ transition.T
            transition = transition @ inner[:, :len(a)]
            p += 0.5 * (more + more.T)
            if not np.isfinite(p).all():
                break
            if float(np.abs(more).max()) <= 1e-16 * float(np.abs(p).max()):
                return p
    raise np.linalg.LinAlgError('no feedback stabilises A')


def lyapunov(a: Array, q: Array) -> Array:
    """Return P = A P A' + Q, shape (n, n); raises numpy.linalg.LinAlgError if A is not stable."""
    return riccati(a.T, np.zeros(len(a)), q)


class Gain(NamedTuple):
    """The stationary Kalman filter of a StateModel, with the noise on y as the unit of y."""

    gain: tuple[float, ...]  # of the update after a prediction
    innovation: float  # standard deviation of the innovation
    cov: Array  # of the state, (n, n)
    quiet: float  # `innovation` with this gain, but with a tenth of the noise on u


@lru_cache(maxsize=64)
def gain_of(model: StateModel, ratio: float) -> Gain:
    """Return the gain for white noise on u that, at a period of 20 samples, moves y by `ratio`
    times the noise on y; a gain of 0 if there is none."""
    n, transfer = model.order, model.transfer_function
    power = abs(transfer.response(np.array([np.exp(0.1j * np.pi)]))[0])
    noise = np.outer(model.b, model.b) * (ratio / power) ** 2
    noise += 1e-9 * float(np.trace(noise)) * np.eye(n)  # keeps the Riccati equation regular
    c = model.c * np.eye(n)[0]
    try:
        p = riccati(model.a.T, c, noise)
        variance = float(c @ p @ c) + 1.0
        column = p @ c / variance
        # Error of the prediction with this gain: P = (A - A k c) P (A - A k c)' + A k k' A' + Q.
        after = model.a @ column
        quiet = lyapunov(model.a - np.outer(after, c), np.outer(after, after) + noise * 10.0**-2)
    except np.linalg.LinAlgError:
        return Gain((0.0,) * n, 1.0, np.eye(n), 1.0)
    return Gain(tuple(column.tolist()), sqrt(variance), p - np.outer(column, column) * variance,
                sqrt(float(c @ quiet @ c) + 1.0))


# Effects of the noise on u that gains are designed for, relative to the noise on y (`gain_of`).
RATIOS = tuple(10.0**exponent for exponent in range(-4, 5))


def gains_of(model: StateModel) -> tuple[Gain, ...]:
    """Gains for all RATIOS; takes too long for the loop."""
    return tuple(gain_of(model, ratio) for ratio in RATIOS)


def state_after(model: TransferFunction, u: Array, y: Array) -> Array:
    """State of G (observer form) after u (M,), by least squares from y (M,), nan where lost."""
    a, b, c = model.state_space()
    responses = powers(a, b, len(u))
    # Not by lfilter: the loop runs this too, and importing SciPy would make a command late.
    forced = np.convolve(responses @ c, u)[:len(u)]
    columns = powers(a.T, a.T @ c, len(u))  # response to the initial state
    known = np.isfinite(y)
    before = np.linalg.lstsq(columns[known], (y - forced)[known], rcond=1e-12)[0]
    return np.asarray(np.linalg.matrix_power(a, len(u)) @ before + u[::-1] @ responses)


class FourBlocks(NamedTuple):
    """Gains of the four-block structure of Tao and Kokotović, and transfer functions of the loop.

        u_d = theta_1' w_1 + theta_2' w_2 + theta_20 y + theta_3 r
        w_1 = a(z)/Lambda(z) u_d,   w_2 = a(z)/Lambda(z) y,   a = (z^(n-2), ..., z, 1)'

    filter: Lambda, shape (n,). reference: theta_3 B/A_m from r to y. disturbance: W from u - u_d
    to y. returned: B R/(Lambda A_m). demand: theta_3 A/A_m from r to u_d, its coefficients.
    """

    theta_1: Array
    theta_2: Array
    theta_20: float
    theta_3: float
    filter: Array
    reference: TransferFunction
    disturbance: TransferFunction
    returned: TransferFunction
    demand: tuple[Array, Array]


def place_poles(model: TransferFunction, closed: Array, filter_pole: float) -> FourBlocks:
    """Return gains for A_m = closed, monic (n + 1,), and Lambda = (z - filter_pole)^(n-1).

    With G = B/A, S = Lambda - theta_1' a and R = theta_2' a + theta_20 Lambda they solve

        A S - B R = Lambda A_m

    so that y = theta_3 B/A_m r + W (u - u_d) with W = B S/(Lambda A_m), and no zero of G is
    cancelled. theta_3 gives unit gain at z = 1. Raises ParameterError if numerator and denominator
    of G have a common factor, or nearly so, or if G has a zero at z = 1.
    """
    n, a, b = model.order, model.denominator, model.numerator[1:]
    placed = np.atleast_1d(np.poly(np.full(n - 1, filter_pole)))
    product = np.convolve(placed, closed)
    # Sylvester matrix: columns are A and -B shifted by the unknown coefficients of S and R.
    sylvester = np.zeros((2 * n - 1, 2 * n - 1))
    for i in range(n - 1):
        sylvester[i:i + n + 1, i] = a[:2 * n - 1 - i]
    for i in range(n):
        sylvester[i:i + n, n - 1 + i] = -b
    known = np.convolve(a, np.eye(1, n)[0])  # S is monic: A z^(n-1) is on the left already
    right = (product - known)[1:]
    unknown = np.linalg.lstsq(sylvester, right, rcond=None)[0]
    residual = float(np.linalg.norm(sylvester @ unknown - right))
    dc_gain = float(np.sum(b))
    if not residual <= 1e-6 * float(np.linalg.norm(product)) or dc_gain == 0.0:
        raise ParameterError(
            'structure', 'pole_placement', 'cannot place the poles of this G(z)',
            'cancel its common factors or take structure: tracking',
        )
    s, r = np.concatenate([[1.0], unknown[:n - 1]]), unknown[n - 1:]
    theta_3 = float(np.sum(closed)) / dc_gain
    return FourBlocks(
        (placed - s)[1:], (r - r[0] * placed)[1:], float(r[0]), theta_3, placed,
        TransferFunction((theta_3 * b).tolist(), closed.tolist()),
        TransferFunction(np.convolve(b, s).tolist(), product.tolist()),
        TransferFunction(np.convolve(b, r).tolist(), product.tolist()), (theta_3 * a, closed),
    )


class NoiseLevel:
    """Standard deviation of the white noise in a signal that moves slowly, or in jumps.

    It is taken from sixth differences, in which motion, even with 30 samples per period, leaves
    1e-4 of its amplitude. They have sqrt(924) times the standard deviation of the noise; the median
    magnitude of a normal variable is 0.6745 of its standard deviation.
    """

    def __init__(self) -> None:
        self._signal: deque[float] = deque(maxlen=7)
        self._sizes: deque[float] = deque(maxlen=301)
        self._sorted: list[float] = []

    @property
    def std(self) -> float:
        """The estimate; 0 until there are 15 differences."""
        count = len(self._sorted)
        return 1.0 / (924.0**0.5 * 0.6745) * self._sorted[count // 2] if count >= 15 else 0.0

    def take(self, value: float) -> None:
        self._signal.append(value)
        if len(self._signal) < 7:
            return
        a, b, c, d, e, f, g = self._signal
        size = abs(a - 6.0 * b + 15.0 * c - 20.0 * d + 15.0 * e - 6.0 * f + g)
        if len(self._sizes) == self._sizes.maxlen:
            del self._sorted[bisect_left(self._sorted, self._sizes[0])]
        self._sizes.append(size)
        insort(self._sorted, size)


def isolated(flags: NDArray[np.bool_], known: NDArray[np.intp], most: float, run: int) -> \
        NDArray[np.bool_]:
    """Return flags (N,) without runs of `run` or more of the known samples (K,); none at all if
    there are more flags than the fraction `most` of these."""
    out: NDArray[np.bool_] = flags & (flags.sum() <= most * len(known))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], out[known].astype(int), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if end - begin >= run:
            out[known[begin:end]] = False
    return out


def basis(columns: Array) -> Array:
    """Return orthonormal columns (N, P) that span the same space as these (N, P)."""
    return np.linalg.qr(columns / np.maximum(np.abs(columns).max(axis=0), 1e-300))[0]


def triangle(rows: Array) -> Array:
    """R of the QR decomposition of these rows (N, P), shape (P, P); overwrites them."""
    from scipy.linalg.lapack import dgeqrf  # where it is needed: 31 MB

    return np.asarray(np.triu(dgeqrf(rows, overwrite_a=1)[0][:rows.shape[1]]))


def squares_of(apart: Array, cov: Array) -> float:
    """Square of a difference (n,) in standard deviations of its covariance (n, n)."""
    return float(apart @ np.linalg.lstsq(cov, apart, rcond=1e-14)[0])


def std_of(cov: Array) -> Array:
    """Standard deviations (n,) of a covariance (n, n), 0 where rounding made it negative."""
    return np.asarray(np.sqrt(np.maximum(np.diag(cov), 0.0)))


def chi_square(probability: float, freedom: float) -> float:
    """What chi-square of that many degrees of freedom exceeds with this probability."""
    from scipy.special import chdtri  # where it is needed: 31 MB

    return float(chdtri(freedom, probability))


def chance_limit(least: float, count: float, rho: float) -> float:
    """Limit on the mean square of count normalized residuals: `least`, or what chance explains.

    rho: their correlation.
    """
    free = max(count / (1.0 + (count - 1.0) * rho), 1.0)
    return max(least, chi_square(1e-5, free) / free)


def log_jeffreys(hits: int, count: int) -> float:
    """Log-probability that just these of `count` trials are hits, by the prior of Jeffreys."""
    a, b = hits + 0.5, max(count - hits, 0) + 0.5
    return lgamma(a) + lgamma(b) - lgamma(a + b)


def agree(one: Array, other: Array, cov: Array, chance: float) -> bool:
    """Whether vectors (n,) differ by no more than chance; cov: of their difference (n, n)."""
    return squares_of(one - other, cov) < chi_square(chance, len(one))


def log_density(apart: Array, cov: Array) -> float:
    """Log-density of a difference (n,) of this covariance (n, n), up to a constant."""
    return -0.5 * (squares_of(apart, cov) + float(np.linalg.slogdet(cov)[1]))


def bins_of(v: Array, most: int) -> NDArray[np.intp]:
    """First samples of some `most` bins, spread half evenly over time and half over motion of v."""
    count = len(v)
    if count <= most:
        return np.arange(count)
    move = np.abs(np.diff(v, prepend=v[0]))
    clock = np.cumsum(0.5 / count + 0.5 * move / max(float(move.sum()), 1e-300))
    return np.flatnonzero(np.diff(np.floor(clock * most), prepend=-1.0) > 0)
