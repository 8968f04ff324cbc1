"""Gears made of physics in one process: identified from limits alone, then in the closed loop."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from math import asin, inf, pi, sin
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from reporting import Array

sys.path.append(str(Path(__file__).resolve().parents[2] / 'examples'))

from gear_physics import PRESETS, Gear, GearPhysics

from backlash_ros.core import Parameters, Status, build_controller
from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.control.motion import strokes
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import Identification, identify
from backlash_ros.core.identification.structure_search import Options
from backlash_ros.core.parameters import ParameterError, Value
from backlash_ros.tools.identify.outcome import as_estimate, identified_parameters

Motion = Callable[[float], float]  # of the phase [rad], between -1 and 1

# Options of `identify`, in the order in which its own messages propose them.
ATTEMPTS = {
    '': Options(), '--integrator no': Options(integrators=(False,)),
    '--integrator no --order 1-2': Options(orders=(1, 2), integrators=(False,)),
}
# Share of the rate, and times the duration: of the motion, and of those where the messages say to
# move more slowly, at lower frequencies, or for longer.
PACES = ((1.0, 1.0), (0.5, 2.0), (0.25, 2.0))
STROKES_S = 20.0  # of the motion for identification, at most 4000 samples
SETTLING_S = 0.5  # at rest before a record
PERIODS, FIRST = 4, 2  # of a motion, and those of them that do not count
CONSTANT_PERIODS, CONSTANT_FIRST = 2, 1  # ... where nothing is learned
SWINGS = 4.0  # of the lost motion either way, in which it is measured
QUASI_STATIC_S = 40.0  # for a period of that
JUMP = 30.0  # second derivative of a shape by its phase, that no smooth one has
# Of gear_of: motor over load, so that friction hardly turns it back; damping ratio; limits over
# what the sine needs; step of the encoders [rad].
HEAVY_MOTOR, DAMPED, HEADROOM, RESOLUTION = 1000.0, 0.8, 1.5, 2.0 * pi / 2**16
DOUBT = 0.5  # without compensation: the observer allows for what that gets wrong


def _triangle(phase: float) -> float:
    return 2.0 / pi * asin(max(-1.0, min(1.0, sin(phase))))


def _multisine(x: float) -> float:
    return (0.6 * sin(x) + 0.3 * sin(2.0 * x + 1.0) + 0.2 * sin(3.0 * x + 4.0)) / 0.95


# Shape, and frequency over that of the preset; the last one moves half of the time, and rests.
MOTIONS: dict[str, tuple[Motion, float]] = {
    'sine': (sin, 1.0), 'slow sine': (sin, 0.3), 'multisine': (_multisine, 0.7),
    'triangle': (_triangle, 0.7),
    'moves and rests': (lambda phase: max(-1.0, min(1.0, 2.0 * _triangle(phase))), 0.5),
}


@dataclass(frozen=True)
class Run:
    """A closed loop: true load, y_m as it is to be followed, motor, estimated gap, (N,) each."""

    y: Array
    y_m: Array
    motor: Array
    gap: Array
    status: NDArray[np.int64]
    first: int  # sample from which it counts

    @property
    def error(self) -> float:
        return float(np.sqrt(np.mean((self.y - self.y_m)[self.first:]**2)))

    def said_tracking_off_by(self, lost_motion: float) -> float:
        """Largest relative error of the gap while the state was tracking; 0 where it never was."""
        rows = self.status[self.first:] == Status.TRACKING
        return float(np.abs(self.gap[self.first:][rows] / lost_motion - 1.0).max(initial=0.0))


def quasi_static(gear: Gear) -> tuple[Array, Array, Array]:
    """One period of a slow motion to and fro: v, motor and load, (N,) each."""
    interval, physics, rows = 0.05, GearPhysics(gear), []
    for k in range(round(1.25 * QUASI_STATIC_S / interval)):
        v = SWINGS * gear.lost_motion * _triangle(2.0 * pi * k * interval / QUASI_STATIC_S)
        physics.move_to(v)
        physics.advance(interval)
        rows.append((v, physics.motor, physics.load))
    v, motor, load = np.array(rows[round(0.25 * QUASI_STATIC_S / interval):]).T
    return v, motor, load


def lost_motion(v: Array, load: Array) -> float:
    """Distance along v of the two branches of a hysteresis loop, in its middle half."""
    middle, speed = np.abs(load) < 0.5 * np.abs(load).max(), np.gradient(load)
    ahead, back = (np.median((v - load)[middle & (sign * speed > 0.0)]) for sign in (1.0, -1.0))
    return float(ahead - back)


def record(gear: Gear, seconds: float = STROKES_S) -> tuple[Array, Array, Array]:
    """The motion of `identify --drive` within the limits: v, motor and load encoder, (N,) each.

    motor: that at the end of the interval in which v acts, as a driver reports it.
    """
    physics, period, rows = GearPhysics(gear), gear.sample_period, []
    reach, rate = gear.scale * gear.reach, gear.scale * gear.rate
    physics.advance(SETTLING_S)
    for v in islice(strokes(-reach, reach, rate, period, seconds, 0.0), round(seconds / period)):
        y = physics.load_encoder()
        physics.move_to(v)
        physics.advance(period)
        rows.append((v, physics.motor_encoder(), y))
    v, motor, y = np.array(rows).T
    return v, motor, y


class Identified(NamedTuple):
    """What `identify --drive` finds within the limits, and the file that it writes.

    option: what it had to be told because nothing of use was found without. parameters: None where
    no controller takes them, refused: why.
    """

    found: Identification
    option: str
    parameters: Parameters | None
    refused: str = ''

    @property
    def controller(self) -> AdaptiveController:
        assert self.parameters is not None
        return build_controller(self.parameters, as_estimate(self.found, self.parameters))


def limits_of(gear: Gear) -> dict[str, Value]:
    """What is known of a gear before it is identified, as parameters."""
    reach = gear.scale * gear.reach
    return {'sample_period': gear.sample_period, 'control.min': -reach, 'control.max': reach,
            'control.rate_max': gear.scale * gear.rate}


def identified(gear: Gear, encoder: bool) -> Identified:
    """Identify from v, or from the motor encoder; if it is not of use, again as told to."""
    given = {**limits_of(gear), 'estimator.use_applied_control': 'true' if encoder else 'false'}
    results: list[Identified] = []
    for pace, longer in PACES:
        v, motor, y = record(replace(gear, rate=pace * gear.rate), longer * STROKES_S)
        for option, choice in ATTEMPTS.items():
            found = identify(motor if encoder else v, y, gear.sample_period, choice)
            if encoder:
                found = with_actuator(found, v)
            told = f'{"" if pace == 1.0 else f"--rate {pace:.0%}"} {option}'.strip()
            try:
                results.append(Identified(found, told, identified_parameters(found, given)))
            except ParameterError as error:
                results.append(Identified(found, told, None, str(error)))
            if found.usable and not results[-1].refused:
                return results[-1]
    return next((one for one in results if one.parameters is not None), results[0])


def constant(
    parameters: Parameters, m: float, c_r: float, c_l: float, doubt: float = 0.0,
) -> AdaptiveController:
    """The same with these constants for good."""
    return build_controller(parameters.replaced({
        'estimator.law': 'fixed', 'fixed.doubt': doubt, 'estimator.initial.m': m,
        'estimator.initial.c_r': c_r, 'estimator.initial.c_l': c_l,
        'estimator.bounds.m': (0.1 * m, 10.0 * m),
        'estimator.bounds.c_r': (0.0, max(2.0 * c_r, 1e-9)),
        'estimator.bounds.c_l': (min(2.0 * c_l, -1e-9), 0.0),
    }))


def close_loop(
    gear: Gear, controller: AdaptiveController, motion: str, encoder: bool = False,
    periods: int = PERIODS, first: int = FIRST,
) -> Run:
    """Run one motion. encoder: the motor encoder is reported. first: period that counts."""
    shape, times = MOTIONS[motion]
    period, frequency = gear.sample_period, times * gear.frequency
    samples = round(periods / frequency / period)
    size = gear.scale * gear.swing
    reference = size * np.array([shape(2.0 * pi * frequency * period * k) for k in range(samples)])
    physics, rows = GearPhysics(gear), np.zeros((samples, 4))
    applied: tuple[float, ...] = ()
    for k in range(samples):
        y, motor = physics.load, physics.motor
        step = controller.step(physics.load_encoder(), float(reference[k]), applied=applied)
        controller.refine()
        rows[k] = y, motor, step.estimate.c_r - step.estimate.c_l, step.estimate.status
        physics.move_to(step.v)
        physics.advance(period)
        applied = (physics.motor_encoder(),) if encoder else ()
    y, motor, gap, status = rows.T
    due = np.append(np.full(controller.structure.delay, reference[0]), reference)[:samples]
    return Run(y, due, motor, gap, status.astype(int), round(first / frequency / period))


def uncompensated(gear: Gear, parameters: Parameters, motion: str) -> Run:
    """The loop that takes the gap for 0."""
    controller = constant(parameters, parameters.estimator.initial.m, 0.0, 0.0, DOUBT)
    return close_loop(gear, controller, motion, False, CONSTANT_PERIODS, CONSTANT_FIRST)


def inertia(gear: Gear, motion: str) -> tuple[float, float]:
    """Largest J |a| / friction of the load on a motion, inf where its speed jumps; and the way that
    the load would coast at its largest speed, over the gap.
    """
    shape, times = MOTIONS[motion]
    w, phase = 2.0 * pi * times * gear.frequency, np.linspace(0.0, 2.0 * pi, 2001)
    speed = np.gradient([shape(float(x)) for x in phase], phase)
    a = np.abs(np.gradient(speed, phase)).max()
    ratio = gear.total_inertia * a * w**2 * gear.swing / gear.friction
    energy = 0.5 * gear.total_inertia * (np.abs(speed).max() * w * gear.swing) ** 2
    return inf if a > JUMP else float(ratio), float(energy / gear.friction / gear.gap)


def gear_of(inertia: float, bandwidth: float) -> Gear:
    """A gear like the servo preset, with a motor that is heavy beside the load.

    inertia: J |a| / friction of its sine. bandwidth: of the position loop over its frequency.
    """
    base = PRESETS['servo']
    w = 2.0 * pi * base.frequency
    motor, servo = HEAVY_MOTOR * base.load_inertia, bandwidth * w
    return replace(
        base, friction=base.load_inertia * base.swing * w**2 / inertia, viscous=0.0,
        motor_inertia=motor, stiffness=motor * servo**2, damping=2.0 * DAMPED * motor * servo,
        torque_limit=1e6, motor_resolution=RESOLUTION, load_resolution=RESOLUTION,
        reach=HEADROOM * base.swing, rate=HEADROOM * base.swing * w,
    )
