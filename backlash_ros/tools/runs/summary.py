"""Figures of merit of a run: the content of summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.assembly import build_structure, first_guess
from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.metrics import (
    control_error_rms,
    delayed_tracking_error_rms,
    settling_time,
)
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.cli import NOTHING, InputError, format_table
from backlash_ros.topics import BACKLASH

ESTIMATE_HEADER = ('estimate', 'std', 'truth', 'error', 'within 1 % from')


def summarise(
    run: RunRecord, parameters: Parameters | None, latency_s: NDArray[np.float64] | None = None,
) -> dict[str, Any]:
    """Figures of merit of a run, the content of summary.json.

    parameters: None where they are not known. latency_s: of each sample, None for a simulation.
    Raises InputError for a run without samples.
    """
    if run.samples == 0:
        raise InputError('the run holds no sample that reached the controller')
    t, status = run.column('t'), run.column('status')
    status = status[np.isfinite(status)]
    words = {float(state): state.word for state in Status}
    latency = np.empty(0) if latency_s is None else latency_s[np.isfinite(latency_s)]

    def last(name: str) -> float:
        return float(run.column(name)[-1])

    learned = run.learned
    return {
        'estimator': parameters.estimator.law if parameters else None,
        'structure': parameters.structure if parameters else None,
        'samples': run.samples,
        'sample_period': run.sample_period,
        'lost_samples': run.lost_samples,
        'began_with': _beginning(run, parameters),
        'final': {name: last(name) for name in (*BACKLASH, 'f')},
        'final_std': {name: last(f'std_{name}') for name in BACKLASH},
        'truth': {name: last(f'true_{name}') if run.has_truth else None for name in BACKLASH},
        'settling_time_s': {
            name: settling_time(t, run.column(name), run.column(f'true_{name}'))
            if run.has_truth else None for name in BACKLASH
        },
        'control_error_rms': control_error_rms(run),
        'tracking_error_rms': delayed_tracking_error_rms(
            run, reference_delay(parameters), float(t[run.samples // 2])
        ),
        'loop_latency_ms': {
            f'p{q}': 1e3 * float(np.percentile(latency, q)) for q in (50, 99)
        } if latency.size else None,
        'final_status': words.get(last('status')),
        'status_share': {word: float(np.mean(status == state)) for state, word in words.items()}
        if status.size else None,
        'model': {
            'numerator': list(learned.numerator), 'denominator': list(learned.denominator),
            'delay_samples': learned.delay_samples,
        } if learned else None,
        'noise_ratio': learned.noise_ratio if learned else None,
        'unexplained': learned.unexplained if learned else None,
    }


def _beginning(run: RunRecord, parameters: Parameters | None) -> dict[str, Any]:
    """The estimates of the first command, and where they are from; None where that is unknown."""
    first = {name: float(run.column(name)[0]) for name in (*BACKLASH, 'f')}
    if parameters is None:
        return {**first, 'from': None}
    guess = first_guess(parameters)
    guessed = all(first[name] == getattr(guess, name) for name in BACKLASH)
    loaded = parameters.estimates.load and not guessed
    return {**first, 'from': parameters.estimates.file if loaded else 'estimator.initial'}


def reference_delay(parameters: Parameters | None) -> int:
    """Samples by which y is to follow y_m late, which the structure decides; 0 if unknown."""
    return build_structure(parameters).delay if parameters else 0


def estimate_cells(summary: Mapping[str, Any], name: str) -> tuple[str, ...]:
    """What a summary has on m, c_r or c_l, as the texts below ESTIMATE_HEADER."""
    final, std = summary['final'][name], summary['final_std'][name]
    truth, settled = summary['truth'][name], summary['settling_time_s'][name]
    known = f'{final:.6g}', f'{std:.2g}' if isfinite(std) else NOTHING
    if truth is None:
        return *known, NOTHING, NOTHING, NOTHING
    error = f'{100.0 * (final - truth) / abs(truth):+.3g} %' if truth else NOTHING
    return *known, f'{truth:.6g}', error, 'never' if settled is None else f'{settled:.4g} s'


def estimate_table(summary: Mapping[str, Any], title: str = '') -> str:
    """The estimates of a run as text; title: of the first column."""
    rows = [(name, *estimate_cells(summary, name)) for name in BACKLASH]
    return format_table((title, *ESTIMATE_HEADER), rows)
