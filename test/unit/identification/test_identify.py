"""The command identify: records of every kind, the files it writes, what it says and returns."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_identification import PERIOD_S, motion, record

from backlash_ros.core import Estimate, Parameters, build_controller
from backlash_ros.core.estimate import save_estimate
from backlash_ros.tools import simulate as simulate
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.identify.command import main
from backlash_ros.tools.records.reading import read_record

QUICK = ('--order', '1-2', '--delay', '0-1')


def write_csv(path: Path, v: np.ndarray, y: np.ndarray) -> Path:
    rows = [
        f'{k * PERIOD_S!r},{float(a)!r},{"" if np.isnan(b) else repr(float(b))}'
        for k, (a, b) in enumerate(zip(v, y, strict=True))]
    path.write_text('t,v,y\n' + '\n'.join(rows) + '\n')
    return path


@pytest.fixture(scope='module')
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of what a good record leads to, after another record had led there."""
    folder = tmp_path_factory.mktemp('identify')
    (folder / 'out').mkdir()
    of_another = Estimate(0.7, 1.0, -1.0, 0.0, 0.1, 0.1, 0.1)
    save_estimate(folder / 'out' / 'estimates.json', of_another, Parameters())
    config = folder / 'mine.yaml'
    config.write_text(
        '/**: {ros__parameters: {control: {min: -4.0, max: 4.0, rate_max: 40.0},'
        ' on_stop: zero, backlash: {m: 7.0}, input_disturbance: 2.0}}')
    v, y = record()
    y[::50] = np.nan
    source = write_csv(folder / 'mine.csv', v, y)
    assert main([str(source), *QUICK, '--slope', '0.5', '--config', str(config),
                 '--out', str(folder / 'out')]) == 0
    return folder / 'out'


def test_all_files_are_written_with_the_numbers_of_the_actuator(result: Path) -> None:
    assert {path.name for path in result.iterdir()} == {
        'identified.yaml', 'identified.json', 'identify.html', 'estimates.json', 'record.csv',
        'held_out.png', 'loop.png', 'residual.png', 'bode.png'}
    found = json.loads((result / 'identified.json').read_text())
    assert found['usable'] is True
    assert (found['reasons'], found['m']) == ([], 0.5)
    for name, true in (('gap', 0.9), ('c_r', 0.5), ('c_l', -0.4)):
        assert abs(found[name] - true) < 4.0 * found['std'][name] < 0.05
    assert found['delay_samples'] == 1
    assert found['denominator'] == pytest.approx([1.0, -1.7, 0.755], abs=0.01)
    assert found['sample_period'] == PERIOD_S
    assert found['output_noise_std'] == pytest.approx(2e-3, rel=0.1)
    assert found['lost_samples'] == 32


def test_the_file_is_a_complete_configuration(result: Path) -> None:
    parameters = read_configuration(result / 'identified.yaml').parameters()
    numbers = json.loads((result / 'identified.json').read_text())
    assert parameters.plant.denominator == pytest.approx(numbers['denominator'])
    assert parameters.control.delay_samples == numbers['delay_samples']
    assert parameters.plant.uncertainty == numbers['uncertainty']
    assert (parameters.control.rate_max, parameters.on_stop) == (40.0, 'zero')
    assert (parameters.backlash.m, parameters.input_disturbance) == (0.5, 0.0)
    build_controller(parameters)


@pytest.mark.usefixtures('undrawn')
def test_the_loop_with_the_file_follows_wherever_0_of_v_is(tmp_path: Path) -> None:
    (v, y), offset = record(), 40.0
    source, out = write_csv(tmp_path / 'a.csv', v + offset, y), tmp_path / 'out'
    assert main([str(source), *QUICK, '--integrator', 'no', '--out', str(tmp_path)]) == 0
    initial = read_configuration(tmp_path / 'identified.yaml').parameters().estimator.initial
    assert (initial.c_r, initial.c_l) == pytest.approx((0.5 + offset, -0.4 + offset), abs=0.01)
    assert simulate.main(['--config', str(tmp_path / 'identified.yaml'), '--duration', '5',
                          '--out', str(out)]) == 0
    assert json.loads((out / 'summary.json').read_text())['tracking_error_rms'] < 0.05


