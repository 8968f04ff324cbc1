"""What is simulated: backlash (2.1), a position loop before it, G(z), the sensor, another G(z)."""

from collections.abc import Callable
from fractions import Fraction
from itertools import accumulate, islice

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from records import resonance
from scipy.signal import lfilter
from strategies import eighths, output_of, paper_example, plants, signals, usual_plays

from backlash_ros.core import assembly
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.backlash import Backlash, clamp, play
from backlash_ros.core.plant.simulated_plant import SimulatedPlant, altered_plant
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop


def as_printed(u_before: Fraction, v: Fraction, m: Fraction, c_r: Fraction, c_l: Fraction,
               ) -> Fraction:
    v_l = u_before / m + c_l
    v_r = u_before / m + c_r
    if v <= v_l:
        return m * (v - c_l)
    if v >= v_r:
        return m * (v - c_r)
    return u_before


@given(
    m=eighths(1, 40), c_l=eighths(-80, 40), gap=eighths(1, 80), u=eighths(-400, 400),
    signal=st.lists(eighths(-160, 160), min_size=1, max_size=40),
)
def test_clamp_equals_the_three_printed_cases(m, c_l, gap, u, signal):
    backlash = Backlash(m, c_l + gap, c_l, u)
    expected = Fraction(u)
    for v in signal:
        expected = as_printed(
            expected, Fraction(v), Fraction(m), Fraction(c_l + gap), Fraction(c_l))
        assert backlash.step(v) == expected


values = st.floats(-10.0, 10.0)


@given(v=st.lists(values, min_size=1, max_size=40), gaps=st.lists(
    st.floats(0.0, 5.0), min_size=1, max_size=3), before=values)
def test_stepping_the_turns_alone_leaves_nothing_out(v, gaps, before):
    stepped = [
        list(islice(accumulate(v, lambda p, x, g=gap: clamp(p, x, x + g), initial=before), 1, None))
        for gap in gaps]
    assert play(np.array(v), gaps[0], before).tolist() == stepped[0]
    assert play(np.array(v), np.array(gaps), np.full(len(gaps), before)).tolist() == stepped


SLOW = TransferFunction([0.1], [1.0, -0.9])


def plant(**values: object) -> SimulatedPlant:
    return SimulatedPlant(Parameters(values), SLOW)


def outputs(simulated: SimulatedPlant, control: list[float]) -> list[float]:
    result = []
    for v in control:
        result.append(simulated.measure())
        simulated.step(v)
    return result


@given(model=plants(), play=usual_plays(), control=signals(), disturbance=st.floats(-5.0, 5.0))
def test_y_is_g_of_the_backlash_output_plus_the_disturbance(model, play, control, disturbance):
    simulated = SimulatedPlant(Parameters({
        'backlash.m': play.m, 'backlash.c_r': play.c_r, 'backlash.c_l': play.c_l,
        'input_disturbance': disturbance,
    }), model)
    backlash = Backlash(play.m, play.c_r, play.c_l)
    u = np.array([backlash.step(v) for v in control])
    expected = output_of(model, u + disturbance)
    np.testing.assert_allclose(
        outputs(simulated, control), expected, atol=1e-9 * (1.0 + np.abs(expected).max()))


@given(control=signals(), quantum=st.floats(0.001, 1.0))
def test_quantised_output_is_the_nearest_multiple(control: list[float], quantum: float) -> None:
    exact = outputs(plant(), control)
    coarse = outputs(plant(output_quantum=quantum), control)
    for y, shown in zip(exact, coarse, strict=True):
        assert abs(shown - y) <= 0.5 * quantum * (1.0 + 1e-9)
        assert shown / quantum == pytest.approx(round(shown / quantum), abs=1e-6)


def test_wear_moves_the_backlash_with_time_and_the_jump_comes_at_its_time() -> None:
    simulated = plant(**{
        'backlash.rate': (0.1, 1.0, -2.0), 'backlash.jump_time': 0.5,
        'backlash.jump': (0.0, 1.0, 0.0), 'sample_period': 0.1})
    seen = []
    for _ in range(11):
        simulated.step(0.0)
        seen.append((simulated.backlash.m, simulated.backlash.c_r, simulated.backlash.c_l))
    assert seen[0] == pytest.approx((1.3, 3.0, -3.0))
    assert seen[4] == pytest.approx((1.34, 3.4, -3.8))
    assert seen[5] == pytest.approx((1.35, 4.5, -4.0))
    assert seen[10] == pytest.approx((1.4, 5.0, -5.0))


@pytest.mark.parametrize('changes', [
    {'backlash__jump': [-2.0, 0.0, 0.0]}, {'backlash__jump': [0.0, -3.0, 3.0]},
    {'backlash__rate': [-1.0, 0.0, 0.0]},
], ids=['jump to m < 0', 'jump to c_l = c_r', 'm falls below 0 after 1.3 s'])
def test_wear_never_ends_in_an_invalid_backlash(changes: dict[str, list[float]]) -> None:
    with pytest.raises(ParameterError) as refusal:
        outputs(assembly.build_plant(paper_example(**changes)), [0.0] * 400)
    assert refusal.value.name.startswith('backlash.')


