"""The loops that are compared, and what becomes of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, nan
from statistics import median
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from backlash_ros.core.assembly import build_model
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import ClosedLoop, build_closed_loop
from backlash_ros.core.simulation.metrics import (
    control_error_rms,
    delayed_reference,
    delayed_tracking_error_rms,
    gap_crossings_per_reversal,
    total_variation,
)
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.cli.errors import BrokenOffError
from backlash_ros.tools.simulate.simulation import run_loop

Array = NDArray[np.float64]

HEADER = (
    'loop', 'control error', 'tracking error', 'backlash penalty', 'total variation of v',
    'crossings per reversal', 'time per step',
)


@dataclass(frozen=True)
class Contender:
    """A loop of the comparison: its name and what sets it apart."""

    name: str
    changes: Mapping[str, object]
    follows: bool  # whether y is meant to follow y_m; otherwise y_m sets u_d


@dataclass(frozen=True)
class Result:
    """What became of a contender; its numbers are nan where they mean nothing.

    control_error [unit of u], tracking_error relative, penalty: tracking error that the backlash
    costs. note: why the run broke off, if it did.
    """

    contender: Contender
    run: RunRecord | None
    delay: int = 0
    control_error: float = nan
    tracking_error: float = nan
    penalty: float = nan
    variation: float = nan
    crossings: float = nan
    step_us: float = nan
    note: str = ''


def contenders(scenario: Parameters) -> list[Contender]:
    """The loops to compare, from the paper's to the one without a backlash."""
    m, c_r, c_l = (scenario.get_float(f'backlash.{name}') for name in ('m', 'c_r', 'c_l'))
    paper = {'structure': 'proportional'}
    tracks = {'structure': 'tracking'}
    return [
        *(
            Contender(f'{law}, u_d = y_m + f v', {**paper, 'estimator.law': law}, False)
            for law in ('printed', 'lms', 'moving_horizon')
        ),
        Contender('gradient, four blocks', {
            'structure': 'pole_placement', 'estimator.law': 'gradient',
            # With less, y, which they feed back unfiltered, has to be less noisy.
            'tracking.input_weight': 1.0,
        }, True),
        Contender('moving_horizon, tracking', {**tracks, 'estimator.law': 'moving_horizon'}, True),
        Contender('wrong constants, tracking', {
            **tracks, **_fixed(m, 1.3 * c_r, 1.3 * c_l), 'fixed.doubt': 0.5,
        }, True),
        Contender('no compensation, tracking', {
            **tracks, **_fixed(m, 0.0, 0.0), 'fixed.doubt': 0.5,
        }, True),
        Contender('no backlash, tracking', {
            **tracks, **_fixed(m, 0.0, 0.0), **_NO_GAP,
        }, True),
    ]


# A gap is wider than nothing by definition (2.1); this one is as good as none.
_NO_GAP = {'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9}


def _fixed(m: float, c_r: float, c_l: float) -> dict[str, object]:
    return {
        'estimator.law': 'fixed', 'estimator.initial.m': m, 'estimator.initial.c_r': c_r,
        'estimator.initial.c_l': c_l,
    }


def compare(scenario: Parameters, samples: int) -> list[Result]:
    """Run every contender and return its figures of merit.

    Where y follows y_m, y_m is scaled by |G| at its frequency, so that every loop asks about the
    same motion of G.
    """
    results = []
    for contender in tqdm(contenders(scenario), desc='compare', unit='loop', disable=None):
        results.append(_measure(contender, _parameters(contender, scenario), samples))
    return results


def _parameters(contender: Contender, scenario: Parameters) -> Parameters:
    changed = scenario.replaced(contender.changes)
    if not contender.follows:
        return changed
    z = np.exp(1j * scenario.get_float('frequency') * scenario.get_float('sample_period'))
    gain = abs(complex(build_model(scenario).response(np.array([z]))[0]))
    return changed.replaced({
        name: gain * scenario.get_float(name) for name in ('amplitude', 'bias')
    })


def _measure(contender: Contender, parameters: Parameters, samples: int) -> Result:
    loop = build_closed_loop(parameters)
    delay = loop.controller.structure.delay
    try:
        run = run_loop(loop, samples)
        step_us = 1e6 * median(_step_times(loop))
    except BrokenOffError as broken:
        return Result(contender, None, delay, note=str(broken))
    result = Result(
        contender, run, delay, _number(control_error_rms(run)),
        variation=total_variation(_late(run, run.column('v'))),
        crossings=_number(gap_crossings_per_reversal(run, _since(run))),
        step_us=step_us,
    )
    if not contender.follows:
        return result
    since = _since(run)
    error = _number(delayed_tracking_error_rms(run, delay, since))
    gapless = run_loop(build_closed_loop(parameters.replaced({
        **_NO_GAP, **_fixed(parameters.get_float('backlash.m'), 0.0, 0.0), 'fixed.doubt': 0.0,
    })), samples)
    best = _number(delayed_tracking_error_rms(gapless, delay, since))
    return replace(result, tracking_error=error, penalty=error - best)


def _since(run: RunRecord) -> float:
    """When the figures of merit begin [s]."""
    return 0.2 * run.samples * run.sample_period


def _late(run: RunRecord, values: Array) -> Array:
    return values[run.column('t') >= _since(run)]


def _number(value: float | None) -> float:
    return nan if value is None else value


def _step_times(loop: ClosedLoop) -> list[float]:
    """Times of some further steps of the controller [s]."""
    times = []
    for _ in range(100):
        y, y_m = loop.plant.measure(), loop.reference(loop.plant.sample * loop.sample_period)
        begin = perf_counter()
        step = loop.controller.step(y, y_m)
        times.append(perf_counter() - begin)
        loop.controller.refine()
        loop.plant.step(step.v)
    return times


def row(result: Result) -> tuple[str, ...]:
    """The line of the table for a result."""
    if result.note:
        return (result.contender.name, 'broke off', *['-'] * (len(HEADER) - 2))
    return (
        result.contender.name, _text(result.control_error), _text(result.tracking_error),
        _text(result.penalty), _text(result.variation), _text(result.crossings, '.2f'),
        f'{result.step_us:.0f} us',
    )


def _text(value: float, form: str = '.3g') -> str:
    return format(value, form) if isfinite(value) else '-'


def tracking_deviation(result: Result) -> Array | None:
    """y - y_m(k - delay); None where y is not meant to follow."""
    if result.run is None or not result.contender.follows:
        return None
    return result.run.column('y') - delayed_reference(result.run, result.delay)
