"""What the figures show, computed; drawing is left to figures.py."""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.assembly import LAWS, law_fits
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.reference.signal import PERIODIC
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.metrics import delayed_reference, delayed_tracking_error_rms
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.cli import BrokenOffError, InputError
from backlash_ros.tools.runs.read_run import run_loop
from backlash_ros.tools.runs.summary import reference_delay

Array = NDArray[np.float64]


class Part(NamedTuple):
    """A stretch of a run with a name for it."""

    name: str
    rows: slice


class ErrorCurves(NamedTuple):
    """Moving RMS of the control error and of the tracking error of a loop, shape (N,) each.

    tracking: None where y is not meant to follow y_m.
    """

    name: str
    t: Array
    control: Array
    tracking: Array | None = None


def control_error(run: RunRecord) -> Array:
    """e = u - u_d (3.4) of each sample, shape (N,); nan where u is unknown."""
    return run.column('u') - run.column('u_d')


def _reference_period(parameters: Parameters | None) -> float | None:
    """Period of y_m [s]; None where it has none or is not known."""
    if parameters is None or parameters.waveform not in PERIODIC:
        return None
    return 2.0 * pi / parameters.frequency


def interesting_parts(run: RunRecord, parameters: Parameters | None) -> tuple[Part, Part]:
    """Start and end of a run: two periods of y_m each, or a tenth of the run."""
    period = _reference_period(parameters)
    samples = round(2.0 * period / run.sample_period) if period else run.samples // 10
    samples = min(max(samples, 2), run.samples)
    return Part('Start', slice(0, samples)), Part('End', slice(run.samples - samples, None))


def moving_rms(values: Array, samples: int) -> Array:
    """RMS of the newest `samples` values at each place, fewer at the start; nan is left out."""
    if values.size == 0:
        return values
    known = np.isfinite(values)
    # Each sum from scratch: a running one would keep the rounding errors of large values long past.
    window = np.ones(samples)
    with np.errstate(over='ignore'):  # of a law that diverges
        squares = np.convolve(np.where(known, values, 0.0) ** 2, window)[:len(values)]
    count = np.convolve(known.astype(np.float64), window)[:len(values)]
    return np.where(count > 0.0, np.sqrt(squares / np.maximum(count, 1.0)), np.nan)


def compared_samples(run: RunRecord) -> int:
    """For how many samples the laws are compared: the run with its lost ones, 10,000 at most."""
    return min(round(float(run.column('t')[-1]) / run.sample_period) + 1, 10_000)


def compare_laws(
    run: RunRecord, parameters: Parameters,
) -> tuple[list[ErrorCurves], float, list[str]]:
    """The run's law beside every other one, simulated with the same parameters (Figure 5).

    Also over how long the RMS is taken [s], a period of y_m, and what kept a law from its curve.
    """
    samples = compared_samples(run)
    window_s = _reference_period(parameters) or 1.0
    window = max(round(window_s / run.sample_period), 1)
    compared = run.column('t') < (samples - 0.5) * run.sample_period
    own, notes = parameters.estimator.law, []
    curves = [ErrorCurves(f'{own} (this run)', run.column('t')[compared],
                          moving_rms(control_error(run)[compared], window))]
    for law in LAWS:
        if law == own or not law_fits(law, parameters.structure):
            continue
        try:
            other = run_loop(build_closed_loop(parameters.replaced({
                'estimator.law': law, 'estimates.load': False,
            })), samples)
        except (ParameterError, InputError, BrokenOffError) as error:
            notes.append(f'{law}: {error}')
        else:
            curves.append(ErrorCurves(
                law, other.column('t'), moving_rms(control_error(other), window)))
    return curves, window_s, notes


def followed_reference(run: RunRecord, parameters: Parameters | None) -> tuple[Array, float, bool]:
    """What y is to follow, shape (N,), how late [s], and whether y comes close enough to it.

    Then both are drawn on one scale.
    """
    delay = reference_delay(parameters)
    error = delayed_tracking_error_rms(run, delay, float(run.column('t')[run.samples // 2]))
    close = error is not None and error < 0.5  # of the RMS of the reference
    return delayed_reference(run, delay), delay * run.sample_period, close


def estimated_loop(run: RunRecord) -> Array:
    """u = B[v] as the last estimates see it, for the v of the run, shape (N,)."""
    m, c_r, c_l = (float(run.column(name)[-1]) for name in ('m', 'c_r', 'c_l'))
    if c_l >= c_r:
        return m * (run.column('v') - c_r)  # no gap left, and then no backlash to simulate
    backlash = Backlash(m, c_r, c_l)
    return np.array([backlash.step(v) for v in run.column('v').tolist()])
