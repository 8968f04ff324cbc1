"""A controller that takes over from another one, as after a silence of the driver."""

from collections.abc import Iterator, Sequence
from copy import deepcopy

import numpy as np
import pytest
from numpy.typing import NDArray

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import ClosedLoop, build_closed_loop

AT = range(250, 292, 3)  # all phases of the reference
STRUCTURES = {
    'proportional': {}, 'tracking': {'amplitude': 0.2}, 'pole_placement': {'amplitude': 0.2},
}


def renewed(p: Parameters, at: Sequence[int], samples: int) -> Iterator[NDArray[np.float64]]:
    """v of one loop in which the controller is replaced at a sample, and of some samples after it.

    The new one inherits the estimates. There is one answer for each of these places; what comes
    before them is simulated once.
    """
    loop = build_closed_loop(p)
    v: list[float] = []
    for k in at:
        followed(loop, v, k)
        again, v_again = deepcopy(loop), v.copy()
        before = again.controller
        again.controller = build_controller(p, before.estimator.estimate)
        again.controller.go_on_from(before)
        followed(again, v_again, k + samples)
        yield np.array(v_again)


def followed(loop: ClosedLoop, v: list[float], until: int) -> None:
    """Append what the loop commands up to this sample."""
    for k in range(len(v), until):
        step = loop.controller.step(loop.plant.measure(), loop.reference(k * loop.sample_period))
        loop.controller.refine()
        loop.plant.step(step.v)
        v.append(step.v)


@pytest.mark.parametrize('name', STRUCTURES)
def test_v_goes_on_without_a_jump(name: str) -> None:
    p = Parameters({'structure': name, 'output_noise_std': 1e-3, **STRUCTURES[name]})
    for at, v in zip(AT, renewed(p, AT, 20), strict=True):
        moves = np.abs(np.diff(v))
        usual = moves[at - 101:at - 1].max()
        # While x_hat settles feedback moves v more than usual, but far from what a start does.
        assert moves[at - 1:].max() <= (1.01 if name == 'proportional' else 2.5) * usual, at


def test_proportional_loop_that_knows_the_backlash_does_not_notice() -> None:
    p = Parameters({'estimator.law': 'fixed', 'inverse.take_up_rate': 100.0})
    unchanged: list[float] = []
    followed(build_closed_loop(p), unchanged, AT[-1] + 50)
    for v in renewed(p, AT, 50):
        assert v == pytest.approx(np.array(unchanged[:len(v)]))
