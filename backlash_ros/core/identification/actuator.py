"""What lies between the command and the v that a driver reports: a lag, and wind-up by friction.

    v(k) = z L(z) command(k) - w s(k) - offset,   s = 1, -1 while the load is pushed right, left

Dry friction of the load holds the motor back by w while it pushes, and not within the gap; it
builds up while the contact winds up. So only samples count that come some time after that. s is
what the backlash that was identified behind v says. All but the poles of L is linear.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.identification import Identification
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.filtering import lfilter
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

STABLE = 0.9999  # largest reflection coefficient of the denominator
SLOWEST = 0.99  # pole: a motor that takes longer follows no command
PUSHED_FOR = 10  # samples after which the load is pushed on a side as hard as it ever is
FEWEST = 10  # samples of them for each unknown
NEGLIGIBLE = 0.01  # gaps (rms) by which v is off the command where nothing lies between them
POOR = 0.1  # gaps (rms) that an L may leave unexplained


class _Fitted(NamedTuple):
    """A fit. taps: coefficients of the numerator, the first of them `delay` samples late."""

    denominator: Array
    taps: Array
    delay: int
    wind_up: float
    offset: float
    squares: float


def with_actuator(found: Identification, commands: Array) -> Identification:
    """The same with what lies between the commands (N,) and the v that were reported, if anything.

    Where no L explains v, a remark says so.
    """
    details, gap = found.details, found.gap
    off = float(np.sqrt(np.mean((found.v - commands)**2)))
    if details is None or off <= NEGLIGIBLE * gap:
        return found
    p = details.fit.p
    side = np.where(p <= found.v, 1.0, np.where(p >= found.v + gap, -1.0, 0.0))
    rows = _pushed(side)
    best = _best(commands, found.v, side, rows)
    left = off if best is None else float(np.sqrt(best.squares / len(rows)))
    if best is None or left > POOR * gap:
        return replace(found, remarks=(
            *found.remarks,
            f'applied_control is off control by {left / gap:.0%} of the gap (rms) that no lag '
            'explains, and y will follow worse for it: stay within what the motor can follow',
        ))
    return replace(found, actuator=_actuator(best))


def _pushed(side: Array) -> NDArray[np.int64]:
    """Samples at which the load has been pushed on one side for a while."""
    same = np.ones(len(side), dtype=bool)
    same[:PUSHED_FOR] = False
    for ago in range(1, PUSHED_FOR + 1):
        same[ago:] &= side[ago:] == side[:-ago]
    return np.flatnonzero(same & (side != 0.0))


def _best(
    commands: Array, v: Array, side: Array, rows: NDArray[np.int64],
) -> _Fitted | None:
    """The fit with the least rows log(squares) + unknowns log(rows); None without any."""
    found: list[tuple[float, _Fitted]] = []
    for order in (1, 2):
        for delay in range(4):
            # A coefficient more than poles is part of a delay.
            unknowns = 2 * order + 3
            if len(rows) < FEWEST * unknowns or len(np.unique(side[rows])) < 2:
                continue
            one = _fitted(commands, v, side, rows, order, delay)
            if one is not None:
                squares = max(one.squares, np.finfo(float).tiny)
                found.append((
                    len(rows) * float(np.log(squares)) + unknowns * float(np.log(len(rows))), one,
                ))
    return min(found, key=lambda pair: pair[0])[1] if found else None


def _fitted(
    commands: Array, v: Array, side: Array, rows: NDArray[np.int64], order: int, delay: int,
) -> _Fitted | None:
    moved = np.concatenate([np.zeros(delay), (commands - commands[0])[:len(commands) - delay]])
    target = v[rows]

    def solved(reflections: Array) -> tuple[Array, Array, Array]:
        denominator = _denominator(reflections)
        answer = lfilter([1.0], denominator, moved)
        columns = [np.concatenate([np.zeros(i), answer[:len(answer) - i]])[rows]
                   for i in range(order + 1)]
        matrix = np.column_stack([*columns, -side[rows], -np.ones(len(rows))])
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        return denominator, solution, target - matrix @ solution

    from scipy.optimize import least_squares  # takes a fifth of the time that a start takes
    size = float(np.std(target)) or 1.0
    fits = [
        least_squares(
            lambda x: solved(x)[2] / size, _reflections(np.full(order, pole)),
            bounds=(-STABLE, STABLE), x_scale=0.1,
        ) for pole in (0.3, 0.7, 0.9)
    ]
    best = min(fits, key=lambda one: float(one.cost))
    denominator, solution, residual = solved(best.x)
    if np.abs(np.roots(denominator)).max() > SLOWEST:
        return None
    taps, (wind_up, offset) = solution[:order + 1], solution[order + 1:]
    gain = float(taps.sum() / denominator.sum())
    one = _Fitted(
        denominator, taps, delay, float(wind_up), float(offset) + gain * float(commands[0]),
        float(residual @ residual),
    )
    try:
        _actuator(one)
    except ParameterError:
        return None
    return one


def _reflections(poles: Array) -> Array:
    """Reflection coefficients of real poles (1,) or (2,): all within 1 where all poles are."""
    if len(poles) == 1:
        return -poles
    product = float(poles[0] * poles[1])
    return np.array([-float(poles.sum()) / (1.0 + product), product])


def _denominator(reflections: Array) -> Array:
    """z^n + ... of reflection coefficients, by the Levinson recursion."""
    a = np.ones(1)
    for k in reflections.tolist():
        a = np.append(a, 0.0) + k * np.append(0.0, a[::-1])
    return a


def _actuator(fitted: _Fitted) -> Actuator:
    """As parameters have it: L strictly proper, the wind-up in units of the command."""
    # v at the end of an interval belongs to the next sample: one more pole at 0.
    at_zero = fitted.delay + len(fitted.taps) - (len(fitted.denominator) - 1)
    denominator = np.append(fitted.denominator, np.zeros(at_zero))
    gain = float(fitted.taps.sum() / fitted.denominator.sum())
    if not gain > 0.0:
        raise ParameterError('actuator.numerator', fitted.taps.tolist(), 'must have a gain > 0')
    return Actuator(
        TransferFunction(fitted.taps.tolist(), denominator.tolist(), 'actuator'),
        ((fitted.wind_up + fitted.offset) / gain, (fitted.wind_up - fitted.offset) / gain),
    )
