"""Every parameter, declared once: used by the nodes, the YAML check and the documents."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

CONTROLLER, PLANT, REFERENCE, RECORDER = 'controller', 'plant', 'reference', 'recorder'
BRINGUP = 'bringup'
JOINTS = 'joints'
# Whose names the sections of a parameter file have.
NODES = (CONTROLLER, PLANT, REFERENCE, RECORDER, BRINGUP)


@dataclass(frozen=True)
class Parameter:
    """A parameter: its default gives its type, low and high hold for each element of a list.

    above: low itself is excluded. length: how many elements a list must have, None for any.
    choices: the allowed words. aliases: former words among them, each with the one that it stands
    for. used_by: executables that read it. live: may change in a running node.
    """

    name: str
    default: Value
    description: str
    unit: str = ''
    low: float = -inf
    high: float = inf
    above: bool = False
    length: int | None = None
    choices: tuple[str, ...] = ()
    aliases: tuple[tuple[str, str], ...] = ()
    used_by: tuple[str, ...] = (CONTROLLER,)
    live: bool = False
    infinite: bool = False  # inf is allowed and means "no limit", or "not known"
    names: bool = False  # a list of names instead of numbers, possibly empty
    may_be_empty: bool = False  # a list of numbers that stands for another one where it is empty


BOTH = (CONTROLLER, PLANT)

PARAMETERS: tuple[Parameter, ...] = (
    Parameter(
        'sample_period', 0.01, 'sample period T of G(z)', 's', low=0.0, above=True,
        used_by=(CONTROLLER, PLANT, REFERENCE),
    ),
    Parameter(
        'plant.numerator', (1e-5, 4e-5, 1e-5),
        'numerator of G(z), descending powers of z', used_by=BOTH,
    ),
    Parameter(
        'plant.denominator', (1.0, -2.88504, 2.77196, -0.88692),
        'denominator of G(z), descending powers of z', used_by=BOTH,
    ),
    Parameter('plant.uncertainty', 0.2,
              'relative spread of the time constants, damping and delay of G; 0: G is exact',
              low=0.0, high=1.0),
    Parameter('actuator.numerator', (),
              'numerator of L(z), from control to the motor encoder that applied_control reports; '
              'empty: the command is what acts on the gap', used_by=BOTH, may_be_empty=True),
    Parameter('actuator.denominator', (), 'denominator of L(z), descending powers of z',
              used_by=BOTH, may_be_empty=True),
    Parameter('actuator.wind_up', (0.0, 0.0),
              'how much further than the motor the command has to go against the friction of the '
              'load, on its right and on its left side', 'v', length=2, used_by=BOTH),
    Parameter('plant.adapt', True, 'redesign gains and preview for the G that was learned'),
    Parameter(
        'lockstep', False,
        'run as fast as the machine allows: each sample waits for its reference and its control',
        used_by=(CONTROLLER, PLANT, REFERENCE, RECORDER),
    ),
    Parameter('wait_for_subscribers', 0,
              'start only when the main topic has this many listeners', low=0,
              used_by=(CONTROLLER, PLANT, REFERENCE)),
    Parameter(
        'estimator.law', 'moving_horizon',
        'law that learns m, c_r, c_l; kalman: a former name of moving_horizon',
        choices=('moving_horizon', 'kalman', 'lms', 'printed', 'fixed', 'gradient'),
        aliases=(('kalman', 'moving_horizon'),),
    ),
    Parameter('estimator.initial.m', 0.696, 'first estimate of the slope', 'u/v',
              low=0.0, above=True),
    Parameter('estimator.initial.c_r', 0.5, 'first estimate of the right crossing', 'v'),
    Parameter('estimator.initial.c_l', -0.5, 'first estimate of the left crossing', 'v'),
    Parameter('estimator.bounds.m', (0.01, 100.0), 'interval of the slope', 'u/v', length=2,
              low=0.0, above=True),
    Parameter('estimator.bounds.c_r', (-100.0, 100.0),
              'interval of the right crossing, which an offset of u moves too', 'v', length=2),
    Parameter('estimator.bounds.c_l', (-100.0, 100.0),
              'interval of the left crossing, which an offset of u moves too', 'v', length=2),
    Parameter('estimator.output_noise_std', 1e-5,
              'standard deviation of the noise on y; where it is not given, that of the simulated '
              'noise and quantum if there is any; not live for every law', 'y', low=0.0, live=True),
    Parameter('estimator.input_noise_std', 0.0,
              'moving_horizon: first guess of how far a slow disturbance of u walks within a '
              'record; learned from the data', 'u', low=0.0, live=True),
    Parameter('estimator.drift_std', (0.0, 0.0, 0.0),
              'moving_horizon: random walk of m, c_r, c_l per square root of a second', length=3,
              low=0.0, live=True),
    Parameter('estimator.use_applied_control', 'auto',
              'take v from applied_control instead of the own command; auto: as soon as the driver '
              'reports every sample, as long as it does, and where control.delay_samples is 0',
              choices=('auto', 'true', 'false')),
    Parameter('estimator.lag', 20,
              'lms and printed: samples by which the reconstruction of u looks back', 'samples',
              low=10, high=1000),
    Parameter('lms.step', 1.0, 'step of the normalised LMS on (m, m c_r, m c_l)', low=0.0,
              high=2.0, above=True, live=True),
    Parameter('lms.step_f', 0.0, 'step of the normalised LMS on f, 0 keeps f', low=0.0, high=2.0,
              live=True),
    Parameter('gradient.step', 1.0, 'gradient: step on (m, m c_r, m c_l)', low=0.0, high=2.0,
              above=True),
    Parameter('structure', 'proportional', 'linear part that makes u_d',
              choices=('proportional', 'tracking', 'pole_placement')),
    Parameter('proportional.f', 0.22, 'gain f of u_d = y_m + f v (3.2)', 'u/v'),
    Parameter('proportional.bounds', (-0.5, 0.5), 'interval of f when the law adapts it', 'u/v',
              length=2),
    Parameter('tracking.preview', 60,
              'tracking: samples of y_m looked at ahead; y follows y_m delayed by as many',
              'samples', low=0, high=10000),
    Parameter('tracking.input_weight', 1e-2,
              'tracking, pole_placement: weight of the square of u less what holds y at the '
              'reference, in units of |G|^2 at a twentieth of the sampling rate',
              low=0.0, above=True, live=True),
    Parameter('tracking.integral_weight', 0.0,
              'tracking: weight of the squared integral of y_m - y; 0, for none, suffices where '
              'the law learns, as effective crossings take up a constant disturbance', low=0.0,
              live=True),
    Parameter('pole_placement.filter_pole', 0.6,
              'pole_placement: pole of the filters of u_d and y', low=0.0, high=0.999),
    Parameter('inverse.caution', 1.0,
              'tracking: standard deviations by which the crossings are shrunk',
              low=0.0, high=100.0,
              live=True),
    Parameter('fixed.doubt', 0.0,
              'fixed: how much of the motion of u the given constants may get wrong', low=0.0),
    Parameter('control.delay_samples', 0, 'samples between control and its effect', 'samples',
              low=0, high=100, used_by=BOTH),
    Parameter('control.min', -inf, 'smallest v', 'v', live=True, infinite=True),
    Parameter('control.max', inf, 'largest v', 'v', live=True, infinite=True),
    Parameter('control.rate_max', inf, 'largest speed of v', 'v/s', low=0.0, above=True,
              live=True, infinite=True),
    Parameter('control.acceleration_max', inf,
              'largest acceleration of v, so that a stepper loses no steps; v brakes in time for '
              'its bounds and for where it is to go', 'v/s^2', low=0.0, above=True, live=True,
              infinite=True),
    Parameter('control.initial', inf,
              'v that acts when the controller starts, where no applied_control tells it; '
              '.inf: not known', 'v', infinite=True),
    Parameter('inverse.direction_band', 0.0,
              'u_d has turned only after coming back by more than this', 'u', low=0.0, live=True),
    Parameter('inverse.take_up_rate', inf,
              'largest speed of v while it crosses the gap; in proportional also while it goes '
              'over to a line that new estimates have moved', 'v/s',
              low=0.0, above=True, live=True, infinite=True),
    Parameter('autostart', True, 'configure and activate at the start, without being asked'),
    Parameter('on_stop', 'hold',
              'last command at deactivation and at the end: v is held, set to zero as fast as '
              'control.rate_max allows (none: at once), or ramped to zero at control.rate_max, '
              'which must be set then', choices=('hold', 'zero', 'ramp'), live=True),
    Parameter('on_timeout', 'hold', 'the same while plant_output is silent',
              choices=('hold', 'zero', 'ramp'), live=True),
    Parameter('on_rival', 'stand_down',
              'what to do where another node published control before this one was activated: '
              'publish nothing until it is gone, or go on and report it',
              choices=('stand_down', 'warn'), live=True),
    Parameter('timeout.plant_output', 0.5,
              'longest silence of plant_output before on_timeout is done, 0 for never', 's',
              low=0.0, high=3600.0, live=True),
    Parameter('timeout.reference', 1.0,
              'longest silence of reference before it is reported, 0 for never', 's',
              low=0.0, high=3600.0,
              live=True),
    Parameter('timeout.ramp', 0.5,
              'longest ramp at the end; a v that is not at zero by then is held', 's',
              low=0.0, high=3600.0,
              live=True),
    Parameter('estimates.file', '', 'file that learned estimates are saved in, empty for none'),
    Parameter('estimates.load', False, 'begin with the estimates in estimates.file, if it exists'),
    Parameter('estimates.save_period', 10.0,
              'time between two savings while running, 0 to save on request and at the end only',
              's', low=0.0, high=86400.0, live=True),
    Parameter(JOINTS, (),
              'joints of an arm, each a loop of its own in one controller, in the order of their '
              'commands in an array; empty for one loop', names=True),
    Parameter('io.style', 'native',
              'native: Float64 on plant_output and control; ros2_control: JointState on '
              'joint_states and Float64MultiArray on forward_command_controller/commands; '
              'joint_state_topic: JointState, references on robot_joint_command, outputs on '
              'robot_joint_states, commands as io.command says',
              choices=('native', 'ros2_control', 'joint_state_topic'),
              used_by=(CONTROLLER, REFERENCE, RECORDER)),
    Parameter('io.command', 'joint_state',
              'joint_state_topic: JointState on joint_commands, or an array of all joints on '
              'forward_command_controller/commands', choices=('joint_state', 'array'),
              used_by=(CONTROLLER, RECORDER)),
    Parameter('io.together', True,
              'where one joint is silent for timeout.plant_output, all joints do on_timeout, until '
              'it is back'),
    Parameter('io.joint', '', 'name of the joint in JointState, empty where there is just one',
              used_by=(CONTROLLER, REFERENCE)),
    Parameter('io.field', 'position', 'what of the joint is y in JointState',
              choices=('position', 'velocity', 'effort'), used_by=(CONTROLLER, REFERENCE)),
    Parameter('io.best_effort', False,
              'listen to a driver that publishes best effort, which may lose messages',
              used_by=(CONTROLLER, REFERENCE, RECORDER)),
    Parameter('backlash.m', 1.3, 'simulated slope', 'u/v', low=0.0, above=True,
              used_by=(PLANT,), live=True),
    Parameter('backlash.c_r', 3.0, 'simulated right crossing', 'v', used_by=(PLANT,), live=True),
    Parameter('backlash.c_l', -3.0, 'simulated left crossing', 'v', used_by=(PLANT,), live=True),
    Parameter('backlash.initial_u', 0.0, 'simulated u held at the start', 'u', used_by=(PLANT,)),
    Parameter('backlash.rate', (0.0, 0.0, 0.0), 'simulated wear of m, c_r, c_l', '1/s', length=3,
              used_by=(PLANT,), live=True),
    Parameter('backlash.jump_time', 0.0, 'time at which backlash.jump is added', 's', low=0.0,
              used_by=(PLANT,), live=True),
    Parameter('backlash.jump', (0.0, 0.0, 0.0), 'simulated step of m, c_r, c_l', length=3,
              used_by=(PLANT,), live=True),
    Parameter('output_noise_std', 0.0, 'simulated noise on y', 'y', low=0.0,
              used_by=(PLANT,), live=True),
    Parameter('output_quantum', 0.0, 'simulated resolution of y, 0 for none', 'y', low=0.0,
              used_by=(PLANT,), live=True),
    Parameter('output_loss', 0.0, 'simulated share of y that never arrives', low=0.0, high=0.99,
              used_by=(PLANT,), live=True),
    Parameter('input_disturbance', 0.0, 'simulated constant added to u', 'u',
              used_by=(PLANT,), live=True),
    Parameter('truth.numerator', (), 'numerator of the simulated G(z), empty: plant.numerator',
              used_by=(PLANT,), may_be_empty=True),
    Parameter('truth.denominator', (),
              'denominator of the simulated G(z), empty: plant.denominator', used_by=(PLANT,),
              may_be_empty=True),
    Parameter('truth.delay_samples', -1,
              'simulated samples between control and its effect, -1: control.delay_samples',
              'samples', low=-1, high=100, used_by=(PLANT,)),
    Parameter('truth.scale_frequency', 1.0,
              'simulated G(z): factor on the natural frequency of every pole', low=0.0, above=True,
              used_by=(PLANT,)),
    Parameter('truth.scale_damping', 1.0,
              'simulated G(z): factor on the damping ratio of every complex pair of poles',
              low=0.0, above=True, used_by=(PLANT,)),
    Parameter('truth.extra_lag', 0.0,
              'simulated dead time of u, parts of a sample included', 's', low=0.0,
              used_by=(PLANT,)),
    Parameter('truth.walk_std', 0.0,
              'simulated random walk added to u, per square root of a second; like '
              'input_disturbance it is no part of the u that plant/truth shows', 'u', low=0.0,
              used_by=(PLANT,)),
    Parameter('seed', 1, 'seed of the simulated noise', low=0, used_by=(PLANT,)),
    Parameter('samples', 0, 'outputs to simulate, 0 for no end', low=0, used_by=(PLANT,)),
    Parameter('waveform', 'sine', 'shape of y_m',
              choices=('sine', 'step', 'square', 'triangle', 'multisine', 'chirp', 'file'),
              used_by=(REFERENCE,), live=True),
    Parameter('amplitude', 10.0, 'amplitude of y_m', 'y_m', low=0.0,
              used_by=(REFERENCE,), live=True),
    Parameter('frequency', 12.6, 'frequency of y_m (chirp: the last one)', 'rad/s', low=0.0,
              above=True, used_by=(REFERENCE,), live=True),
    Parameter('frequency_start', 0.63, 'first frequency of a chirp', 'rad/s', low=0.0, above=True,
              used_by=(REFERENCE,), live=True),
    Parameter('sweep_time', 10.0, 'duration of a chirp', 's', low=0.0, above=True,
              used_by=(REFERENCE,), live=True),
    Parameter('bias', 0.0, 'constant added to y_m', 'y_m', used_by=(REFERENCE,), live=True),
    Parameter('file', '', 'CSV with a row t,y_m per sample for waveform: file',
              used_by=(REFERENCE,), live=True),
    Parameter('storage', 'mcap', 'format of the bag', choices=('mcap', 'sqlite3'),
              used_by=(RECORDER,)),
    Parameter('bag', '', 'folder of the bag, must not exist yet; empty for none',
              used_by=(RECORDER,)),
    Parameter('wait_for_publishers', False,
              'listen to plant_output only once all other nodes are heard', used_by=(RECORDER,)),
    Parameter('axes', (),
              'names of the axes, each a namespace with nodes of its own, empty for one loop '
              "without a namespace; 'y' and 'n' in quotes, as ROS 2 reads them as true and false",
              names=True, used_by=(BRINGUP,)),
    Parameter('driver', '',
              'command to start instead of plant, where {axis} stands for the name of the axis; '
              'none waits for a driver that is started elsewhere, empty is the simulated plant',
              used_by=(BRINGUP,)),
)

# What a controller with several joints has once.
NODE_WIDE = frozenset((
    'sample_period', 'lockstep', 'wait_for_subscribers', JOINTS, 'autostart', 'on_stop',
    'on_timeout', 'on_rival', 'timeout.plant_output', 'timeout.reference', 'timeout.ramp',
    'estimates.file', 'estimates.load', 'estimates.save_period',
    'io.style', 'io.command', 'io.together', 'io.joint', 'io.field', 'io.best_effort',
))

BY_NAME: dict[str, Parameter] = {parameter.name: parameter for parameter in PARAMETERS}


def as_yaml(value: Value) -> str:
    """A value as it stands in a YAML file or after -p NAME:=."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return '[' + ', '.join(map(as_yaml, value)) + ']'
    if isinstance(value, str):
        return value or "''"
    if abs(value) == inf:
        return '.inf' if value > 0 else '-.inf'
    return f'{value:g}' if isinstance(value, float) and value == float(f'{value:g}') else str(value)
