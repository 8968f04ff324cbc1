"""First models for a known play output: Steiglitz-McBride, from several first filters.

A y = B p + e + X, with p and y filtered by 1/A of the step before: what is left is white where the
noise of y is, so that the poles are not biased as those of a plain ARX fit are.
"""

from __future__ import annotations

from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from backlash_ros.core.identification.output_error import (
    SINGULAR,
    Samples,
    Structure,
    full_denominator,
    solve_linear,
)
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

INSIDE = 0.999  # a pole outside is put back to here


def steiglitz_mcbride(samples: Samples, structure: Structure, p: Array) -> list[Array]:
    """Free coefficients of A, the best first; at least one."""
    tried: list[tuple[float, int, Array]] = []
    y = _without_losses(samples)
    # The first filter has this pole as often as G has poles.
    for first in (0.5, 0.9, 0.98):
        a = np.atleast_1d(np.poly(np.full(structure.free_poles, first)))[1:]
        for step in range(5):
            # Two steps later it is compared with others.
            if step >= 2 or not structure.free_poles:
                squares = solve_linear(samples, structure, a, p).squares
                tried.append((squares, len(tried), a))
            better = _refined(samples, structure, a, p, y)
            if better is None:
                break
            a = better
    if not tried:
        tried.append((inf, 0, np.zeros(structure.free_poles)))
    return [a for _, _, a in sorted(tried)]


def _without_losses(samples: Samples) -> Array:
    if samples.complete:
        return samples.y
    return np.asarray(np.interp(np.arange(samples.count), samples.known, samples.target))


def _refined(
    samples: Samples, structure: Structure, a: Array, p: Array, y: Array,
) -> Array | None:
    """One step: the least squares in A and B with everything filtered by 1/A."""
    count, taps, poles = samples.count, structure.numerator_taps, structure.free_poles
    if not poles:
        return None
    inputs = np.zeros((2, count))
    inputs[0] = samples.delayed(p, structure.delay) - samples.centre
    inputs[1, 0] = 1.0
    moved, impulse = lfilter([1.0], full_denominator(structure, a), inputs)
    # A y over A: with an integrator in both, 1 - 1/z cancels.
    filtered = lfilter([1.0], np.append(1.0, a), y)
    columns = np.zeros((count, poles + taps + 1 + structure.state_terms), order='F')
    for j in range(poles):
        columns[j + 1:, j] = -filtered[:count - j - 1]
    for i in range(taps):
        columns[i:, poles + i] = moved[:count - i]
    columns[:, poles + taps] = np.cumsum(impulse)
    for i in range(structure.state_terms):
        columns[i:, poles + taps + 1 + i] = impulse[:count - i]
    scale = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    scale[scale == 0.0] = 1.0
    basis, upper = np.linalg.qr(columns / scale)
    if not np.abs(np.diag(upper)).min() > SINGULAR:
        return None
    a = (solve_triangular(upper, basis.T @ filtered, check_finite=False) / scale)[:poles]
    return stable(a) if np.isfinite(a).all() else None


def stable(a: Array) -> Array:
    """The same with poles outside of the unit circle put inside."""
    poles = np.roots(np.append(1.0, a))
    size = np.abs(poles)
    if not len(poles) or size.max() <= INSIDE:
        return a
    poles = np.where(size > INSIDE, poles / np.maximum(size, 1e-12) * INSIDE, poles)
    return np.real(np.poly(poles))[1:]
