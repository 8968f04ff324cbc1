"""An arm with play in six joints, as MuJoCo integrates it, behind the loops of one controller."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

from arm_physics import RESOLUTION, ArmPhysics
from joint_trajectory import swing
from places import ROOT

from backlash_ros.core.assembly import first_guess
from backlash_ros.core.loop.joint_loops import JointLoops
from backlash_ros.core.loop.sample_counter import JointOutputs, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.config import load_config

AMPLITUDE, PERIOD, DURATION = 0.2, 8.0, 16.0  # of a swing [rad, s], and for how long [s]


def tip_errors(share: float) -> NDArray[np.float64]:
    """Distance of the tip from where it belongs, over the second period [m].

    share: of the motion that each joint loses, that its loop takes for the gap.
    """
    arm = ArmPhysics()
    values: dict[str, object] = {
        **load_config(ROOT / 'config' / 'arm.yaml'), 'estimator.law': 'fixed',
    }
    for joint in arm.joints:
        half = 0.5 * share * arm.lost_motion(joint)
        values |= {f'{joint.name}.estimator.initial.c_r': half,
                   f'{joint.name}.estimator.initial.c_l': -half}
    p = Parameters(values)
    sample_s = p.get_float('sample_period')
    v = dict.fromkeys(p.joints, 0.0)
    now_ns = 0
    loops = JointLoops(
        p, v.update, lambda: now_ns, {joint: first_guess(p.of_joint(joint)) for joint in p.joints},
        SampleCounter(sample_s), dict(v),
    )
    references, positions = [], []
    for k in range(round(DURATION / sample_s)):
        now_ns = round((1.0 + k * sample_s) * 1e9)
        reference = [swing(k * sample_s, i, AMPLITUDE, PERIOD) for i in range(len(p.joints))]
        loops.take_references(dict(zip(p.joints, reference, strict=True)))
        references.append(arm.tip_at(reference))
        positions.append(arm.tip)
        y = dict(zip(p.joints, arm.encoders(), strict=True))
        loops.command(JointOutputs(y, now_ns, now_ns, now_ns, k, numbered=False))
        loops.note()
        # Servos take whole steps.
        arm.move_to([RESOLUTION * round(v[joint] / RESOLUTION) for joint in p.joints])
        arm.advance(sample_s)
    delay = loops.by_name[p.joints[0]].core.structure.delay
    apart = np.array(positions[delay:]) - np.array(references[:-delay])
    return np.linalg.norm(apart[len(apart) // 2:], axis=1)


def test_the_tip_goes_where_it_belongs_once_all_gaps_are_known() -> None:
    without, with_them = (np.sqrt(np.mean(tip_errors(share)**2)) for share in (0.0, 1.0))
    assert without > 5e-3
    assert with_them < 0.15 * without
