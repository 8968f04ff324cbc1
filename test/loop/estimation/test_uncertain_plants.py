"""Learning from plants that differ from the nominal one, and from loads that coast."""

from __future__ import annotations

import numpy as np
import pytest
from cases.coasting_load import CoastingLoad
from cases.geared_motor import motor, random_backlash
from contract.learning_rows import Job, run_job
from places import ROOT
from scipy.signal import cont2discrete, lfilter

from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.tools.config import load_config

PERIOD = 0.005
SHIPPED = ROOT / 'config'


@pytest.mark.parametrize('amplitude', [0.8, 1.2])
def test_a_triangle_read_by_an_encoder_is_learned_from(amplitude: float) -> None:
    # One speed tells a lag from a gap at the turns alone. At the amplitude of the file, 1, y moves
    # by 26.08 steps of the encoder per sample: rounding that repeats is too coloured to learn from.
    p = load_config(SHIPPED / 'geared_motor.yaml')
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
        **load_config(SHIPPED / 'geared_motor.yaml'), 'structure': 'proportional',
        'truth.scale_frequency': 0.8,
    })
    record = build_closed_loop(p).run(900)
    assert (record.column('status')[200:] == Status.TRACKING).all()


def positions(load: CoastingLoad, control: np.ndarray) -> np.ndarray:
    result = []
    for v in control:
        result.append(load.measure())
        load.step(float(v))
    return np.array(result)


@pytest.mark.parametrize('seed', [0, 1])
def test_first_swap_waits_until_the_gap_was_crossed_with_the_first_estimate(seed: int) -> None:
    loop = build_closed_loop(Parameters({
        **motor(), **random_backlash(seed), 'seed': seed, 'structure': 'tracking',
        'truth.scale_frequency': 0.8,
    }))
    models: list[object] = []
    v = loop.run(800, lambda _: models.append(loop.controller.adopted)).column('v')
    moves = np.abs(np.diff(v, prepend=0.0))
    swaps = [k for k in range(1, 800) if models[k] is not models[k - 1]]
    assert swaps
    for k in swaps:
        assert moves[k:k + 5].max() <= moves[k - 200:k].max()


def test_load_that_is_pushed_follows_like_the_told_plant() -> None:
    load = CoastingLoad(Backlash(0.1, 0.5, -0.4), PERIOD)
    # Away from the gap, rising ever slower, it stays in contact.
    v = 0.5 + 20.0 * (1.0 - np.exp(-np.arange(400) * PERIOD / 0.5))
    w = 40.0 * np.pi
    b, a, _ = cont2discrete(([w * w], [1.0, w, w * w]), PERIOD, 'foh')
    p = np.append(v[0], v) * 0.1 - 0.05  # v(k) is reached when sample k + 1 is taken
    expected = lfilter(np.ravel(b), a, p)[:400]
    assert np.abs(positions(load, v) - expected).max() < 2e-3


def test_load_coasts_through_the_gap_until_friction_stops_it() -> None:
    control = np.append(np.linspace(0.0, 10.0, 100), np.full(300, 9.9))
    held = Backlash(0.1, 0.5, -0.4)
    for v in control:
        u = held.step(float(v))
    weak, strong, dry = (
        positions(CoastingLoad(Backlash(0.1, 0.5, -0.4), PERIOD, damping=d, dry=f), control)
        for d, f in ((0.05, 0.0), (2.0, 0.0), (0.05, 20.0))
    )
    assert weak.max() > u + 0.03
    assert strong.max() < u + 0.01
    assert u - 0.02 < dry.max() < weak.max()
    for end in (weak[-1], strong[-1], dry[-1]):
        assert u - 0.02 < end < u + 0.1
    assert dry[-100:].std() == 0.0


@pytest.mark.parametrize('seed', [6, 7])
def test_load_that_coasts_is_not_tracked_with_more_error_than_stated(seed: int) -> None:
    gear = {**motor(), **random_backlash(seed), 'seed': seed}
    found = run_job(Job('', gear, 10.0, {'damping': 0.5})).judged
    assert found is not None
    assert found.wrong <= 0.1
