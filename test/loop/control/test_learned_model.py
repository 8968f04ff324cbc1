"""A better model of G in a loop: what is believed, who designs for it, when it is used, and how."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from records import resonance

from backlash_ros.core import Estimate, Parameters, build_closed_loop
from backlash_ros.core.assembly import build_model, build_true_model
from backlash_ros.core.control.controller import LONGEST_WAIT, AdaptiveController
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.control.structure import ControlStructure
from backlash_ros.core.control.tracking import design as designs
from backlash_ros.core.control.tracking.tracking import Tracking
from backlash_ros.core.law import Interval, Law, LawReport
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.parameters.table import TrackingWeights
from backlash_ros.core.plant.simulated_plant import SimulatedPlant, delayed
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction
from backlash_ros.core.simulation import run_record
from backlash_ros.core.simulation.closed_loop import ClosedLoop

MOTOR = Parameters({
    'sample_period': 0.005, 'plant.numerator': [0.1513, 0.1325],
    'plant.denominator': [1.0, -1.3834, 0.6672], 'plant.uncertainty': 0.2,
    'backlash.m': 1.3, 'backlash.c_r': 0.6, 'backlash.c_l': -0.4,
    'waveform': 'multisine', 'amplitude': 3.0, 'frequency': 4.0, 'output_noise_std': 1e-3,
    'estimator.output_noise_std': 1e-3,
})


def report(loop: ClosedLoop) -> LawReport:
    return loop.controller.estimator.report


@given(
    st.lists(st.floats(0.1, 1.0), min_size=1, max_size=4), st.floats(-0.9, 0.9),
    st.integers(0, 3), st.integers(0, 3),
)
def test_a_model_without_its_delay_is_the_same_with_it(taps, pole, delay, more):
    denominator = [1.0, -pole, *[0.0] * (delay + len(taps))]
    model = TransferFunction(taps, denominator[:max(len(taps) + 1, len(denominator) - more)])
    numerator, rest, samples = model.without_delay()
    z = np.exp(1j * np.array([0.1, 1.0, 3.0]))
    # What is left is a G(z) that one may be told: it takes a sample at least.
    again = TransferFunction(numerator, rest)
    assert z**-samples * again.response(z) == pytest.approx(model.response(z), rel=1e-9)
    assert again.delay == 1 or again.denominator[-1] != 0.0


def test_what_was_learned_is_as_sure_as_it_says() -> None:
    p = MOTOR.replaced({'truth.scale_frequency': 1.1, 'output_noise_std': 2e-3})
    found = build_closed_loop(p).run(1200).learned
    assert found['denominator'] != p.plant.denominator
    z = np.exp(2j * np.pi * np.array(run_record.FREQUENCIES))
    gain = [build_true_model(p).response(np.ones(1, complex)), build_model(p).response(
        np.ones(1, complex))]
    response = TransferFunction(found['numerator'], found['denominator']).response(z) \
        * z**-found['delay_samples'][0]
    off = np.abs(build_true_model(p).response(z) / gain[0] * gain[1] / response - 1.0)
    std = [values[0] for label, values in found.items() if label.startswith('response_std')]
    assert len(std) == len(z)
    assert np.all(off <= 3.0 * np.array(std))
    assert found['noise_ratio'][0] == pytest.approx(2.0, rel=0.1)
    assert 0.0 <= found['unexplained'][0] < 0.05


def test_wrong_sign_is_told_until_there_is_an_estimate() -> None:
    turned = {
        'truth.numerator': [-b for b in MOTOR.plant.numerator],
        'truth.denominator': list(MOTOR.plant.denominator)}
    loop = build_closed_loop(MOTOR.replaced(turned))
    assert not report(loop).wrong_sign
    loop.run(400)
    assert report(loop).wrong_sign
    measure = loop.plant.measure
    loop.plant.measure = lambda: -measure()  # type: ignore[method-assign]
    loop.run(800)
    assert loop.controller.estimator.estimate.learned
    assert not report(loop).wrong_sign


Array = NDArray[np.float64]

PERIOD, NOISE = 0.005, 1e-4
WEIGHTS = TrackingWeights(60, 1e-2, 0.0)
TRUTH = Estimate(0.098, 0.55, -0.35, 0.0)


def motor(scale: float = 1.0, damping: float = 0.5, delay: int = 0) -> TransferFunction:
    return delayed(resonance(20.0 * scale, damping), delay)


class Learner(Law):
    """Knows the backlash, and at some time the true G; x_hat is always that of one model."""

    def __init__(self, told: StateModel, better: StateModel, after: int, doubt: float) -> None:
        self._observers = {m: FixedBacklash(TRUTH, m, NOISE, doubt) for m in (told, better)}
        self._better, self._after = better, after
        self.model, self.adapting = told, True
        self.estimate = self._observers[told].estimate
        self.samples, self.adopted_at = 0, -1

    @property
    def proposal(self) -> StateModel | None:
        return self._better if self.samples >= self._after else None

    def adopt(self, model: StateModel) -> None:
        self.model, self.adopted_at = model, self.samples

    @property
    def x_hat(self) -> list[float]:
        return self._observers[self.model].x_hat

    @property
    def x_cov(self) -> Array:
        return self._observers[self.model].x_cov

    def update(self, y: float | None, interval: Interval) -> None:
        self.samples += 1
        for observer in self._observers.values():
            observer.update(y, interval)


@dataclass
class Run:
    """A run of the loop: y_m, y without noise, v."""

    y_m: Array
    y: Array
    v: Array
    learner: Learner
    structure: ControlStructure

    def error(self, since: int) -> float:
        delay = self.structure.delay
        late = self.y[since:] - self.y_m[since - delay:len(self.y_m) - delay]
        return float(np.sqrt(np.mean(late**2)))


def multisine(k: int) -> float:
    t = k * PERIOD
    return min(k / 100.0, 1.0) * 0.5 * sum(np.sin(2.0 * pi * f * t + f) for f in (0.5, 1.3, 2.1))


def run(
    told: TransferFunction, true: TransferFunction, after: int, samples: int = 1600,
    reference: Callable[[int], float] = multisine,
) -> Run:
    model, better = StateModel(told), StateModel(true)
    learner = Learner(model, better, after, 0.1)
    structure = Tracking(designs.design(model, WEIGHTS), WEIGHTS, 1.0, NOISE)
    controller = AdaptiveController(learner, structure, BacklashInverse(), Limits(), redesign=True)
    rng = np.random.default_rng(1)
    plant = SimulatedPlant(Parameters({
        'backlash.m': TRUTH.m, 'backlash.c_r': TRUTH.c_r, 'backlash.c_l': TRUTH.c_l,
        'sample_period': PERIOD,
    }), true)
    rows = []
    for k in range(samples):
        y_m, y = reference(k), plant.measure()
        step = controller.step(y + NOISE * float(rng.standard_normal()), y_m)
        controller.refine()
        rows.append((y_m, y, step.v))
        plant.step(step.v)
    y_m_row, y, v = np.array(rows).T
    return Run(y_m_row, y, v, learner, structure)


TRUE = {
    'faster': motor(1.2), 'slower': motor(0.8), 'damped': motor(damping=0.8),
    'late': motor(delay=1), 'far off': motor(0.5),
}


@pytest.mark.parametrize('name', TRUE)
def test_after_the_swap_y_follows_as_if_the_true_model_had_been_told(name: str) -> None:
    ideal = run(TRUE[name], TRUE[name], 10_000)
    swapped = run(motor(), TRUE[name], 600)
    assert 600 <= swapped.learner.adopted_at <= 600 + LONGEST_WAIT + 1
    assert swapped.error(900) <= 1.03 * ideal.error(900)
    assert swapped.structure.delay == ideal.structure.delay


@pytest.mark.parametrize('reference', [multisine, lambda k: multisine(min(k, 560))])
@pytest.mark.parametrize('name', [name for name in TRUE if name != 'late'])
@pytest.mark.parametrize('after', [601, 712])
def test_no_move_at_a_swap_is_larger_than_the_largest_of_the_second_before(name, after, reference):
    swapped = run(motor(), TRUE[name], after, 900, reference)
    moves = np.abs(np.diff(swapped.v))
    at = swapped.learner.adopted_at
    assert after <= at <= after + LONGEST_WAIT + 1
    # Where the reference stops short, the true model asks for a larger move than any before.
    asked = np.abs(np.diff(run(TRUE[name], TRUE[name], 10_000, 900, reference).v))[at:at + 40]
    assert moves[at:at + 40].max() <= max(moves[at - 200:at].max(), 1.02 * asked.max())


def test_a_loop_that_the_told_model_makes_unstable_is_rescued() -> None:
    swapped = run(motor(), TRUE['late'], 300, 1200)
    assert np.abs(swapped.v[200:300]).max() > 100.0
    assert np.abs(swapped.v[1000:]).max() < 20.0


def redesigned(
    told: TransferFunction, better: TransferFunction, weights: TrackingWeights,
) -> designs.TrackingDesign | None:
    present = designs.design(StateModel(told), weights)
    return designs.better_design(StateModel(better), weights, present)


def test_feedback_softens_until_the_loop_is_as_safe_as_the_one_it_replaces() -> None:
    safe = redesigned(motor(), motor(0.5), WEIGHTS)
    assert safe.feedback.state == pytest.approx(safe.plans[0].gains.state)
    # Around a motor a quarter as fast the gains would keep less than is safe.
    weights = TrackingWeights(60, 0.1, 0.0)
    present = designs.design(StateModel(motor()), weights)
    softer = redesigned(motor(), motor(0.25), weights)
    nominal = designs.design(softer.model, weights)
    needed = min(0.5, *(designs.modulus_margin(plant, present.model, present.feedback)
                        for plant in (present.model, softer.model)))
    assert designs.modulus_margin(softer.model, softer.model, nominal.feedback) < needed
    assert designs.modulus_margin(softer.model, softer.model, softer.feedback) >= needed
    assert softer.plans[0].gains.preview == pytest.approx(nominal.plans[0].gains.preview)


def test_a_model_without_gains_is_refused() -> None:
    # The zero cancels the pole at 1.2, which no feedback can move then.
    unmoved = TransferFunction([1.0, -1.2], [1.0, -1.7, 0.6])
    assert redesigned(motor(), unmoved, WEIGHTS) is None
