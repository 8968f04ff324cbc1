"""What a record cannot tell, in sentences: why a result is of no use, and what to know of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.order_selection import cancelled_poles
from backlash_ros.core.identification.output_error import Fit, Samples

Array = NDArray[np.float64]

REVERSALS = 3  # changes of the engaged side: fewer leave gap, crossings and start entangled
PRECISE = 0.1  # relative deviation of gap, gain and G(z) beyond which they are not known
NO_GAP = 0.005  # of the swing of v: a gap known this well may be 0
SHOWS = 15.0  # log-likelihood by which the fit must beat a u that stands still
SURE = 3.0  # standard deviations
WHOLE_SWING = 0.95  # of the swing of v: a gap as wide as this was not seen from both sides
ROUNDING = 1.5 / 12.0  # mean square of rounding by a quantum of 1, with a margin
UNEXPLAINED = 0.05  # of the motion of y that the gap makes, which play and linear G do not explain
WORSE_LATER = 2.0  # ratio of the error on held-out samples to that of the fit
CONCENTRATED = 2.0  # ratio of the residual while v crosses the gap to that while it is engaged
ONE_SPEED = 0.05  # relative spread of the speeds of v that are one speed
STUCK = 5  # samples at the largest or smallest y in a row, while v goes on
APART = 0.02  # relative distance of two gaps that are not the same
BEYOND = 5.0  # standard deviations: nearer ones are covered by them
UNDECIDED = 6.0  # log-likelihood by which another gap may fall behind


class Evidence(NamedTuple):
    """What there is to judge by.

    gap_std, c_r_std, gain_std (relative), response_std (relative): standard deviations. evidence:
    log-likelihood by which the fit beats a u that stands still. correlation: of successive
    residuals beyond chance. held_out, trained: rms of the errors on the samples held out and on
    the others. rivals: other gaps with the log-likelihood by which they fall behind. gain: mean
    response of y to v where y moves. quantum: of y, 0 for none. frequencies: at which y moves.
    """

    samples: Samples
    fit: Fit
    gap_std: float
    c_r_std: float
    gain_std: float
    response_std: float
    evidence: float
    correlation: float
    held_out: float
    trained: float
    rivals: list[tuple[float, float]]
    gain: float
    quantum: float


def reasons(e: Evidence) -> list[str]:
    """Why the result is of no use, a sentence with its cure each; empty where it is of use."""
    swing, gap = e.samples.play.swing, e.fit.point.gap
    found = _stuck(e)
    if e.evidence < SHOWS and not found:
        return [
            f'y shows nothing of v, which swung by {swing:.4g}: let v swing wider than the gap, '
            'and see that v is what the actuator gets'
        ]
    if gap >= WHOLE_SWING * swing:
        return [*found, f'the gap is at its bound, the swing of v ({swing:.4g}): let v swing '
                'wider, past the gap in both directions']
    if e.fit.play.reversals < REVERSALS:
        found.append(
            f'v went past the gap and back {e.fit.play.reversals} times, {REVERSALS} are needed: '
            'move it to and fro more often, or record for longer'
        )
    alike = [
        rival for rival, behind in e.rivals
        if behind < UNDECIDED and abs(rival - gap) > BEYOND * e.gap_std
    ]
    if alike:
        found.append(
            f'two gaps fit alike, {gap:.4g} and {alike[0]:.4g}: move v at several speeds and '
            'amplitudes'
        )
    imprecise = e.gap_std > max(PRECISE * gap, NO_GAP * swing)
    if imprecise:
        found.append(_why_imprecise(e))
    if e.gain_std > PRECISE:
        found.append(
            f'the gain of G is known to {e.gain_std:.0%} only: move v further and at lower '
            'frequencies, or record for longer'
        )
    elif e.response_std > PRECISE:
        found.append(
            f'G is known to {e.response_std:.0%} only: move v at more speeds, or record for longer'
        )
    unexplained = unexplained_of(e)
    if unexplained > UNEXPLAINED:
        found.append(_why_unexplained(e, unexplained))
    c_l = e.fit.c_r - gap
    if e.fit.c_r < -SURE * e.c_r_std or c_l > SURE * e.c_r_std:
        found.append(
            f'0 of v lies outside of the gap (c_r = {e.fit.c_r:.4g}, c_l = {c_l:.4g}), where the '
            'controller expects it: shift the zero of v, or that of y'
        )
    return found


def unexplained_of(e: Evidence) -> float:
    """Correlated residual over the motion of y that the gap makes."""
    step = e.gain * e.fit.point.gap
    # What an encoder rounds away repeats itself as well, but is explained.
    excess = e.fit.rms**2 - ROUNDING * e.quantum**2
    if e.correlation <= 0.0 or step <= 0.0 or excess <= 0.0:
        return 0.0
    return float(np.sqrt(excess * e.correlation) / step)


def remarks(e: Evidence) -> list[str]:
    """What to know of a result that is of use, a sentence each."""
    found = []
    swing, gap = e.samples.play.swing, e.fit.point.gap
    if gap <= SURE * e.gap_std or gap < NO_GAP * swing:
        found.append(
            f'no backlash was found: the gap is below {max(gap + SURE * e.gap_std, 0.0):.2g}'
        )
    if _one_speed(e.samples.v):
        found.append(
            'v moved at one speed only: a lag before the gap would look like a wider gap; move v '
            'at several speeds'
        )
    cancelled = cancelled_poles(e.fit)
    if cancelled:
        found.append(
            f'the pole {_text(cancelled[0])} is cancelled by a zero: a lower order does as well; '
            'limit --order'
        )
    if e.held_out > WORSE_LATER * e.trained:
        found.append(
            f'the last part of the record is predicted {e.held_out / e.trained:.2g} times worse '
            'than the rest is fitted: the plant changed on the way, or the record is short'
        )
    return found


def _why_imprecise(e: Evidence) -> str:
    gap = e.fit.point.gap
    text = f'the gap, about {gap:.3g}, is known to {e.gap_std:.2g} only'
    moved = e.gain * gap
    if e.quantum > moved:
        return (
            f'{text}: y is quantised in steps of {e.quantum:.3g}, and the gap moves it by '
            f'{moved:.2g} only; use a finer sensor, or record for longer'
        )
    return (
        f'{text}: y has a noise of {e.fit.rms:.2g}, and the gap moves it by {moved:.2g}; '
        'record for longer, or turn v more often'
    )


def _why_unexplained(e: Evidence, share: float) -> str:
    text = f'{share:.0%} of the motion that the gap makes follows from no backlash and no linear G'
    crossing = e.fit.play.p[1:] == e.fit.play.p[:-1]
    crossing &= np.abs(np.diff(e.samples.v)) > 0.0
    inside = e.samples.delayed(np.append(crossing, False).astype(float), e.fit.structure.delay)
    residual = e.samples.y - e.fit.simulated
    known = np.isfinite(residual)
    within, engaged = known & (inside > 0.0), known & (inside == 0.0)
    if within.any() and engaged.any():
        ratio = float(np.sqrt(np.mean(residual[within]**2) / np.mean(residual[engaged]**2)))
        if ratio > CONCENTRATED:
            return (
                f'{text}, most of it while v crosses the gap: the load coasts or is pushed there; '
                'brake it, or move more slowly'
            )
    return f'{text}: friction, a load that moves by itself, or a higher order; see --order'


def _stuck(e: Evidence) -> list[str]:
    """Where y stays at its largest or smallest value while v goes on."""
    y, v = e.samples.whole_y, e.samples.v
    path = np.append(0.0, np.cumsum(np.abs(np.diff(v))))
    # While v crosses the gap, y may well rest.
    gap = e.fit.point.gap if e.evidence >= SHOWS else 0.25 * e.samples.play.swing
    passed = 1.5 * gap + 0.1 * e.samples.play.swing
    found = []
    for name, extreme in (('largest', np.nanmax(y)), ('smallest', np.nanmin(y))):
        at = np.append(False, np.append(y == extreme, False))
        begins, ends = np.flatnonzero(~at[:-1] & at[1:]), np.flatnonzero(at[:-1] & ~at[1:]) - 1
        long = ends - begins >= STUCK
        moved = path[ends[long]] - path[begins[long]]
        if np.count_nonzero(moved > passed) >= 2:
            found.append(
                f'y stays at its {name} value, {extreme:.4g}, while v goes on: the sensor is at '
                'its end; move v less far'
            )
    return found


def _one_speed(v: Array) -> bool:
    speeds = np.abs(np.diff(v))
    speeds = speeds[speeds > 0.01 * speeds.max(initial=0.0)]
    return bool(len(speeds) and np.std(speeds) < ONE_SPEED * np.mean(speeds))


def _text(root: complex) -> str:
    return f'{root.real:.4g}' if abs(root.imag) < 1e-9 else f'{root:.4g}'
