"""Estimates in a file: what is saved comes back, what does not fit is refused with the reason."""

import json
from dataclasses import replace
from math import isnan, nan
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backlash_ros.core import Estimate, Parameters, Status, build_closed_loop, build_controller
from backlash_ros.core.assembly import known_before
from backlash_ros.core.estimate import load_estimate, save_estimate, worth_saving
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import SampleCounter
from backlash_ros.core.parameters import ParameterError
from backlash_ros.core.simulation.closed_loop import replay
from backlash_ros.tools.runs.summary import summarise

LEARNED = Estimate(1.25, 2.5, -3.5, 0.2, 0.01, 0.02, 0.03, Status.TRACKING)


def parameters(file: Path, **values: object) -> Parameters:
    return Parameters({'estimates.file': str(file), 'estimates.load': True, **values})


@given(
    st.floats(0.01, 100.0), st.floats(0.0, 100.0), st.floats(-100.0, 0.0), st.floats(-0.5, 0.5),
    st.one_of(st.just(nan), st.floats(0.0, 10.0, exclude_min=True)),
)
def test_saved_estimate_comes_back_to_the_last_bit(tmp_path_factory, m, c_r, c_l, f, std):
    p = parameters(tmp_path_factory.mktemp('saved') / 'estimates.json')
    estimate = Estimate(m, c_r, c_l, f, std, std, std)
    save_estimate(Path(p.estimates.file), estimate, p)
    loaded = load_estimate(p)
    assert (loaded.m, loaded.c_r, loaded.c_l, loaded.f) == (m, c_r, c_l, f)
    assert loaded.std_m == std or (isnan(std) and not loaded.learned)


def test_nothing_is_loaded_unless_asked_or_before_it_was_saved(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    assert load_estimate(parameters(file)) is None
    save_estimate(file, LEARNED, parameters(file))
    assert load_estimate(Parameters({'estimates.file': str(file)})) is None
    with pytest.raises(ParameterError, match='must name a file'):
        load_estimate(Parameters({'estimates.load': True}))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / 'estimates.json'
    save_estimate(path, LEARNED, parameters(path))
    return path


@pytest.mark.parametrize(('name', 'value'), [
    ('sample_period', 0.02), ('plant.numerator', [1e-5, 4e-5, 2e-5]),
    ('control.delay_samples', 1), ('estimator.law', 'lms'),
])
def test_estimates_of_another_plant_or_law_are_refused(file, name, value):
    with pytest.raises(ParameterError, match=f'was learned with {name}='):
        load_estimate(parameters(file, **{name: value}))


@pytest.mark.parametrize(('std', 'reason'), [
    (0.01, ''), (nan, ''), (0.0, 'holds constants that were given'),
])
def test_constants_that_were_learned_serve_the_law_that_learns_none(file, std, reason):
    learned = replace(LEARNED, std_m=std, std_c_r=std, std_c_l=std)
    save_estimate(file, learned, parameters(file))
    p = parameters(file, **{'estimator.law': 'fixed'})
    if reason:
        with pytest.raises(ParameterError, match=reason):
            load_estimate(p)
    else:
        assert load_estimate(p) is not None


@pytest.mark.parametrize('content', [
    '', '{', '[]', '3', '{"version": 1}', 'null', '{"version": 1, "key": {}, "estimate": 2}',
    '{"version": 1, "key": {}, "estimate": {"m": "1"}}', '\x00', '"estimate"',
])
def test_a_broken_file_is_refused_in_one_sentence(file: Path, content: str) -> None:
    file.write_text(content)
    with pytest.raises(ParameterError, match=r'estimates\.file='):
        load_estimate(parameters(file))


@pytest.mark.parametrize(('part', 'value', 'reason'), [
    ('m', 1000.0, 'outside of estimator.bounds.m'), ('c_r', -1000.0, 'outside'),
    ('c_r', -4.0, 'c_l=-3.5 above c_r=-4.0'), ('c_l', None, 'c_l=nan outside'),
])
def test_values_that_cannot_be_are_refused(file, part, value, reason):
    content = json.loads(file.read_text())
    content['estimate'][part] = value
    file.write_text(json.dumps(content))
    with pytest.raises(ParameterError, match=reason):
        load_estimate(parameters(file))


def test_a_first_guess_is_not_worth_saving() -> None:
    assert worth_saving(LEARNED)
    assert not worth_saving(Estimate(1.0, 1.0, -1.0, 0.2))
    assert worth_saving(Estimate(1.0, 1.0, -1.0, 0.2, status=Status.TRACKING))
    assert worth_saving(replace(LEARNED, status=Status.INCONSISTENT))


@pytest.mark.parametrize(('law', 'step_f', 'f'), [
    ('moving_horizon', 0.0, 0.1), ('lms', 0.0, 0.1), ('lms', 0.5, 0.2), ('printed', 0.0, 0.2)])
def test_f_comes_from_the_file_only_for_a_law_that_learns_it(tmp_path, law, step_f, f):
    p = parameters(tmp_path / 'a.json', **{
        'estimator.law': law, 'lms.step_f': step_f, 'proportional.f': 0.1})
    save_estimate(tmp_path / 'a.json', LEARNED, p)
    assert known_before(p).f == f


def test_whoever_builds_a_controller_begins_with_what_was_known(file: Path) -> None:
    p = parameters(file)
    assert build_controller(p).estimator.estimate.c_r == LEARNED.c_r
    run = build_closed_loop(p).run(30)
    assert run.column('c_l')[0] == LEARNED.c_l
    assert replay(run, p).column('c_l')[0] == LEARNED.c_l
    loop = ControlLoop(p, Driver(lambda: 0), None, SampleCounter(0.01))
    assert loop.estimate.m == LEARNED.m
    loop.reset()
    assert loop.estimate.m == p.estimator.initial.m
    assert summarise(run, p)['began_with'] == {
        'm': 1.25, 'c_r': 2.5, 'c_l': -3.5, 'f': 0.22, 'from': p.estimates.file}
    plain = Parameters()
    began = summarise(build_closed_loop(plain).run(30), plain)['began_with']
    assert (began['c_r'], began['from']) == (0.5, 'estimator.initial')
