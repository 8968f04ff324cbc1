"""The runs and the tables with numbers that `make docs` writes, and the page of parameters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import combinations_of_laws
import numpy as np
import printed_law
from reporting import markdown_table as markdown

from backlash_ros.core import Parameters, Status, build_closed_loop
from backlash_ros.core.assembly import build_model, build_true_model
from backlash_ros.core.parameters import BY_NAME, Parameter, as_yaml
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.run_record import RunRecord, control_error_rms, settling_time
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.runs.read_run import run_loop

# No compensation: the inverse is told that there is no gap, and learns nothing.
WITHOUT = {'estimator.law': 'fixed', 'estimator.initial.c_r': '0.0', 'estimator.initial.c_l': '0.0'}


@dataclass(frozen=True)
class Run:
    """One run: what `simulate --config CONFIG --set ... --duration SECONDS` computes."""

    parameters: Parameters
    record: RunRecord
    delay: int  # samples by which y is meant to follow y_m
    model: TransferFunction  # G at the end: the learned one where one is in use


def simulate(
    duration: float, settings: Mapping[str, str] | None = None, config: str | None = None,
) -> Run:
    """Run once, or take the run that has been made already."""
    return _simulate(duration, tuple((settings or {}).items()), config)


@cache
def _simulate(duration: float, settings: tuple[tuple[str, str], ...], config: str | None) -> Run:
    parameters = read_configuration(Path(config) if config else None, [
        f'{name}={value}' for name, value in settings]).parameters()
    loop = build_closed_loop(parameters)
    record = run_loop(loop, round(duration / parameters.sample_period))
    learned = loop.controller.redesign.adopted
    model = build_model(parameters) if learned is None else learned.transfer_function
    return Run(parameters, record, loop.controller.structure.delay, model)


HEAD = """# Parameters

Made from [table.py](../../backlash_ros/core/parameters/table.py) by `make docs`; do not edit.
The nodes, `bringup` and `simulate` all read one YAML file:
[paper_example.yaml](../../config/paper_example.yaml) shows those that are used most.
`y`, `y_m`, `u` and `v` stand for the units of those signals. Parameters marked *live* may change in
a running node; all others of `controller`, but for those marked *fixed*, while it is unconfigured.

| name | default | unit | allowed | meaning | used by |
|---|---|---|---|---|---|
"""


def parameters_page() -> str:
    return HEAD + ''.join(f'{_row(parameter)}\n' for parameter in BY_NAME.values())


def _row(p: Parameter) -> str:
    users = ', '.join([*p.used_by, *{'live': ['*live*'], 'never': ['*fixed*']}.get(p.change, [])])
    cells = (f'`{p.name}`', f'`{as_yaml(p.default)}`', p.unit, _allowed(p), p.description, users)
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


def _allowed(p: Parameter) -> str:
    if p.choices:
        return ', '.join(f'`{choice}`' for choice in p.choices)
    if isinstance(p.default, bool):
        return '`true`, `false`'
    return ', '.join(filter(None, (p.rules, f'{p.length} numbers' if p.length else '')))



NAMES = ('m', 'c_r', 'c_l')
SECONDS = 10.0
MOTOR = 'geared_motor.yaml'
# True plants that differ from the G(z) of MOTOR, by what is set.
TRUE_PLANTS: dict[str, dict[str, str]] = {
    'nominal': {},
    'natural frequency × 0.98': {'truth.scale_frequency': '0.98'},
    'natural frequency × 0.8': {'truth.scale_frequency': '0.8'},
    'natural frequency × 1.2': {'truth.scale_frequency': '1.2'},
    'damping × 1.2': {'truth.scale_damping': '1.2'},
    '5 ms of lag (one sample)': {'truth.extra_lag': '0.005'},
    'natural frequency × 0.5': {'truth.scale_frequency': '0.5'},
    '20 ms of lag': {'truth.extra_lag': '0.02'},
}
RESPONSE_HZ = (2.5, 10.0)  # frequencies at which G is compared


def plant_facts() -> str:
    """What G(z) of the example is like."""
    p = simulate(SECONDS).parameters
    model, frequency = build_model(p), p.frequency
    gain = abs(model.response(np.exp(1j * np.array([frequency * p.sample_period])))[0])
    poles = sorted(np.abs(model.poles), reverse=True)
    return markdown(('of G(z)', 'value', 'and therefore'), (
        ('poles', ', '.join(f'{pole:.5f}' for pole in poles),
         'an integrator and two lags: a constant error of u makes y drift'),
        ('zeros', ', '.join(f'{zero.real:.3f}'
                            for zero in sorted(np.roots(model.numerator), key=abs)),
         'one outside the unit circle: u cannot be had by running 1/G forwards in time'),
        (f'gain at {frequency:g} rad/s', f'{gain:.4f}',
         f'with u_d ≈ y_m, y swings by about ±{gain * p.amplitude:.2f}, not by ±10'),
    ))


def laws() -> str:
    """What each law reaches on the paper's example."""
    rows = []
    for law in ('printed', 'lms', 'moving_horizon'):
        run = simulate(SECONDS, {'estimator.law': law}).record
        t = run.column('t')
        settled = [settling_time(t, run.column(n), run.column(f'true_{n}')) for n in NAMES]
        error = control_error_rms(run)
        rows.append((
            f'`{law}`', *(f'{run.column(name)[-1]:.5g}' for name in NAMES),
            'never' if None in settled else f'{max(s for s in settled if s is not None):.2f} s',
            '-' if error is None else f'{error:.2g}',
        ))
    return markdown(
        ('`estimator.law`', *NAMES, 'all within 1 % from', 'RMS of u − u_d, last second'),
        [('truth', '1.3', '3', '-3', '', ''), *rows],
    )


