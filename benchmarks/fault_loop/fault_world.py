"""What surrounds the controller in the fault campaign: random loops, driver, sensor, clock."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from cases.random_cases import random_plant

from backlash_ros.core import Parameters, build_controller, build_plant, build_reference
from backlash_ros.core.assembly import build_model, law_fits
from backlash_ros.core.loop.sample_counter import Output

PERIOD_S = 0.01
LAWS = ('moving_horizon',) * 4 + ('lms', 'printed', 'fixed', 'gradient')
STRUCTURES = ('proportional', 'tracking', 'pole_placement')


def parameters_of(rng: np.random.Generator) -> tuple[Parameters, float]:
    """Parameters of a loop, and the swing of its y."""
    law = str(rng.choice(LAWS))
    structure = str(rng.choice([name for name in STRUCTURES if law_fits(law, name)]))
    numerator, denominator = random_plant(rng)
    m = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0))))
    c_r, c_l = (float(np.exp(rng.uniform(np.log(0.2), np.log(8.0)))) for _ in range(2))
    gap = c_r + c_l
    omega = 2.0 * np.pi / (int(rng.integers(40, 150)) * PERIOD_S)
    factors = 10.0 ** rng.uniform(-0.7, 0.7, 3)
    u_swing = float(rng.uniform(0.4, 4.0)) * m * gap
    f = 0.22 * m if rng.random() < 0.5 else 0.0
    values: dict[str, object] = {
        'sample_period': PERIOD_S, 'estimator.law': law, 'structure': structure,
        'plant.numerator': numerator.tolist(), 'plant.denominator': denominator.tolist(),
        'control.delay_samples': int(rng.choice([0, 0, 1])),
        'backlash.m': m, 'backlash.c_r': c_r, 'backlash.c_l': -c_l,
        'estimator.initial.m': m * factors[0], 'estimator.initial.c_r': c_r * factors[1],
        'estimator.initial.c_l': -c_l * factors[2], 'proportional.f': f,
        'waveform': str(rng.choice(['sine', 'multisine', 'square', 'triangle'])),
        'frequency': float(omega), 'seed': int(rng.integers(2**31)),
        'timeout.plant_output': float(rng.uniform(0.1, 0.5)),
    }
    gain = abs(complex(build_model(Parameters(values)).response(
        np.exp(1j * np.array([omega * PERIOD_S])))[0]))
    y_swing, v_swing = u_swing * gain, u_swing / m + gap
    values['amplitude'] = u_swing if structure == 'proportional' else y_swing
    noise = y_swing * 10.0 ** float(rng.uniform(-5.0, -2.0))
    values['output_noise_std'] = noise
    values['estimator.output_noise_std'] = noise * float(rng.choice([0.3, 1.0, 3.0]))
    if rng.random() < 0.3:
        values['truth.scale_frequency'] = float(rng.uniform(0.85, 1.15))
    if rng.random() < 0.75:
        values['control.min'] = -v_swing * float(rng.uniform(0.7, 3.0))
        values['control.max'] = v_swing * float(rng.uniform(0.7, 3.0))
    actions = ['hold', 'zero']
    if rng.random() < 0.6:
        values['control.rate_max'] = v_swing * float(omega * rng.uniform(1.0, 10.0))
        actions.append('ramp')
    if rng.random() < 0.2:
        values['inverse.take_up_rate'] = v_swing * float(omega * rng.uniform(0.5, 5.0))
    if rng.random() < 0.2:
        values['inverse.direction_band'] = 0.02 * u_swing
    values['on_stop'], values['on_timeout'] = (str(rng.choice(actions)) for _ in range(2))
    p = Parameters(values)
    build_controller(p)
    build_plant(p)
    return p, y_swing


START_NS = 1_800_000_000_000_000_000
TRANSIT = 0.05  # of a period: how long a message is under way
ANSWER = 0.1  # of a period: when the answer to a message leaves
REPORT_NS = 1000  # by which a report leaves before its output
SPIKES, LOSSES = 0.1, 0.3  # share of the samples while such a fault lasts


@dataclass
class Actuator:
    v: float = 0.0


@dataclass
class Sensor:
    """What becomes of y on its way. fault: '' for none."""

    rng: np.random.Generator
    swing: float  # of a sound y
    fault: str = ''
    value: float = 0.0  # that a constant sensor shows
    last: float = 0.0

    def seen(self, y: float, tick: int) -> float:
        chance = float(self.rng.random())
        instead = {'sign': -y, 'constant': self.value, 'stuck': self.last,
                   'another axis': self.swing * float(np.sin(0.037 * tick + 1.0))}
        if self.fault in instead:
            return instead[self.fault]
        if self.fault == 'spikes' and chance < SPIKES:
            return y + 100.0 * self.swing * float(self.rng.standard_normal())
        if self.fault == 'nan' and chance < LOSSES:
            return float(self.rng.choice([np.nan, np.inf, -np.inf, 1e300]))
        self.last = y
        return y


SENSOR_FAULTS = ('sign', 'constant', 'stuck', 'another axis', 'spikes', 'nan')


@dataclass
class Driver:
    """Publishes y, applies the newest v, and reports it where it is asked to.

    origin: the v that a motor encoder shows where v is 0. slow: share by which its period is longer
    than it is told. jitter: share of a period by which stamps scatter.
    """

    p: Parameters
    rng: np.random.Generator
    actuator: Actuator
    sensor: Sensor
    reports: bool
    origin: float = 0.0
    slow: float = 0.0
    jitter: float = 0.0
    loses: bool = False
    loses_reports: bool = False
    repeats: bool = False
    down_until: int = 0
    offset_ns: int = 0  # of its clock, and of that of everybody
    tick: int = 0
    number: int = 0
    outputs: list[Output] = field(default_factory=list)  # on their way to the controller
    applied: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.plant = build_plant(self.p)
        self.reference: Callable[[float], float] = build_reference(self.p)
        self.period_ns = round(self.p.sample_period * 1e9 * (1.0 + self.slow))

    @property
    def time_ns(self) -> int:
        return START_NS + self.tick * self.period_ns + self.offset_ns

    @property
    def answered_ns(self) -> int:
        return self.time_ns + round(ANSWER * self.period_ns)

    def advance(self) -> None:
        """Let one period pass, with the v that acts, and publish the sample at its end."""
        v = self.actuator.v
        self.plant.step(v)
        self.tick += 1
        y = self.sensor.seen(self.plant.measure(), self.tick)
        if self.tick < self.down_until:
            return
        self.number = 1 if self.tick == self.down_until else self.number + 1
        now = self.time_ns
        if self.jitter:
            now += round(self.rng.random() * self.jitter * self.period_ns)
        if self.reports and not (self.loses_reports and self.rng.random() < LOSSES):
            self.applied.append((v + self.origin, now - REPORT_NS))
        if self.loses and self.rng.random() < LOSSES:
            return
        output = Output(y, now, now, now + round(TRANSIT * self.period_ns), self.number)
        self.outputs.append(output)
        if self.repeats and self.rng.random() < LOSSES:
            self.number += 1
            early = now + round(0.1 * self.period_ns)
            self.outputs.append(output._replace(stamp_ns=early, sequence=self.number))
