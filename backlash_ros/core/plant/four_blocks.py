"""Gains of the four-block structure of Tao and Kokotović, from pole placement.

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

from backlash_ros.core.parameters import ParameterError
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
