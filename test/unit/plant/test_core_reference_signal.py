"""Reference signals y_m(t), from a formula or from a CSV file."""

from math import pi
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core.parameters import BY_NAME, ParameterError, Parameters
from backlash_ros.core.reference.signal import ReferenceSignal

OMEGA = 2.0 * pi  # a period of one second


def signal(waveform: str, samples: tuple[float, ...] = (), **values: object) -> ReferenceSignal:
    return ReferenceSignal(
        Parameters({'waveform': waveform, 'amplitude': 1.0, 'frequency': OMEGA, **values}), samples
    )


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
    ('', 'header t,y_m'),
    ('t,y_m\n0,1,2\n', 'line 2 must hold t,y_m'),
    ('t,y_m\n0,1\n0.02,2\n', 'line 3 must hold t=0.01'),
    ('t,y_m\n0,nan\n', 'finite y_m'),
    ('t,y_m\n', 'at least one sample'),
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
