"""The parameter table and the check of values against it."""

from math import inf, isnan, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.parameters import BY_NAME, Parameter, ParameterError, Parameters, check_value

NUMBERS = [p for p in BY_NAME.values() if isinstance(p.default, (int, float))
           and not isinstance(p.default, bool)]
LISTS = [p for p in BY_NAME.values() if isinstance(p.default, tuple) and not p.names]


def named(parameters: list[Parameter]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize('parameter', parameters, ids=lambda p: p.name)


def refusal_of(name: str, value: object) -> str:
    """The message, which must be one line that names the parameter, and the value if it exists."""
    with pytest.raises(ParameterError) as refusal:
        Parameters({name: value})
    message = str(refusal.value)
    assert refusal.value.name == name
    assert message.startswith(f'{name}=' if name in BY_NAME else f'{name} is not a parameter: ')
    assert '\n' not in message
    return message


def build_everything(values: dict[str, object]) -> None:
    p = Parameters(values)
    build_reference(p)
    build_plant(p)
    build_controller(p)


@named(list(BY_NAME.values()))
def test_default_obeys_its_own_rules(parameter: Parameter) -> None:
    value = check_value(parameter, parameter.default)
    assert value == parameter.default
    assert type(value) is type(parameter.default)


@pytest.mark.parametrize(('misspelt', 'meant'), [
    ('plant.numerater', 'plant.numerator'), ('estimator.intial.m', 'estimator.initial.m'),
    ('backlash.cr', 'backlash.c_r'), ('Structure', 'structure'),
    ('estimator.bound.c_l', 'estimator.bounds.c_l'),
])
def test_unknown_name_is_refused_with_the_nearest_valid_one(misspelt: str, meant: str) -> None:
    assert f'did you mean {meant}?' in refusal_of(misspelt, 1.0)


@settings(max_examples=20)
@given(name=st.text(max_size=30).filter(lambda name: name not in BY_NAME))
def test_any_unknown_name_is_refused_with_a_valid_one(name: str) -> None:
    with pytest.raises(ParameterError) as refusal:
        Parameters({name: 1.0})
    assert str(refusal.value).rsplit('did you mean ', 1)[1].rstrip('?') in BY_NAME


@named(NUMBERS + LISTS)
def test_value_beyond_a_bound_is_refused_and_the_bound_itself_unless_excluded(parameter):
    count = len(parameter.default) if isinstance(parameter.default, tuple) else 0
    rules = []
    low = parameter.low if isnan(parameter.above) else parameter.above
    if low > -inf:
        rule = f'{">=" if isnan(parameter.above) else ">"} {low:g}'
        rules = [(low - 1.0, rule), (low - 1e9, rule)]
    if parameter.high < inf:
        rules.append((parameter.high + 1.0, f'<= {parameter.high:g}'))
    for value, rule in rules:
        assert rule in refusal_of(parameter.name, [value] * count if count else value)
    if parameter in NUMBERS and low > parameter.low:
        refusal_of(parameter.name, low)
    elif parameter in NUMBERS and low > -inf:
        assert Parameters({parameter.name: low})[parameter.name] == low


@named(NUMBERS)
def test_what_is_no_finite_number_is_refused_unless_infinity_means_no_limit(parameter):
    for value in (nan, 'nan'):
        assert 'must be finite' in refusal_of(parameter.name, value)
    if parameter.high == inf:
        assert 'must be within' in refusal_of(parameter.name, 1e160)
    for value in (True, None, [1.0], 'ten', '', {}):
        assert 'must be a number' in refusal_of(parameter.name, value)
    if parameter.infinite:
        assert parameter.default in (inf, -inf)
        for value in (parameter.default, str(parameter.default)):
            assert Parameters({parameter.name: value})[parameter.name] == parameter.default
    else:
        for value in (inf, -inf, 'inf'):
            assert 'must be' in refusal_of(parameter.name, value)


@named(NUMBERS)
def test_number_has_the_type_of_its_parameter(parameter: Parameter) -> None:
    low = max(parameter.low, -1.0 if isnan(parameter.above) else parameter.above + 0.5)
    whole = next(i for i in (3, 1, -1, 0, 20) if low <= i <= parameter.high)
    is_real = isinstance(parameter.default, float)
    value = Parameters({parameter.name: whole if is_real else float(whole)})[parameter.name]
    assert type(value) is type(parameter.default)
    assert value == whole
    if not is_real:
        assert 'must be a whole number' in refusal_of(parameter.name, whole + 0.5)
        if parameter.high == inf:
            assert Parameters({parameter.name: 2**53 + 1})[parameter.name] == 2**53 + 1


@pytest.mark.parametrize('name', ['seed', 'bias', 'control.max'])
def test_number_too_large_for_a_float_is_refused(name: str) -> None:
    assert 'is too large for a number' in refusal_of(name, 10**400)


def test_yaml_text_without_a_point_is_a_number() -> None:
    p = Parameters({'plant.numerator': ['1e-5', '4e-5', 1e-5], 'lms.step': '5e-1', 'seed': '7'})
    assert p.plant.numerator == (1e-5, 4e-5, 1e-5)
    assert (p.lms.step, p.seed) == (0.5, 7)


@pytest.mark.parametrize(
    'value', [[1, 2], (1.0, 2.0), '[1, 2]', '1,2', ' [1e0, 2e0] ', ['1', 2]], ids=repr,
)
def test_list_is_taken_as_a_list_or_as_text(value: object) -> None:
    assert Parameters({'plant.numerator': value})['plant.numerator'] == (1.0, 2.0)


@named(LISTS)
def test_what_is_no_list_of_that_many_numbers_is_refused(parameter: Parameter) -> None:
    for value in (3.0, True, None, [True], ['x'], 'x', [nan], [[1.0]]):
        refusal_of(parameter.name, value)
    if parameter.default == ():
        for value in ([], '[]'):
            assert Parameters({parameter.name: value})[parameter.name] == ()
    else:
        refusal_of(parameter.name, [])
    if parameter.length is not None:
        for count in (parameter.length - 1, parameter.length + 1):
            message = refusal_of(parameter.name, [1.0] * count)
            assert f'must have {parameter.length} numbers' in message


@named([p for p in BY_NAME.values() if p.choices])
def test_word_outside_the_choices_is_refused_and_they_are_listed(parameter: Parameter) -> None:
    assert ', '.join(parameter.choices) in refusal_of(parameter.name, 'no such word')
    for word in parameter.choices:
        stands_for = 'moving_horizon' if word == 'kalman' else word
        assert Parameters({parameter.name: word})[parameter.name] == stands_for


@named([p for p in BY_NAME.values() if isinstance(p.default, str)])
def test_word_must_be_a_text(parameter: Parameter) -> None:
    said = 'must be one of ' if parameter.choices else 'must be a string'
    assert said in refusal_of(parameter.name, 1.0)


@named([p for p in BY_NAME.values() if 'true' in p.choices or isinstance(p.default, bool)])
def test_true_and_false_are_read_as_yaml_and_ros_write_them(parameter: Parameter) -> None:
    for given_value in (True, 'true', 'True', False, 'false', 'False'):
        value = Parameters({parameter.name: given_value})[parameter.name]
        assert str(value).lower() == str(given_value).lower()
        assert type(value) is type(parameter.default)
    for wrong in (1, 0.0, 'yes', None, ['true']):
        refusal_of(parameter.name, wrong)


@pytest.mark.parametrize(('changes', 'name'), [
    ({'control.min': 2.0, 'control.max': 1.0}, 'control.min'),
    ({'control.min': 2.0, 'control.max': 2.0}, 'control.min'),
    ({'estimator.bounds.m': [2.0, 1.0]}, 'estimator.bounds.m'),
    ({'estimator.bounds.c_r': [2.0, 2.0]}, 'estimator.bounds.c_r'),
    ({'estimator.bounds.c_l': [-1.0, -2.0]}, 'estimator.bounds.c_l'),
    ({'estimator.initial.c_l': 1.0}, 'estimator.initial.c_l'),
    ({'proportional.bounds': [0.5, -0.5]}, 'proportional.bounds'),
    ({'estimator.initial.m': 3.0, 'estimator.bounds.m': [0.1, 2.0]}, 'estimator.initial.m'),
    ({'estimator.initial.c_r': 6.0, 'estimator.bounds.c_r': [0.0, 5.0]}, 'estimator.initial.c_r'),
    ({'estimator.initial.c_l': -0.1, 'estimator.bounds.c_l': [-5.0, -0.5]},
     'estimator.initial.c_l'),
    ({'backlash.c_r': -4.0}, 'backlash.c_l'),
    ({'plant.numerator': [1.0] * 4}, 'plant.numerator'),
    ({'plant.denominator': [0.0, 1.0]}, 'plant.denominator'),
    ({'waveform': 'file'}, 'file'),
])
@pytest.mark.parametrize('law', ['lms', 'printed'])
def test_values_that_contradict_each_other_are_refused_before_anything_runs(changes, name, law):
    with pytest.raises(ParameterError) as refusal:
        build_everything({'estimator.law': law, **changes})
    assert refusal.value.name == name


def test_set_of_parameters_is_complete_and_keeps_what_is_not_changed() -> None:
    p = Parameters({'lms.step': 0.5})
    assert (len(p), set(p)) == (len(BY_NAME), set(BY_NAME))
    changed = p.replaced({'seed': 9})
    assert (changed.lms.step, changed.seed, p.seed) == (0.5, 9, BY_NAME['seed'].default)
    with pytest.raises(ParameterError, match='did you mean seed'):
        p.replaced({'sed': 9})
