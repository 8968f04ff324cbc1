"""y_m(t) from a formula or a CSV file; how often it leaves and for which sample."""

from itertools import pairwise
from math import pi
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.loop.sample_counter import ReferencePace, SampleCounter
from backlash_ros.core.parameters import BY_NAME, ParameterError, Parameters
from backlash_ros.core.scenario import ReferenceSignal

OMEGA = 2.0 * pi  # a period of one second


def signal(waveform: str, samples: tuple[float, ...] = (), **values: object) -> ReferenceSignal:
    return ReferenceSignal(
        Parameters({'waveform': waveform, 'amplitude': 1.0, 'frequency': OMEGA, **values}), samples)


@given(t=st.floats(0.0, 100.0), amplitude=st.floats(0.0, 10.0), bias=st.floats(-10.0, 10.0),
       waveform=st.sampled_from([w for w in BY_NAME['waveform'].choices if w != 'file']))
def test_every_waveform_stays_within_amplitude_around_bias(t, amplitude, bias, waveform):
    y_m = signal(waveform, amplitude=amplitude, bias=bias)(t)
    assert abs(y_m - bias) <= amplitude + 1e-9


@pytest.mark.parametrize(('waveform', 't', 'value'), [
    ('sine', 0.0, 1.0), ('sine', 0.25, 3.0), ('sine', 0.75, -1.0),
    ('step', 0.0, 1.0), ('step', 0.49, 1.0), ('step', 0.51, 3.0), ('step', 7.0, 3.0),
    ('square', 0.1, 3.0), ('square', 0.6, -1.0), ('square', 1.1, 3.0),
    ('triangle', 0.0, 1.0), ('triangle', 0.125, 2.0), ('triangle', 0.25, 3.0),
    ('triangle', 0.375, 2.0), ('triangle', 0.75, -1.0),
])
def test_shape_of(waveform: str, t: float, value: float) -> None:
    assert signal(waveform, amplitude=2.0, bias=1.0)(t) == pytest.approx(value)


def test_chirp_sweeps_its_frequency_and_starts_again() -> None:
    chirp = signal('chirp', frequency=20.0, frequency_start=2.0, sweep_time=10.0)
    step = 1e-4
    def frequency(t: float) -> float:
        slope = (chirp(t + step) - chirp(t - step)) / (2.0 * step)
        return abs(slope) / (1.0 - chirp(t) ** 2) ** 0.5
    for t, omega in ((0.1, 2.18), (5.0, 11.0), (9.9, 19.82)):
        assert frequency(t) == pytest.approx(omega, rel=0.01)
    assert chirp(13.3) == pytest.approx(chirp(3.3))


@given(k=st.integers(0, 20000), period=st.sampled_from([0.001, 0.01, 0.02, 0.1, 1.0 / 3.0]))
def test_file_plays_sample_k_at_the_kth_period_whatever_the_rounding(k, period):
    reference = signal('file', tuple(float(i) for i in range(20001)), sample_period=period)
    assert reference(k * period) == float(k)


@pytest.mark.parametrize(('text', 'complaint'), [
    ('', 'header t,y_m'), ('t,y_m\n0,1,2\n', 'line 2 must hold t=0 and a finite y_m'),
    ('t,y_m\n0,1\n0.02,2\n', 'line 3 must hold t=0.01'),
    ('t,y_m\n0,nan\n', 'finite y_m'), ('t,y_m\n', 'at least one sample'),
])
def test_a_reference_file_is_refused_with_its_line(tmp_path, text, complaint):
    file = tmp_path / 'reference.csv'
    file.write_text(text)
    with pytest.raises(ParameterError, match=complaint):
        signal('file', file=str(file))


def test_a_reference_file_gives_one_value_per_period(tmp_path: Path) -> None:
    file = tmp_path / 'reference.csv'
    file.write_text('t,y_m\n0,1\n0.010000001,-2.5\n')
    reference = signal('file', file=str(file))
    assert [reference(t) for t in (0.0, 0.01, 7.0)] == [1.0, -2.5, -2.5]


PERIOD_S = 0.005
STEP_S = PERIOD_S / 50.0  # by which the tests let time go on
S_TO_NS, ROUNDING_S = 1e9, 1e-9

arrival_gaps = st.lists(st.floats(0.05, 6.0), min_size=20, max_size=120)  # periods


def messages_of(
    arrivals_s: list[float], end_s: float, sleeps: bool = True,
) -> list[tuple[float, int]]:
    """When y_m left for which sample, with outputs that arrive at these times [s].

    sleeps: whether the node looks for outputs only when it has something to do, as it really does.
    """
    pace = ReferencePace(PERIOD_S, waits=True, now_s=0.0)
    counter = SampleCounter(PERIOD_S)
    waiting, sent = list(arrivals_s), []
    now = 0.0
    while now < end_s:
        if not sleeps or now >= pace.due_s:
            heard = [at for at in waiting if at <= now]
            waiting = waiting[len(heard):]
            for at in heard:
                if counter.count(int((1.0 + at) * S_TO_NS)).is_sample:
                    pace.hear(counter.index, at)
        sample = pace.sample_to_send(now)
        if sample is not None:
            sent.append((now, sample))
        now += STEP_S
    return sent


def times(count: int, period_s: float = PERIOD_S) -> list[float]:
    return [0.5 * PERIOD_S + k * period_s for k in range(count)]


def test_reference_of_the_next_sample_leaves_half_a_period_after_each_output() -> None:
    arrivals = times(100)
    sent = messages_of(arrivals, 100 * PERIOD_S)[2:]
    for at, sample in sent:
        assert at - arrivals[sample - 1] == pytest.approx(0.5 * PERIOD_S, abs=2 * STEP_S)
    assert [sample for _, sample in sent] == list(range(sent[0][1], sent[0][1] + len(sent)))


@given(arrival_gaps, st.booleans())
def test_there_is_never_more_than_a_message_per_period_nor_two_close_together(gaps, sleeps):
    arrivals, at = [], 0.0
    for gap in gaps:
        at += gap * PERIOD_S
        arrivals.append(at)
    end_s = at + 10 * PERIOD_S
    sent = messages_of(arrivals, end_s, sleeps)
    gaps = [later - earlier for (earlier, _), (later, _) in pairwise(sent)]
    assert min(gaps) >= 0.5 * PERIOD_S - ROUNDING_S
    assert len(sent) <= end_s / PERIOD_S + 2
    samples = [sample for _, sample in sent]
    begun = [sample for sample in samples if sample > 0]
    assert begun == sorted(set(begun))


def test_a_node_that_waits_for_nobody_goes_on_by_its_own_clock() -> None:
    pace = ReferencePace(PERIOD_S, waits=False, now_s=0.0)
    sent = [pace.sample_to_send(k * STEP_S) for k in range(1000)]
    assert [sample for sample in sent if sample is not None] == list(range(20))
    pace.hear(7, 1000 * STEP_S)
    assert pace.sample_to_send(1001 * STEP_S) == 20
    pace.hear(8, 1050 * STEP_S)
    assert pace.sample_to_send(1060 * STEP_S) is None
    assert pace.sample_to_send(1076 * STEP_S) == 21


def test_signal_goes_on_by_the_own_clock_once_outputs_are_no_longer_waited_for() -> None:
    pace = ReferencePace(PERIOD_S, waits=True, now_s=0.0)
    assert [pace.sample_to_send(k * PERIOD_S) for k in range(3)] == [0, 0, 0]
    assert pace.waits
    pace.waits = False
    sent = [pace.sample_to_send(k * PERIOD_S) for k in range(3, 6)]
    assert sent == [0, 1, 2]
