"""What no loop does, however wrong what it is told of the plant: run away, or break a limit."""

from math import inf
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from backlash_ros.core.assembly import (
    build_controller,
    build_plant,
    build_reference,
)
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.protocol import (
    LARGEST_FEEDBACK,
    LARGEST_IN_ACQUISITION,
    ControlInput,
)
from backlash_ros.core.control.tracking.design import Weights, design, feedback_around
from backlash_ros.core.control.tracking.rest import TOLERANCE
from backlash_ros.core.control.tracking.tracking import FADING, Tracking
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction


class Told:
    """An estimator that knows what it is told, and x of no plant."""

    def __init__(self) -> None:
        self.estimate = Estimate(1.0, 1.0, -1.0, 0.1)
        self.adapting, self.u_hat, self.innovation = True, 0.0, 0.0
        self.x_hat: list[float] = [0.0, 0.0]
        self.x_cov: np.ndarray | None = None

    def update(self, y: float | None, interval: Interval) -> None:
        if y is not None:
            self.x_hat = [y, 0.5 * y]

    def refine(self, budget_s: float = inf) -> None:
        """Nothing to do."""


MODEL = StateModel(TransferFunction([0.1, 0.05], [1.0, -1.7, 0.72]))
WEIGHTS = Weights(1e-2, 0.0, 5)
DESIGN = design(MODEL, WEIGHTS)


@settings(max_examples=200)
@given(noise_std=st.sampled_from([0.0, 1e-3]), sequence=st.lists(st.one_of(
    st.tuples(st.just('state'), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    st.tuples(st.just('estimate'), st.floats(0.1, 100.0), st.floats(0.01, 100.0),
              st.floats(-100.0, -0.01), st.sampled_from(Status),
              st.sampled_from([float('nan'), 0.0, 0.1])),
    st.tuples(st.just('renewal'), st.floats(-1e3, 1e3), st.just(False)),
    st.tuples(st.just('redesign'), st.sampled_from([1e-3, 1e-2, 1e-1]), st.just(True)),
), max_size=15))
def test_a_loop_that_nothing_is_asked_of_moves_u_d_no_further_than_its_doubts_allow(
    noise_std: float, sequence: list[tuple[Any, ...]],
) -> None:
    def following(weights: Weights) -> Tracking:
        return Tracking(design(MODEL, weights), weights, 1.0, noise_std)

    weights, source, estimate = WEIGHTS, Told(), Estimate(1.0, 1.0, -1.0, 0.0)
    source.x_cov = 1e-12 * np.eye(2)
    structure, inverse = following(weights), BacklashInverse()
    handed_over = called_for = 0.0
    for what, *values in sequence:
        if what == 'state':
            source.x_hat = values
        elif what == 'estimate':
            m, c_r, c_l, status, std = values
            estimate = Estimate(m, c_r, c_l, 0.0, std, std, std, status)
        else:
            weights = Weights(values[0], 0.0, 5) if what == 'redesign' else weights
            before, structure = structure, following(weights)
            structure.go_on_from(before, state_known=what == 'redesign')
        if what == 'renewal':
            inverse.start_from(values[0])
            beyond = abs(values[0]) + max(estimate.c_r, -estimate.c_l)
            handed_over = estimate.m * beyond
        gain = feedback_around(MODEL, weights, 1.0).gain
        called_for = TOLERANCE * noise_std * float(np.linalg.norm(gain))
        for _ in range(12):
            u_d = structure.control(ControlInput(0.0, 0.0, estimate, source), inverse).u_d
            allowed = LARGEST_IN_ACQUISITION * estimate.m * (estimate.c_r - estimate.c_l)
            known = estimate.status not in (Status.ACQUIRING, Status.INCONSISTENT)
            if known and estimate.learned:
                allowed = LARGEST_FEEDBACK * max(allowed / LARGEST_IN_ACQUISITION, called_for)
            assert abs(u_d) <= (allowed + handed_over) * (1.0 + 1e-9)
            handed_over *= FADING


def test_a_loop_that_was_driven_to_its_bounds_comes_back() -> None:
    # Full feedback between its own bounds would cycle like between those of v.
    p = Parameters({
        'structure': 'tracking', 'amplitude': 0.2, 'estimator.law': 'fixed', 'fixed.doubt': 0.1,
        'estimator.initial.m': 1.3, 'estimator.initial.c_r': 3.0, 'estimator.initial.c_l': -3.0,
    })
    controller, plant, reference = build_controller(p), build_plant(p), build_reference(p)
    y = []
    for k in range(900):
        y.append(plant.measure())
        step = controller.step(-y[-1] if 100 <= k < 160 else y[-1], reference(k * 0.01))
        plant.step(step.v)
    assert max(map(abs, y)) > 10.0
    assert max(map(abs, y[600:])) < 0.25
