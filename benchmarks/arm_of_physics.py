"""The tip of an arm with play in six joints, with and without its loops knowing of the gaps.

    python benchmarks/arm_of_physics.py [--write]

Everything is in one process and in simulated time: the arm of examples/arm_physics.py, the
trajectory of examples/joint_trajectory.py, the loops of one controller with config/arm.yaml. y are
encoders of 12 bits, v are whole steps of them. --write: draws docs/images/arm.png.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from reporting import ROOT, text_table

sys.path.append(str(Path(__file__).resolve().parents[1] / 'examples'))

from arm_physics import RESOLUTION, ArmPhysics
from joint_trajectory import swing

from backlash_ros.core.assembly import first_guess
from backlash_ros.core.loop.joint_loops import JointLoops
from backlash_ros.core.loop.sample_counter import JointOutputs, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.config import load_config
from backlash_ros.tools.figures import TIME_LABEL, curve, label, new_figure, png

Array = NDArray[np.float64]

AMPLITUDE, PERIOD_S, DURATION_S = 0.2, 8.0, 16.0  # of a swing [rad], and for how long
PICTURE = ROOT / 'docs' / 'images' / 'arm.png'


class Motion(NamedTuple):
    """The second period.

    t (N,) [s]. tip (N,): distance from where it belongs [m]. joints (N, 6): those of the joints
    [rad].
    """

    t: Array
    tip: Array
    joints: Array


def move(share: float) -> Motion:
    """The arm with loops that take this share of what each joint loses for its gap."""
    arm = ArmPhysics()
    p = parameters(arm, share)
    sample_s = p.sample_period
    v = dict.fromkeys(p.joint_names, 0.0)
    now_ns = 0
    loops = JointLoops(
        p, v.update, lambda: now_ns,
        {joint: first_guess(p.of_joint(joint)) for joint in p.joint_names},
        SampleCounter(sample_s), dict(v),
    )
    references, positions = [], []
    for k in range(round(DURATION_S / sample_s)):
        now_ns = round((1.0 + k * sample_s) * 1e9)
        references.append([
            swing(k * sample_s, i, AMPLITUDE, PERIOD_S) for i in range(len(p.joint_names))
        ])
        positions.append(arm.links)
        loops.take_references(dict(zip(p.joint_names, references[-1], strict=True)))
        y = dict(zip(p.joint_names, arm.encoders(), strict=True))
        loops.answer(JointOutputs(y, now_ns, now_ns, now_ns, k, numbered=False))
        arm.move_to([RESOLUTION * round(v[joint] / RESOLUTION) for joint in p.joint_names])
        arm.advance(sample_s)
    delay = loops.by_name[p.joint_names[0]].core.structure.delay
    first = len(positions) // 2
    where, wanted = np.array(positions[first:]), np.array(references[first - delay:-delay])
    tip = [
        np.linalg.norm(arm.tip_at(a) - arm.tip_at(b)) for a, b in zip(where, wanted, strict=True)
    ]
    return Motion(sample_s * np.arange(len(tip)), np.array(tip), where - wanted)


def parameters(arm: ArmPhysics, share: float) -> Parameters:
    """Those of config/arm.yaml with constants for the gaps."""
    values: dict[str, object] = {
        **load_config(ROOT / 'config' / 'arm.yaml'), 'estimator.law': 'fixed',
    }
    for joint in arm.joints:
        half = 0.5 * share * arm.lost_motion(joint)
        values |= {f'{joint.name}.estimator.initial.c_r': half,
                   f'{joint.name}.estimator.initial.c_l': -half}
    return Parameters(values)


def rms(values: Array) -> Array:
    """Root of the mean square over time."""
    return np.sqrt(np.mean(values**2, axis=0))


def draw(without: Motion, compensated: Motion) -> None:
    """Distance of the tip over time, both."""
    figure = new_figure(3.2)
    axes = figure.subplots()
    curve(axes, without.t, 1e3 * without.tip, 'tab:red', 'gaps taken for 0')
    curve(axes, compensated.t, 1e3 * compensated.tip, 'tab:blue', 'gaps known')
    label(axes, 'Tip of an arm with play in six joints', 'from where it belongs [mm]', TIME_LABEL)
    axes.legend()
    axes.grid(alpha=0.3)
    PICTURE.write_bytes(png(figure))


def main() -> None:
    """Print what both come to."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--write', action='store_true')
    without, compensated = move(0.0), move(1.0)
    if parser.parse_args().write:
        draw(without, compensated)
    rows = [['tip [mm]', *(f'{1e3 * rms(one.tip):.2f}' for one in (without, compensated))]]
    for i, joint in enumerate(ArmPhysics().joints):
        rows.append([f'{joint.name} [mrad]', *(
            f'{1e3 * rms(one.joints)[i]:.2f}' for one in (without, compensated))])
    print(text_table(('RMS error', 'gaps taken for 0', 'gaps known'), rows))


if __name__ == '__main__':
    main()
