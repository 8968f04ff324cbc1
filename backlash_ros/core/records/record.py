"""Record: v and y on one uniform grid, and what an identification needs to know of their origin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from backlash_ros.core.plant.transfer_function import Array


class RecordError(ValueError):
    """A record cannot be understood: one line says what is wrong, where, and the cure."""


def seconds(time_s: float) -> str:
    """A time [s] as text, in ms or s."""
    return f'{time_s * 1e3:.4g} ms' if time_s < 0.1 else f'{time_s:.4g} s'


def counted(number: int, of: str) -> str:
    """A number with its noun as text, in the plural unless it is 1."""
    return f'{number} {of}{"" if number == 1 else "s"}'


@dataclass(frozen=True)
class Record:
    """One motion on a uniform grid of sample_period [s], N samples.

    v (N,): acts from sample k to k+1, finite. y (N,): read at k, nan where k has no reading of its
    own. quantum: quantization step of y before it was moved onto the grid, 0 if none. commands
    (N,): what the motor was told, if v is from its encoder. timing: one sentence on what was done
    to the stamps. notes: what else was done, a sentence each. source: where the record is from.
    """

    v: Array
    y: Array
    sample_period: float
    quantum: float = 0.0
    source: str = ''
    timing: str = ''
    notes: tuple[str, ...] = ()
    commands: Array | None = None

    @property
    def lost(self) -> int:
        return int(np.isnan(self.y).sum())

    def between(self, from_s: float, to_s: float) -> Record:
        """The samples from from_s up to, not including, to_s [s]; RecordError if there are none."""
        t = self.sample_period * np.arange(len(self.v))
        slack = 1e-6 * self.sample_period  # of rounding
        kept = (t >= from_s - slack) & (t < to_s - slack)
        if not kept.any():
            raise RecordError('there is no sample between --from and --to')
        commands = None if self.commands is None else self.commands[kept]
        return replace(self, v=self.v[kept], y=self.y[kept], commands=commands)
