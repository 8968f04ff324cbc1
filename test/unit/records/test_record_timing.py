"""Rows with stamps and readings of every kind: v and y at the instants that were meant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from backlash_ros.core.records import readings
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.stamps import spread_evenly
from backlash_ros.core.records.time_grid import averaged, record_of

Array = NDArray[np.float64]
PERIOD_S, COUNT = 0.01, 1200


def position(t: Array) -> Array:
    return np.asarray(np.sin(5.0 * t) + 0.4 * np.sin(11.0 * t + 1.0))


def command(t: Array) -> Array:
    return np.asarray(1.2 * np.sin(5.0 * t + 0.1))


def log(t: Array, noise: float = 1e-3, stamps: Array | None = None, **more: float) -> Record:
    y = position(t) + noise * np.random.default_rng(2).standard_normal(len(t))
    return record_of(t if stamps is None else stamps, command(t), y, **more)


def even(count: int = COUNT) -> Array:
    return PERIOD_S * np.arange(count)


def off(record: Record, begin: float = 0.0) -> float:
    t = begin + record.sample_period * np.arange(len(record.y))
    return float(np.sqrt(np.nanmean((record.y - position(t))**2)))


def test_even_rows_stay_as_they_are() -> None:
    record = log(even())
    assert record.sample_period == PERIOD_S
    assert record.v.tolist() == command(even()).tolist()
    assert record.lost == 0
    assert record.timing == '1200 rows, one every 10 ms'


@pytest.mark.parametrize('jitter', [0.02, 0.08, 0.2, 0.5])
def test_readings_are_moved_from_their_true_instants_onto_the_grid(jitter: float) -> None:
    t = np.sort(even() + jitter * PERIOD_S * np.random.default_rng(1).uniform(-1.0, 1.0, COUNT))
    record = log(t)
    assert 'v and y are taken at them' in record.timing
    assert record.sample_period == pytest.approx(PERIOD_S, rel=2e-3)
    assert np.count_nonzero(np.isfinite(record.y)) > 0.9 * COUNT
    # As good as the noise, where rows by number would be off by the speed times the jitter.
    begin = t[0] + _begin(record, t)
    assert off(record, begin) < 1.3e-3
    assert np.abs(np.asarray(record.v) - command(
        begin + record.sample_period * np.arange(len(record.v)))).mean() < 0.06


def _begin(record: Record, t: Array) -> float:
    """Time of the first sample after that of the first row, by the v that is known at any time."""
    shifts = np.linspace(-0.6, 0.6, 241) * PERIOD_S
    k = record.sample_period * np.arange(len(record.y))
    errors = [np.nanmean((record.y - position(t[0] + shift + k))**2) for shift in shifts]
    return float(shifts[int(np.argmin(errors))])


def test_steps_that_vary_from_row_to_row_are_true_instants() -> None:
    t = np.cumsum(PERIOD_S * np.random.default_rng(3).choice([1.0, 1.0, 1.0, 1.4], COUNT))
    record = log(t)
    assert off(record, t[0] + _begin(record, t)) < 2e-3


def test_late_stamps_of_even_samples_are_numbered() -> None:
    late = 0.7 * PERIOD_S * np.random.default_rng(1).random(COUNT)
    record = log(even(), stamps=even() + late)
    assert 'rows are numbered' in record.timing
    assert record.sample_period == pytest.approx(PERIOD_S, rel=1e-3)
    assert record.v.tolist() == command(even()).tolist()
    assert off(record) < 1.1e-3


@pytest.mark.parametrize('lost', [0.0, 0.01, 0.1])
@pytest.mark.parametrize('jitter', ['normal', 'uniform', 'late'])
@pytest.mark.parametrize('count', [300, 3000])
def test_where_stamps_jitter_missing_rows_are_told_from_a_shorter_period(
    count: int, jitter: str, lost: float,
) -> None:
    random = np.random.default_rng(count)
    shift = {'normal': random.normal(0.0, 0.3, count), 'uniform': random.uniform(-0.5, 0.5, count),
             'late': random.exponential(0.3, count)}[jitter]
    kept = random.random(count) >= lost
    kept[0] = kept[-1] = True
    t = even(count)
    stamps = np.maximum.accumulate(t + PERIOD_S * shift)
    record = log(t[kept], stamps=stamps[kept])
    assert 'rows are numbered' in record.timing
    assert record.sample_period == pytest.approx(PERIOD_S, rel=0.5 / count)
    # A row next to a hole may be on either side of it, the first one as well.
    assert record.lost == pytest.approx(count - kept.sum(), abs=1 + 0.02 * count)
    t = PERIOD_S * np.arange(len(record.y))
    shares = [np.mean(np.abs(record.y - position(t + by * PERIOD_S))[np.isfinite(record.y)] < 6e-3)
              for by in (-1, 0, 1)]
    assert max(shares) > 0.93


def test_a_period_far_below_the_steps_of_a_coarse_clock_is_kept() -> None:
    t = np.cumsum(np.tile([0.0, 0.0, 0.5], 100))
    slow = 1e-3 * np.arange(300)  # moves little from one equal stamp to the next
    record = record_of(t, command(t) + slow, position(t) + slow, period=0.012)
    assert record.sample_period == 0.012
    assert '199 rows with equal stamps' in record.timing


@pytest.mark.parametrize(('unit_s', 'scale', 'origin'), [
    (1e-3, 1e3, 0.0), (1e-6, 1e6, 5.0), (None, 1e9, 1.7e9), (None, 1e3, 1.7e9),
])
def test_stamps_may_count_other_units(unit_s: float | None, scale: float, origin: float) -> None:
    stamps = np.round((even() + origin) * scale)
    record = record_of(stamps, command(even()), position(even()), unit_s=unit_s)
    assert record.sample_period == pytest.approx(PERIOD_S, rel=1e-3)
    assert len(record.v) == COUNT


def test_stamps_that_count_samples_or_milliseconds_are_told_by_the_period() -> None:
    for step, said in ((1.0, 't counts the samples'), (10.0, 't counts 1 ms')):
        record = log(even(), stamps=step * np.arange(COUNT), period=PERIOD_S)
        assert record.sample_period == PERIOD_S
        assert len(record.v) == COUNT
        assert said in record.timing
    assert '--period' in log(even(), stamps=np.arange(0.0, COUNT)).timing


def test_a_longer_period_than_that_of_the_stamps_is_kept_with_the_time() -> None:
    record = log(even(), period=2.0 * PERIOD_S)
    assert record.sample_period == 2.0 * PERIOD_S
    assert len(record.v) == pytest.approx(COUNT / 2, abs=1)
    assert off(record) < 1.3e-3


def test_equal_stamps_of_a_coarse_clock_keep_the_mean_period() -> None:
    for rows in (2, 3, 8):
        record = log(even(), stamps=even()[rows * (np.arange(COUNT) // rows)])
        assert record.sample_period == pytest.approx(PERIOD_S, rel=1e-6)
        assert record.lost == 0
        assert off(record) < 1.1e-3


@pytest.mark.parametrize(('lost', 'early_s'), [(0, 0.0), (40, 0.05)])
def test_stamps_with_too_few_digits_make_no_sample_up(lost: int, early_s: float) -> None:
    t = np.delete(even(), slice(600, 600 + lost))
    record = log(t, stamps=np.round(t - early_s, 1))  # 9 to 11 rows have the same one
    assert record.sample_period == PERIOD_S
    assert record.lost == lost
    assert off(record) < 1.3e-3


def test_rows_that_share_a_stamp_end_before_the_next_one() -> None:
    lost = np.random.default_rng(3).random(COUNT) < 0.1
    t = even()[~lost]
    said: list[str] = []
    spread = spread_evenly(np.floor(t / 0.1) * 0.1, said, command(t))
    assert said
    assert (np.diff(spread) > 0.0).all()


def test_a_period_shorter_than_the_time_from_row_to_row_leaves_samples_without_a_reading() -> None:
    stamps = even() + 0.2 * PERIOD_S * np.random.default_rng(5).uniform(-1.0, 1.0, COUNT)
    record = log(even(), stamps=stamps, period=0.2 * PERIOD_S)
    assert record.sample_period == 0.2 * PERIOD_S
    assert record.lost == pytest.approx(4 * COUNT, rel=0.01)


def test_rows_with_equal_stamps_that_do_not_move_are_one_reading() -> None:
    stamps = even()[2 * (np.arange(COUNT) // 2)]
    record = record_of(stamps, command(stamps), position(stamps) + 1e-9 * even())
    assert record.sample_period == pytest.approx(2.0 * PERIOD_S, rel=1e-3) or record.lost > 500


@pytest.mark.parametrize(('around', 'unit_s'), [
    (86400.0, 1.0), (2.0**32, 1e-3), (2.0**32, 1e-6), (2.0**16, 1e-3), (3600.0, 1.0),
])
def test_a_clock_that_begins_anew_is_counted_on(around: float, unit_s: float) -> None:
    stamps = np.round(np.mod(around - 5.0 / unit_s + even() / unit_s, around), 6)
    record = record_of(stamps, command(even()), position(even()), unit_s=unit_s)
    assert record.y.tolist() == position(even()).tolist()
    assert record.sample_period == pytest.approx(PERIOD_S, rel=1e-6)
    assert 'continued' in record.timing


def test_missing_rows_of_even_stamps_are_counted() -> None:
    kept = np.random.default_rng(1).random(COUNT) > 0.2
    record = log(even()[kept])
    assert record.sample_period == PERIOD_S
    assert record.lost == len(record.y) - np.count_nonzero(kept)


@pytest.mark.parametrize('stamps', [None, np.zeros(COUNT), np.full(COUNT, np.nan)])
def test_without_a_time_rows_are_counted_with_the_period_alone(stamps: Array | None) -> None:
    v, y = command(even()), position(even())
    with pytest.raises(RecordError, match='give --period S'):
        record_of(stamps, v, y)
    assert record_of(stamps, v, y, PERIOD_S).v.tolist() == v.tolist()


def test_rows_in_any_order_are_sorted() -> None:
    t, shuffled = even(), np.arange(COUNT)
    for k in (100, 300, 500):
        shuffled[[k, k + 1]] = shuffled[[k + 1, k]]
    expected = log(t, noise=0.0).y.tolist()
    for order, said in ((np.arange(COUNT)[::-1], 'reversed'), (shuffled, 'sorted')):
        record = record_of(t[order], command(t)[order], position(t)[order])
        assert record.y.tolist() == expected
        assert said in record.timing


@pytest.mark.parametrize('bad', [0.0, 3e7, 9.2e18, np.nan])
@pytest.mark.parametrize('rows', [[0], [600], [COUNT - 1], [200, 201, 700]])
def test_stamps_that_are_none_are_left_out_and_counted(bad: float, rows: list[int]) -> None:
    stamps = even() + 1e6
    stamps[rows] = bad
    record = log(even(), stamps=stamps)
    assert f'{len(rows)} row{"s" * (len(rows) > 1)} with' in record.timing
    kept = np.delete(np.arange(COUNT), rows)
    assert len(record.v) == kept[-1] - kept[0] + 1
    assert record.lost == len(record.v) - len(kept)
    assert off(record, PERIOD_S * kept[0]) < 1.1e-3


def test_the_longest_run_of_a_log_with_several_is_used() -> None:
    record = log(np.concatenate([even(300), even(700), even(200)]))
    assert len(record.v) == 700
    assert 'restarts 2 times' in record.timing


def test_a_short_gap_is_missing_samples_and_a_long_one_ends_the_record() -> None:
    record = log(np.concatenate([even(500), even(500) + 5.1]))
    assert (len(record.v), record.lost) == (1010, 10)
    assert set(record.v[499:510]) == {command(even()[499:500])[0]}
    record = log(np.concatenate([even(500), even(700) + 3e5]))
    assert len(record.v) == 700
    assert 'long break' in record.timing


def test_rows_that_repeat_the_one_before_count_once() -> None:
    record = log(np.repeat(even(), 2), noise=0.0)
    assert record.v.tolist() == command(even()).tolist()
    assert '1200 rows that repeat' in record.timing


def test_where_moving_y_would_show_the_grid_is_finer() -> None:
    t = np.sort(even() + 0.4 * PERIOD_S * np.random.default_rng(1).uniform(-1.0, 1.0, COUNT))
    record = record_of(t, 1.1 * np.sin(90.0 * t), np.sin(90.0 * t))
    assert record.sample_period <= 0.51 * PERIOD_S
    assert np.count_nonzero(np.isfinite(record.y)) > 0.97 * COUNT


def test_v_that_is_sent_more_often_than_y_is_read_is_averaged() -> None:
    t = np.arange(0.0, 6.0, 0.001)
    y = np.where(np.arange(len(t)) % 10 == 0, position(t), np.nan)
    v = np.where(np.arange(len(t)) % 10 == 0, np.nan, command(t))
    record = record_of(t, v, y)
    assert record.sample_period == pytest.approx(PERIOD_S)
    middle = PERIOD_S * np.arange(len(record.v)) + 0.0045  # v holds
    assert record.v[1:-1] == pytest.approx(command(middle)[1:-1], abs=1e-3)
    assert off(record) < 1e-9


@given(st.lists(st.floats(0.3, 2.0), min_size=30, max_size=60), st.integers(0, 10**6))
def test_averaging_keeps_what_v_sums_up_to_at_every_time(steps: list[float], seed: int) -> None:
    t = np.append(0.0, np.cumsum(steps))
    v = np.random.default_rng(seed).standard_normal(len(t))
    grid = averaged(t, v, 0.7, 30)
    edges = 0.7 * np.arange(1, 31)
    held = [np.sum(v * np.clip(np.append(t[1:], np.inf).clip(max=edge) - t, 0.0, None))
            for edge in edges]
    assert np.cumsum(grid) * 0.7 == pytest.approx(np.array(held), abs=1e-9)


@pytest.mark.parametrize(('t', 'said'), [
    ([0.0], 'which is no motion'), ([0.0, 5.0, 1.0, 7.0, 2.0, 9.0, 0.0] * 9, 'falls back'),
])
def test_stamps_without_sense_are_told(t: list[float], said: str) -> None:
    stamps = np.array(t)
    with pytest.raises(RecordError, match=said):
        record_of(stamps, stamps + 1.0, stamps)


def test_a_stretch_of_one_stamp_is_refused() -> None:
    stamps, motion = np.append(np.zeros(50), 1e6 + np.arange(21.0)), np.sin(0.3 * np.arange(71))
    with pytest.raises(RecordError, match='t does not rise steadily: give --period S'):
        record_of(stamps, motion, np.roll(motion, 1))


T = 0.005 * np.arange(3000)
MOTION = np.sin(3.0 * T) + 0.2 * np.sin(7.0 * T)
SQUARE = np.where(np.sin(3.0 * T) > 0.0, 360.0, 0.0)
STEPPED = 40.0 * np.round(8.0 * MOTION)  # what jumps from rest to rest
NOISE = 1e-3 * np.random.default_rng(1).standard_normal(len(T))


def repeated(times: int) -> Array:
    return (MOTION + NOISE)[times * (np.arange(len(T)) // times)]


@pytest.mark.parametrize('times', [2, 3, 5, 12])
def test_rows_that_repeat_a_slower_sensor_are_no_readings(times: int) -> None:
    own, period = readings.own_readings(T, repeated(times))
    assert own.tolist() == (np.arange(len(T)) % times == 0).tolist()
    assert period == pytest.approx(times * 0.005)


@pytest.mark.parametrize('y', [
    MOTION + NOISE, np.round(20.0 * MOTION), SQUARE, STEPPED, np.zeros(len(T)), MOTION[:20],
    np.where(np.arange(len(T)) % 2 == 0, MOTION, np.nan),
], ids=['noise', 'coarse', 'square', 'stepped', 'rest', 'short', 'every second'])
def test_what_only_looks_repeated_is_kept(y: Array) -> None:
    own, period = readings.own_readings(T[:len(y)], y)
    assert (own.tolist(), period) == (np.isfinite(y).tolist(), 0.0)


@pytest.mark.parametrize('value', [0.0, -1.0, 65535.0])
@pytest.mark.parametrize('share', [0.002, 0.3])
def test_reads_that_failed_are_lost(value: float, share: float) -> None:
    y = 2.0 + MOTION
    wrong = np.random.default_rng(4).random(len(y)) < share
    y[wrong] = value
    found, told = readings.failed(y)
    assert told == value
    assert found.tolist() == wrong.tolist()
    assert np.isnan(record_of(T, MOTION, y).y[wrong]).all()


@pytest.mark.parametrize('y', [MOTION, np.round(20.0 * MOTION), SQUARE, STEPPED, MOTION[:8]])
def test_values_that_a_motion_passes_are_readings(y: Array) -> None:
    assert not readings.failed(y)[0].any()


@pytest.mark.parametrize('turn', [360.0, 2.0 * np.pi, 4096.0])
@pytest.mark.parametrize('step', [0.0, 0.5])
def test_an_angle_that_begins_anew_is_unwrapped(turn: float, step: float) -> None:
    angle = turn * (0.9 * MOTION + 0.3)
    angle = np.round(angle / step) * step if step * 100 < turn and step else angle
    found, told = readings.unwrapped(np.mod(angle, turn))
    assert told == turn
    assert found - found[0] == pytest.approx(angle - angle[0], abs=1e-9 * turn)
    record: Record = record_of(T, MOTION, np.mod(angle, turn))
    assert any('wraps around' in note for note in record.notes)
    # Where v and y come in rows of their own, v is what those of v say.
    nothing, shift = np.full(len(T), np.nan), 0.25 * (T[1] - T[0])
    apart: Record = record_of(
        np.column_stack([T, T + shift]).ravel(),
        np.column_stack([nothing, np.mod(angle, turn)]).ravel(),
        np.column_stack([MOTION, nothing]).ravel())
    assert np.abs(np.diff(apart.v)).max() < 0.5 * turn
    assert [note.split()[0] for note in apart.notes if 'wraps around' in note] == ['v']


@pytest.mark.parametrize('values', [
    SQUARE, 360.0 * MOTION, 180.0 * MOTION, STEPPED, MOTION[:8],
    360.0 * np.mod(np.arange(len(T)) * 0.37, 1.0),
], ids=['square', 'smooth', 'half', 'stepped', 'short', 'too fast'])
def test_what_only_jumps_is_not_unwrapped(values: Array) -> None:
    found, told = readings.unwrapped(values)
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
    assert readings.without_slips(y, v)[1] == 0.0


@pytest.mark.parametrize(('y', 'step'), [
    (MOTION, 0.0), (np.round(MOTION, 1), 0.1), (0.25 * np.round(200.0 * MOTION) + 8e8, 0.25),
    # an encoder, in a file of few digits
    (np.round(np.round(MOTION * 64.0) / 64.0, 3), 1.0 / 64.0), (np.full(9, 3.0), 0.0),
    # of a fast motion, none of them twice
    (0.25 * np.cumsum([35.0, 10.0, 45.0, 14.0, 40.0, 25.0, 6.0, 55.0]), 0.25),
])
def test_the_step_of_a_quantised_y_is_told(y: Array, step: float) -> None:
    assert readings.quantum(y) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize(('scale', 'asks'), [(1e3, True), (1.0, False)])
def test_milliseconds_with_decimals_are_not_taken_for_seconds_without_a_word(
    scale: float, asks: bool,
) -> None:
    jitter = 1e-4 * PERIOD_S * np.random.default_rng(0).uniform(-1.0, 1.0, COUNT)
    record = log(even(), stamps=scale * (even() + jitter))
    assert ('if it counts something else: --period' in record.timing) is asks
