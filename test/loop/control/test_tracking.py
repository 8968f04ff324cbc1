"""The tracking structure: y follows y_m as if there were no backlash."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import signal
from strategies import known_backlash

from backlash_ros.core.assembly import build_controller, build_model, build_plant, build_reference
from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.tracking.design import (
    CONFIDENCES,
    PreviewGains,
    _observer,
    design,
    modulus_margin,
    preview_gains,
)
from backlash_ros.core.control.tracking.feedback import (
    SETTLING,
    SHORT,
    Mode,
    Rest,
    shrunk_crossings,
)
from backlash_ros.core.control.tracking.trajectory import IdealTrajectory
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import TrackingWeights
from backlash_ros.core.plant.backlash import RIGHT
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction
from backlash_ros.core.scenario import ReferenceSignal
from backlash_ros.core.simulation import run_record
from backlash_ros.core.simulation.closed_loop import build_closed_loop

NO_GAP = {'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9}
KNOWN = {'estimator.law': 'fixed', 'estimator.initial.m': 1.3}
GAPLESS = {**KNOWN, 'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0}
EXACT = known_backlash(1.3, 3.0, -3.0)


def tracking(**changes: object) -> Parameters:
    named = {name.replace('__', '.'): value for name, value in changes.items()}
    # What is promised here supposes, as the paper does, that G is exact.
    known = {'structure': 'tracking', 'amplitude': 0.2, 'plant.uncertainty': 0.0}
    return Parameters({**known, **named})


def simulate(p: Parameters, samples: int, y_m: np.ndarray | None = None) -> run_record.RunRecord:
    loop = build_closed_loop(p)
    if y_m is not None:
        loop.reference = ReferenceSignal(
            Parameters({'waveform': 'file', 'amplitude': 1.0}), tuple(y_m.tolist()))
    return loop.run(samples)


def error(p: Parameters, samples: int = 500) -> float:
    run = simulate(p, samples)
    value = run_record.delayed_tracking_error_rms(run, p.tracking.preview, since=2.0)
    assert value is not None
    return value


@pytest.mark.parametrize('amplitude', [0.2, 1.0, 10.0])
def test_learned_backlash_costs_nothing(amplitude: float) -> None:
    p = tracking(amplitude=amplitude)
    ideal = error(p.replaced({**GAPLESS, **NO_GAP}))
    assert error(p) <= 1.02 * ideal + 0.3 * p.estimator.output_noise_std / amplitude


@pytest.mark.parametrize('preview', [20, 60])
def test_y_follows_late_by_the_preview_window(preview: int) -> None:
    p = tracking(tracking__preview=preview, **{k.replace('.', '__'): v for k, v in EXACT.items()})
    loop = build_closed_loop(p)
    assert loop.controller.structure.delay == preview
    run = loop.run(500)
    y, y_m = run.column('y')[200:], run.column('y_m')
    errors = [np.abs(y - y_m[200 - d:500 - d]).max() for d in range(preview - 5, preview + 6)]
    assert int(np.argmin(errors)) == 5


GEAR: dict[str, object] = {
    **known_backlash(0.098, 0.55, -0.35), 'sample_period': 0.005, 'structure': 'tracking',
    'output_quantum': 2.0 * np.pi / 2**14, 'estimator.output_noise_std': 1.1e-4,
    'waveform': 'multisine', 'amplitude': 1.0, 'frequency': 3.14, 'inverse.direction_band': 1e-3,
}
# Natural frequency [rad/s], damping, lag [s].
MOTORS = {
    'as told': (40.0, 0.5, 0.0), 'faster': (48.0, 0.5, 0.0), 'slower': (32.0, 0.5, 0.0),
    'damped': (40.0, 0.6, 0.0), 'late': (40.0, 0.5, 0.005),
}


@pytest.mark.parametrize('take_up', [30.0, np.inf])
@pytest.mark.parametrize('motor', MOTORS)
def test_v_rests_however_long_it_takes_to_cross_the_gap(motor, take_up):
    stop = 3.7
    w, damping, lag = MOTORS[motor]
    w *= np.pi
    denominator = np.polymul([lag, 1.0], [1.0, 2.0 * damping * w, w * w])
    numerator, denominator, _ = signal.cont2discrete(
        ([w * w], denominator[denominator.nonzero()[0][0]:]), 0.005, 'zoh')
    p = Parameters({
        **GEAR, 'plant.numerator': numerator[0][1:].tolist(),
        'plant.denominator': denominator.tolist(), 'inverse.take_up_rate': take_up})
    loop = build_closed_loop(p)
    moving = loop.reference
    loop.reference = lambda t: moving(min(t, stop))
    run = loop.run(round(stop / 0.005) + 600)
    assert np.mean(np.diff(run.column('v')[-400:]) != 0.0) < 0.03
    # The weight of u leaves 1 % of the reference.
    y_m = run.column('y_m')[-1]
    assert run.column('y')[-100:] == pytest.approx(y_m, abs=0.012 * abs(y_m) + 1.2e-3)


@pytest.mark.parametrize('take_up', [100.0, 300.0, 600.0])
@pytest.mark.parametrize('law', ['kalman', 'fixed'])
def test_slow_crossing_of_the_gap_leaves_the_loop_stable(law: str, take_up: float) -> None:
    p = tracking(inverse__take_up_rate=take_up, output_noise_std=1e-3)
    run = simulate(p if law == 'kalman' else p.replaced(EXACT), 900)
    # Up to six samples in the gap of 6: no feedback makes up for that, but none makes it worse.
    assert np.abs(run.column('y')).max() < 0.4
    assert np.abs(run.column('y')[500:]).max() < 0.25


@pytest.mark.parametrize('seed', [21, 22])
def test_v_comes_to_rest_after_a_motion_in_spite_of_noise(seed: int) -> None:
    sigma = 1e-3
    t = np.arange(1600) * 0.01
    y_m = np.where(t < 4.5, 0.2 * np.sin(12.6 * t), 0.2 * np.sin(12.6 * 4.5))
    p = tracking(output_noise_std=sigma, seed=seed)
    run = simulate(p, 1600, y_m)
    v = run.column('v')[1000:]
    # G integrates what is left of u, so y may have to be brought back: there and back again.
    assert np.count_nonzero(np.diff(v)) <= 10
    assert run_record.turns(v, 3.0) <= 2
    model = build_model(p)
    y = signal.lfilter(model.numerator, model.denominator, run.column('u'))
    assert np.abs(y[1000:] - y_m[-1]).max() < 6.0 * sigma


def test_a_step_to_rest_stops_short_of_the_u_at_rest_by_what_is_uncertain() -> None:
    rest, inverse, estimate = resting(std=0.01)
    model, x = StateModel(TransferFunction([0.1], [1.0, -1.9, 0.9])), [0.0, 0.0]
    plan = IdealTrajectory(design(model, TrackingWeights(10, 1e-2, 0.0)))
    assert rest.decide(0.0, 1e-3, plan, x, 0.0, inverse.side, lambda _: 0.0, False) is Mode.HOLD
    rest.step(estimate, plan, 0.0, inverse, begins=True)
    # From u = 1 down to 0, where c_l = -1 may lie 0.01 higher or lower.
    assert stepped(rest, inverse, estimate) == pytest.approx(-1.0 + SHORT * 0.01)
    rest.step(estimate, plan, 0.0, inverse, begins=False)
    assert not inverse.taking_up, 'nothing more is known, so nothing more is done'
    known = resting(std=0.001)[2]
    rest.step(known, plan, 0.0, inverse, begins=False)
    assert stepped(rest, inverse, known) == pytest.approx(-1.0 + SHORT * 0.001)


def test_a_step_at_rest_that_throws_a_coasting_load_further_off_is_not_repeated() -> None:
    rest, noise = Rest(), 1e-3
    model = StateModel(TransferFunction([0.1], [1.0, -1.9, 0.9]))
    plan = IdealTrajectory(design(model, TrackingWeights(10, 1e-2, 0.0)))

    def mode(deviation: float) -> Mode:
        return rest.decide(0.0, noise, plan, [deviation, 0.0], 0.0, RIGHT, lambda x: -x[0], False)

    assert mode(10.0 * noise) is Mode.LEAD_BACK
    for _ in range(10):
        assert mode(-20.0 * noise) is Mode.HOLD
    plan.spread = 1.0
    assert mode(0.0) is Mode.FOLLOW
    plan.spread = 0.0
    assert mode(20.0 * noise) is Mode.HOLD, 'as much is tolerated after the next motion, too'
    for _ in range(SETTLING):
        assert mode(0.0) is Mode.HOLD
    assert mode(30.0 * noise) is Mode.LEAD_BACK, 'once y has been held close, it is again'


def stepped(rest: Rest, inverse: BacklashInverse, estimate: Estimate) -> float:
    crossings = shrunk_crossings(estimate, rest.target[1], known=True)
    return inverse.proceed(1.0, *crossings)


def resting(std: float) -> tuple[Rest, BacklashInverse, Estimate]:
    """v engaged at u = 1 on the right of a gap from -1 to 1 with m = 1, and what is known of it."""
    inverse = BacklashInverse()
    inverse.step(1.0, 1.0, 1.0, -1.0)
    estimate = Estimate(1.0, 1.0, -1.0, 0.0, std, std, std, Status.TRACKING)
    return Rest(), inverse, estimate


@pytest.mark.parametrize('seed', [14, 319])
def test_reference_that_begins_slowly_is_followed_from_two_seconds_on(seed: int) -> None:
    # v meets the far side of the gap after 1.5 s. Filters that know nothing of x before that
    # believe a wrong gap with these noises; the fit of all samples does not.
    chirp = {
        'waveform': 'chirp', 'frequency_start': 0.2 * np.pi, 'frequency': 6.0 * np.pi,
        'output_noise_std': 1e-3, 'seed': seed}
    p = tracking(**chirp)
    assert np.abs(simulate(p, 400).column('y')).max() < 0.3
    assert error(p, 1200) <= 1.1 * error(p.replaced({**GAPLESS, **NO_GAP}), 1200)


def test_feedback_by_the_first_guess_is_left_out_where_a_wrong_slope_would_destabilise() -> None:
    quick = StateModel(TransferFunction([0.1], [1.0, -0.9]))
    slow = StateModel(TransferFunction([1e-6], np.poly([1.0, 0.99, 0.985, 0.98]).tolist()))
    for model, bears in ((quick, True), (slow, False)):
        gains = preview_gains(model, 1.0)
        assert modulus_margin(model, model, gains) > 0.0
        assert (modulus_margin(model, model, gains, 3.0) > 0.0) is bears


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=2))
def test_with_the_true_slope_the_observer_changes_no_pole_of_the_loop(gain: list[float]) -> None:
    model = StateModel(TransferFunction([0.1, 0.05], [1.0, -1.7, 0.72]))
    k = np.array(gain)
    radius = np.abs(np.linalg.eigvals(model.a - np.outer(model.b, k))).max()
    assume(abs(radius - 1.0) > 1e-3)
    gains = PreviewGains(k, 0.0, np.zeros(1))
    assert (modulus_margin(model, model, gains) > 0.0) == (radius < 1.0)


@pytest.mark.parametrize('weight', [0.0, 1e-3, 1.0])
def test_the_modulus_margin_is_that_of_the_loop_with_its_integral(weight: float) -> None:
    model = StateModel(TransferFunction([0.1, 0.05], [1.0, -1.7, 0.72]))
    gains, most = preview_gains(model, 0.1, weight), 0.0
    for confidence in CONFIDENCES:
        a, drive, seen, correction = _observer(model, confidence)
        x, x_hat, q, pushed = np.zeros(2), np.zeros(3), 0.0, []
        for k in range(3000):
            u = -gains.state @ x_hat[:2] - gains.integral * q
            pushed.append(u + (k == 0))  # a unit pulse added to u: what becomes of it is 1/(1 + L)
            q -= model.c * x[0]
            x = model.a @ x + model.b * pushed[-1]
            x_hat = a @ x_hat + drive * u
            x_hat += correction * (model.c * x[0] - seen @ x_hat)
        most = max(most, np.abs(np.fft.rfft(pushed, 2**15)).max())
    assert modulus_margin(model, model, gains) == pytest.approx(1.0 / most, rel=2e-3)


@pytest.mark.parametrize('law', ['moving_horizon', 'fixed'])
def test_saturation_and_rate_limit_leave_no_cycle_behind(law: str) -> None:
    t = np.arange(900) * 0.01
    y_m = np.where(t < 5.0, 0.3, 0.1) * np.sin(12.6 * t)
    p = tracking(control__max=22.0, control__min=-22.0, control__rate_max=1280.0)
    run = simulate(p if law == 'moving_horizon' else p.replaced(EXACT), 900, y_m)
    assert np.abs(run.column('v')).max() == 22.0
    # Full feedback through these limits cycles with an amplitude of 7.
    assert np.abs(run.column('y')[700:]).max() < 0.105


def record(y_m: np.ndarray, y: np.ndarray, v: np.ndarray | None = None) -> run_record.RunRecord:
    rows = np.zeros((len(y_m), len(run_record.COLUMNS)))
    for name, values in {
        't': np.arange(len(y_m)) * 0.01, 'y_m': y_m, 'y': y, 'v': y if v is None else v,
        'true_c_r': 1.0, 'true_c_l': -1.0,
    }.items():
        rows[:, run_record.COLUMNS.index(name)] = values
    return run_record.RunRecord(rows, 0.01)


def test_delayed_copy_has_no_delayed_error() -> None:
    y_m = np.sin(0.1 * np.arange(300))
    y = np.concatenate([np.zeros(7), y_m[:-7]])
    assert run_record.delayed_tracking_error_rms(record(y_m, y), 7) == pytest.approx(0.0, abs=1e-12)
    assert run_record.delayed_tracking_error_rms(record(0.0 * y_m, y), 7) is None


def test_delay_counts_sample_periods_where_samples_were_lost() -> None:
    y_m = np.arange(100.0)
    whole = record(y_m, y_m)
    kept = run_record.RunRecord(np.delete(whole.rows, [40, 41], axis=0), 0.01, 2)
    assert run_record.delayed_reference(kept, 5)[-1] == 94.0


def test_turns_counts_what_turns_back_by_more_than_the_least() -> None:
    assert run_record.turns(np.array([0.0, 2.0, 0.0, 2.0, 1.5, 3.0]), 1.0) == 2
    assert run_record.turns(np.array([0.0, 2.0, 1.5, 2.0]), 1.0) == 0
    assert run_record.turns(np.empty(0), 1.0) == 0


def test_crossings_are_counted_per_reversal_of_the_reference() -> None:
    y_m = np.sin(0.1 * np.arange(630))
    v = 2.0 * y_m + np.sign(np.gradient(y_m))
    assert run_record.gap_crossings_per_reversal(record(y_m, y_m, v)) == pytest.approx(1.0)
    chatter = v + 2.0 * (np.arange(630) % 2)
    value = run_record.gap_crossings_per_reversal(record(y_m, y_m, chatter))
    assert value > 10.0


def test_a_loop_that_was_driven_to_its_bounds_comes_back() -> None:
    # Full feedback between its own bounds would cycle like between those of v.
    p = tracking(fixed__doubt=0.1).replaced(EXACT)
    controller, plant, reference = build_controller(p), build_plant(p), build_reference(p)
    y = []
    for k in range(900):
        y.append(plant.measure())
        step = controller.step(-y[-1] if 100 <= k < 160 else y[-1], reference(k * 0.01))
        plant.step(step.v)
    assert max(map(abs, y)) > 10.0
    assert max(map(abs, y[600:])) < 0.25
