"""Readings that are none: repeated ones, failed ones, angles that begin anew; and what looks so."""

import numpy as np
import pytest
from numpy.typing import NDArray

from backlash_ros.core.records.readings import (
    failed,
    own_readings,
    quantum,
    unwrapped,
    without_slips,
)
from backlash_ros.core.records.record import Record
from backlash_ros.core.records.rows_to_record import record_of

Array = NDArray[np.float64]
T = 0.005 * np.arange(3000)
MOTION = np.sin(3.0 * T) + 0.2 * np.sin(7.0 * T)
SQUARE = np.where(np.sin(3.0 * T) > 0.0, 360.0, 0.0)
STEPPED = 40.0 * np.round(8.0 * MOTION)  # what jumps from rest to rest
NOISE = 1e-3 * np.random.default_rng(1).standard_normal(len(T))


def repeated(times: int) -> Array:
    return (MOTION + NOISE)[times * (np.arange(len(T)) // times)]


@pytest.mark.parametrize('times', [2, 3, 5, 12])
def test_rows_that_repeat_a_slower_sensor_are_no_readings(times: int) -> None:
    own, period = own_readings(T, repeated(times))
    assert own.tolist() == (np.arange(len(T)) % times == 0).tolist()
    assert period == pytest.approx(times * 0.005)


@pytest.mark.parametrize('y', [
    MOTION + NOISE, np.round(20.0 * MOTION), SQUARE, STEPPED, np.zeros(len(T)), MOTION[:20],
    np.where(np.arange(len(T)) % 2 == 0, MOTION, np.nan),
], ids=['noise', 'coarse', 'square', 'stepped', 'rest', 'short', 'every second'])
def test_what_only_looks_repeated_is_kept(y: Array) -> None:
    own, period = own_readings(T[:len(y)], y)
    assert (own.tolist(), period) == (np.isfinite(y).tolist(), 0.0)


@pytest.mark.parametrize('value', [0.0, -1.0, 65535.0])
@pytest.mark.parametrize('share', [0.002, 0.3])
def test_reads_that_failed_are_lost(value: float, share: float) -> None:
    y = 2.0 + MOTION
    wrong = np.random.default_rng(4).random(len(y)) < share
    y[wrong] = value
    found, told = failed(y)
    assert told == value
    # Three in a row are rare enough.
    assert found.tolist() == wrong.tolist()
    assert np.isnan(record_of(T, MOTION, y).y[wrong]).all()


@pytest.mark.parametrize('y', [MOTION, np.round(20.0 * MOTION), SQUARE, STEPPED, MOTION[:8]])
def test_values_that_a_motion_passes_are_readings(y: Array) -> None:
    assert not failed(y)[0].any()


@pytest.mark.parametrize('turn', [360.0, 2.0 * np.pi, 4096.0])
@pytest.mark.parametrize('step', [0.0, 0.5])
def test_an_angle_that_begins_anew_is_unwrapped(turn: float, step: float) -> None:
    angle = turn * (0.9 * MOTION + 0.3)
    angle = np.round(angle / step) * step if step * 100 < turn and step else angle
    found, told = unwrapped(np.mod(angle, turn))
    assert told == turn
    assert found - found[0] == pytest.approx(angle - angle[0], abs=1e-9 * turn)
    record: Record = record_of(T, MOTION, np.mod(angle, turn))
    assert any('begins anew' in note for note in record.notes)


@pytest.mark.parametrize('values', [
    SQUARE, 360.0 * MOTION, 180.0 * MOTION, STEPPED, MOTION[:8],
    360.0 * np.mod(np.arange(len(T)) * 0.37, 1.0),
], ids=['square', 'smooth', 'half', 'stepped', 'short', 'too fast'])
def test_what_only_jumps_is_not_unwrapped(values: Array) -> None:
    found, told = unwrapped(values)
    assert told == 0.0
    assert found is values


@pytest.mark.parametrize('turn', [2.0 * np.pi, -360.0])
def test_a_turn_that_was_lost_is_taken_out_and_said(turn: float) -> None:
    slipped = MOTION + NOISE + np.where((T > 3.0) & (T < 9.0), turn, 0.0)
    record = record_of(T, 1.2 * MOTION, slipped)
    assert record.y == pytest.approx(MOTION + NOISE, abs=1e-9)
    assert 'a whole turn, while v does not: taken out' in record.notes[0]


@pytest.mark.parametrize(('v', 'y'), [
    (SQUARE, SQUARE), (MOTION, MOTION + np.where(T > 3.0, 6.0, 0.0)), (STEPPED, 9.0 * STEPPED),
], ids=['v jumps', 'no whole turn', 'stepped'])
def test_what_v_does_and_what_is_no_turn_is_kept(v: Array, y: Array) -> None:
    assert without_slips(y, v)[1] == 0.0


@pytest.mark.parametrize(('y', 'step'), [
    (MOTION, 0.0), (np.round(MOTION, 1), 0.1), (0.25 * np.round(200.0 * MOTION) + 8e8, 0.25),
    # an encoder, in a file of few digits
    (np.round(np.round(MOTION * 64.0) / 64.0, 3), 1.0 / 64.0),
    (np.full(9, 3.0), 0.0),
])
def test_the_step_of_a_quantised_y_is_told(y: Array, step: float) -> None:
    assert quantum(y) == pytest.approx(step, rel=1e-3)
