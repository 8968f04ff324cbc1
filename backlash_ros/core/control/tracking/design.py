"""Gains of the tracking structure for a model of G: pure functions, for any process.

LQ tracking of a reference that is known for some samples ahead minimises
sum (y - r)^2 + w_i q^2 + rho (u - u_r)^2 with the integral q(k+1) = q(k) + r(k) - y(k):

    u(k) = -K z(k) - sum_{j=0..N} f_j r(k+j),   z = [x; q]

u_r is the u that holds y at r: r / G(1), earlier by the delay of G for slow motion; 0 if G
integrates. Weighting u itself would leave y short of r. Beyond the window r keeps its last value.

Reference: M. Tomizuka, Optimal continuous finite preview problem, IEEE Trans. Automatic Control
20 (1975) 362-365; A. Bemporad, lecture form of the affine Riccati recursion.
"""

from collections.abc import Sequence
from functools import lru_cache
from math import inf
from typing import NamedTuple

import numpy as np

from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.parameters.table import TrackingWeights
from backlash_ros.core.plant.numerics import riccati
from backlash_ros.core.plant.transfer_function import Array, StateModel, TransferFunction, powers

Gain = list[float]

# Factors on the input weight of feedback. The softer gains are for noise; those up to SOFTEST also
# while v meets its limits or the estimate is new; SOFTEST itself while the backlash is unknown.
SCHEDULE = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)
SOFTEST = 4
# The same for the ideal trajectory: the larger the weight, the less noise of y_m moves it.
SOFTER = (1.0, 1e2, 1e4)
# Factors on the input weight that are tried in turn for feedback around a better G, until the loop
# is as robust as the one it replaces. The trajectory keeps the weight that was configured.
SAFER = (1.0, *np.geomspace(1.1, 100.0, 60).tolist())
HORIZON = 300  # samples over which responses to u, and to noise of the references, are summed up
LOOK_AHEAD = 20  # samples, at most, for which u* is known ahead
# Variance of the disturbance per sample, seen in y, over that of the noise on y: from an observer
# that trusts its model to one that trusts y alone.
CONFIDENCES = (1e-4, 1e-1, 1e2, 1e5)


class PreviewGains(NamedTuple):
    """state: K of x, shape (n,). integral: K of q. preview: f_0 .. f_N, shape (N + 1,)."""

    state: Array
    integral: float
    preview: Array


# Cached: a controller that restarts in the middle of a loop must not wait for them.
@lru_cache(maxsize=64)
def preview_gains(
    model: StateModel, input_weight: float, integral_weight: float = 0.0, window: int = 0,
) -> PreviewGains:
    """Return the gains for rho = input_weight > 0, w_i = integral_weight >= 0, N = window >= 0.

    Raises ParameterError if G cannot be stabilised or, with w_i > 0, has a zero at z = 1.
    """
    n, integrates = model.order, integral_weight > 0.0
    size = n + integrates
    a, b, c, e = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
    # u in units of 1/sqrt(rho), so that all weights in the Riccati equation are of one size.
    unit = input_weight**-0.5
    a[:n, :n], b[:n], c[0] = model.a, model.b * unit, model.c
    q: Array = np.asarray(np.outer(c, c), np.float64)
    if integrates:
        a[n, 0], a[n, n], e[n], q[n, n] = -model.c, 1.0, 1.0, integral_weight
    try:
        p = riccati(a, b, q)
    except np.linalg.LinAlgError:
        raise ParameterError(
            'plant.numerator', 'G(z)', 'cannot be stabilised by feedback of its state',
            'a pole on or outside the unit circle is cancelled, or tracking.integral_weight > 0 '
            'meets a zero at z = 1',
        ) from None
    share = b / (1.0 + float(b @ p @ b))  # (R + B'PB)^-1 B'
    gain = share @ p @ a
    closed = a - np.outer(b, gain)
    preview = _preview(share, closed, p @ e, c, window) * unit
    # u = u_r + u': only u' is weighted, and u_r drives G as a known input.
    by_u_r = _preview(share, closed, p @ b, np.zeros(size), window)
    by_u_r[0] -= 1.0
    of_each = np.convolve(by_u_r, _holding(model.transfer_function, window))
    preview += of_each[:window + 1]
    preview[window] += of_each[window + 1:].sum()
    return PreviewGains(gain[:n] * unit, float(gain[n] * unit) if integrates else 0.0, preview)


