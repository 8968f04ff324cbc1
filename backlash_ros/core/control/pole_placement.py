"""The four-block structure of Tao and Kokotović, by pole placement, and v = BI(u_d).

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

from dataclasses import dataclass

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
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]


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
    unknown = np.linalg.lstsq(sylvester, right, rcond=None)[0]
    residual = float(np.linalg.norm(sylvester @ unknown - right))
    dc_gain = float(np.sum(b))
    if not residual <= 1e-6 * float(np.linalg.norm(product)) or dc_gain == 0.0:
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