@pytest.mark.usefixtures('undrawn')
def test_a_record_of_no_use_is_told_and_leaves_no_parameter_file(tmp_path, capsys):
    v = 0.1 * motion(1200)
    source = write_csv(tmp_path / 'a.csv', v, np.random.default_rng(1).standard_normal(1200))
    (tmp_path / 'out').mkdir()
    for name in ('identified.yaml', 'estimates.json'):
        (tmp_path / 'out' / name).write_text('of another record')
    assert main([str(source), *QUICK, '--out', str(tmp_path / 'out')]) == 1
    assert 'not known: y shows nothing of v' in capsys.readouterr().out
    assert not (tmp_path / 'out' / 'identified.yaml').exists()
    assert not (tmp_path / 'out' / 'estimates.json').exists()
    assert json.loads((tmp_path / 'out' / 'identified.json').read_text())['usable'] is False


@pytest.mark.parametrize('arguments', [
    [], ['nowhere.csv'], ['--drive', 'a.csv'], ['a.csv', '--order', '7'],
    ['a.csv', '--order', '4-2'], ['a.csv', '--delay', 'x'], ['a.csv', '--slope', '0'],
    ['a.csv', '--from', '3', '--to', '2'],
    ['a.csv', '--integrator', 'perhaps'], ['a.csv', '--precision', '200%'],
    ['a.csv', '--columns', 'x=1'], ['a.csv', '--columns', 't=w'], ['a.csv', '--period', '0'],
    ['a.csv', '--config', 'nowhere.yaml'], ['a.csv', '--ros-args', '-r', 'a:=b'],
    ['a.csv', '--config', 'arm.yaml', '--axis', 'shoulder'], ['a.csv', '--precision', '1%'],
    ['a.csv', '--amplitude', '1'], ['--drive', '--output-range', '2', '1'],
    ['--drive', '--from', '1'], ['--drive', '--columns', 't=a'], ['--drive', '--out', 'a.csv'],
])
def test_bad_options_are_told_in_one_line(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    write_csv(tmp_path / 'a.csv', *record(100))
    assert (main(arguments), capsys.readouterr().err.count('\n')) == (2, 1)


def test_a_span_is_cut_out(tmp_path: Path) -> None:
    from backlash_ros.tools.cli import Span
    v, y = record(400)
    source = write_csv(tmp_path / 'a.csv', v, y)
    part = read_record(source, span=Span(0.5, 1.5))
    assert part.v.tolist() == v[100:300].tolist()
    with pytest.raises(InputError, match='no sample between'):
        read_record(source, span=Span(50.0, 60.0))


@pytest.mark.usefixtures('undrawn')
def test_what_the_controller_refuses_is_told(tmp_path, capsys):
    config = tmp_path / 'a.yaml'
    # The gradient law needs another structure.
    config.write_text('/**: {ros__parameters: {estimator: {law: gradient}, structure: tracking}}')
    source = write_csv(tmp_path / 'a.csv', *record(800))
    assert main([str(source), *QUICK, '--config', str(config), '--out', str(tmp_path / 'o')]) == 0
    assert not (tmp_path / 'o' / 'identified.yaml').exists()
    assert 'the controller does not take it: structure' in capsys.readouterr().out


@pytest.mark.usefixtures('undrawn')
def test_an_axis_gets_a_file_of_its_own(tmp_path, capsys):
    config = tmp_path / 'axes.yaml'
    config.write_text(
        "/bringup: {ros__parameters: {axes: ['x', 'z']}}\n"
        '/**: {ros__parameters: {control: {min: -4.0, max: 4.0, rate_max: 40.0}}}\n'
        '/z/**: {ros__parameters: {control: {max: 5.0}}}\n')
    source = write_csv(tmp_path / 'a.csv', *record(800))
    given = [str(source), *QUICK, '--config', str(config), '--out', str(tmp_path / 'out')]
    assert main(given) == 2
    assert 'must be one of x, z: choose it with --axis' in capsys.readouterr().err
    assert main([*given, '--axis', 'z']) == 0
    found = read_configuration(tmp_path / 'out' / 'identified.yaml').parameters('z')
    assert found.control.max == 5.0


@pytest.mark.usefixtures('undrawn')
def test_a_longer_record_than_is_searched_is_fitted_as_a_whole(tmp_path: Path) -> None:
    v, y = record(6500)
    y[6200] = 40.0
    source = write_csv(tmp_path / 'a.csv', v, y)
    assert main([str(source), *QUICK, '--out', str(tmp_path / 'out')]) == 0
    found = json.loads((tmp_path / 'out' / 'identified.json').read_text())
    assert found['samples'] == 6500
    assert found['outliers'] >= 1
    assert abs(found['gap'] - 0.9) < 4.0 * found['std']['gap'] < 2e-3