def _preview(share: Array, closed: Array, first: Array, c: Array, window: int) -> Array:
    """Gains f_0 .. f_N for a known w in z(k+1) = A z + B u + e w and the error c'z - w; first: P e.

    Backward recursion of the affine term s of the cost: u = -K z - share' (P e w(k) + s(k+1)).
    """
    gains = np.empty(window + 1)
    gains[0] = share @ first
    row = closed.T @ first - c
    for j in range(1, window + 1):
        gains[j] = share @ row
        row = closed.T @ row
    # w is held beyond the window, so the remaining geometric series multiplies its last value.
    gains[window] += share @ np.linalg.solve(np.eye(len(c)) - closed.T, row)
    return gains


def _holding(model: TransferFunction, window: int) -> Array:
    """Return h of u_r(k) = sum_j h_j r(k+j), shape (N + 1,)."""
    taps = np.zeros(window + 1)
    b, a = model.numerator, model.denominator
    b_1, a_1 = float(b.sum()), float(a.sum())
    # G has a zero or a pole at z = 1 if a sum vanishes but for rounding of the coefficients.
    if abs(b_1) <= 1e-9 * np.abs(b).sum() or abs(a_1) <= 1e-9 * np.abs(a).sum():
        return taps  # no u holds y, or u = 0 does
    whole, part = divmod(min(max(model.group_delay, 0.0), float(window)), 1.0)
    taps[int(whole)] = 1.0 - part
    taps[min(int(whole) + 1, window)] += part
    return taps * (a_1 / b_1)


class Plan(NamedTuple):
    """One ideal trajectory, with z = [x*; q*]."""

    gains: PreviewGains
    closed: Array  # transition F of z, shape (n + 1, n + 1)
    states: Array  # from z to u* of the next L samples, shape (L, n + 1)
    references: Array  # the same from the references, shape (L, N + 1)
    noise_gains: Array  # see ReferenceWindow
    # For unit noise on r, for each width of averaging: `variances` of x*, (widths + 1, S + 1).
    x_noise: Array


class TrackingDesign(NamedTuple):
    """What is designed for one model of G; gains of x have the shape (n,)."""

    model: StateModel
    factor: float  # see feedback_around
    plans: tuple[Plan, ...]  # with larger and larger weights of u, for noisy references
    feedback: PreviewGains  # for deviations from the plan
    schedule: tuple[Gain, ...]  # from full feedback to the softest
    acquisition: Gain | None  # while the backlash is unknown; None if no feedback is better
    gentle: Gain  # brings y back at rest
    push: float  # |x| after HORIZON samples of u = 1
    push_ahead: float  # |y| after LOOK_AHEAD samples of u = 1
    holding: list[tuple[Array, Array]]  # see _agreed, for each gain of the schedule


def variances(schedule: Sequence[Gain], x_cov: Array) -> Array:
    """Variances (S + 1,) of K x for each of S gains of a schedule, then of |x|."""
    gains = np.array(schedule)
    return np.append(((gains @ x_cov) * gains).sum(axis=1), x_cov.trace())


def design(model: StateModel, weights: TrackingWeights, factor: float = 1.0) -> TrackingDesign:
    """Design all gains for a model of G; raises ParameterError if there are none."""
    rest_bandwidth = 1.0 / 80.0  # [rad/sample] up to which y is corrected at rest
    # True slope over its first guess that acquisition feedback has to bear. With a plant that bears
    # less, any useful feedback leads y astray; without, the backlash is learned before y is lost.
    wrong_slope = 1.35
    rho = weights.input_weight * power_gain(model.transfer_function, np.pi / 10.0)
    feedback = feedback_around(model, weights, factor)
    softer = [preview_gains(model, max(more, factor) * rho) for more in SCHEDULE[1:]]
    schedule = feedback.state.tolist(), *(gains.state.tolist() for gains in softer)
    plans = tuple(
        _plan(model, schedule, preview_gains(
            model, more * rho, weights.integral_weight, weights.preview))
        for more in SOFTER)
    bears = modulus_margin(model, model, softer[SOFTEST - 1], wrong_slope) > 0.0
    # With |G|^2 at a frequency as weight of u^2, feedback acts up to about that frequency.
    gentle = preview_gains(model, power_gain(model.transfer_function, rest_bandwidth)).state
    ahead, later = (powers(model.a, model.b, k).sum(axis=0) for k in (LOOK_AHEAD, HORIZON))
    return TrackingDesign(
        model, factor, plans, feedback, schedule, schedule[SOFTEST] if bears else None,
        gentle.tolist(),
        float(np.linalg.norm(later)), model.c * abs(float(ahead[0])),
        [_agreed(model, gain, len(plans[0].states)) for gain in schedule])


