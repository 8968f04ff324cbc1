"""An arm with play in six joints, as MuJoCo integrates it, behind the loops of one controller."""

import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

from arm_of_physics import move, rms, with_gaps
from places import ROOT

from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.config import read_configuration


def test_the_tip_goes_where_it_belongs_once_all_gaps_are_known() -> None:
    values = read_configuration(ROOT / 'config' / 'arm.yaml').given()
    tips = [move(Parameters(with_gaps(values, share)), 2).tip for share in (0.0, 1.0)]
    without, compensated = (rms(tip[len(tip) // 2:]) for tip in tips)  # once all joints swing
    assert without > 5e-3
    assert compensated < 0.15 * without
