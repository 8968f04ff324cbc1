"""Figures of merit of a run: the content of summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.assembly import build_structure, first_guess
from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.learned_model import LearnedModel
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.metrics import (
    control_error_rms,
    delayed_tracking_error_rms,
    settling_time,
)
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import NOTHING, InputError, format_table
from backlash_ros.topics import BACKLASH


def summarise(
    run: RunRecord, parameters: Parameters | None, latency_s: NDArray[np.float64] | None = None,
) -> dict[str, Any]:
    """Figures of merit of a run, the content of summary.json.

    parameters: None where they are not known. latency_s: of each sample, None for a simulation.
    Raises InputError for a run without samples.
    """
    if run.samples == 0:
        raise InputError('the run holds no sample that reached the controller')
    last = dict(zip(COLUMNS, run.rows[-1].tolist(), strict=True))
    truth, t = run.has_truth, run.column('t')
    settling = {
        name: settling_time(t, run.column(name), run.column(f'true_{name}')) if truth else None
        for name in BACKLASH
    }
    return {
        'estimator': parameters.estimator.law if parameters else None,
        'structure': parameters.structure if parameters else None,
        'samples': run.samples,
        'sample_period': run.sample_period,
        'lost_samples': run.lost_samples,
        'began_with': _beginning(run, parameters),
        'final': {name: last[name] for name in (*BACKLASH, 'f')},
        'final_std': {name: last[f'std_{name}'] for name in BACKLASH},
        'truth': {name: last[f'true_{name}'] if truth else None for name in BACKLASH},
        'settling_time_s': settling,
        'control_error_rms': control_error_rms(run),
        'tracking_error_rms': delayed_tracking_error_rms(
            run, reference_delay(parameters), float(t[run.samples // 2])
        ),
        'loop_latency_ms': latency_ms(latency_s),
        'final_status': Status(int(code)).word if (code := last['status']) in set(Status) else None,
        'status_share': _status_share(run.column('status')),
        **_learned(run.learned),
    }


def _beginning(run: RunRecord, parameters: Parameters | None) -> dict[str, Any]:
    """The estimates of the first command, and where they are from; None where that is unknown."""
    first = {name: float(run.column(name)[0]) for name in (*BACKLASH, 'f')}
    if parameters is None:
        return {**first, 'from': None}
    guess = first_guess(parameters)
    guessed = all(first[name] == getattr(guess, name) for name in BACKLASH)
    loaded = parameters.estimates.load and not guessed
    return {
        **first, 'from': parameters.estimates.file if loaded else 'estimator.initial',
    }


ESTIMATE_HEADER = ('estimate', 'std', 'truth', 'error', 'within 1 % from')


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


def _status_share(status: NDArray[np.float64]) -> dict[str, float] | None:
    """Share of the samples in each status, None where it was not recorded."""
    known = status[np.isfinite(status)]
    if known.size == 0:
        return None
    return {state.word: float(np.mean(known == state)) for state in Status}


def _learned(learned: LearnedModel | None) -> dict[str, Any]:
    if learned is None:
        return {'model': None, 'noise_ratio': None, 'unexplained': None}
    return {
        'model': {
            'numerator': list(learned.numerator), 'denominator': list(learned.denominator),
            'delay_samples': learned.delay_samples,
        },
        'noise_ratio': learned.noise_ratio, 'unexplained': learned.unexplained,
    }


def reference_delay(parameters: Parameters | None) -> int:
    """Samples by which y is to follow y_m late, which the structure decides; 0 if unknown."""
    return build_structure(parameters).delay if parameters else 0


def latency_ms(latency_s: NDArray[np.float64] | None) -> dict[str, float] | None:
    """Quantiles [ms] of latencies [s], shape (samples,); None where none is known."""
    known = latency_s[np.isfinite(latency_s)] if latency_s is not None else np.empty(0)
    if known.size == 0:
        return None
    p50, p99 = np.percentile(known, [50, 99]) * 1e3
    return {'p50': float(p50), 'p99': float(p99)}