def assert_equal(found: TransferFunction, expected: TransferFunction, tolerance: float) -> None:
    np.testing.assert_allclose(found.numerator, expected.numerator, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(found.denominator, expected.denominator, rtol=0.0, atol=tolerance)


def step_response(model: TransferFunction, samples: int) -> NDArray[np.float64]:
    return np.asarray(lfilter(model.numerator, model.denominator, np.ones(samples)))


def continuous(model: TransferFunction) -> bool:
    poles = model.poles
    return not np.any((poles.real <= 0.0) & (np.abs(poles.imag) < 1e-3))


@pytest.mark.parametrize('factor', [0.5, 0.8, 0.98, 1.02, 1.2, 1.5])
def test_scaled_frequency_is_the_motor_at_that_frequency(factor: float) -> None:
    assert_equal(altered_plant(resonance(20.0), frequency=factor), resonance(20.0 * factor), 1e-12)


@given(plants(), st.integers(0, 2), st.integers(1, 3))
def test_lag_by_a_part_of_a_sample_shifts_the_response_by_that_part(model, whole, quarters):
    assume(continuous(model))
    lagging = step_response(altered_plant(model, lag=whole + 0.25 * quarters), 60)
    # A quarter of the frequency shows the response between the samples as well.
    slow = step_response(altered_plant(model, frequency=0.25), 240)
    if np.any(np.abs(model.poles - 1.0) < 1e-6):
        slow = slow * 0.25
    expected = np.append(np.zeros(whole + 1), slow[4 - quarters::4])[:60]
    np.testing.assert_allclose(lagging, expected, rtol=0.0, atol=1e-7 * np.abs(slow).max())


def test_plant_that_no_continuous_one_has_is_refused_with_its_pole() -> None:
    ringing = TransferFunction([1.0], [1.0, 0.25])
    with pytest.raises(ParameterError, match=r'pole -0\.25.*negative real axis.*truth\.numerator'):
        altered_plant(ringing, frequency=1.2)
    # Whole samples of dead time need no continuous plant.
    assert altered_plant(ringing, lag=2.0).delay == 3


def test_given_plant_takes_the_place_of_the_known_one_in_the_simulation_alone() -> None:
    known = Parameters({'control.delay_samples': 1})
    p = known.replaced({
        'truth.numerator': [0.3], 'truth.denominator': [1.0, -0.5, 0.06], 'truth.delay_samples': 3})
    true = TransferFunction([0.3], [1.0, -0.5, 0.06, 0.0, 0.0, 0.0])
    assert_equal(assembly.build_true_model(p), true, 0.0)
    assert_equal(assembly.build_model(p), assembly.build_model(known), 0.0)
    denominator = p.replaced({'truth.numerator': [], 'truth.denominator': [1.0, -2.8, 2.7, -0.9]})
    assert assembly.build_true_model(denominator).numerator.max() == max(p.plant.numerator)


def test_bad_truth_is_named_as_such() -> None:
    p = Parameters({'truth.numerator': [1.0, 2.0], 'truth.denominator': [1.0, 0.5]})
    with pytest.raises(ParameterError, match=r'truth\.numerator=.* of truth\.denominator'):
        assembly.build_plant(p)


LAG = TransferFunction((0.05, 0.05), (1.0, -1.6, 0.65), 'actuator')  # gain 2
ACTUATOR = Actuator(LAG, (0.3, 0.2))
MODEL = TransferFunction((0.3, 0.2), (1.0, -0.6, 0.1))
PARAMETERS = {
    'actuator.numerator': (0.05, 0.05), 'actuator.denominator': (1.0, -1.6, 0.65),
    'actuator.wind_up': (0.3, 0.2),
}


def response_to(commands: list[float]) -> np.ndarray:
    plant = assembly.build_plant(Parameters({
        **PARAMETERS, 'plant.numerator': (0.3, 0.2), 'plant.denominator': (1.0, -0.6, 0.1),
        'backlash.m': 1.0, 'backlash.c_r': 1.0, 'backlash.c_l': -0.5}))
    y = []
    for command in commands:
        y.append(plant.measure())
        plant.step(command)
    return np.array(y)


def test_a_command_beyond_its_crossing_moves_y_and_within_does_not() -> None:
    c_r, c_l = ACTUATOR.crossings(1.0, -0.5)
    assert (c_r, c_l) == pytest.approx((0.8, -0.45))
    gain = 2.0 * MODEL.numerator.sum() / MODEL.denominator.sum()
    top = c_r + 1.0
    def rests_at(lowest: float) -> float:
        ways = [(0.0, top), (top, top), (top, lowest), (lowest, lowest)]
        commands = [np.linspace(a, b, 400) for a, b in ways]
        return float(response_to(np.concatenate(commands).tolist())[-1])
    assert rests_at(top) == pytest.approx(gain, rel=1e-3)
    across = top - (c_r - c_l)
    assert rests_at(across + 0.01) == pytest.approx(gain, rel=1e-3)
    assert rests_at(across - 0.1) == pytest.approx(0.9 * gain, rel=1e-3)


@pytest.mark.parametrize(('changes', 'text'), [
    ({'actuator.denominator': (1.0, -2.1, 1.1)}, 'actuator.denominator.*within the unit circle'),
    ({'actuator.numerator': (-0.1,)}, 'actuator.numerator.*must be > 0'),
    ({'actuator.numerator': ()}, 'actuator.numerator.*at least one number'),
    ({'actuator.numerator': (1.0, 0.0, 0.0)}, 'actuator.numerator.*must be below the degree'),
])
def test_an_actuator_that_is_none_is_refused_by_name(changes, text):
    with pytest.raises(ParameterError, match=text):
        assembly.build_controller(Parameters({**PARAMETERS, **changes}))


# A position loop with a lag of 6 samples, whose wind-up is a third of the gap behind it.
TRUE = Parameters({
    'sample_period': 0.005, 'plant.numerator': (0.3, 0.2), 'plant.denominator': (1.0, -0.6, 0.1),
    'plant.uncertainty': 0.02, 'actuator.numerator': (0.03, 0.02),
    'actuator.denominator': (1.0, -1.6, 0.65), 'actuator.wind_up': (0.05, 0.04),
    'structure': 'tracking', 'amplitude': 1.0, 'frequency': 6.0,
    'output_noise_std': 1e-4, 'estimator.use_applied_control': 'true',
    'backlash.m': 1.0, 'backlash.c_r': 0.15, 'backlash.c_l': -0.1,
    'estimator.initial.m': 0.9, 'estimator.initial.c_r': 0.01, 'estimator.initial.c_l': -0.01,
    'estimator.bounds.m': (0.3, 3.0), 'estimator.bounds.c_r': (0.0, 0.5),
    'estimator.bounds.c_l': (-0.5, 0.0),
})
IGNORANT = TRUE.replaced({
    'actuator.numerator': (), 'actuator.denominator': (), 'actuator.wind_up': (0.0, 0.0),
})
SAMPLES = 1000


def follow(
    known: Parameters, reported: Callable[[int], bool] = lambda k: True,
) -> tuple[float, Estimate]:
    """RMS of y against the delayed y_m over the second half, and the last estimate."""
    controller, plant = assembly.build_controller(known), assembly.build_plant(TRUE)
    y_m = assembly.build_reference(TRUE)
    applied: tuple[float, ...] = ()
    rows = []
    for k in range(SAMPLES):
        y = plant.measure()
        step = controller.step(y, y_m(k * 0.005), applied=applied if reported(k) else ())
        controller.refine()
        plant.step(step.v)
        applied = (plant.applied,)
        rows.append((y, step.y_m))
    y, asked = np.array(rows).T
    half, delay = SAMPLES // 2, controller.structure.delay
    error = float(np.sqrt(np.mean((y[half:] - asked[half - delay:SAMPLES - delay])**2)))
    return error, controller.estimator.estimate


def test_lag_and_wind_up_of_the_motor_are_made_up_for() -> None:
    error, estimate = follow(TRUE)
    ignorant, _ = follow(IGNORANT)
    assert estimate.status is Status.TRACKING
    # Behind the motor: the wind-up is no part of the estimate.
    assert (estimate.c_r, estimate.c_l) == pytest.approx((0.15, -0.1), rel=0.01)
    assert error < 0.025
    assert error < 0.4 * ignorant


def test_lost_outputs_are_stepped_over() -> None:
    loop = build_closed_loop(TRUE.replaced({'output_loss': 0.2, 'tracking.input_weight': 0.1}))
    record = loop.run(SAMPLES)
    assert record.lost_samples > 100
    y, t = record.column('y'), record.column('t')
    assert np.abs(y[t > 2.0]).max() < 1.3


def test_a_reading_that_is_none_does_not_move_the_motor() -> None:
    controller, plant = assembly.build_controller(TRUE), assembly.build_plant(TRUE)
    y_m = assembly.build_reference(TRUE)
    moves, v = [], 0.0
    for k in range(SAMPLES):
        y = plant.measure() + (50.0 if k in (800, 801) else 0.0)
        before, v = v, controller.step(y, y_m(k * 0.005), applied=(plant.applied,) if k else ()).v
        controller.refine()
        plant.step(v)
        moves.append(abs(v - before))
    assert max(moves[795:810]) < max(moves[500:795]) + TRUE.backlash.c_r - TRUE.backlash.c_l
