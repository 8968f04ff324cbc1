"""Builds the objects of the core from checked parameters: the only module that knows both."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from backlash_ros.core.control.controller import DOUBT, AdaptiveController, SerialPlant
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import Limits, check_last_commands
from backlash_ros.core.control.structure import ControlStructure, PolePlacement, Proportional
from backlash_ros.core.control.tracking.design import better_design, design, feedback_around
from backlash_ros.core.control.tracking.tracking import Tracking
from backlash_ros.core.estimate import Estimate, load_estimate
from backlash_ros.core.estimation.estimator import MovingHorizon, fitted
from backlash_ros.core.jobs import Executor
from backlash_ros.core.law import Law
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.laws.gradient import GradientEstimator
from backlash_ros.core.laws.input_reconstruction import InputReconstruction
from backlash_ros.core.laws.lms_and_printed import NormalisedLms, PrintedLaw
from backlash_ros.core.parameters import BY_NAME, Bounds, ParameterError, Parameters
from backlash_ros.core.plant.numerics import FourBlocks, place_poles
from backlash_ros.core.plant.transfer_function import (
    StateModel,
    TransferFunction,
    check_model,
    model_warnings,
)
from backlash_ros.core.scenario import (
    build_actuator,
    build_model,
    build_plant,
    build_reference,
    build_true_model,
)

__all__ = ['build_model', 'build_plant', 'build_reference', 'build_true_model']  # and its own

# Modules that a worker process needs for fits and gains.
WORKER_MODULES = (fitted.__module__, better_design.__module__)
LAWS = tuple(dict.fromkeys(BY_NAME['estimator.law'].choices.values()))
STRUCTURES = tuple(BY_NAME['structure'].choices)
# Laws that belong to one structure, and why.
ONLY_IN = {
    'printed': ('proportional', 'the law solves u_d = y_m + f v (3.2), which no other one has'),
    'gradient': ('pole_placement', 'the law learns behind the filters of that loop'),
}


def law_fits(law: str, structure: str) -> bool:
    return law not in ONLY_IN or ONLY_IN[law][0] == structure


def build_controller(p: Parameters, estimate: Estimate | None = None,
                     executor: Executor | None = None) -> AdaptiveController:
    """Return the controller with the law and the structure that the parameters name.

    estimate: to begin with; None: known_before(p). executor: computes fits and gains; None: in this
    process. Raises ParameterError for parameters that contradict each other.
    """
    check_model(build_model(p))
    _check_estimates(p)
    check_last_commands(p)
    inverse = BacklashInverse(p.inverse.direction_band, p.inverse.take_up_rate * p.sample_period)
    law = p.estimator.law
    if not law_fits(law, p.structure):
        only, why = ONLY_IN[law]
        raise ParameterError('structure', p.structure, f'must be {only} for estimator.law: {law}',
                             f'{why}; moving_horizon, lms and fixed fit any structure')
    executor, actuator = executor or Executor(), build_actuator(p)
    estimator = _build_law(p, estimate or known_before(p), executor)
    serial = None if actuator is None else SerialPlant(
        actuator, build_state_model(p), p.estimator.output_noise_std)
    return AdaptiveController(
        estimator, build_structure(p), inverse, build_limits(p), p.plant.adapt, serial, executor
    )


def _build_law(p: Parameters, initial: Estimate, executor: Executor) -> Law:
    options, model, noise_std = p.estimator, build_state_model(p), p.estimator.output_noise_std
    bounds = options.bounds
    if options.law == 'moving_horizon':
        given = initial if initial.learned else replace(initial, c_r=0.0, c_l=0.0)
        observer = None if p.structure == 'proportional' \
            else FixedBacklash(given, model, noise_std, DOUBT)
        return MovingHorizon(initial, bounds, model, p, observer, executor)
    if options.law == 'fixed':
        return FixedBacklash(initial, model, noise_std, p.fixed.doubt)
    # The other laws assume c_l < 0 < c_r, unless the bounds exclude that.
    (low_r, high_r), (low_l, high_l) = bounds.c_r, bounds.c_l
    bounds = Bounds(bounds.m, (max(low_r, 0.0) if high_r > 0.0 else low_r, high_r),
                    (low_l, min(high_l, 0.0) if low_l < 0.0 else high_l))
    if options.law == 'gradient':
        return GradientEstimator(
            initial, bounds, build_four_blocks(p), p.gradient.step, noise_std)
    # A law itself averages out the noise of u, but not the bias that smoothing would add.
    reconstruction = InputReconstruction(build_model(p), noise_std, options.lag, smoothed=0.1)
    common = initial, bounds, p.proportional.bounds, reconstruction
    if options.law == 'printed':
        return PrintedLaw(*common)
    return NormalisedLms(*common, p.lms.step, p.lms.step_f)


def build_structure(p: Parameters) -> ControlStructure:
    if p.structure == 'proportional':
        return Proportional()
    if p.structure == 'pole_placement':
        return PolePlacement(build_four_blocks(p))
    return Tracking(design(build_state_model(p, commanded=True), p.tracking), p.tracking,
                    p.inverse.caution, p.estimator.output_noise_std)


def build_four_blocks(p: Parameters) -> FourBlocks:
    """Return gains of `pole_placement` for the poles that state feedback of `tracking` gives."""
    state = build_state_model(p, commanded=True)
    gains = feedback_around(state, p.tracking._replace(integral_weight=0.0))
    closed = np.real(np.poly(state.a - np.outer(state.b, gains.state)))
    return place_poles(state.transfer_function, closed, p.pole_placement.filter_pole)


def build_limits(p: Parameters) -> Limits:
    """Return the limits of v per sample."""
    control, period = p.control, p.sample_period
    return Limits(control.min, control.max, control.rate_max * period,
                  control.acceleration_max * period**2)


def build_state_model(p: Parameters, commanded: bool = False) -> StateModel:
    """Return the state space of G(z), or, commanded, of L(z) G(z) from the command to y."""
    model, actuator = build_model(p), build_actuator(p)
    if commanded and actuator is not None:
        model = actuator.in_front_of(model)
    return _state_model(tuple(model.numerator), tuple(model.denominator))


# Cached, as a controller that restarts does so in the middle of a loop.
@lru_cache(maxsize=16)
def _state_model(numerator: tuple[float, ...], denominator: tuple[float, ...]) -> StateModel:
    return StateModel(TransferFunction(numerator, denominator))


def first_guess(p: Parameters) -> Estimate:
    """Return the estimate that estimator.initial and proportional.f name."""
    return Estimate(*p.estimator.initial, p.proportional.f)


def known_before(p: Parameters) -> Estimate:
    """Return the estimate to begin with: that of estimates.file if loaded, else first_guess(p)."""
    guess, loaded, law = first_guess(p), load_estimate(p), p.estimator.law
    if loaded is None:
        return guess
    learns_f = law in ('printed', 'fixed') or (law == 'lms' and p.lms.step_f > 0.0)
    return loaded if learns_f else replace(loaded, f=guess.f)


def takes_model_as_exact(p: Parameters) -> bool:
    """Whether a G other than that of the paper's example is taken as exact by a law that learns."""
    return p.estimator.law == 'moving_horizon' and not p.plant.uncertainty and any(
        p[name] != BY_NAME[name].default for name in ('plant.numerator', 'plant.denominator'))


def warnings_of(p: Parameters, with_reference: bool = True) -> list[str]:
    """Return warnings of what makes the estimate hard; with_reference: whether p's is in use."""
    return model_warnings(build_model(p), p.sample_period, p.frequency if with_reference else None)


def _check_estimates(p: Parameters) -> None:
    """Raise ParameterError if first guesses and bounds contradict each other."""
    initial, bounds = p.estimator.initial, p.estimator.bounds
    for name, (low, high), value in zip(bounds._fields, bounds, initial, strict=True):
        if low >= high:
            raise ParameterError(f'estimator.bounds.{name}', [low, high],
                                 'must be [low, high] with low < high')
        if not low <= value <= high:
            raise ParameterError(f'estimator.initial.{name}', value, f'must lie within [{low:g}, '
                                 f'{high:g}]', f'change it or estimator.bounds.{name}')
    if initial.c_l > initial.c_r:
        raise ParameterError('estimator.initial.c_l', initial.c_l,
                             f'must be <= estimator.initial.c_r={initial.c_r!r}')
    low_f, high_f = p.proportional.bounds
    if low_f >= high_f:
        raise ParameterError('proportional.bounds', [low_f, high_f],
                             'must be [low, high], low < high')
