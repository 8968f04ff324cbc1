"""An arm with play in six joints: each identified alone, then all of them on a trajectory.

    python benchmarks/arm_of_physics.py [--files DIR] [--passes 2] [--write]

Everything is in one process and in simulated time: the arm of examples/arm_physics.py, encoders of
12 bits, commands in whole steps of them, which the driver reports. `identify` gets a record of each
joint, moved as `identify --drive` moves it; one controller goes on with the files that it writes,
on the trajectory of examples/joint_trajectory.py. --files: keeps those files, and uses those that
are there. --write: makes the film of docs/arm.md, with libOSMesa (apt-get install libosmesa6) where
there is no display.
"""

import os
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from reporting import ROOT, Array, format_table, parser_of, save_film

sys.path.append(str(ROOT / 'examples'))
if '--write' in sys.argv:
    os.environ.setdefault('MUJOCO_GL', 'osmesa')  # mujoco reads it when it is imported

from arm_physics import JOINTS, RESOLUTION, ArmPhysics, Joint
from joint_trajectory import swing

from backlash_ros.core.assembly import first_guess, known_before
from backlash_ros.core.control.motion import Drive, drive_limits
from backlash_ros.core.loop.control_loop import Driver, JointLoops
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.figures import TIME_LABEL, curve, label
from backlash_ros.tools.identify.command import main as identify

AMPLITUDE, PERIOD_S = 0.2, 8.0  # of a swing [rad]
REACH, SPEED, DRIVE_S = 0.2, 0.08, 120.0  # for identify [rad], [rad/s]: no link coasts
KNOWN_OF_SERVOS = ('--order', '1', '--integrator', 'no')  # position loops in slow motion
OF_A_JOINT = ('plant.', 'estimator.', 'tracking.', 'control.delay_samples')  # of identified.yaml
NAMES = [joint.name for joint in JOINTS]
FILM = ROOT / 'docs' / 'images' / 'arm.gif'
FRAME_S, COLOURS, VIEW_AT = 0.16, 48, (0.12, 0.0, 0.2)  # of the film


class Motion(NamedTuple):
    """One joint after the other in its columns, a sample in each row, beginning at rest.

    errors (N, 6): of the joints [rad], and tip (N,): distance of the tip [m] from where it belongs,
    for references as late as the loops follow them. gaps (N, 6): as estimated [rad].
    poses (N, 12): of motors and joints, as the physics have them [rad].
    """

    errors: Array
    tip: Array
    gaps: Array
    poses: Array


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
    drive, rows = Drive(limits, period_s, DRIVE_S), ['t,v,y']
    for k in range(round(DRIVE_S / period_s)):
        y, goals[at] = arm.encoders()[at], in_steps(drive.step())
        rows.append(f'{k * period_s:.3f},{goals[at]!r},{y!r}')
        arm.move_to(goals)
        arm.advance(period_s)
    record = folder / f'{joint.name}.csv'
    record.write_text('\n'.join(rows) + '\n')
    identify([str(record), *KNOWN_OF_SERVOS, '--out', str(folder / joint.name)])


def identified(folder: Path) -> dict[str, object]:
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
        own, half = f'{joint.name}.estimator', 0.5 * share * ArmPhysics().lost_motion(joint)
        fixed |= {f'{own}.law': 'fixed', f'{own}.initial.c_r': half, f'{own}.initial.c_l': -half}
    return fixed


def move(p: Parameters, passes: int) -> Motion:
    """The arm with these loops on so many periods of the trajectory."""
    arm, period_s, now_ns = ArmPhysics(), p.sample_period, 0
    v = dict.fromkeys(NAMES, 0.0)
    before = known_before if p.estimates.load else first_guess
    loops = JointLoops(
        p, v.update, lambda name: Driver(lambda: now_ns),
        {name: before(p.of_joint(name)) for name in NAMES}, SampleCounter(period_s), dict(v))
    references, positions, gaps, poses = [], [], [], []
    for k in range(round(passes * PERIOD_S / period_s)):
        now_ns = round((1.0 + k * period_s) * 1e9)
        references.append([swing(k * period_s, i, AMPLITUDE, PERIOD_S) for i in range(len(v))])
        positions.append(arm.links)
        poses.append(arm.data.qpos.copy())
        loops.take_references(dict(zip(NAMES, references[-1], strict=True)))
        loops.answer({name: Output(y, now_ns, now_ns, now_ns, k, numbered=False)
                      for name, y in zip(NAMES, arm.encoders(), strict=True)})
        loops.prepare(NAMES)
        each = list(loops.by_name.values())
        gaps.append([loop.estimate.c_r - loop.estimate.c_l for loop in each])
        goals = [in_steps(v[name]) for name in NAMES]
        for loop, goal in zip(each, goals, strict=True):
            loop.take_applied(goal, now_ns + round(period_s * 1e9))
        arm.move_to(goals)
        arm.advance(period_s)
    delays = [loop.core.structure.delay for loop in loops.by_name.values()]
    late = np.maximum(np.arange(len(positions))[:, None] - delays, 0)
    wanted, where = np.take_along_axis(np.array(references), late, 0), np.array(positions)
    tip = np.array([np.linalg.norm(arm.tip_at(a) - arm.tip_at(b))
                    for a, b in zip(where, wanted, strict=True)])
    return Motion(where - wanted, tip, np.array(gaps), np.array(poses))


