"""Parameter files and settings: what is accepted, how mistakes are answered; files of 0.2.0."""

from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from backlash_ros.core import Parameters, build_closed_loop, build_controller
from backlash_ros.core.estimate import load_estimate
from backlash_ros.core.parameters import ParameterError
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.config import (
    parse_setting,
    read_configuration,
    write_config,
)
from backlash_ros.tools.replay import main as replay
from backlash_ros.tools.runs.read_run import read_run

SHIPPED = sorted((ROOT / 'config').glob('*.yaml'))


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding='utf-8')
    return path


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return tmp_path / 'my.yaml'


def test_paper_example_says_what_the_table_says_but_that_its_plant_is_exact() -> None:
    example = read_configuration(None).given()
    # The paper supposes G(z) exact, which the plant of a user never is.
    exact = Parameters().replaced({'plant.uncertainty': 0.0})
    assert example == {name: exact[name] for name in example}
    assert read_configuration(None).parameters() == exact
    assert Parameters().plant.uncertainty > 0.0


@pytest.mark.parametrize('path', SHIPPED, ids=lambda path: path.name)
def test_shipped_file_loads_and_runs(path: Path) -> None:
    configuration = read_configuration(path)
    for axis in configuration.axes or configuration.joints or ('',):
        parameters = read_configuration(path).parameters(axis)
        assert build_closed_loop(parameters).run(50).samples == 50


def test_of_an_arm_one_joint_is_chosen(config: Path) -> None:
    written(config, """/**/controller: {ros__parameters: {joints: [waist, wrist],
      control: {rate_max: 2.0}, waist: {control: {rate_max: 1.0}, plant: {denominator: [1, -0.5],
      numerator: [0.5]}}, io: {style: joint_state_topic}}}""")
    assert read_configuration(config).parameters('waist')['control.rate_max'] == 1.0
    assert read_configuration(config).parameters('wrist')['control.rate_max'] == 2.0
    with pytest.raises(InputError, match="axis='' must be one of waist, wrist"):
        read_configuration(config).parameters()
    written(config, config.read_text().replace('numerator:', 'numerators:'))
    with pytest.raises(ParameterError, match=r'waist\.plant\.numerators is not a parameter'):
        read_configuration(config).parameters('waist')


def test_values_of_joints_are_written_back_and_may_stand_apart_from_their_list(config, tmp_path):
    written(config, """/**: {ros__parameters: {joints: [waist, wrist], sample_period: 0.02}}
/controller: {ros__parameters: {waist: {plant: {denominator: [1, -0.5], numerator: [0.5]}}}}""")
    configuration = read_configuration(config, ['waist/control.max=3'])
    parameters = configuration.of_controller()
    assert parameters.of_joint('waist')['control.max'] == 3.0
    copy = tmp_path / 'copy.yaml'
    write_config(parameters, copy)
    again = read_configuration(copy).of_controller()
    for joint in ('waist', 'wrist'):
        assert again.of_joint(joint) == parameters.of_joint(joint)
    with pytest.raises(InputError, match="axis='wist' must be one of waist, wrist"):
        read_configuration(config, ['wist/control.max=3'])


def test_written_configuration_is_read_back_unchanged(config: Path) -> None:
    parameters = Parameters({
        'driver': "ros2 run 'it'", 'axes': ['x', 'y'], 'plant.numerator': [1 / 3, 1e-300],
        'control.min': -0.1, 'control.rate_max': 5.5, 'lockstep': True,
        'file': "it's a: file.csv", 'seed': 7, 'backlash.jump': [0.0, 1e22, -0.5],
        'truth.numerator': [0.5], 'truth.denominator': [1.0, -0.5],
        'actuator.numerator': [0.5], 'actuator.denominator': [1.0, -0.5]})
    write_config(parameters, config)
    again = read_configuration(config).given('x')
    assert Parameters(again) == parameters
    # ROS 2 knows no empty list.
    assert all(parameters[name] == () for name in set(parameters) - set(again))


