"""Every parameter, declared once: nodes, files, the command line and the documents follow.

To add one, add a field: name, type, default, sentence, unit, rules (see Parameter). `p.control.max`
is then its value in a set of Parameters, and `control.max` its name everywhere else.
"""

from functools import partial
from math import inf
from typing import NamedTuple

from backlash_ros.core.parameters.parameter import Parameter, declared_in, option

CONTROLLER, PLANT, REFERENCE_NODE, RECORDER = 'controller', 'plant', 'reference', 'recorder'
BRINGUP = 'bringup'
# The sections of a parameter file have these names.
NODES = (CONTROLLER, PLANT, REFERENCE_NODE, RECORDER, BRINGUP)
NOISE = 'estimator.output_noise_std'

of_both = partial(option, used_by=(CONTROLLER, PLANT))
simulated = partial(option, used_by=(PLANT,))
of_reference = partial(option, used_by=(REFERENCE_NODE,))
of_node = partial(option, per_node=True, change='never')
silence = partial(option, unit='s', low=0.0, high=3600.0, change='live', per_node=True)


class PlantModel(NamedTuple):
    numerator: tuple[float, ...] = of_both(
        (1e-05, 4e-05, 1e-05), 'numerator of G(z), descending powers of z')
    denominator: tuple[float, ...] = of_both(
        (1.0, -2.88504, 2.77196, -0.88692), 'denominator of G(z), descending powers of z')
    uncertainty: float = option(0.2, 'relative spread of the time constants, damping and delay of '
                                'G; 0: G is exact', low=0.0, high=1.0)
    adapt: bool = option(True, 'redesign gains and preview for the learned G')


class ActuatorModel(NamedTuple):
    numerator: tuple[float, ...] = of_both(
        (), 'numerator of L(z), from control to the motor encoder that applied_control reports; '
        'empty: the command itself acts on the gap')
    denominator: tuple[float, ...] = of_both((), 'denominator of L(z), descending powers of z')
    wind_up: tuple[float, float] = of_both(
        (0.0, 0.0), 'how much further the command has to go than the motor, against the friction '
        'of the load, on the right and on the left side', 'v')


class InitialEstimate(NamedTuple):
    m: float = option(0.696, 'first estimate of the slope', 'u/v', above=0.0)
    c_r: float = option(0.5, 'first estimate of the right crossing', 'v')
    c_l: float = option(-0.5, 'first estimate of the left crossing', 'v')


class Bounds(NamedTuple):
    """Intervals [low, high] into which estimates are projected."""

    m: tuple[float, float] = option((0.01, 100.0), 'interval of the slope', 'u/v', above=0.0)
    c_r: tuple[float, float] = option(
        (-100.0, 100.0), 'interval of the right crossing, which an offset of u moves too', 'v')
    c_l: tuple[float, float] = option(
        (-100.0, 100.0), 'interval of the left crossing, which an offset of u moves too', 'v')

    def project(self, m: float, c_r: float, c_l: float) -> tuple[float, float, float]:
        """(m, c_r, c_l) inside the bounds, and c_l at c_r where it would lie to the right of it."""
        m = min(max(m, self.m[0]), self.m[1])
        c_r = min(max(c_r, self.c_r[0]), self.c_r[1])
        c_l = min(max(c_l, self.c_l[0]), self.c_l[1])
        if c_l > c_r:
            c_r = min(max(0.5 * (c_l + c_r), self.c_r[0], self.c_l[0]), self.c_r[1])
            c_l = min(c_r, self.c_l[1])
        return m, c_r, c_l

    def of_products(self, m: float, m_c_r: float, m_c_l: float) -> tuple[float, float, float]:
        """(m, c_r, c_l) inside the bounds, from m, m c_r and m c_l."""
        m = min(max(m, self.m[0]), self.m[1])
        return self.project(m, m_c_r / m, m_c_l / m)


