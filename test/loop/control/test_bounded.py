"""What no loop does, however wrong what it is told of the plant: run away, or break a limit."""

from itertools import islice
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
from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import Limits, at_rest, last_commands
from backlash_ros.core.control.pole_placement import PolePlacement
from backlash_ros.core.control.proportional import Proportional
from backlash_ros.core.control.protocol import (
    LARGEST_FEEDBACK,
    LARGEST_IN_ACQUISITION,
    ControlInput,
    Structure,
)
from backlash_ros.core.control.tracking.design import Weights, design, feedback_around
from backlash_ros.core.control.tracking.rest import TOLERANCE
from backlash_ros.core.control.tracking.tracking import FADING, Tracking
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.four_blocks import place_poles
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
BLOCKS = place_poles(MODEL.transfer_function, np.poly([0.5, 0.5]), 0.2)


def structure_named(name: str) -> Structure:
    if name == 'tracking':
        return Tracking(DESIGN, WEIGHTS, 1.0, 1e-3)
    return Proportional() if name == 'proportional' else PolePlacement(BLOCKS)


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


numbers = st.floats(-1e6, 1e6)
events = st.one_of(
    st.tuples(st.just('sample'), numbers, st.floats(-50.0, 50.0), st.integers(0, 3)),
    st.tuples(st.just('estimate'), st.floats(0.01, 100.0), st.floats(0.0, 100.0),
              st.floats(-100.0, 0.0), st.floats(0.0, 2.0), st.sampled_from(Status),
              st.sampled_from([float('nan'), 0.0, 0.1])),
    st.tuples(st.just('limits'), st.floats(-30.0, 20.0), st.floats(0.1, 40.0),
              st.one_of(st.just(inf), st.floats(0.01, 20.0))),
    st.tuples(st.just('compensating'), st.booleans()),
    st.tuples(st.just('take_up'), st.one_of(st.just(inf), st.floats(0.01, 20.0))),
    st.tuples(st.just('renewal'), st.booleans()),
    st.tuples(st.just('end'), st.sampled_from(['hold', 'zero', 'ramp'])),
)


@settings(max_examples=300)
@given(
    name=st.sampled_from(['proportional', 'tracking', 'pole_placement']),
    sequence=st.lists(events, max_size=40),
)
def test_every_command_keeps_the_limits_that_hold_at_that_moment(name, sequence):
    limits, inverse = Limits(), BacklashInverse()
    core = AdaptiveController(Told(), structure_named(name), inverse, limits)
    v = 0.0
    for what, *values in sequence:
        sent: list[float] = []
        if what == 'sample':
            y, y_m, lost = values
            sent = [core.step(y, y_m, lost).v]
            core.refine()
        elif what == 'estimate':
            m, c_r, c_l, f, status, std = values
            core.estimator.estimate = Estimate(m, c_r, c_l, f, std, std, std, status)
        elif what == 'limits':
            low, width, move = values
            limits = core.limits = Limits(low, low + width, move)
        elif what == 'compensating':
            core.compensating = values[0]
        elif what == 'take_up':
            core.inverse.take_up = values[0]
        elif what == 'renewal':
            before = core
            core = AdaptiveController(Told(), structure_named(name), BacklashInverse(), limits)
            if values[0]:
                core.go_on_from(before)
            core.start_from(v)
        else:
            if values[0] == 'ramp' and limits.move == inf:
                continue  # refused when it is configured
            sent = list(islice(last_commands(values[0], at_rest(v), lambda held=limits: held), 5))
            core.start_from(sent[-1] if sent else v)
        for command in sent:
            assert abs(command - v) <= limits.move * (1.0 + 1e-9)
            outside, outside_before = (
                max(limits.low - x, x - limits.high, 0.0) for x in (command, v)
            )
            assert outside <= max(outside_before - limits.move, 0.0) + 1e-9 * (1.0 + abs(v))
            v = command


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
