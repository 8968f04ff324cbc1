"""An arm with play in six joints, as MuJoCo integrates it, behind the loops of one controller."""

import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

from arm_of_physics import move, rms


def test_the_tip_goes_where_it_belongs_once_all_gaps_are_known() -> None:
    without, compensated = (rms(move(share).tip) for share in (0.0, 1.0))
    assert without > 5e-3
    assert compensated < 0.15 * without
