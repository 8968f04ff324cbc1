"""How much each reading of a sensor tells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def weights_of(y: Array) -> Array:
    """Weight of each reading: 1 over the length of the run of equal readings it stands in.

    A sensor with a resolution repeats its error with its reading; what repeats tells nothing new.
    """
    changes = np.flatnonzero(np.diff(y) != 0.0) + 1  # nan differs from itself
    lengths = np.diff(np.concatenate([[0], changes, [len(y)]]))
    return np.repeat(1.0 / lengths, lengths)