@pytest.mark.parametrize(('text', 'message'), [
    ('/**: {ros__parameters: {estimator: {lwa: lms}}}', 'did you mean estimator.law?'),
    ('/**: {ros__parameters: {sample_period: -1}}', 'sample_period=-1.0 must be > 0 [s]'),
    ('/robot: {ros__parameters: {seed: 1}}', "section '/robot' is for no node of a run without"),
    ('/plant: {ros__parameters: {seed: 1}}\nplant: {ros__parameters: {seed: 2}}', 'each once'),
    ('/plant: {ros__parameters: {sample_period: 1.0}}\n'
     '/reference: {ros__parameters: {sample_period: 2.0}}', 'has two values, 1.0 and 2.0'),
    ('/**: {ros__parameters: {seed: 1, seed: 2}}', "'seed' is given twice"),
    ('/**: {seed: 1}', 'must hold sections'), ('/**: {ros__parameters: }', 'must hold sections'),
    ('/**: {ros__parameters: {seed: [}}', 'line 1'), ('seed', 'must hold'), ('', 'must hold'),
    ('/**: {ros__parameters: {5: 1}}', '5 is not a parameter'),
    ('/contoller: {ros__parameters: {seed: 1}}', 'did you mean /controller?'),
    ('/x/plant: {ros__parameters: {seed: 1}}', 'without the parameter axes, under /bringup'),
    ('/a/b/plant: {ros__parameters: {seed: 1}}', "section '/a/b/plant' is for no node"),
])
def test_mistake_in_a_file_is_one_line_that_names_the_file(config, text, message):
    written(config, text)
    with pytest.raises((InputError, ParameterError)) as caught:
        read_configuration(config).given()
    assert str(caught.value).startswith(f'{config}:')
    assert message in str(caught.value)
    assert '\n' not in str(caught.value)


def test_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'nothing\.yaml: cannot be read: No such file'):
        read_configuration(tmp_path / 'nothing.yaml').given()
    binary = tmp_path / 'binary.yaml'
    binary.write_bytes(b'\xff\xfe\x00')
    with pytest.raises(InputError, match='utf-8'):
        read_configuration(binary).given()


@pytest.mark.parametrize(('text', 'expected'), [
    ('seed=3', ('seed', 3)), ('lockstep=true', ('lockstep', True)), ('axes=[]', ('axes', ())),
    ('axes=[x, y]', ('axes', ('x', 'y'))), ('file=2024', ('file', '2024')),
    ('plant.numerator=[1, 2e-3]', ('plant.numerator', (1.0, 2e-3))),
    ('estimator.law=lms', ('estimator.law', 'lms')),
])
def test_setting_is_read_like_a_line_of_yaml(text: str, expected: tuple[str, object]) -> None:
    assert parse_setting(text) == ('', *expected)


@pytest.mark.parametrize(('text', 'message'), [
    *((text, 'must be KEY=VALUE') for text in ('seed', '/seed=1', '=1')),
    ('sed=1', 'did you mean seed'), ('x/sed=1', 'did you mean seed'),
    ('axes=[on]', 'quote true, on'), ('axes=[a/b]', 'must be a list of names'),
    ('structure=square', 'must be one of'),
    ('seed=x', 'must be a number'), ('seed=[', 'is not a value in YAML'),
    ('seed=2024-13-45', 'is not a value in YAML'), ('seed=1e30', 'must be'),
])
def test_bad_setting_is_refused(text: str, message: str) -> None:
    with pytest.raises((InputError, ParameterError), match=message):
        parse_setting(text)


def test_settings_go_before_the_file_and_the_seed_before_both(config: Path) -> None:
    written(config, '/**: {ros__parameters: {seed: 2, amplitude: 2.0, bias: 2.0}}')
    parameters = read_configuration(config, ['amplitude=3', 'seed=3'], seed=4).parameters()
    assert (parameters['bias'], parameters['amplitude'], parameters['seed']) == (2.0, 3.0, 4)