def better_design(
    model: StateModel, weights: TrackingWeights, present: TrackingDesign,
) -> TrackingDesign | None:
    """Return the design for a better model of G, or None if there is no safe one."""
    # A modulus margin of 0.5, that is a sensitivity below 2, is safe; otherwise that of the present
    # loop is required, around its own G or around the better one. The input weight is raised no
    # further than this takes, as the loop becomes the measure for the next G.
    needed = 0.5
    try:
        for factor in SAFER:
            reached = modulus_margin(model, model, feedback_around(model, weights, factor))
            if reached < needed and factor == SAFER[0]:
                needed = min(needed, *(modulus_margin(plant, present.model, present.feedback)
                                       for plant in (present.model, model)))
            if 0.0 < reached >= needed:
                return design(model, weights, factor)
    except ParameterError:
        pass
    return None


def feedback_around(
    model: StateModel, weights: TrackingWeights, factor: float = 1.0,
) -> PreviewGains:
    """Gains for deviations from the trajectory, with `factor` times the input weight."""
    rho = weights.input_weight * power_gain(model.transfer_function, np.pi / 10.0)
    return preview_gains(model, factor * rho, weights.integral_weight)


def power_gain(model: TransferFunction, frequency: float) -> float:
    """|G|^2 at a frequency [rad/sample]."""
    return float(abs(model.response(np.array([np.exp(1j * frequency)]))[0])) ** 2


def _agreed(model: StateModel, gain: Gain, length: int) -> tuple[Array, Array]:
    """Maps (L - 1, n) of e and (L - 1, L) of u* to the u that a gain still asks for after a hold.

    A u that was held for j samples from x - x* = e on is what u*(k+j) - K (x - x*) asks for if
    (1 + sum_i K A^i B) u = u*(k+j) + sum_i K A^(j-1-i) B u*(k+i) - K A^j e,  i = 0 .. j - 1
    """
    by_state = np.array(gain) @ powers(model.a, np.eye(model.order), length)
    answers = np.append(1.0, by_state @ model.b)[:length]
    # A Toeplitz matrix without SciPy, which would cost a controller 22 MB.
    ago = np.subtract.outer(np.arange(length), np.arange(length))
    by_u = np.tril(answers[np.maximum(ago, 0)])[1:]
    total = by_u.sum(axis=1)
    count = int(np.cumprod(total > 0.0).sum())  # beyond, a larger u is asked to grow further
    return -by_state[1:count + 1] / total[:count, None], by_u[:count] / total[:count, None]


