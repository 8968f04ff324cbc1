"""What all laws offer."""

import pytest

from backlash_ros.core.assembly import LAWS, build_controller
from backlash_ros.core.law import Law, LawReport
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import PARAMETERS

STRUCTURES = {'gradient': 'pole_placement'}


def law(name: str) -> Law:
    structure = STRUCTURES.get(name, 'proportional')
    return build_controller(
        Parameters({'estimator.law': name, 'structure': structure})
    ).estimator


@pytest.mark.parametrize('name', LAWS)
def test_only_live_parameters_are_taken_up_while_a_law_runs(name: str) -> None:
    live = {p.name for p in PARAMETERS if p.live}
    assert set(law(name).RETUNED) <= live


@pytest.mark.parametrize('name', sorted({*LAWS} - {'moving_horizon'}))
def test_a_law_that_learns_no_model_says_nothing_of_one(name: str) -> None:
    simple = law(name)
    assert simple.learned_model is simple.proposal is None
    # As text: nan differs from itself.
    assert str(simple.report) == str(LawReport())
