"""Fits of the whole record, one after the other, as long as it is short."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.record_search import MISFIT, RecordOptimum, RecordSearch
from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]

LONGEST = 400  # samples of a record that is fitted
MOST_MISFITS = 3  # in a row: the record is not what a fit supposes
PRECISION_OF_GAP, PRECISION_OF_M = 0.2, 0.2  # relative deviations below which a fit is of use
# Share of the time that fits may take, the time of a grid per sample of the record, and the most
# grids per new sample.
SHARE, GRID_STEP_S, MOST_GRIDS = 0.4, 5e-6, 5


class EarlyFits:
    """Starts searches of the record and passes on what is precise enough."""

    def __init__(self, model: TransferFunction, widest: float, sample_period: float) -> None:
        """widest: gap that the bounds allow."""
        self._model, self._widest = model, widest
        self._allowance_s = SHARE * sample_period
        self._search: RecordSearch | None = None
        self._best: RecordOptimum | None = None  # the last that fitted, precise or not
        self.successful = False  # one was precise enough
        self._misfits = 0
        self._credit_s = 0.0

    @property
    def running(self) -> bool:
        """Whether a search is under way."""
        return self._search is not None

    def possible(self, samples: int) -> bool:
        """Whether a record of so many samples may be fitted; never in a loop without the time."""
        # A grid of the longest record in one go must not hold up the next samples.
        affordable = self._allowance_s >= GRID_STEP_S * LONGEST
        return affordable and samples <= LONGEST and self._misfits < MOST_MISFITS

    def give_up(self) -> None:
        """End a search without a result."""
        self._search = None

    def begin(self, y: Array, v: Array, noise_std: float) -> None:
        """Search the record (y, v), as RecordSearch takes them."""
        self._search = RecordSearch(self._model, y, v, noise_std, self._widest, self._best)

    def advance(self, samples: int) -> RecordOptimum | None:
        """Go on by what a new sample allows; return what is found if it is precise enough."""
        search = self._search
        if search is None:
            return None
        grid_s = GRID_STEP_S * samples
        self._credit_s = min(self._credit_s + self._allowance_s, MOST_GRIDS * grid_s)
        while self._credit_s >= grid_s:
            self._credit_s -= grid_s
            if search.advance():
                self._search = None
                return self._judge(search.optimum)
        return None

    def _judge(self, found: RecordOptimum | None) -> RecordOptimum | None:
        if found is None:
            return None
        if found.misfit > MISFIT:
            self._misfits += 1
            return None
        self._misfits, self._best = 0, found
        precise = (
            found.std_gap < PRECISION_OF_GAP * found.gap and found.std_m < PRECISION_OF_M * found.m
        )
        # A deviation beyond the last grid comes from another basin.
        alone = found.gaps[0] < found.gap - found.std_gap and (
            found.gap + found.std_gap < found.gaps[-1]
        )
        if not (precise and alone):
            return None
        self.successful = True
        return found
