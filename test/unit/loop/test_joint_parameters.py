"""Parameters of several joints: shared ones, own ones, and joints without any."""

from collections.abc import Mapping

import pytest

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError

ARM: dict[str, object] = {
    'joints': ['waist', 'elbow', 'wrist'], 'sample_period': 0.02, 'control.rate_max': 2.0,
    'estimates.file': 'saved/arm.json',
    'waist.plant.numerator': [0.5], 'waist.plant.denominator': [1.0, -0.5],
    'waist.control.rate_max': 1.0, 'elbow.plant.numerator': [0.2],
    'elbow.plant.denominator': [1.0, -0.8], 'elbow.structure': 'tracking',
}


def of(**changes: object) -> Parameters:
    return Parameters({**ARM, **{name.replace('__', '.'): v for name, v in changes.items()}})


def test_a_joint_has_its_own_value_else_the_shared_one_else_the_default() -> None:
    waist, elbow = of().of_joint('waist'), of().of_joint('elbow')
    assert (waist['control.rate_max'], elbow['control.rate_max']) == (1.0, 2.0)
    assert (waist['structure'], elbow['structure']) == ('proportional', 'tracking')
    assert waist['sample_period'] == elbow['sample_period'] == 0.02
    assert waist['plant.denominator'] == (1.0, -0.5)
    assert waist['io.joint'] == 'waist'
    assert waist['joints'] == ()


def test_a_joint_that_nobody_describes_passes_its_reference_through() -> None:
    wrist = of().of_joint('wrist')
    assert (wrist['estimator.law'], wrist['structure']) == ('fixed', 'proportional')
    assert [wrist[f'estimator.initial.{name}'] for name in ('m', 'c_r', 'c_l')] == [1.0, 0.0, 0.0]
    assert wrist['control.rate_max'] == 2.0
    shared = of(plant__denominator=[1.0, -0.9], plant__numerator=[0.1]).of_joint('wrist')
    assert shared['estimator.law'] == 'moving_horizon'
    assert shared['plant.denominator'] == (1.0, -0.9)


@pytest.mark.parametrize(('file', 'of_waist'), [
    ('saved/arm.json', 'saved/arm-waist.json'), ('{joint}/e.json', 'waist/e.json'), ('', ''),
])
def test_each_joint_saves_into_a_file_of_its_own(file: str, of_waist: str) -> None:
    assert of(estimates__file=file).of_joint('waist')['estimates.file'] == of_waist


@pytest.mark.parametrize(('changes', 'said'), [
    ({'waist.plant.numerators': [1.0]}, 'waist.plant.numerators is not a parameter: did you mean '
     'plant.numerator?'),
    ({'elbo.plant.numerator': [1.0]}, 'did you mean elbow.plant.numerator?'),
    ({'waist.control.rate_max': -1.0}, 'waist.control.rate_max=-1.0 must be > 0'),
    ({'control.rate_max': -1.0}, 'control.rate_max=-1.0 must be > 0'),
    ({'waist.sample_period': 0.1}, 'waist.sample_period=0.1 is not for one joint alone: set '
     'sample_period'),
    ({'waist.seed': 2}, 'waist.seed=2 is not for one joint alone: set seed'),
    ({'joints': ['plant']}, "joints='plant' is the first word of a parameter"),
    ({'joints': ['a b']}, 'must be a list of names'),
    ({'joints': ['waist', 'waist']}, 'must be a list of names'),
])
def test_mistakes_name_the_joint(changes: Mapping[str, object], said: str) -> None:
    with pytest.raises(ParameterError) as error:
        Parameters({**ARM, **changes})
    assert said in str(error.value)


def test_changes_reach_the_joints_that_have_no_value_of_their_own() -> None:
    changed = of().replaced({'control.rate_max': 3.0, 'elbow.structure': 'proportional'})
    assert changed.of_joint('waist')['control.rate_max'] == 1.0
    assert changed.of_joint('wrist')['control.rate_max'] == 3.0
    assert changed.of_joint('elbow')['structure'] == 'proportional'