class EstimatorOptions(NamedTuple):
    law: str = option(
        'moving_horizon', 'law that learns m, c_r, c_l; kalman: a former name of moving_horizon',
        choices=('moving_horizon', 'kalman=moving_horizon', 'lms', 'printed', 'fixed', 'gradient'))
    initial: InitialEstimate = InitialEstimate()
    bounds: Bounds = Bounds()
    output_noise_std: float = option(
        1e-05, 'standard deviation of the noise on y; if it is not given, at least that of the '
        'simulated noise and quantum; not live for every law', 'y', low=0.0, change='live')
    input_noise_std: float = option(
        0.0, 'moving_horizon: random walk of a slow disturbance of u per square root of a second; '
        '0: learned if the data demand one', 'u', low=0.0, change='live')
    drift_std: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), 'moving_horizon: random walk of m, c_r, c_l per square root of a second',
        low=0.0, change='live')
    use_applied_control: str = option(
        'auto', 'take v from applied_control instead of the commands that were sent; auto: while '
        'the driver reports every sample, and only if control.delay_samples is 0',
        choices=('auto', 'true', 'false'), change='never')
    lag: int = option(20, 'lms and printed: samples by which the reconstruction of u is late',
                      'samples', low=10, high=1000)


class LmsSteps(NamedTuple):
    step: float = option(1.0, 'step of the normalised LMS on (m, m c_r, m c_l)', above=0.0,
                         high=2.0, change='live')
    step_f: float = option(
        0.0, 'step of the normalised LMS on f, 0 keeps f', low=0.0, high=2.0, change='live')


class GradientStep(NamedTuple):
    step: float = option(1.0, 'gradient: step on (m, m c_r, m c_l)', above=0.0, high=2.0)


class ProportionalGain(NamedTuple):
    f: float = option(0.22, 'gain f of u_d = y_m + f v (3.2)', 'u/v')
    bounds: tuple[float, float] = option((-0.5, 0.5), 'interval of f when the law adapts it', 'u/v')


class TrackingWeights(NamedTuple):
    preview: int = option(60, 'tracking: samples by which y_m is previewed; y follows y_m delayed '
                          'by as many', 'samples', low=0, high=10000)
    input_weight: float = option(0.01, 'tracking, pole_placement: weight of (u - u_r)^2, where u_r '
                                 'holds y at the reference, in units of |G|^2 at a twentieth of '
                                 'the sampling rate', above=0.0, change='live')
    integral_weight: float = option(
        0.0, 'tracking: weight of the squared integral of y_m - y; 0 (none) suffices if the law '
        'learns, as effective crossings take up a constant disturbance', low=0.0, change='live')


class PolePlacementFilter(NamedTuple):
    filter_pole: float = option(
        0.6, 'pole_placement: pole of the filters of u_d and y', low=0.0, high=0.999)


class InverseOptions(NamedTuple):
    caution: float = option(1.0, 'tracking: standard deviations by which the crossings are shrunk',
                            low=0.0, high=100.0, change='live')
    direction_band: float = option(
        0.0, 'u_d counts as turned once it is back by more than this', 'u', low=0.0, change='live')
    take_up_rate: float = option(
        inf, 'largest speed of v while it crosses the gap; proportional: also while it moves to a '
        'line that new estimates have shifted', 'v/s', above=0.0, change='live')


class FixedDoubt(NamedTuple):
    doubt: float = option(
        0.0, 'fixed: fraction of the motion of u that the given constants may get wrong', low=0.0)


class ControlLimits(NamedTuple):
    delay_samples: int = of_both(
        0, 'samples between control and its effect', 'samples', low=0, high=100)
    min: float = option(-inf, 'smallest v', 'v', change='live')
    max: float = option(inf, 'largest v', 'v', change='live')
    rate_max: float = option(inf, 'largest speed of v', 'v/s', above=0.0, change='live')
    acceleration_max: float = option(
        inf, 'largest acceleration of v, so that a stepper loses no steps; v brakes in time for '
        'its bounds and for where it is to go', 'v/s^2', above=0.0, change='live')
    initial: float = option(inf, 'v that acts when the controller starts, if no applied_control '
                            'reports it; .inf: not known', 'v')


class Timeouts(NamedTuple):
    plant_output: float = silence(
        0.5, 'silence of plant_output after which on_timeout takes effect, 0 for never')
    reference: float = silence(
        1.0, 'silence of reference after which it is reported, 0 for never')
    ramp: float = silence(0.5, 'longest ramp at the end; a v that is not at zero by then is held')


