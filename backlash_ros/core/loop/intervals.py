"""Which v acted from each sample to the next, told from the stamps of messages."""

from __future__ import annotations

from math import inf, nan

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]  # [ns], of one clock

REPORTED = 0.9  # share of the samples that reports have to tell of to be believed


def v_of_intervals(
    index: NDArray[np.int64], output_ns: Stamps, command_ns: Stamps, v: Array, reported: bool,
) -> Array:
    """v over the interval after each sample, shape (N,), N = index[-1] + 1; nan before any v.

    index: number of each sample whose y was heard, rising from 0. output_ns: stamps of these y.
    command_ns, v (M,): messages of v in the order of time. reported: whether they are reports of
    the v that acted, one just before each y; else commands, of which the newest acts that is there
    when the interval ends with the next y.
    """
    begin = output_ns[0]
    outputs, commands = (output_ns - begin).astype(float), (command_ns - begin).astype(float)
    ends = np.interp(np.arange(1, index[-1] + 2), index, outputs)
    ends[-1] = inf
    acted: Array = np.append(v, nan)[np.searchsorted(commands, ends, side='right') - 1]
    if reported:
        until = np.searchsorted(commands, outputs, side='right')
        intervals, reports = np.diff(index), np.diff(until)
        # One each: in their order, since those of a driver that was held up come in a heap. One
        # alone: nothing was sampled in between, and its v was in use all the time.
        for i in np.flatnonzero((intervals > 1) & ((reports == intervals) | (reports == 1))):
            acted[index[i]:index[i + 1]] = v[until[i]:until[i + 1]]
    return acted