def printed_not_finite() -> str:
    """Consequence 2 of the printed law."""
    sample, name = printed_law.first_not_finite()
    return markdown(('without guards', ''), [
        ('first quotient that is 0/0', f'`{name}`'), ('at sample', str(sample))])


def printed_growth() -> str:
    """Consequence 3 of the printed law."""
    return markdown(('f', 'measured e(t+1) / e(t)', 'm / f'), [
        (f'{f:g}', f'{printed_law.error_growth(f):.4f}', f'{1.3 / f:.4f}')
        for f in (0.22, 0.5, 1.0)])


def uncertain_plants() -> str:
    """What is learned where the true plant is not G, with G believed and with the default."""
    rows = []
    for name, change in TRUE_PLANTS.items():
        believed = simulate(2.0, {**change, 'plant.uncertainty': '0.0'}, MOTOR)
        free = simulate(2.0, change, MOTOR)
        true = build_true_model(free.parameters)
        rows.append((name, _crossing_errors(believed.record), _crossing_errors(free.record),
                     *(_response_errors(model, true, free.parameters)
                       for model in (build_model(free.parameters), free.model))))
    at = ' and '.join(f'{f:g}' for f in RESPONSE_HZ)
    return markdown((
        'true plant', 'c_r, c_l with `plant.uncertainty: 0`', 'c_r, c_l with 0.2',
        f'nominal G, at {at} Hz', 'G as learned',
    ), rows)


def _crossing_errors(run: RunRecord) -> str:
    """Errors of c_r and c_l at the end, in parentheses their published deviations."""
    cells = []
    for name in ('c_r', 'c_l'):
        true = run.column(f'true_{name}')[-1]
        error, std = run.column(name)[-1] - true, run.column(f'std_{name}')[-1]
        deviation = 'first guess' if np.isnan(std) else _percent(std / true)
        cells.append(f'{_percent(error / true)} ({deviation})')
    status = Status(int(run.column('status')[-1]))
    return ', '.join(cells) + ('' if status is Status.TRACKING else f', {status.word}')


def _response_errors(model: TransferFunction, true: TransferFunction, p: Parameters) -> str:
    z = np.exp(2j * np.pi * np.array(RESPONSE_HZ) * p.sample_period)
    return ', '.join(map(_percent, model.response(z) / true.response(z) - 1.0))


def _percent(share: complex) -> str:
    percent = 100.0 * abs(share)
    return f'{percent:.0f} %' if percent >= 10.0 or percent < 1e-9 else f'{percent:.2g} %'


TABLES: dict[str, Callable[[], str]] = {
    'combinations': lambda: markdown(*combinations_of_laws.rows()),
    **{table.__name__: table for table in (
        plant_facts, laws, printed_not_finite, printed_growth, uncertain_plants)},
}
