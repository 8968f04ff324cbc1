"""Identify the actuator between the command and the reported v: a lag, and wind-up by friction.

    v(k) = z L(z) command(k) - w s(k) - offset,   s = 1, -1 while the load is pushed right, left

Dry friction of the load holds the motor back by w while it pushes, but not within the gap. This
builds up after contact, so only samples some time after contact are fitted. s follows from the
backlash that was identified behind v. The model is linear in all but the poles of L.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import product
from math import log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.identification import Identification
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.numerics import lfilter, shifted, steiglitz_mcbride
from backlash_ros.core.plant.transfer_function import Array, TransferFunction


def with_actuator(found: Identification, commands: Array) -> Identification:
    """Add the actuator between the commands (N,) and the reported v to a result, if there is one.

    If no L explains v, the result gets a remark instead.
    """
    # rms errors, in gaps: below `negligible` v is the command, above `poor` no L explains v
    negligible, poor = 0.01, 0.1
    pushed_for = 10  # samples in contact after which the wind-up is complete
    details, gap = found.details, found.gap
    off = float(np.sqrt(np.mean((found.v - commands)**2)))
    if details is None or off <= negligible * gap:
        return found
    place, begin = (details.observed.p - details.v) / gap, details.first - 1 - found.model.delay
    side = np.zeros(len(found.v))
    side[begin:begin + len(place)] = (place < 1e-9) * 1.0 - (place > 1.0 - 1e-9)
    pushed = (side != 0.0) & (shifted(side, pushed_for + 1) == side).all(axis=0)
    pushed[:pushed_for] = False
    rows = np.flatnonzero(pushed)
    fits = _fits(commands, found.v, side, rows) if len(np.unique(side[rows])) == 2 else ()
    _, left, actuator = min(fits, default=(0.0, off, None), key=lambda one: one[0])
    if actuator is not None and left <= poor * gap:
        return replace(found, actuator=actuator)
    return found.with_remarks(
        *found.remarks,
        f'applied_control differs from control by {left / gap:.0%} of the gap (rms), which no lag '
        'explains, and y will follow less well: stay within what the motor can follow')


def _fits(
    commands: Array, v: Array, side: Array, rows: NDArray[np.intp],
) -> Iterator[tuple[float, float, Actuator]]:
    """Yield (BIC, rms of the residual, actuator) for each order and delay that can be fitted."""
    slowest_motor = 0.99  # pole; a motor that is slower does not follow the command
    moved, y = commands - commands[0], v - v[0]
    for order, delay in product((1, 2), range(4)):
        late, unknowns = shifted(moved, delay + 1)[-1], 2 * order + 3
        if len(rows) < 10 * unknowns:
            continue

        def follows(a: Array, taps: int = order + 1, late: Array = late) -> Array:
            # One coefficient more than poles allows for a fraction of a sample of delay.
            return np.vstack([shifted(lfilter([1.0], a, late), taps), -side, -np.ones(len(v))])

        for a, weights in steiglitz_mcbride(y, follows, order, rows, steps=12):
            gain = float(weights[:order + 1].sum() / a.sum())
            if gain <= 0.0 or np.abs(np.roots(a)).max() > slowest_motor:
                continue
            left = (y - weights @ follows(a))[rows]
            squares = max(float(left @ left), float(np.finfo(float).tiny))
            wind_up, offset = weights[order + 1:].tolist()
            offset += gain * float(commands[0]) - float(v[0])
            with suppress(ParameterError):
                # v is reported at the end of its interval, a sample later: one more pole at 0.
                lag = TransferFunction(weights[:order + 1].tolist(),
                                       [*a.tolist(), *[0.0] * (delay + 1)], 'actuator')
                yield len(rows) * log(squares) + unknowns * log(len(rows)), \
                    float(np.sqrt(squares / len(rows))), \
                    Actuator(lag, ((wind_up + offset) / gain, (wind_up - offset) / gain))