def in_steps(v: float) -> float:
    """A command as the servos take it [rad]."""
    return RESOLUTION * round(v / RESOLUTION)


def rms(values: Array) -> Array:
    return np.sqrt(np.mean(values**2, axis=0))


def film(without: Motion, learned: Motion, pass_of: int) -> None:
    """The last pass: the arm, and how far its tip is from where it belongs, with and without."""
    import mujoco  # what it draws with is known by now

    drawn, step = ArmPhysics(), round(FRAME_S * pass_of / PERIOD_S)
    data, camera = mujoco.MjData(drawn.model), mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.azimuth, camera.elevation = VIEW_AT, 0.75, 130.0, -15.0
    frames = []
    t = np.arange(pass_of) * PERIOD_S / pass_of
    with mujoco.Renderer(drawn.model, 320, 320) as renderer:
        for k in range(0, pass_of, step):
            data.qpos[:] = learned.poses[k - pass_of]
            mujoco.mj_forward(drawn.model, data)
            renderer.update_scene(data, camera)
            figure = Figure(figsize=(8.0, 3.4), dpi=80, layout='tight')
            view, axes = figure.subplots(1, 2, width_ratios=(2, 3))
            picture = renderer.render()
            view.imshow(np.where(picture.any(-1, keepdims=True), picture, 255))
            view.axis('off')
            for motion, colour, name in ((without, 'tab:red', 'gaps taken for 0'),
                                         (learned, 'tab:blue', 'gaps identified and learned')):
                tip = 1e3 * motion.tip[-pass_of:]
                curve(axes, t, tip, colour, name)
                axes.plot(t[k], tip[k], 'o', color=colour)
            label(axes, 'Tip from where it belongs', 'distance [mm]', TIME_LABEL)
            axes.legend(loc='upper right')
            axes.set_ylim(0.0, 14.0)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB'))
    save_film(FILM, frames, frames[0].quantize(COLOURS), FRAME_S, FRAME_S)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument('--files', type=Path)
    parser.add_argument('--passes', type=int, default=2)
    parser.add_argument('--write', action='store_true')
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
            for each in (with_gaps(values, 0.0), with_gaps(values, 1.0), values))
    pass_of = round(PERIOD_S / Parameters(values).sample_period)
    print(table(without, known, learned, pass_of))
    if options.write:
        film(without, learned, pass_of)


def table(without: Motion, known: Motion, learned: Motion, pass_of: int) -> str:
    """Errors in the passes, each of so many samples, and the gaps after them over those there are.

    The first pass begins at rest and lasts until all joints swing: it is learned from, not judged.
    """
    passes = [slice(k, k + pass_of) for k in range(0, len(learned.tip), pass_of)]
    judged = [without.tip[passes[-1]], known.tip[passes[-1]], *(learned.tip[p] for p in passes)]
    rows = [['tip [mm]', *(f'{1e3 * rms(tip):.2f}' for tip in judged), *[''] * (1 + len(passes))]]
    for i, joint in enumerate(JOINTS):
        judged = [without.errors[passes[-1], i], known.errors[passes[-1], i],
                  *(learned.errors[p, i] for p in passes)]
        lost = ArmPhysics().lost_motion(joint)
        gaps = learned.gaps[[0, *(p.stop - 1 for p in passes)], i] / lost
        rows.append([f'{joint.name} [mrad]', *(f'{1e3 * rms(error):.2f}' for error in judged),
                     *(f'{gap:.3f}' for gap in gaps)])
    names = [f'pass {n}' for n in range(1, len(passes) + 1)]
    header = ('RMS error', 'gaps 0', 'gaps known', *names, 'gap identified',
              *(f'after {name}' for name in names))
    return format_table(header, rows)


if __name__ == '__main__':
    main()
