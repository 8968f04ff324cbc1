"""How often v crosses the gap in `tracking`: once per turn of what is asked for."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal
from strategies import GEAR, known_backlash

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.assembly import build_model
from backlash_ros.core.control.tracking.design import design, variances
from backlash_ros.core.control.tracking.feedback import TRUSTED_AFTER, StateFeedback, Trust
from backlash_ros.core.control.tracking.tracking import Tracking
from backlash_ros.core.control.tracking.trajectory import IdealTrajectory
from backlash_ros.core.parameters.table import TrackingWeights
from backlash_ros.core.plant.backlash import Region
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction
from backlash_ros.core.scenario import ReferenceSignal
from backlash_ros.core.simulation.run_record import turns

Array = NDArray[np.float64]
PERIOD, M, GAP = 0.005, 0.098, 0.9
KNOWN: dict[str, object] = {
    **GEAR, **known_backlash(M, 0.55, -0.35), 'structure': 'tracking',
    'estimator.output_noise_std': 1.1e-4, 'output_quantum': 3.834951969714103e-4,
    'inverse.take_up_rate': 100.0, 'control.min': -12.6, 'control.max': 12.6,
    'control.rate_max': 300.0,
}


def moved(asked: Array, noise: float = 0.0, **changes: object) -> tuple[Array, float]:
    """v, and the RMS of y before the sensor against what is asked for without noise."""
    p = Parameters({**KNOWN, **{name.replace('__', '.'): v for name, v in changes.items()}})
    heard = asked + noise * np.random.default_rng(1).standard_normal(len(asked))
    loop = build_closed_loop(p)
    loop.reference = ReferenceSignal(Parameters({
        'waveform': 'file', 'amplitude': 1.0, 'sample_period': PERIOD,
    }), tuple(heard.tolist()))
    run, delay = loop.run(len(asked)), loop.controller.structure.delay
    model = build_model(p)
    y = signal.lfilter(model.numerator, model.denominator, run.column('u'))
    return run.column('v'), float(np.sqrt(np.mean((y[delay:] - asked[:-delay])[200:]**2)))


@pytest.mark.parametrize('band', [0.0, 1e-2])
@pytest.mark.parametrize('noise', [0.0, 1e-4, 0.1 * GAP * M])
def test_noise_of_the_reference_does_not_make_v_cross_the_gap(noise: float, band: float) -> None:
    asked = 0.5 * np.sin(0.5 * np.arange(0.0, 20.0, PERIOD))
    v, error = moved(asked, noise, inverse__direction_band=band)
    assert turns(v, 0.5 * GAP) <= turns(asked, 0.1) + 3
    # Without a gap y would follow half of the noise.
    assert error < 0.5 * noise + 1e-6


def test_what_is_left_of_u_beside_an_integrator_does_not_make_v_cross_the_gap() -> None:
    b, a, _ = signal.cont2discrete(([20.0], [1.0, 20.0, 0.0]), PERIOD)
    integrator = {'plant__numerator': b[0, 1:].tolist(), 'plant__denominator': a.tolist(),
                  'control__min': -np.inf, 'control__max': np.inf, 'control__rate_max': np.inf,
                  'inverse__take_up_rate': np.inf, 'output_quantum': 0.0}
    asked = 0.1 * signal.sawtooth(3.0 * np.arange(0.0, 10.0, PERIOD) + 0.5 * np.pi, 0.5)
    v, _ = moved(asked, **integrator)
    gapless = {f'{of}__{side}': sign * 1e-9 for of in ('backlash', 'estimator__initial')
               for side, sign in (('c_r', 1.0), ('c_l', -1.0))}
    ideal, _ = moved(asked, **integrator, **gapless)
    assert turns(v, 0.5 * GAP) <= turns(ideal, 0.01 * GAP) + 2


@pytest.mark.parametrize('noise', [1.1e-3, 0.1 * GAP * M])
@pytest.mark.parametrize('rests_from', [12.0, 9.0])
def test_noise_of_y_larger_than_configured_does_not_make_v_cross_the_gap(noise, rests_from):
    asked = 0.5 * np.sin(1.5 * np.minimum(np.arange(0.0, 12.0, PERIOD), rests_from))
    v, error = moved(asked, output_noise_std=noise, fixed__doubt=0.1)
    # u* itself turns a few times where the motion begins and ends.
    assert turns(v, 0.5 * GAP) <= turns(asked, 0.1) + 5
    assert error < 0.15 * noise


def moves_with_rests(seed: int, count: int, rest: int) -> Array:
    rng = np.random.default_rng(seed)
    asked = [np.zeros(200)]
    for _ in range(count):
        begin, end = float(asked[-1][-1]), float(rng.uniform(-0.5, 0.5))
        s = np.linspace(0.0, 1.0, int(rng.integers(60, 200)))
        asked += [begin + (end - begin) * s * s * (3.0 - 2.0 * s), np.full(rest, end)]
    return np.concatenate(asked)


@pytest.mark.parametrize(('noise', 'more'), [(1e-4, 7), (3.65e-4, 1)])  # as configured
def test_v_stays_on_its_side_at_the_end_of_a_move(noise: float, more: int) -> None:
    there = np.clip(0.004 * np.arange(400), 0.0, 0.8) - 0.4
    asked = np.concatenate([there, there[::-1]] * 3)
    known = known_backlash(1.0, 0.021, -0.021).items()
    v, error = moved(
        asked, **{name.replace('.', '__'): value for name, value in known},
        plant__numerator=[0.456, 0.235], plant__denominator=[1.0, -0.475, 0.166],
        estimator__output_noise_std=noise, output_quantum=5e-4, control__min=-1.5,
        control__max=1.5, control__rate_max=5.0)
    assert turns(v, 0.021) <= turns(asked, 0.1) + more
    assert error < 2e-4


def test_moves_with_rests_cross_the_gap_where_they_turn() -> None:
    reference = moves_with_rests(3, 9, 400)
    v, error = moved(reference)
    assert turns(v, 0.5 * GAP) <= turns(reference, 1e-3) + 3
    assert error < 1e-4


@pytest.mark.parametrize('noise', [0.0, 0.03])
def test_feedback_is_as_hard_as_its_noise_beside_the_gap_allows(noise: float) -> None:
    # Full feedback around three slow poles makes many gaps of this noise, and v turns for it.
    told = max(noise, 1e-9)
    p = Parameters({**known_backlash(1.3, 3.0, -3.0), 'structure': 'tracking',
                    'output_noise_std': noise, 'estimator.output_noise_std': told})
    asked = 2.0 * moves_with_rests(2, 4, 200)
    loop = build_closed_loop(p)
    loop.reference = ReferenceSignal(
        Parameters({'waveform': 'file', 'amplitude': 1.0}), tuple(asked.tolist()))
    run, structure = loop.run(len(asked)), loop.controller.structure
    assert isinstance(structure, Tracking)
    assert 0.0 < structure.feedback.noise_u <= 0.1 * 1.3 * 6.0
    hardest = structure.feedback.noise_u == structure.feedback.noise.u_std[0]
    assert hardest is (noise == 0.0)
    assert noise == 0.0 or turns(run.column('v'), 3.0) < 80


@pytest.mark.parametrize('take_up', [20.0, 100.0])
def test_a_slow_crossing_begins_before_the_turn_and_ends_behind_it(take_up: float) -> None:
    asked = 0.5 * np.sin(3.0 * np.arange(0.0, 10.0, PERIOD))
    _, at_once = moved(asked, inverse__take_up_rate=np.inf)
    _, slowly = moved(asked, inverse__take_up_rate=take_up)
    samples = GAP / (take_up * PERIOD)
    # A parabola at the turn: what it does within half of the crossing, a few times per period.
    assert slowly < at_once + 0.5 * 0.5 * (3.0 * PERIOD * samples) ** 2


SLOW = design(StateModel(TransferFunction([0.1], [1.0, -1.9, 0.9])), TrackingWeights(10, 1e-2, 0.0))


def test_no_noise_of_y_hides_a_turn_beside_which_the_gap_is_small() -> None:
    trajectory = IdealTrajectory(SLOW)
    trajectory.begin(0.0)
    for k in range(30):
        trajectory.take(0.1 * k)
        trajectory.turn(1e6, 1.0, 0.0, 0.0)
        trajectory.prepare()
    assert trajectory.turning.side is Region.RIGHT


AXIS = design(StateModel(TransferFunction([0.456, 0.235], [1.0, -0.475, 0.166])),
              TrackingWeights(60, 1e-2, 0.0))


@pytest.mark.parametrize(('gap', 'crossing', 'stays'), [
    (0.04, 2.0, True),  # at the end u* comes back by 4 % of the gap
    (0.01, 2.0, True),  # by 17 %, but sooner than v could go there and come back
    (0.01, 0.2, False),  # v can follow
    (1e-4, 2.0, False),  # by many gaps
])
def test_a_move_ends_without_a_turn_that_is_not_worth_two_crossings(
    gap: float, crossing: float, stays: bool,
) -> None:
    trajectory, sides = IdealTrajectory(AXIS), ''
    trajectory.begin(0.0)
    there = np.minimum(0.004 * np.arange(200), 0.4)
    for r in np.append(there, there[::-1]):
        trajectory.take(r)
        if trajectory.turn(1e-6, gap, 0.0, crossing):
            sides += trajectory.turning.side.name[0]
        trajectory.prepare()
    # The first L: u* swings a little before it moves.
    assert (sides == 'LRL') is stays


def test_v_goes_no_further_than_where_it_stays_at_the_end_of_a_move() -> None:
    trajectory, ideal, aims = IdealTrajectory(AXIS), [0.0], [0.0]
    trajectory.begin(0.0)
    for r in np.minimum(0.004 * np.arange(200), 0.4):
        trajectory.take(r)
        trajectory.turn(1e-6, 0.04, 0.0, 2.0)
        ideal.append(trajectory.u)
        aims.append(trajectory.aim)
        trajectory.prepare()
    assert max(ideal) > 0.401
    assert max(aims) == pytest.approx(0.4, abs=1e-4)
    assert np.diff(aims)[aims.index(max(aims)):].min() > -1e-9  # it does not come back


def test_noise_of_the_references_asks_for_a_trajectory_that_it_moves_less() -> None:
    trajectory = IdealTrajectory(SLOW)
    trajectory.begin(0.0)
    for r in np.random.default_rng(1).standard_normal(60):
        trajectory.take(r)
        trajectory.prepare()
    before = trajectory.references.noise_gains[-1]
    assert not trajectory.soften(0.0), 'without a gap noise costs no crossing'
    assert trajectory.soften(1.0)
    assert trajectory.references.noise_gains[-1] < 0.5 * before
    assert not trajectory.soften(1.0)
    for _ in range(310):  # as many references as tell what the noise is
        trajectory.take(0.0)
        trajectory.prepare()
    assert trajectory.soften(1.0), 'noise that is gone asks for nothing any more'
    assert trajectory.references.noise_gains[-1] == before


def test_a_deviation_that_noise_explains_is_left_alone() -> None:
    feedback = StateFeedback(SLOW, 1.0, 1e-3)
    feedback.trust = Trust(held_for=TRUSTED_AFTER)
    feedback.prepare(np.zeros((2, 2)), 1e-3, np.zeros(len(SLOW.schedule) + 1), 0.0)
    assert feedback.u([3e-3, 0.0], held_back=False, largest=1.0)[0] == 0.0
    full = SLOW.feedback.state[0]
    beyond = feedback.u([1e-2, 0.0], held_back=False, largest=1.0)[0]
    assert beyond == pytest.approx(full * (1e-2 - 3.5e-3))


def test_a_deviation_that_noise_of_the_references_explains_is_worth_no_crossing() -> None:
    feedback = StateFeedback(SLOW, 1.0, 1e-3)
    feedback.trust = Trust(held_for=TRUSTED_AFTER)
    feedback.prepare(np.zeros((2, 2)), 1e-3, variances(SLOW.schedule, np.eye(2)), 1e-2)
    wanted, worth = feedback.u([1e-2, 0.0], held_back=False, largest=1.0)
    assert wanted > 0.0
    assert worth == 0.0


def test_u_goes_no_further_than_feedback_agrees_with_as_long_as_it_is_held() -> None:
    feedback = StateFeedback(SLOW, 1.0, 0.0)
    assert feedback.furthest([0.0, 0.0], [1.0] * 4, Region.RIGHT, 4) == pytest.approx(1.0)
    furthest, model, gain = feedback.furthest([-0.1, 0.0], [1.0] * 4, Region.RIGHT, 4), \
        SLOW.model, np.array(SLOW.schedule[0])
    x, asked = np.array([-0.1, 0.0]), []
    for _ in range(4):
        asked.append(1.0 - gain @ x)
        x = model.a @ x + model.b * (furthest - 1.0)
    assert min(asked[1:]) == pytest.approx(furthest)
    assert asked[0] > furthest > 1.0
