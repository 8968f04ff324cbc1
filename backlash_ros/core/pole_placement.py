"""The four-block structure of Tao and Kokotović, with gains from pole placement.

    u_d = theta_1' w_1 + theta_2' w_2 + theta_20 y + theta_3 r
    w_1 = a(z)/Lambda(z) u_d,   w_2 = a(z)/Lambda(z) y,   a = (z^(n-2), ..., z, 1)'

With G = B/A, S = Lambda - theta_1' a and R = theta_2' a + theta_20 Lambda the loop is
S u_d = R y + theta_3 Lambda r. The gains solve the Diophantine equation

    A S - B R = Lambda A_m

so that y = theta_3 B/A_m r + W (u - u_d) with W = B S/(Lambda A_m). No zero of G is cancelled,
as a zero outside the unit circle would not allow it.

Reference: G. Tao, P. V. Kokotović, Adaptive Control of Systems with Actuator and Sensor
Nonlinearities, Wiley 1996.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from backlash_ros.core.errors import ParameterError
from backlash_ros.core.estimation.protocol import Estimate, Status
from backlash_ros.core.inverse import BacklashInverse
from backlash_ros.core.state_model import StateModel
from backlash_ros.core.structure import (
    LARGEST_CAREFUL,
    LARGEST_FEEDBACK,
    Adoption,
    Command,
    Situation,
    Structure,
)
from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]

WORST_RESIDUAL = 1e-6  # of the Diophantine equation, relative to its right side


@dataclass(frozen=True)
class FourBlocks:
    """Gains theta_1 (n-1,), theta_2 (n-1,), theta_20, theta_3 and what they make of the loop.

    filter: Lambda, shape (n,). reference: theta_3 B/A_m from r to y. disturbance: W from u - u_d
    to y. returned: B R/(Lambda A_m), so that y + returned y = W u whatever makes u. demand:
    theta_3 A/A_m from r to u_d, coefficients of numerator and denominator.
    """

    theta_1: Array
    theta_2: Array
    theta_20: float
    theta_3: float
    filter: Array
    reference: TransferFunction
    disturbance: TransferFunction
    returned: TransferFunction
    demand: tuple[Array, Array]


def place_poles(model: TransferFunction, closed: Array, filter_pole: float) -> FourBlocks:
    """Gains for A_m = closed, shape (n + 1,) and monic, and Lambda = (z - filter_pole)^(n-1).

    theta_3 gives unit gain at z = 1. Raises ParameterError where numerator and denominator of G
    have a common factor or nearly so, or G has a zero at z = 1.
    """
    n, a, b = model.order, model.denominator, model.numerator[1:]
    placed = np.atleast_1d(np.poly(np.full(n - 1, filter_pole)))
    # Sylvester matrix: columns are A and -B shifted by the unknown coefficients of S and R.
    sylvester = np.zeros((2 * n - 1, 2 * n - 1))
    for i in range(n - 1):
        sylvester[i:i + n + 1, i] = a[:2 * n - 1 - i]
    for i in range(n):
        sylvester[i:i + n, n - 1 + i] = -b
    product = np.convolve(placed, closed)
    known = np.convolve(a, np.eye(1, n)[0])  # S is monic: A z^(n-1) is on the left already
    right = (product - known)[1:]
    unknown = linalg.lstsq(sylvester, right)[0]
    residual = float(np.linalg.norm(sylvester @ unknown - right))
    dc_gain = float(np.sum(b))
    if not residual <= WORST_RESIDUAL * float(np.linalg.norm(product)) or dc_gain == 0.0:
        raise ParameterError(
            'structure', 'pole_placement', 'cannot place the poles of this G(z)',
            'cancel its common factors or take structure: tracking',
        )
    s, r = np.concatenate([[1.0], unknown[:n - 1]]), unknown[n - 1:]
    theta_3 = float(np.sum(closed)) / dc_gain
    return FourBlocks(
        (placed - s)[1:], (r - r[0] * placed)[1:], float(r[0]), theta_3, placed,
        TransferFunction((theta_3 * b).tolist(), closed.tolist()),
        TransferFunction(np.convolve(b, s).tolist(), product.tolist()),
        TransferFunction(np.convolve(b, r).tolist(), product.tolist()), (theta_3 * a, closed),
    )


class PolePlacement:
    """u_d from the four blocks, v = BI(u_d).

    delay: what B/A_m delays a slow reference by, rounded to samples.
    """

    needs_output = True

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
        self._reach = 0.0  # largest of it so far
        self.delay = round(_delay_of(blocks.reference))

    @property
    def may_change(self) -> bool:
        """Nothing here changes with G."""
        return True

    def design(self, model: StateModel) -> Iterator[Adoption | None]:
        """The gains stay those of the G that was told."""
        return iter(())

    def go_on_from(self, other: Structure, state_known: bool = True) -> None:
        """Take over what the filters hold."""
        if isinstance(other, PolePlacement) and len(other._w_1) == len(self._w_1):
            self._w_1, self._w_2 = other._w_1, other._w_2
            self._r, self._asked, self._reach = other._r, other._asked, other._reach

    def control(self, situation: Situation, inverse: BacklashInverse) -> Command:
        """Return u_d and v = BI(u_d)."""
        blocks, estimate = self._blocks, situation.estimate
        u_d = float(blocks.theta_1 @ self._w_1 + blocks.theta_2 @ self._w_2)
        u_d += blocks.theta_20 * situation.y + blocks.theta_3 * situation.y_m
        u_d = self._bounded(u_d, situation.y_m, estimate)
        v = inverse.step(u_d, estimate.m, estimate.c_r, estimate.c_l)
        self._w_1 = self._companion @ self._w_1
        self._w_2 = self._companion @ self._w_2
        self._w_1[:1] += u_d
        self._w_2[:1] += situation.y
        return Command(u_d, v, 0.0)

    def _bounded(self, u_d: float, r: float, estimate: Estimate) -> float:
        """u_d, no further than feedback may go from what r asks for without disturbances."""
        numerator, denominator = self._blocks.demand
        self._r[1:] = self._r[:-1]
        self._r[0] = r
        asked = float(numerator @ self._r - denominator[1:] @ self._asked)
        self._asked[1:] = self._asked[:-1]
        self._asked[0] = asked
        self._reach = max(self._reach, abs(asked))
        reach = max(self._reach, estimate.m * (estimate.c_r - estimate.c_l))
        share = LARGEST_FEEDBACK if estimate.status is Status.TRACKING else LARGEST_CAREFUL
        return min(max(u_d, asked - share * reach), asked + share * reach)


def _delay_of(model: TransferFunction) -> float:
    """Group delay at z = 1 in samples."""
    a, b = model.denominator, model.numerator
    return float(
        np.polyval(np.polyder(a), 1.0) / np.sum(a) - np.polyval(np.polyder(b), 1.0) / np.sum(b)
    )
