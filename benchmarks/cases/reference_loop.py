"""Closed loops on a reference that is given sample by sample, and y before the sensor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.reference.signal import ReferenceSignal
from backlash_ros.core.simulation.closed_loop import ClosedLoop
from backlash_ros.core.simulation.run_record import RunRecord

Array = NDArray[np.float64]

NINE_DIGITS = '.9g'  # what a file of a reference holds


def loop_on(values: Mapping[str, object], y_m: Iterable[float], digits: str = '') -> ClosedLoop:
    """The loop; `amplitude` and `bias` count as for waveform: file. digits: format of y_m."""
    loop = build_closed_loop(Parameters(values))
    of_file = Parameters({**values, 'waveform': 'file'})
    loop.reference = ReferenceSignal(of_file, tuple(float(format(y, digits)) for y in y_m))
    return loop


def without_sensor(p: Parameters, run: RunRecord) -> Array:
    """y before noise, rounding and delay of the sensor, shape (N,)."""
    b, a = np.array(p.plant.numerator), np.array(p.plant.denominator)
    return np.asarray(lfilter(np.append(np.zeros(len(a) - len(b)), b), a, run.column('u')))
