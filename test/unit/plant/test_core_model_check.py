"""Which G(z) is refused, and which one is warned of."""

import pytest

from backlash_ros.core.assembly import build_controller, takes_model_as_exact, warnings_of
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError


def plant(numerator: list[float], denominator: list[float], **more: object) -> Parameters:
    return Parameters({'plant.numerator': numerator, 'plant.denominator': denominator, **more})


@pytest.mark.parametrize(('numerator', 'denominator', 'reason'), [
    ([1.0], [1.0, -1.2], 'unstable pole 1.2'),
    ([1.0, -1.0], [1.0, -0.5, 0.06], 'zero at z = 1'),
    ([1.0, -1.0], [1.0, -1.5, 0.5], 'cancels the pole 1'),
])
def test_plant_through_which_nothing_can_be_learned_is_refused(numerator, denominator, reason):
    with pytest.raises(ParameterError, match=reason):
        build_controller(plant(numerator, denominator))


@pytest.mark.parametrize(('parameters', 'reason'), [
    (plant([1.0], [1.0, -0.99999]), 'slower than'),
    (plant([1.0], [1.0, -2.0, 1.0]), 'integrates more than once'),
    (plant([1.0, 1.0], [1.0, -0.5, 0.06]), 'on the unit circle'),
    (Parameters({'frequency': 300.0}), 'samples per period'),
])
def test_plant_that_makes_it_hard_is_warned_of(parameters: Parameters, reason: str) -> None:
    assert any(reason in warning for warning in warnings_of(parameters))


def test_the_example_is_neither_refused_nor_warned_of() -> None:
    build_controller(Parameters())
    assert warnings_of(Parameters()) == []


@pytest.mark.parametrize(('changes', 'exact'), [
    ({'plant.uncertainty': 0.0}, False),  # the paper assumes it of its example
    ({'plant.uncertainty': 0.0, 'plant.numerator': [2e-5, 4e-5, 1e-5]}, True),
    ({'plant.numerator': [2e-5, 4e-5, 1e-5]}, False),
    ({'plant.uncertainty': 0.0, 'plant.numerator': [2e-5, 4e-5, 1e-5],
      'estimator.law': 'fixed'}, False),
])
def test_a_model_that_is_taken_as_exact_is_known(changes, exact):
    assert takes_model_as_exact(Parameters(changes)) is exact