def _plan(model: StateModel, schedule: Sequence[Gain], gains: PreviewGains) -> Plan:
    n, last = model.order, len(gains.preview) - 1
    length = min(LOOK_AHEAD, last // 3) + 1
    closed = np.eye(n + 1)
    closed[:n, :n] = model.a - np.outer(model.b, gains.state)
    closed[:n, n], closed[n, 0] = -gains.integral * model.b, -model.c
    k = np.append(gains.state, gains.integral)
    by_state: Array = np.eye(n + 1)  # z(k+j), from z(k) and from the references
    by_reference: Array = np.zeros((n + 1, last + 1))
    states, references = np.empty((length, n + 1)), np.empty((length, last + 1))
    for j in range(length):
        preview = np.zeros(last + 1)
        preview[j:] = gains.preview[:last + 1 - j]
        preview[last] += gains.preview[last + 1 - j:].sum()  # the last reference is held
        states[j], references[j] = -k @ by_state, -k @ by_reference - preview
        by_reference = np.asarray(closed @ by_reference)
        by_reference[:n] -= np.outer(model.b, preview)
        by_reference[n, min(j, last)] += 1.0
        by_state = closed @ by_state
    # u* and x* for unit noise on the references, for each width of averaging.
    responses = powers(model.a - np.outer(model.b, gains.state), model.b, HORIZON)
    to_u = np.append(1.0, -responses @ gains.state)
    signals = np.column_stack([to_u, np.vstack([np.zeros(n), responses])])
    u_noise, x_noise = [], []
    for kernel in averages(last):
        weights = np.convolve(kernel, gains.preview[::-1])
        of_all = np.array([np.convolve(weights, signal) for signal in signals.T])
        u_noise.append(np.linalg.norm(of_all[0]))
        x_noise.append(variances(schedule, of_all[1:] @ of_all[1:].T))
    # u* ahead also depends on references that are not averaged yet.
    tail = float(np.linalg.norm(references[:, 2 * last // 3:], axis=1).max())
    return Plan(gains, closed, states, references, np.maximum(np.array(u_noise), tail),
                np.array(x_noise))


def modulus_margin(
    plant: StateModel, model: StateModel, gains: PreviewGains, factor: float = 1.0,
) -> float:
    """Return min |1 + L| of the loop L of feedback for `model` around a plant; 0 if unstable."""
    # For the worst of four observers, which do not know that u acts `factor` times as strongly. The
    # gap is left out: it limits the harm that a wrong u does, but not for ever.
    n, least = plant.order, inf
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 120))
    at, response = z[:, None, None], plant.transfer_function.response(z)
    for confidence in CONFIDENCES:
        observer = _observer(model, confidence)
        if observer is None:
            return 0.0
        believed, drive, seen, correction = observer
        # The loop with the state [x of the plant; x_hat; d_hat; q].
        size = n + len(drive) + 1
        gain, loop = np.zeros(size), np.zeros((size, size))
        gain[n:-2], gain[-1] = gains.state, gains.integral
        loop[:n, :n] = plant.a
        loop[:n] -= factor * np.outer(plant.b, gain)
        # x_hat(k+1) = prediction + correction (y(k+1) - its prediction)
        loop[n:-1, n:-1] = believed
        loop[n:-1] -= np.outer(drive, gain)
        loop[n:-1] += np.outer(correction, plant.c * loop[0] - seen @ loop[n:-1])
        if gains.integral:
            loop[-1, 0], loop[-1, -1] = -plant.c, 1.0
        if not np.abs(np.linalg.eigvals(loop)).max() < 1.0:
            return 0.0
        # The loop is opened at u; the observer knows all of u, the part that q adds included.
        closed = believed - np.outer(drive, gain[n:-1])
        closed -= np.outer(correction, seen @ closed)
        by_integral = gains.integral / (z - 1.0)
        of_q = (drive - correction * (seen @ drive))[:, None] * by_integral[:, None, None]
        x_hat = np.linalg.solve(at * np.eye(len(drive)) - closed, at * correction[:, None] + of_q)
        minus_u = (gain[n:-1] @ x_hat)[:, 0] - by_integral
        least = min(least, float(np.abs(1.0 + factor * response * minus_u).min()))
    return least


@lru_cache(maxsize=16)
def _observer(model: StateModel, confidence: float) -> tuple[Array, Array, Array, Array] | None:
    """Return A, B, c and the gain of an observer of [x; d], or None if there is none."""
    n = model.order
    a, b, c = np.eye(n + 1), np.append(model.b, 0.0), np.zeros(n + 1)
    a[:n, :n], a[:n, n], c[0] = model.a, model.b, model.c
    # With a confidence of 1, one sample of d moves y as much as its noise does; a trace of noise on
    # x keeps the equation regular.
    drift = 1e-12 * np.eye(n + 1)
    drift[-1, -1] += 1.0
    drift *= confidence / (float(np.linalg.norm(model.b)) * model.c) ** 2
    try:
        p = riccati(a.T, c, drift)
    except np.linalg.LinAlgError:
        return None
    return a, b, c, np.asarray(p @ c / (c @ p @ c + 1.0))


# --- references that carry noise: see trajectory.py ---------------------------------------------


@lru_cache(maxsize=16)
def parabolas(preview: int) -> tuple[Array, list[int], list[int]]:
    """Return a matrix from 2 H + 1 references to residuals of parabolas through the middle ones.

    It stacks blocks of 2 w + 1 rows for several w <= H, at most a third of the preview: shape
    (sum (2 w + 1), 2 H + 1). Returns as well the first row of each block, and the widths w.
    """
    widths = [w for w in (3, 8, 20) if 3 * w <= preview]
    half, sizes = max(widths, default=0), [2 * w + 1 for w in widths]
    first = [sum(sizes[:i]) for i in range(len(sizes))]
    fits = np.zeros((sum(sizes), 2 * half + 1))
    for w, row in zip(widths, first, strict=True):
        powers = np.arange(-w, w + 1.0)[:, None] ** np.arange(3)
        weighted = powers * np.hanning(2 * w + 3)[1:-1, None]
        fit = powers @ np.linalg.solve(weighted.T @ powers, weighted.T)
        fits[row:row + 2 * w + 1, half - w:half + w + 1] = np.eye(2 * w + 1) - fit
    return fits, first, widths


def averages(preview: int) -> Array:
    """Weights of averaging: first none, then each width of `parabolas`, (widths + 1, 2 H + 1)."""
    fits, first, widths = parabolas(preview)
    kernels = np.zeros((len(widths) + 1, fits.shape[1]))
    kernels[:, fits.shape[1] // 2] = 1.0
    kernels[1:] -= fits[np.add(first, widths).astype(int)]
    return kernels
