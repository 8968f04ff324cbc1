"""How much each reading of a sensor tells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def weights_of(y: Array) -> Array:
    """Weight of each reading: 1 over the length of the run of equal readings it stands in.

    A sensor with a resolution repeats its error with its reading; what repeats tells nothing new.
    """
    changes = np.flatnonzero(y[1:] != y[:-1]) + 1  # nan differs from itself
    ends = np.concatenate([[0], changes, [len(y)]])
    lengths = ends[1:] - ends[:-1]
    return np.repeat(1.0 / lengths, lengths)
