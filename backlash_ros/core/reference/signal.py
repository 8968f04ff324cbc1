"""Reference signals y_m(t)."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, floor, pi, sin

from backlash_ros.core.parameters.errors import ParameterError

# Shapes of the phase alone, which go on where they are if the frequency changes.
PERIODIC = ('sine', 'square', 'triangle', 'multisine')
SHAPES = (*PERIODIC, 'step', 'chirp', 'file')


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
    samples: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.waveform not in SHAPES:
            raise ParameterError('waveform', self.waveform, 'must be one of ' + ', '.join(SHAPES))
        if self.waveform == 'file' and not self.samples:
            raise ParameterError('file', '', 'must hold at least one sample for waveform: file')

    def __call__(self, t: float) -> float:
        """y_m at time t >= 0 [s]."""
        return self.bias + self.amplitude * self._shape(t)

    def _shape(self, t: float) -> float:
        phase = self.frequency * t
        if self.waveform == 'sine':
            return sin(phase)
        if self.waveform == 'step':
            return 1.0 if phase >= pi else 0.0
        if self.waveform == 'square':
            return 1.0 if phase % (2.0 * pi) < pi else -1.0
        if self.waveform == 'triangle':
            return 2.0 / pi * asin(max(-1.0, min(1.0, sin(phase))))
        if self.waveform == 'multisine':
            # Schroeder's phases keep the crest low.
            harmonics = enumerate((1, 2, 3, 5))
            return sum(
                sin(h * self.frequency * t - pi * i * (i + 1) / 4) for i, h in harmonics
            ) / 4
        if self.waveform == 'chirp':
            within = t % self.sweep_time
            slope = (self.frequency - self.frequency_start) / self.sweep_time
            return sin(self.frequency_start * within + 0.5 * slope * within * within)
        # Half a period of slack: t = k T in floating point may fall just short of sample k.
        index = floor(t / self.sample_period + 0.5)
        return self.samples[min(index, len(self.samples) - 1)]
