"""Learning from plants that differ from the nominal one, and from loads that coast."""

import numpy as np
import pytest
from places import ROOT

from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.tools.config import read_configuration

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