class SavedEstimates(NamedTuple):
    file: str = option(
        '', 'file in which learned estimates are saved, empty for none', per_node=True)
    load: bool = option(
        False, 'begin with the estimates in estimates.file, if it exists', per_node=True)
    save_period: float = option(
        10.0, 'time between two saves while running, 0 to save only on request and at the end',
        's', low=0.0, high=86400.0, change='live', per_node=True)


class DriverMessages(NamedTuple):
    style: str = of_node(
        'native', 'native: Float64 on plant_output and control; ros2_control: JointState on '
        'joint_states and Float64MultiArray on forward_command_controller/commands; '
        'joint_state_topic: JointState, references on robot_joint_command, outputs on '
        'robot_joint_states, commands as io.command says',
        choices=('native', 'ros2_control', 'joint_state_topic'),
        used_by=(CONTROLLER, REFERENCE_NODE, RECORDER))
    command: str = of_node('joint_state', 'joint_state_topic: JointState on joint_commands, or an '
                           'array of all joints on forward_command_controller/commands',
                           choices=('joint_state', 'array'), used_by=(CONTROLLER, RECORDER))
    together: bool = of_node(True, 'if one joint is silent for timeout.plant_output, on_timeout '
                             'applies to all joints until it is back')
    joint: str = of_node('', 'name of the joint in JointState, empty if there is just one',
                         used_by=(CONTROLLER, REFERENCE_NODE))
    field: str = of_node(
        'position', 'field of JointState that is y',
        choices=('position', 'velocity', 'effort'), used_by=(CONTROLLER, REFERENCE_NODE))
    best_effort: bool = of_node(False, 'listen to a driver that publishes best effort, which may '
                                'lose messages', used_by=(CONTROLLER, REFERENCE_NODE, RECORDER))


class SimulatedBacklash(NamedTuple):
    m: float = simulated(1.3, 'simulated slope', 'u/v', above=0.0, change='live')
    c_r: float = simulated(3.0, 'simulated right crossing', 'v', change='live')
    c_l: float = simulated(-3.0, 'simulated left crossing', 'v', change='live')
    initial_u: float = simulated(0.0, 'simulated u held at the start', 'u')
    rate: tuple[float, float, float] = simulated(
        (0.0, 0.0, 0.0), 'simulated wear of m, c_r, c_l', '1/s', change='live')
    jump_time: float = simulated(
        0.0, 'time at which backlash.jump is added', 's', low=0.0, change='live')
    jump: tuple[float, float, float] = simulated(
        (0.0, 0.0, 0.0), 'simulated step of m, c_r, c_l', change='live')


class TruePlant(NamedTuple):
    numerator: tuple[float, ...] = simulated(
        (), 'numerator of the simulated G(z), empty: plant.numerator')
    denominator: tuple[float, ...] = simulated(
        (), 'denominator of the simulated G(z), empty: plant.denominator')
    delay_samples: int = simulated(-1, 'simulated samples between control and its effect, -1: '
                                   'control.delay_samples', 'samples', low=-1, high=100)
    scale_frequency: float = simulated(
        1.0, 'simulated G(z): factor on the natural frequency of every pole', above=0.0)
    scale_damping: float = simulated(1.0, 'simulated G(z): factor on the damping ratio of every '
                                     'complex pair of poles', above=0.0)
    extra_lag: float = simulated(
        0.0, 'simulated dead time of u, parts of a sample included', 's', low=0.0)
    walk_std: float = simulated(
        0.0, 'simulated random walk added to u, per square root of a second; like '
        'input_disturbance it is not included in the u of plant/truth', 'u', low=0.0)


