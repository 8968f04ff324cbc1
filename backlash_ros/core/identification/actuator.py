"""What lies between the command and the v that a driver reports: a lag, and wind-up by friction.

    v(k) = z L(z) command(k) - w s(k) - offset,   s = 1, -1 while the load is pushed right, left

Dry friction of the load holds the motor back by w while it pushes, and not within the gap; it
builds up while the contact winds up. So only samples count that come some time after that. s is
what the backlash that was identified behind v says. All but the poles of L is linear.
"""

from dataclasses import replace
from math import log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.plant_family import delayed
from backlash_ros.core.identification.identification import Identification
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import Array, TransferFunction


def with_actuator(found: Identification, commands: Array) -> Identification:
    """The same with what lies between the commands (N,) and the v that were reported, if anything.

    Where no L explains v, a remark says so.
    """
    # gaps (rms) by which v is off the command where nothing lies between, or no L explains it
    negligible, poor = 0.01, 0.1
    pushed_for = 10  # samples after which the load is pushed on a side as hard as it ever is
    details, gap = found.details, found.gap
    off = float(np.sqrt(np.mean((found.v - commands)**2)))
    if details is None or off <= negligible * gap:
        return found
    place, begin = (details.observed.p - details.v) / gap, details.first - 1 - found.model.delay
    side = np.zeros(len(found.v))
    side[begin:begin + len(place)] = (place < 1e-9) * 1.0 - (place > 1.0 - 1e-9)
    pushed = (side != 0.0) & (delayed(side, pushed_for + 1) == side).all(axis=0)
    pushed[:pushed_for] = False
    rows = np.flatnonzero(pushed)
    fits = [] if len(np.unique(side[rows])) < 2 else [
        _fitted(commands, found.v, side, rows, order, delay)
        for order in (1, 2) if len(rows) >= 10 * (2 * order + 3) for delay in range(4)]
    _, left, actuator = min((one for one in fits if one[2] is not None),
                            default=(0.0, off, None), key=lambda one: one[0])
    if actuator is not None and left <= poor * gap:
        return replace(found, actuator=actuator)
    return found.with_remarks(
        *found.remarks,
        f'applied_control is off control by {left / gap:.0%} of the gap (rms) that no lag '
        'explains, and y will follow worse for it: stay within what the motor can follow')


def _fitted(
    commands: Array, v: Array, side: Array, rows: NDArray[np.intp], order: int, delay: int,
) -> tuple[float, float, Actuator | None]:
    """Criterion (BIC), rms of what is left over, and the actuator, None where it would be none."""
    slowest_motor = 0.99  # pole: a motor that takes longer follows no command
    moved, target = delayed(commands - commands[0], delay + 1)[-1], v[rows]

    def solved(reflections: Array) -> tuple[Array, Array, Array]:
        denominator = np.ones(1)
        for k in reflections.tolist():  # the Levinson recursion
            denominator = np.append(denominator, 0.0) + k * np.append(0.0, denominator[::-1])
        # A coefficient more than poles is part of a delay.
        taps = delayed(lfilter([1.0], denominator, moved), order + 1)[:, rows]
        matrix = np.column_stack([*taps, -side[rows], -np.ones(len(rows))])
        solution = np.linalg.lstsq(matrix, target, rcond=None)[0]
        return denominator, solution, target - matrix @ solution

    from scipy.optimize import least_squares  # takes a fifth of the time that a start takes
    size = float(np.std(target)) or 1.0
    # Reflection coefficients of real poles: all within 1 where all poles are.
    starts = [[-2.0 * pole / (1.0 + pole**2), pole**2] if order == 2 else [-pole]
              for pole in (0.3, 0.7, 0.9)]
    best = min((
        least_squares(lambda x: solved(x)[2] / size, start, bounds=(-0.9999, 0.9999), x_scale=0.1)
        for start in starts), key=lambda one: float(one.cost))
    denominator, solution, residual = solved(best.x)
    taps, (wind_up, offset) = solution[:order + 1], solution[order + 1:]
    squares = max(float(residual @ residual), float(np.finfo(float).tiny))
    criterion = len(rows) * log(squares) + (2 * order + 3) * log(len(rows))
    gain, actuator = float(taps.sum() / denominator.sum()), None
    if gain > 0.0 and np.abs(np.roots(denominator)).max() <= slowest_motor:
        offset += gain * float(commands[0])
        try:
            # v at the end of an interval belongs to the next sample: one more pole at 0.
            lag = TransferFunction(
                taps.tolist(), [*denominator.tolist(), *[0.0] * (delay + 1)], 'actuator')
            actuator = Actuator(lag, ((wind_up + offset) / gain, (wind_up - offset) / gain))
        except ParameterError:
            pass
    return criterion, float(np.sqrt(squares / len(rows))), actuator
