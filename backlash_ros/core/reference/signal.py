"""Reference signals y_m(t)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import asin, floor, pi, sin

from backlash_ros.core.parameters.errors import ParameterError

# Crest-friendly multisine: harmonics of the base frequency with Schroeder's phases.
MULTISINE_HARMONICS = (1, 2, 3, 5)
MULTISINE_TERMS = tuple(
    (h, pi * i * (i + 1) / len(MULTISINE_HARMONICS)) for i, h in enumerate(MULTISINE_HARMONICS)
)
# Shapes of the phase alone, which go on where they are if the frequency changes.
PERIODIC = ('sine', 'square', 'triangle', 'multisine')


@dataclass(frozen=True)
class ReferenceSignal:
    """y_m(t) = bias + amplitude * shape(t).

    waveform: sine, step, square, triangle, multisine, chirp or file. frequency [rad/s]; a step
    rises after half a period. chirp: from frequency_start to frequency within sweep_time [s],
    linear, and again. samples: the values for `file`, one per sample period, the last one held.
    """

    waveform: str = 'sine'
    amplitude: float = 1.0
    frequency: float = 1.0
    bias: float = 0.0
    frequency_start: float = 0.63
    sweep_time: float = 10.0
    sample_period: float = 0.01
    samples: tuple[float, ...] = field(default=())

    def __post_init__(self) -> None:
        if self.waveform not in SHAPES:
            raise ParameterError('waveform', self.waveform, 'must be one of ' + ', '.join(SHAPES))
        if self.waveform == 'file' and not self.samples:
            raise ParameterError('file', '', 'must hold at least one sample for waveform: file')

    def __call__(self, t: float) -> float:
        """y_m at time t >= 0 [s]."""
        return self.bias + self.amplitude * SHAPES[self.waveform](self, t)


def _sine(r: ReferenceSignal, t: float) -> float:
    return sin(r.frequency * t)


def _step(r: ReferenceSignal, t: float) -> float:
    return 1.0 if r.frequency * t >= pi else 0.0


def _square(r: ReferenceSignal, t: float) -> float:
    return 1.0 if (r.frequency * t) % (2.0 * pi) < pi else -1.0


def _triangle(r: ReferenceSignal, t: float) -> float:
    return 2.0 / pi * asin(max(-1.0, min(1.0, sin(r.frequency * t))))


def _multisine(r: ReferenceSignal, t: float) -> float:
    total = 0.0
    for harmonic, phase in MULTISINE_TERMS:
        total += sin(harmonic * r.frequency * t - phase)
    return total / len(MULTISINE_TERMS)


def _chirp(r: ReferenceSignal, t: float) -> float:
    within = t % r.sweep_time
    slope = (r.frequency - r.frequency_start) / r.sweep_time
    return sin(r.frequency_start * within + 0.5 * slope * within * within)


def _file(r: ReferenceSignal, t: float) -> float:
    # Half a period of slack: t = k T in floating point may fall just short of sample k.
    index = floor(t / r.sample_period + 0.5)
    return r.samples[min(index, len(r.samples) - 1)]


SHAPES: dict[str, Callable[[ReferenceSignal, float], float]] = {
    'sine': _sine, 'step': _step, 'square': _square, 'triangle': _triangle,
    'multisine': _multisine, 'chirp': _chirp, 'file': _file,
}
