"""y_m from a CSV file."""

from pathlib import Path

import pytest

from backlash_ros.core.assembly import build_reference
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.reference.signal import read_reference_file


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('', 'header t,y_m'),
        ('t,y_m\n0,1,2\n', 'line 2 must hold t,y_m'),
        ('t,y_m\n0,1\n0.02,2\n', 'line 3 must hold t=0.01'),
        ('t,y_m\n0,nan\n', 'finite y_m'),
        ('t,y_m\n', 'at least one sample'),
    ],
)
def test_a_reference_file_is_refused_with_its_line(tmp_path, text, complaint):
    file = tmp_path / 'reference.csv'
    file.write_text(text)
    parameters = Parameters({'waveform': 'file', 'file': str(file)})
    with pytest.raises(ParameterError, match=complaint):
        build_reference(parameters)


def test_a_reference_file_gives_one_value_per_period(tmp_path: Path) -> None:
    file = tmp_path / 'reference.csv'
    file.write_text('t,y_m\n0,1\n0.010000001,-2.5\n')
    parameters = Parameters({'waveform': 'file', 'file': str(file)})
    assert read_reference_file(parameters) == (1.0, -2.5)