class NodeParameters:
    """Parameters of nodes, beside those of control."""

    sample_period: float = option(0.01, 'sample period T of G(z)', 's', above=0.0,
                                  used_by=(CONTROLLER, PLANT, REFERENCE_NODE), per_node=True)
    actuator: ActuatorModel
    lockstep: bool = of_node(
        False, 'run as fast as the machine allows: each sample waits for reference and control',
        used_by=(CONTROLLER, PLANT, REFERENCE_NODE, RECORDER))
    wait_for_subscribers: int = of_node(0, 'start only once the main topic has so many subscribers',
                                        low=0, used_by=(CONTROLLER, PLANT, REFERENCE_NODE))
    autostart: bool = of_node(True, 'configure and activate at the start, without being asked')
    on_stop: str = option(
        'hold', 'last command at deactivation and at the end: v is held, set to zero as fast as '
        'control.rate_max allows (none: at once), or ramped to zero at control.rate_max, which '
        'must be set then', choices=('hold', 'zero', 'ramp'), change='live', per_node=True)
    on_timeout: str = option('hold', 'the same while plant_output is silent',
                             choices=('hold', 'zero', 'ramp'), change='live', per_node=True)
    on_rival: str = option(
        'stand_down', 'what to do if another node published control before this one was '
        'activated: publish nothing until it is gone, or go on and report it',
        choices=('stand_down', 'warn'), change='live', per_node=True)
    timeout: Timeouts
    joints: tuple[str, ...] = of_node(
        (), 'joints of an arm, each a loop of its own in one controller, in the order of their '
        'commands in an array; empty for one loop')
    io: DriverMessages


class ControllerParameters:
    """Model, estimator and control."""

    plant: PlantModel
    estimator: EstimatorOptions
    estimates: SavedEstimates
    lms: LmsSteps
    gradient: GradientStep
    structure: str = option('proportional', 'control structure that computes u_d',
                            choices=('proportional', 'tracking', 'pole_placement'))
    proportional: ProportionalGain
    tracking: TrackingWeights
    pole_placement: PolePlacementFilter
    inverse: InverseOptions
    fixed: FixedDoubt
    control: ControlLimits


class SimulatedPlantParameters:
    """The plant that is simulated."""

    backlash: SimulatedBacklash
    output_noise_std: float = simulated(0.0, 'simulated noise on y', 'y', low=0.0, change='live')
    output_quantum: float = simulated(
        0.0, 'simulated resolution of y, 0 for none', 'y', low=0.0, change='live')
    output_loss: float = simulated(
        0.0, 'simulated fraction of y that never arrives', low=0.0, high=0.99, change='live')
    input_disturbance: float = simulated(0.0, 'simulated constant added to u', 'u', change='live')
    truth: TruePlant
    seed: int = simulated(1, 'seed of the simulated noise', low=0, high=2**32 - 1)
    samples: int = simulated(0, 'outputs to simulate, 0 for no end', low=0)


class ReferenceParameters:
    """The reference y_m."""

    waveform: str = of_reference(
        'sine', 'shape of y_m',
        choices=('sine', 'step', 'square', 'triangle', 'multisine', 'chirp', 'file'), change='live')
    amplitude: float = of_reference(10.0, 'amplitude of y_m', 'y_m', low=0.0, change='live')
    frequency: float = of_reference(
        12.6, 'frequency of y_m (chirp: the last one)', 'rad/s', above=0.0, change='live')
    frequency_start: float = of_reference(
        0.63, 'first frequency of a chirp', 'rad/s', above=0.0, change='live')
    sweep_time: float = of_reference(10.0, 'duration of a chirp', 's', above=0.0, change='live')
    bias: float = of_reference(0.0, 'constant added to y_m', 'y_m', change='live')
    file: str = of_reference('', 'CSV of rows t,y_m for waveform: file', change='live')


class RunParameters:
    """A run: its bag, its axes, its driver."""

    storage: str = option(
        'mcap', 'format of the bag', choices=('mcap', 'sqlite3'), used_by=(RECORDER,))
    bag: str = option(
        '', 'folder of the bag, must not exist yet; empty for none', used_by=(RECORDER,))
    wait_for_publishers: bool = option(
        False, 'listen to plant_output only once all other nodes are heard', used_by=(RECORDER,))
    axes: tuple[str, ...] = option((), 'names of the axes, each a namespace with nodes of its own, '
                                   "empty for one loop without a namespace; 'y' and 'n' in quotes, "
                                   'as ROS 2 reads them as true and false', used_by=(BRINGUP,))
    driver: str = option('', 'command to start instead of plant, where {axis} stands for the name '
                         'of the axis; none: wait for a driver that is started elsewhere; empty: '
                         'the simulated plant', used_by=(BRINGUP,))


class ParameterTree(
    RunParameters, ReferenceParameters, SimulatedPlantParameters, ControllerParameters,
    NodeParameters,
):
    """All parameters: `tree.control.max` is the value of control.max."""


BY_NAME: dict[str, Parameter] = {each.name: each for each in declared_in(ParameterTree)}
