"""The command replay: the run's own estimates to the last bit, or where it parts from them."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from undrawn import leave_out

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.replay import parting, replay
from backlash_ros.tools import simulate as simulate
from backlash_ros.tools.replay import main

NOISY = {'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3}
# Losses, a structure that feeds y back, a learned G, a law of another kind, a limited v.
RUNS: dict[str, dict[str, object]] = {
    'paper': NOISY,
    'losses': {**NOISY, 'output_loss': 0.2},
    'tracking': {**NOISY, 'structure': 'tracking', 'amplitude': 1.0, 'frequency': 3.0},
    'learned G': {**NOISY, 'plant.uncertainty': 0.2, 'truth.scale_frequency': 1.1,
                  'structure': 'tracking', 'amplitude': 1.0, 'frequency': 3.0},
    'lms': {**NOISY, 'estimator.law': 'lms'},
    'limits': {**NOISY, 'control.min': -8.0, 'control.max': 8.0, 'control.rate_max': 60.0},
}


@pytest.mark.parametrize('name', RUNS)
def test_a_replay_with_the_own_parameters_gives_the_own_estimates(name: str) -> None:
    parameters = Parameters({'plant.uncertainty': 0.0, **RUNS[name]})
    run = build_closed_loop(parameters).run(300)
    again = replay(run, parameters)
    assert parting(run, again) is None
    assert np.array_equal(again.rows, run.rows, equal_nan=True)
    assert repr(again.learned) == repr(run.learned)  # repr, as nan differs from itself


def test_other_parameters_part_from_the_run_and_learn_from_its_v() -> None:
    parameters = Parameters({'plant.uncertainty': 0.0, **NOISY})
    run = build_closed_loop(parameters).run(300)
    again = replay(run, parameters.replaced({'plant.uncertainty': 0.1}))
    parted = parting(run, again)
    assert parted is not None
    assert parted.t == pytest.approx(0.01 * parted.sample)
    assert parted.recorded != parted.replayed
    assert again.column('v').tolist() == run.column('v').tolist()
    assert again.column('c_r')[-1] == pytest.approx(3.0, rel=0.02)


def test_a_row_without_numbers_is_refused() -> None:
    parameters = Parameters(NOISY)
    run = build_closed_loop(parameters).run(50)
    run.rows[20, 2] = np.nan
    with pytest.raises(ValueError, match=r't=0\.2'):
        replay(run, parameters)


@pytest.fixture(scope='module')
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('run') / 'run'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, 'print_png', leave_out)
        assert simulate.main(['--duration', '3', '--set', 'output_noise_std=1e-3',
                              '--out', str(folder)]) == 0
    return folder


@pytest.mark.usefixtures('undrawn')
def test_the_command_says_that_nothing_parts_or_where(recorded, tmp_path, capsys):
    assert main([str(recorded), '--set', 'plant.uncertainty=0.1', '--out', str(tmp_path)]) == 0
    assert 'part from those of the run at t = 0.' in capsys.readouterr().out
    assert main([str(recorded), '--out', str(tmp_path)]) == 0
    assert 'to the last bit' in capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert {'replay.png', 'report.html', 'summary.json', 'samples.csv', 'record.npz'} <= names
    own, again = (json.loads((folder / 'summary.json').read_text())
                  for folder in (recorded, tmp_path))
    assert again['final'] == own['final']
    assert again['truth'] == own['truth']


@pytest.mark.parametrize('arguments', [
    [], ['nowhere'], ['RUN', '--set', 'nothing=1'], ['RUN', '--set', 'x/amplitude=1'],
    ['RUN', '--sweep', 'amplitude'], ['RUN', '--from', '2', '--to', '1'],
    ['RUN', '--set', 'estimator.bounds.m=[2.0, 3.0]'],
])
def test_bad_input_is_told_in_one_line(recorded, tmp_path, capsys, arguments):
    given = [str(recorded) if word == 'RUN' else word for word in arguments]
    assert main([*given, '--out', str(tmp_path)]) == 2
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize('repeated', [1, 3])
def test_a_log_tells_what_the_controller_would_have_learned_from_it(tmp_path, capsys, repeated):
    run = build_closed_loop(Parameters({'plant.uncertainty': 0.0, **NOISY})).run(300)
    log, config = tmp_path / 'log.csv', tmp_path / 'a.yaml'
    y = run.column('y')[repeated * (np.arange(300) // repeated)]
    log.write_text('time_ms;command;position\n' + ''.join(
        f'{1e3 * t!r};{v!r};{y_k!r}\n' for t, v, y_k in zip(
            run.column('t').tolist(), run.column('v').tolist(), y.tolist(), strict=True)))
    config.write_text('/**: {ros__parameters: {plant: {uncertainty: 0.0}}}')
    assert main([str(log), '--out', str(tmp_path / 'out')]) == 2
    assert 'is a log: give --config' in capsys.readouterr().err
    assert main([str(log), '--config', str(config), '--out', str(tmp_path / 'out')]) == 0
    said = capsys.readouterr()
    assert 'states: acquiring from 0 s, tracking from' in said.out
    assert ('y repeats 3 times' in said.err) is (repeated == 3)
    final = json.loads((tmp_path / 'out' / 'summary.json').read_text())['final']
    assert final['c_r'] == pytest.approx(3.0, rel=0.02)
    assert final['c_l'] == pytest.approx(-3.0, rel=0.02)