AXES = '/bringup: {ros__parameters: {axes: [x, y]}}\n'


@pytest.mark.parametrize('sections', [
    # From the most to the least specific; the order in the file is of no account.
    ['/x/plant', '/**/plant', '/x/**', '/**'],
    ['/**', '/x/**', '/**/plant', '/x/plant'],
])
def test_named_node_goes_before_named_axis_and_that_before_all(config, sections):
    values = {'/x/plant': 4, '/**/plant': 3, '/x/**': 2, '/**': 1}
    text = AXES
    left = list(sections)
    for specific in ('/x/plant', '/**/plant', '/x/**', '/**'):
        text = AXES + ''.join(
            f'{name}: {{ros__parameters: {{seed: {values[name]}}}}}\n' for name in left)
        written(config, text)
        assert read_configuration(config).parameters('x')['seed'] == values[specific]
        left.remove(specific)


@pytest.mark.parametrize(('section', 'message'), [
    ('/plant', "section '/plant' is for no node of the axes x, y: did you mean /y/plant?"),
    ('/z/contoller', 'did you mean /y/controller?'), ('/xx/**', 'did you mean /x/**?'),
])
def test_section_that_no_axis_would_read_is_refused(config, section, message):
    written(config, AXES + f'{section}: {{ros__parameters: {{seed: 1}}}}')
    with pytest.raises(InputError) as caught:
        read_configuration(config)
    assert str(caught.value).startswith(f'{config}: ')
    assert message in str(caught.value)


def test_one_of_several_axes_must_be_chosen_by_its_name(config: Path) -> None:
    written(config, AXES)
    with pytest.raises(InputError, match="axis='' must be one of x, y: choose it with --axis"):
        read_configuration(config).parameters()
    with pytest.raises(InputError, match="axis='z' must be one of x, y"):
        read_configuration(config).parameters('z')
    with pytest.raises(InputError, match="--set z/seed: axis='z' must be one of x, y"):
        read_configuration(config, ['z/seed=1']).parameters('x')


OLD = ROOT / 'test' / 'of_0_2_0'
LAST = {'m': 1.30029, 'c_r': 3.00258, 'c_l': -2.99812}  # as 0.2.0 printed them


def test_parameter_file_means_what_it_meant() -> None:
    parameters = read_configuration(OLD / 'parameters.yaml').parameters()
    assert (parameters.lockstep, parameters.samples, parameters.output_noise_std) == (
        True, 50, 1e-4)
    assert parameters.estimator.law == 'moving_horizon'
    build_controller(parameters)


def test_saved_estimates_are_begun_with() -> None:
    parameters = read_configuration(OLD / 'parameters.yaml', [
        'estimates.load=true', f'estimates.file={OLD / "estimates.json"}']).parameters()
    found = load_estimate(parameters)
    assert {name: getattr(found, name) for name in LAST} == pytest.approx(LAST, rel=1e-5)
    assert found.learned
    assert build_controller(parameters).step(0.0, 0.0).estimate.m == pytest.approx(found.m)


@pytest.mark.parametrize('name', ['bag', 'record.npz', 'samples.csv'])
def test_run_is_read_from_each_of_its_files(name: str) -> None:
    run = read_run(OLD / name)
    assert run.parameters is not None
    assert (run.record.samples, run.record.lost_samples) == (50, 0)
    assert {of: run.record.column(of)[-1] for of in LAST} == pytest.approx(LAST, rel=1e-5)
    columns = [run.record.column(column) for column in ('t', 'y_m', 'y', 'v')]
    others = [read_run(OLD / 'bag').record.column(column) for column in ('t', 'y_m', 'y', 'v')]
    np.testing.assert_allclose(columns, others, rtol=1e-12)


@pytest.mark.usefixtures('undrawn')
def test_bag_is_replayed(tmp_path: Path) -> None:
    assert replay([str(OLD / 'bag'), '--out', str(tmp_path)]) == 0
    assert read_run(tmp_path).record.samples == 50
