"""Loops: parameters of config/geared_motor.yaml, its load at other rates, given references."""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from math import pi
from typing import Any

import numpy as np
from reporting import ROOT, Array
from scipy.signal import cont2discrete, lfilter

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.scenario import ReferenceSignal
from backlash_ros.core.simulation.closed_loop import ClosedLoop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.config import read_configuration


@lru_cache
def motor() -> dict[str, Any]:
    """Parameters of config/geared_motor.yaml and its simulated plant."""
    return read_configuration(ROOT / 'config' / 'geared_motor.yaml').given()


def random_backlash(seed: int) -> dict[str, float]:
    """A slope, and a gap that is split at random between c_r and -c_l."""
    rng = np.random.default_rng([seed, 12])
    gap, share = rng.uniform(0.2, 2.0), rng.uniform(0.2, 0.8)
    return {'backlash.m': float(rng.uniform(0.06, 0.15)), 'backlash.c_r': float(gap * share),
            'backlash.c_l': float(gap * (share - 1.0))}


def load_model(period_s: float) -> tuple[list[float], list[float]]:
    """Numerator, without the delay of one sample, and denominator of its load at a period."""
    corner, damping = 2.0 * pi * 20.0, 0.5
    b, a, _ = cont2discrete(([corner**2], [1.0, 2.0 * damping * corner, corner**2]), period_s)
    return b[0, 1:].tolist(), a.tolist()


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
