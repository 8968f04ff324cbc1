"""An arm with play in six joints: each identified alone, then all of them on a trajectory.

    python benchmarks/arm_of_physics.py [--files DIR] [--passes 2]

Everything is in one process and in simulated time: the arm of examples/arm_physics.py, encoders of
12 bits, commands in whole steps of them, which the driver reports. `identify` gets a record of each
joint, moved as `identify --drive` moves it; one controller goes on with the files that it writes,
on the trajectory of examples/joint_trajectory.py. --files: keeps those files, and uses those that
are there.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from reporting import ROOT, text_table

sys.path.append(str(ROOT / 'examples'))

from arm_physics import JOINTS, RESOLUTION, ArmPhysics, Joint
from joint_trajectory import swing

from backlash_ros.core.assembly import first_guess, known_before
from backlash_ros.core.identification.motion import Drive, drive_limits, strokes
from backlash_ros.core.loop.control_loop import Driver
from backlash_ros.core.loop.joint_loops import JointLoops
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.identify.command import main as identify

Array = NDArray[np.float64]

AMPLITUDE, PERIOD_S = 0.2, 8.0  # of a swing [rad]
REACH, SPEED, DRIVE_S = 0.2, 0.08, 120.0  # for identify [rad], [rad/s]: no link coasts
KNOWN_OF_SERVOS = ('--order', '1', '--integrator', 'no')  # position loops in slow motion
OF_A_JOINT = ('plant.', 'estimator.', 'tracking.', 'control.delay_samples')  # of identified.yaml
NAMES = [joint.name for joint in JOINTS]


class Motion(NamedTuple):
    """One joint after the other in its columns, a sample in each row, beginning at rest.

    errors (N, 6): of the joints [rad], and tip (N,): distance of the tip [m] from where it belongs,
    for references as late as the loops follow them. gaps (N, 6): as estimated [rad].
    """

    errors: Array
    tip: Array
    gaps: Array


def shared_parameters() -> dict[str, object]:
    """What config/arm.yaml says of all joints."""
    given = read_configuration(ROOT / 'config' / 'arm.yaml').given()
    return {name: value for name, value in given.items() if name.partition('.')[0] not in NAMES}


def identify_joint(joint: Joint, folder: Path) -> None:
    """Move one joint while the others are held, and let `identify` write what it finds."""
    shared = shared_parameters()
    period_s = Parameters(shared).sample_period
    arm, at, goals = ArmPhysics(), NAMES.index(joint.name), [0.0] * len(JOINTS)
    limits = drive_limits(Parameters(shared), REACH, SPEED)
    drive, rows = Drive(strokes, limits, period_s, DRIVE_S), ['t,v,y']
    for k in range(round(DRIVE_S / period_s)):
        y, goals[at] = arm.encoders()[at], in_steps(drive.step())
        rows.append(f'{k * period_s:.3f},{goals[at]!r},{y!r}')
        arm.move_to(goals)
        arm.advance(period_s)
    record = folder / f'{joint.name}.csv'
    record.write_text('\n'.join(rows) + '\n')
    identify([str(record), *KNOWN_OF_SERVOS, '--out', str(folder / joint.name)])


def identified(folder: Path) -> dict[str, object]:
    """Parameters of the arm, with what `identify` has written of each joint."""
    values: dict[str, object] = {
        **shared_parameters(), 'estimates.load': True,
        'estimates.file': str(folder / '{joint}' / 'estimates.json'),
    }
    for name in NAMES:
        found = read_configuration(folder / name / 'identified.yaml').given()
        values |= {f'{name}.{own}': value for own, value in found.items()
                   if own.startswith(OF_A_JOINT)}
    return values


def with_gaps(values: dict[str, object], share: float) -> dict[str, object]:
    """The same with constants: this share of what each joint loses for its gap."""
    fixed = {**values, 'estimator.law': 'fixed', 'estimates.load': False}
    for joint in JOINTS:
        half = 0.5 * share * ArmPhysics().lost_motion(joint)
        fixed |= {f'{joint.name}.estimator.initial.c_r': half,
                  f'{joint.name}.estimator.initial.c_l': -half,
                  f'{joint.name}.estimator.law': 'fixed'}
    return fixed


def move(p: Parameters, passes: int) -> Motion:
    """The arm with these loops on so many periods of the trajectory."""
    arm, period_s, now_ns = ArmPhysics(), p.sample_period, 0
    v = dict.fromkeys(NAMES, 0.0)
    before = known_before if p.estimates.load else first_guess
    loops = JointLoops(
        p, v.update, lambda name: Driver(lambda: now_ns),
        {name: before(p.of_joint(name)) for name in NAMES}, SampleCounter(period_s), dict(v),
    )
    references, positions, gaps = [], [], []
    for k in range(round(passes * PERIOD_S / period_s)):
        now_ns = round((1.0 + k * period_s) * 1e9)
        references.append([swing(k * period_s, i, AMPLITUDE, PERIOD_S) for i in range(len(v))])
        positions.append(arm.links)
        loops.take_references(dict(zip(NAMES, references[-1], strict=True)))
        loops.answer({
            name: Output(y, now_ns, now_ns, now_ns, k, numbered=False)
            for name, y in zip(NAMES, arm.encoders(), strict=True)
        })
        estimates = [loop.estimate for loop in loops.by_name.values()]
        gaps.append([one.c_r - one.c_l for one in estimates])
        for loop in loops.by_name.values():
            loop.core.refine()
        goals = [in_steps(v[name]) for name in NAMES]
        for name, goal in zip(NAMES, goals, strict=True):
            loops.by_name[name].take_applied(goal, now_ns + round(period_s * 1e9))
        arm.move_to(goals)
        arm.advance(period_s)
    delays = [loop.core.structure.delay for loop in loops.by_name.values()]
    late = np.maximum(np.arange(len(positions))[:, None] - delays, 0)
    wanted, where = np.take_along_axis(np.array(references), late, 0), np.array(positions)
    tip = np.array([
        np.linalg.norm(arm.tip_at(a) - arm.tip_at(b)) for a, b in zip(where, wanted, strict=True)
    ])
    return Motion(where - wanted, tip, np.array(gaps))


def in_steps(v: float) -> float:
    """A command as the servos take it [rad]."""
    return RESOLUTION * round(v / RESOLUTION)


def rms(values: Array) -> Array:
    """Root of the mean square over time."""
    return np.sqrt(np.mean(values**2, axis=0))


def main() -> None:
    """Print what each joint and the tip come to."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--files', type=Path)
    parser.add_argument('--passes', type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = options.files or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        for joint in JOINTS:
            if not (folder / joint.name / 'identified.yaml').exists():
                identify_joint(joint, folder)
        values = identified(folder)
        without, known, learned = (
            move(Parameters(each), options.passes)
            for each in (with_gaps(values, 0.0), with_gaps(values, 1.0), values)
        )
    print(table(without, known, learned, round(PERIOD_S / Parameters(values).sample_period)))


def table(without: Motion, known: Motion, learned: Motion, pass_of: int) -> str:
    """Errors in the passes, each of so many samples, and the gaps after them over those there are.

    The first pass begins at rest and lasts until all joints swing: it is learned from, not judged.
    """
    passes = [slice(k, k + pass_of) for k in range(0, len(learned.tip), pass_of)]
    judged = [without.tip[passes[-1]], known.tip[passes[-1]], *(learned.tip[p] for p in passes)]
    rows = [['tip [mm]', *(f'{1e3 * rms(tip):.2f}' for tip in judged)]]
    for i, joint in enumerate(JOINTS):
        judged = [without.errors[passes[-1], i], known.errors[passes[-1], i],
                  *(learned.errors[p, i] for p in passes)]
        lost = ArmPhysics().lost_motion(joint)
        gaps = learned.gaps[[0, *(p.stop - 1 for p in passes)], i] / lost
        rows.append([f'{joint.name} [mrad]', *(f'{1e3 * rms(error):.2f}' for error in judged),
                     *(f'{gap:.3f}' for gap in gaps)])
    numbers = range(1, len(passes) + 1)
    header = ('RMS error', 'gaps 0', 'gaps known', *(f'pass {n}' for n in numbers),
              'gap identified', *(f'after pass {n}' for n in numbers))
    rows[0] += [''] * (len(header) - len(rows[0]))
    return text_table(header, rows)


if __name__ == '__main__':
    main()
