"""Which order, delay and integrator: compared on samples that the fit has not seen.

A pole that a zero cancels is none: such a structure gives way to the same one without that pole. It
would predict a little better, but only what no G makes: the state and the offset that fit the
samples held out would have a drift more to fit them with. Structures whose held-out error is
within a few percent of the least of the others are equally good predictors. Among them the least

    N' log(squares) + unknowns log(N)

over all samples is taken (BIC), with N' = N (1 - r) / (1 + r) for the lag-1 correlation r of the
residual: what repeats itself from sample to sample, as the error of a quantised y, speaks less.

Without any noise the residual is what the arithmetic of the simulation rounds, and says nothing of
the structure. Of the structures that explain y to within their own rounding, the smallest is taken.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.output_error import (
    Fit,
    Point,
    Samples,
    Structure,
    fit,
    squares_of,
)
from backlash_ros.core.identification.starting_models import steiglitz_mcbride
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

WITHIN = 1.05  # times the least held-out error: equally good
STARTS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # places in the gap at which p may begin
CANCELS = 0.02  # distance of a pole and a zero that cancel, relative to that of the pole from 1
SLOWEST = 0.01  # ... which counts as this much at least: a zero at 1 cancels an integrator
EPS = float(np.finfo(float).eps)
ROUNDED = 2.0  # the simulated y, and the measured one, which may be a simulation as well
AS_WELL = 4.0  # ratio of the squares left over: without noise, it shows a pole that is cancelled
PLATEAU = 10.0  # difference of the criterion below which two delays are equally good


class Compared(NamedTuple):
    """One structure.

    trained: fitted to the first part, with which held_out, the rms of the error on the last part,
    is made. fit: to all samples. criterion: as above, the smaller the better. exact: whether the
    residual is no more than the rounding of the simulation.
    """

    structure: Structure
    held_out: float
    trained: Fit
    fit: Fit
    criterion: float
    exact: bool


def compare(
    samples: Samples, candidates: Sequence[Point], orders: Sequence[int], delays: Sequence[int],
    integrators: Sequence[bool], held_out: float,
) -> Generator[None, None, list[Compared]]:
    """Fit every structure, from gaps and starts that are about right; yields between them.

    held_out: share at the end of the record that is compared on.
    """
    cut = samples.last - round(held_out * samples.count)
    train, later = samples.part(samples.first, cut), samples.part(cut, samples.last)
    found: list[tuple[float, Fit, Fit]] = []
    for integrator in integrators:
        for delay in delays:
            below: Fit | None = None
            for order in orders:
                if order < integrator:
                    continue
                structure = Structure(order, delay, integrator)
                below = _fit_from(train, structure, candidates, below)
                whole = fit(samples, structure, below.point)
                found.append((held_out_rms(below, later), below, whole))
                yield
    best = min((whole for _, _, whole in found), key=lambda whole: whole.squares)
    rows = effective_rows(samples, best)
    smallest = np.finfo(float).tiny
    return [
        Compared(
            whole.structure, rms, trained, whole,
            rows * float(np.log(max(whole.squares, smallest)))
            + whole.structure.unknowns * float(np.log(len(samples.known))),
            whole.rms <= rounding(samples, whole),
        )
        for rms, trained, whole in found
    ]


def selected(compared: Sequence[Compared]) -> Compared:
    """The structure that is taken."""
    needed = [one for one in compared if not gives_way(one.fit, compared)]
    # What a pole near 1 rounds may hide noise: without it, y is explained as well.
    exact = [one for one in compared if one.exact and not gives_way(one.fit, [
        other for other in compared if other.fit.squares < AS_WELL * one.fit.squares
    ])]
    if exact:
        return min(exact, key=lambda one: (one.structure.unknowns, one.fit.squares))
    least = min(one.held_out for one in needed)
    good = [one for one in needed if one.held_out <= WITHIN * least]
    return min(good, key=lambda one: one.criterion)


def gives_way(found: Fit, compared: Sequence[Compared]) -> bool:
    """Whether a zero cancels a pole, and the structure without that pole is compared as well."""
    order, delay, integrator, _ = found.structure
    smaller = [
        Structure(order - 1, delay, integrator and pole != 1.0) for pole in cancelled_poles(found)
    ]
    return any(one.structure in smaller for one in compared)


def cancelled_poles(found: Fit) -> list[complex]:
    """Poles that a zero all but cancels, so that neither shows; an integrator as exactly 1."""
    zeros = np.roots(found.numerator)
    if not len(zeros) or not np.isfinite(zeros).all():
        return []
    poles = [*np.roots(np.append(1.0, found.point.a)), *[1.0] * found.structure.integrator]
    return [
        complex(pole) for pole in poles
        if float(np.abs(zeros - pole).min()) < CANCELS * max(abs(1.0 - pole), SLOWEST)
    ]


def rounding(samples: Samples, found: Fit) -> float:
    """Deviation of the simulated y by rounding alone.

    A step of the recursion A y = ... rounds by |A|_1 |y| eps at most, and 1/A hands that on.
    """
    impulse = np.zeros(samples.count)
    impulse[0] = 1.0
    answer = lfilter([1.0], found.denominator, impulse)
    y = float(np.sqrt(np.mean(samples.target**2)))
    return ROUNDED * EPS * float(np.abs(found.denominator).sum()) * y * float(
        np.linalg.norm(answer)
    )


def equal_delays(compared: Sequence[Compared], chosen: Compared) -> list[int]:
    """Delays that explain y as well as the chosen one, with as many poles or more.

    A lag that a pole of its own would make may stand for a delay.
    """
    order, _, integrator, _ = chosen.structure
    return sorted({
        one.structure.delay for one in compared
        if one.structure.integrator == integrator and one.structure.order >= order
        and one.criterion <= chosen.criterion + PLATEAU
    })


def _fit_from(
    samples: Samples, structure: Structure, candidates: Sequence[Point], below: Fit | None,
) -> Fit:
    fits: list[Fit] = []
    for point in candidates:
        p = samples.play.output(point.gap, point.start).p
        a = steiglitz_mcbride(samples, structure, p)[0]
        v0 = float(samples.v[0])
        # A state of fewer numbers does not hide a start that is wrong.
        starts = [point.start, *(v0 + share * point.gap for share in STARTS)]
        fits.append(fit(samples, structure, min(
            (Point(a, point.gap, start) for start in starts),
            key=lambda one: squares_of(samples, structure, one),
        )))
    if below is not None and below.structure.free_poles == structure.free_poles - 1:
        for pole in (0.3, 0.85):
            a = np.convolve(np.append(1.0, below.point.a), (1.0, -pole))[1:]
            fits.append(fit(samples, structure, below.point._replace(a=a)))
    return min(fits, key=lambda found: found.squares)


def held_out_rms(found: Fit, later: Samples) -> float:
    """Error of what the fit predicts for later samples."""
    residual = later.target - predicted(found, later)[later.known]
    rms = float(np.sqrt(np.mean(residual**2)))
    return rms if np.isfinite(rms) else inf


def predicted(found: Fit, later: Samples) -> Array:
    """Simulation over samples (M,), begun in the state and with the offset that fit them best."""
    structure, count = found.structure, later.count
    inputs = np.zeros((2, count))
    p = later.play.output(found.point.gap, found.point.start).p
    inputs[0] = later.delayed(p, structure.delay) - found.centre
    inputs[1, 0] = 1.0
    denominator = found.denominator
    simulated = lfilter(found.numerator, denominator, inputs[0])
    impulse = lfilter([1.0], denominator, inputs[1])
    columns = np.zeros((count, 1 + structure.state_terms))
    columns[:, 0] = np.cumsum(impulse)
    for i in range(structure.state_terms):
        columns[i:, 1 + i] = impulse[:count - i]
    scale = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    columns /= np.where(scale > 0.0, scale, 1.0)
    error = later.target - simulated[later.known]
    best = np.linalg.lstsq(columns[later.known], error, rcond=None)[0]
    return np.asarray(simulated + columns @ best)


def effective_rows(samples: Samples, found: Fit) -> float:
    """N' of the formula above."""
    r = lag_one(samples, found)
    return len(samples.known) * (1.0 - r) / (1.0 + r)


def lag_one(samples: Samples, found: Fit) -> float:
    """Correlation of the residuals of successive readings, lost ones left out, at least 0."""
    residual = samples.target - found.simulated[samples.known]
    energy = float(np.mean(residual**2))
    if energy == 0.0 or len(residual) < 2:
        return 0.0
    return min(max(float(np.mean(residual[1:] * residual[:-1])) / energy, 0.0), 0.99)
