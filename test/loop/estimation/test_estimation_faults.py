"""What the default law makes of data and of plants that do not fit."""

from collections.abc import Callable

import numpy as np
import pytest
from places import ROOT

from backlash_ros.core import Parameters, Status, build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.config import read_configuration

NOISE = 1e-3
NAMES = ('m', 'c_r', 'c_l')


def run(samples: int, fault: Callable[[int, float], float], **changes: float) -> RunRecord:
    loop = build_closed_loop(Parameters({
        'plant.uncertainty': 0.0, 'output_noise_std': NOISE, **changes,
    }))
    measure = loop.plant.measure
    loop.plant.measure = lambda: fault(loop.plant.sample, measure())  # type: ignore[method-assign]
    return loop.run(samples)


def errors(record: RunRecord, k: int) -> np.ndarray:
    return np.array([
        abs(record.column(name)[k] / record.column(f'true_{name}')[k] - 1.0) for name in NAMES
    ])


def test_one_wild_sample_moves_no_estimate_by_more_than_its_deviation() -> None:
    record = run(320, lambda k, y: y + 100.0 * NOISE * (k == 300))
    for name in NAMES:
        moved = abs(record.column(name)[303] - record.column(name)[299])
        assert moved <= record.column(f'std_{name}')[299]
    assert record.column('status')[303] == Status.TRACKING


def test_sensor_that_comes_back_ends_the_freeze() -> None:
    record = run(900, lambda k, y: -y if 300 <= k < 500 else y)
    assert record.column('status')[450] == Status.INCONSISTENT
    assert record.column('status')[-1] == Status.TRACKING
    assert errors(record, -1).max() < 0.01


@pytest.mark.parametrize('seed', [303, 305])
def test_samples_that_contradict_in_a_row_are_none_of_them_lost(seed: int) -> None:
    # An integrator that leaks contradicts the first estimate at once: what was refused as outliers
    # until then is just what tells of the leak.
    leaking = np.convolve([1.0, -0.999], [1.0, -1.88504, 0.88692]).tolist()
    record = build_closed_loop(Parameters({
        'truth.denominator': leaking, 'output_noise_std': 1e-4, 'seed': seed,
    })).run(300)
    tracking = record.column('status') == Status.TRACKING
    for name in NAMES:
        off = np.abs(record.column(name) - record.column(f'true_{name}'))
        assert np.all(off[tracking] <= 5.0 * record.column(f'std_{name}')[tracking])
    assert np.count_nonzero(tracking) > 200


@pytest.mark.parametrize('disturbance', [2.0, -1.0])
def test_constant_disturbance_is_cancelled_by_effective_crossings(disturbance: float) -> None:
    record = run(500, lambda k, y: y, input_disturbance=disturbance)
    shifted = record.column('true_c_r') - disturbance / 1.3
    assert record.column('c_r')[-1] == pytest.approx(shifted[-1], rel=0.01)
    e = record.column('u') + disturbance - record.column('u_d')
    assert np.abs(e[300:]).max() < 0.05


def test_plant_without_a_gap_is_recognised() -> None:
    record = run(300, lambda k, y: y, **{'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9})
    assert record.column('status')[-1] == Status.TRACKING
    assert record.column('m')[-1] == pytest.approx(1.3, rel=0.01)
    assert record.column('c_r')[-1] - record.column('c_l')[-1] < 0.05


SHIPPED = ROOT / 'config'


@pytest.mark.parametrize('amplitude', [0.8, 1.2])
def test_a_triangle_read_by_an_encoder_is_learned_from(amplitude: float) -> None:
    # One speed tells a lag from a gap at the turns alone. At the amplitude of the file, 1, y moves
    # by 26.08 steps of the encoder per sample: rounding that repeats is too coloured to learn from.
    p = read_configuration(SHIPPED / 'geared_motor.yaml').given()
    changed = Parameters({**p, 'waveform': 'triangle', 'amplitude': amplitude})
    record = build_closed_loop(changed).run(1600)
    later = slice(1000, None)
    assert np.mean(record.column('status')[later] == Status.TRACKING) > 0.8
    for name in ('m', 'c_r', 'c_l'):
        true = record.column(f'true_{name}')[later]
        assert np.abs(record.column(name)[later] / true - 1.0).max() < 0.01


def test_where_the_play_began_does_not_contradict_readings_that_were_rounded() -> None:
    # Labels before the first engagement are the least sure ones, and intervals the sharpest data.
    p = Parameters({
        **read_configuration(SHIPPED / 'geared_motor.yaml').given(), 'structure': 'proportional',
        'truth.scale_frequency': 0.8,
    })
    record = build_closed_loop(p).run(900)
    assert (record.column('status')[200:] == Status.TRACKING).all()
