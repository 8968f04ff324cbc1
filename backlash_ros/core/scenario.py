"""Builds the surroundings of a controller from checked parameters: G(z), simulated plant, y_m.

Apart from assembly.py, so that the nodes for these start without loading laws and controllers.
"""

import csv
from collections.abc import Callable, Mapping
from math import asin, floor, isfinite, nan, pi, sin
from pathlib import Path

from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.simulated_plant import SimulatedPlant, altered_plant, delayed
from backlash_ros.core.plant.transfer_function import TransferFunction

# Functions of the phase alone, which continue without a jump if the frequency changes.
PERIODIC: Mapping[str, Callable[[float], float]] = {
    'sine': sin,
    'square': lambda phase: 1.0 if phase % (2.0 * pi) < pi else -1.0,
    'triangle': lambda phase: 2.0 / pi * asin(max(-1.0, min(1.0, sin(phase)))),
    # Schroeder phases keep the crest factor low.
    'multisine': lambda phase: sum(
        sin(h * phase - pi * i * (i + 1) / 4) for i, h in enumerate((1, 2, 3, 5))) / 4,
}


def build_model(p: Parameters) -> TransferFunction:
    """Return G(z), with the delay between control and its effect as poles at 0."""
    delay = (0.0,) * p.control.delay_samples
    return TransferFunction(p.plant.numerator, p.plant.denominator + delay)


def build_actuator(p: Parameters) -> Actuator | None:
    """Return the actuator between control and applied_control, or None if there is none."""
    lag = p.actuator.numerator, p.actuator.denominator
    return Actuator(TransferFunction(*lag, 'actuator'), p.actuator.wind_up) if any(lag) else None


def build_true_model(p: Parameters) -> TransferFunction:
    """Return G(z) of the simulated plant, which truth.* may make differ from the known one."""
    truth, plant = p.truth, p.plant
    base = TransferFunction(
        truth.numerator or plant.numerator, truth.denominator or plant.denominator,
        'truth' if truth.numerator or truth.denominator else 'plant')
    altered = altered_plant(
        base, truth.scale_frequency, truth.scale_damping, truth.extra_lag / p.sample_period)
    samples = truth.delay_samples if truth.delay_samples >= 0 else p.control.delay_samples
    return delayed(altered, samples)


def build_plant(p: Parameters) -> SimulatedPlant:
    """Return the simulated plant with its hidden backlash."""
    return SimulatedPlant(p, build_true_model(p), build_actuator(p))


class ReferenceSignal:
    """y_m(t) = bias + amplitude * shape(t), by the parameters of the reference.

    frequency [rad/s]; a step rises after half a period; a chirp sweeps linearly from
    frequency_start to frequency in sweep_time [s], again and again. samples: instead of those of
    the file for waveform: file, one per sample period, the last one held. Raises ParameterError.
    """

    def __init__(self, p: Parameters, samples: tuple[float, ...] = ()) -> None:
        self._p, self.waveform, self.frequency = p, p.waveform, p.frequency
        self._samples = samples or (_samples_of_file(p) if p.waveform == 'file' else ())

    def __call__(self, t: float) -> float:
        """Return y_m at time t >= 0 [s]."""
        return self._p.bias + self._p.amplitude * self._shape(t)

    def _shape(self, t: float) -> float:
        phase = self.frequency * t
        if self.waveform in PERIODIC:
            return PERIODIC[self.waveform](phase)
        if self.waveform == 'step':
            return 1.0 if phase >= pi else 0.0
        if self.waveform == 'chirp':
            within, start = t % self._p.sweep_time, self._p.frequency_start
            slope = (self.frequency - start) / self._p.sweep_time
            return sin(start * within + 0.5 * slope * within * within)
        # Half a period of slack: t = k T in floating point may fall just short of sample k.
        index = floor(t / self._p.sample_period + 0.5)
        return self._samples[min(index, len(self._samples) - 1)]


build_reference = ReferenceSignal


def _samples_of_file(p: Parameters) -> tuple[float, ...]:
    """Read the values of the CSV with header t,y_m and a row per sample period."""
    if not p.file:
        raise ParameterError('file', '', 'must name a CSV with rows t,y_m for waveform: file')
    try:
        with Path(p.file).open(newline='', encoding='utf-8') as file:
            header, *rows = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ParameterError('file', p.file, f'cannot be read: {error}') from None
    if [cell.strip() for cell in header] != ['t', 'y_m']:
        raise ParameterError('file', p.file, 'must begin with the header t,y_m')
    if not rows:
        raise ParameterError('file', p.file, 'must hold at least one sample for waveform: file')
    samples: list[float] = []
    for line, row in enumerate(rows, start=2):
        due = len(samples) * p.sample_period
        try:
            t, y_m = map(float, row)
        except ValueError:
            t = y_m = nan
        # Decimal times in a file are rounded.
        if not (abs(t - due) <= 1e-3 * p.sample_period and isfinite(y_m)):
            raise ParameterError(
                'file', p.file, f'line {line} must hold t={due:.9g} and a finite y_m',
                f'one row per sample_period={p.sample_period!r}')
        samples.append(y_m)
    return tuple(samples)
