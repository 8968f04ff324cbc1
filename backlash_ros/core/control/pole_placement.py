"""The four-block structure of Tao and Kokotović: u_d from filtered u_d, y and r, v = BI(u_d).

The filters, the gains and what they make of the loop stand in numerics.py.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.protocol import (
    LARGEST_FEEDBACK,
    LARGEST_IN_ACQUISITION,
    Command,
    ControlInput,
    ControlStructure,
)
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.plant.numerics import FourBlocks

Array = NDArray[np.float64]


class PolePlacement(ControlStructure):
    """u_d from the four blocks, v = BI(u_d). The gains stay those of the nominal G.

    delay: what B/A_m delays a slow reference by, rounded to samples.
    """

    def __init__(self, blocks: FourBlocks) -> None:
        self._blocks = blocks
        size = len(blocks.filter) - 1
        self._companion = np.eye(size, k=-1)
        self._companion[:1] = -blocks.filter[1:]
        self._w_1: Array = np.zeros(size)
        self._w_2: Array = np.zeros(size)
        # r and what it asks for, newest first.
        self._r: Array = np.zeros(len(blocks.demand[0]))
        self._asked: Array = np.zeros(len(blocks.demand[1]) - 1)
        self._largest_asked = 0.0  # largest of it so far
        b, a = blocks.reference.numerator, blocks.reference.denominator
        self.delay = round(float(  # the group delay at z = 1
            np.polyval(np.polyder(a), 1.0) / a.sum() - np.polyval(np.polyder(b), 1.0) / b.sum()
        ))

    def go_on_from(self, other: ControlStructure, state_known: bool = True) -> None:
        """Take over what the filters hold."""
        if isinstance(other, PolePlacement) and len(other._w_1) == len(self._w_1):
            self._w_1, self._w_2 = other._w_1, other._w_2
            self._r, self._asked, self._largest_asked = other._r, other._asked, other._largest_asked

    def control(self, inputs: ControlInput, inverse: BacklashInverse) -> Command:
        """Return u_d and v = BI(u_d)."""
        blocks, estimate = self._blocks, inputs.estimate
        u_d = float(blocks.theta_1 @ self._w_1 + blocks.theta_2 @ self._w_2)
        u_d += blocks.theta_20 * inputs.y + blocks.theta_3 * inputs.y_m
        u_d = self._bounded(u_d, inputs.y_m, estimate)
        v = inverse.step(u_d, estimate.m, estimate.c_r, estimate.c_l)
        self._w_1 = self._companion @ self._w_1
        self._w_2 = self._companion @ self._w_2
        self._w_1[:1] += u_d
        self._w_2[:1] += inputs.y
        return Command(u_d, v, 0.0)

    def _bounded(self, u_d: float, r: float, estimate: Estimate) -> float:
        """u_d, no further than feedback may go from what r asks for without disturbances."""
        numerator, denominator = self._blocks.demand
        self._r = np.append(r, self._r[:-1])
        asked = float(numerator @ self._r - denominator[1:] @ self._asked)
        self._asked = np.append(asked, self._asked)[:-1]
        self._largest_asked = max(self._largest_asked, abs(asked))
        share = LARGEST_FEEDBACK if estimate.status is Status.TRACKING else LARGEST_IN_ACQUISITION
        reach = share * max(self._largest_asked, estimate.m * (estimate.c_r - estimate.c_l))
        return min(max(u_d, asked - reach), asked + reach)
