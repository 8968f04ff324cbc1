"""Summarise a run: figures of merit for summary.json, tables of estimates, curves to compare."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from backlash_ros.core.assembly import LAWS, build_structure, first_guess, law_fits
from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.simulation import run_record
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import NOTHING, BrokenOffError, InputError, format_table, number
from backlash_ros.tools.runs.read_run import run_loop
from backlash_ros.topics import BACKLASH

ERROR_WINDOW_S = 0.5  # over which the error of a curve is averaged
ESTIMATE_HEADER = ('estimate', 'std', 'truth', 'error', 'within 1 % from')


def summarise(run: RunRecord, parameters: Parameters | None) -> dict[str, Any]:
    """Figures of merit of a run, as in summary.json; raises InputError if it has no samples."""
    if run.samples == 0:
        raise InputError('the run holds no sample that reached the controller')
    t, status, latency = (run.column(name) for name in ('t', 'status', 'latency_s'))
    status, latency = status[np.isfinite(status)], latency[np.isfinite(latency)]
    words = {float(state): state.word for state in Status}
    first, newest = (dict(zip(COLUMNS, row, strict=True)) for row in run.rows[[0, -1]].tolist())
    learned, source = run.learned, None
    if parameters is not None:
        guess, estimates = first_guess(parameters), parameters.estimates
        loaded = estimates.load and any(first[name] != getattr(guess, name) for name in BACKLASH)
        source = estimates.file if loaded else 'estimator.initial'
    return {
        'estimator': parameters.estimator.law if parameters else None,
        'structure': parameters.structure if parameters else None,
        'samples': run.samples,
        'sample_period': run.sample_period,
        'lost_samples': run.lost_samples,
        'began_with': {**{name: first[name] for name in (*BACKLASH, 'f')}, 'from': source},
        'final': {name: newest[name] for name in (*BACKLASH, 'f')},
        'final_std': {name: newest[f'std_{name}'] for name in BACKLASH},
        'truth': {name: newest[f'true_{name}'] if run.has_truth else None for name in BACKLASH},
        'settling_time_s': {
            name: run_record.settling_time(t, run.column(name), run.column(f'true_{name}'))
            if run.has_truth else None for name in BACKLASH},
        'control_error_rms': run_record.control_error_rms(run),
        'tracking_error_rms': run_record.delayed_tracking_error_rms(
            run, reference_delay(parameters), float(t[run.samples // 2])),
        'loop_latency_ms': {f'p{q}': 1e3 * float(np.percentile(latency, q)) for q in (50, 99)}
        if latency.size else None,
        'final_status': words.get(newest['status']),
        'status_share': {word: float(np.mean(status == state)) for state, word in words.items()}
        if status.size else None,
        'model': learned and {
            'numerator': list(learned['numerator']), 'denominator': list(learned['denominator']),
            'delay_samples': int(learned['delay_samples'][0])},
        'noise_ratio': learned and learned['noise_ratio'][0],
        'unexplained': learned and learned['unexplained'][0],
    }


def reference_delay(parameters: Parameters | None) -> int:
    """Samples by which y is to lag y_m, 0 if unknown."""
    return build_structure(parameters).delay if parameters else 0


def estimate_cells(summary: Mapping[str, Any], name: str) -> tuple[str, ...]:
    """Cells below ESTIMATE_HEADER for m, c_r or c_l of a summary."""
    final, std, truth, settled = (
        summary[group][name] for group in ('final', 'final_std', 'truth', 'settling_time_s'))
    known = number(final, 6), number(std, 2)
    if truth is None:
        return *known, NOTHING, NOTHING, NOTHING
    error = f'{100.0 * (final - truth) / abs(truth):+.3g} %' if truth else NOTHING
    return *known, number(truth, 6), error, 'never' if settled is None else number(settled, 4, 's')


def estimate_table(summary: Mapping[str, Any], title: str = '') -> str:
    """The estimates of a run as a table in text. title: head of the first column."""
    return format_table((title, *ESTIMATE_HEADER),
                        [(name, *estimate_cells(summary, name)) for name in BACKLASH])


def interesting_parts(run: RunRecord) -> tuple[slice, slice]:
    """Rows at the start and the end of a run: a tenth of it each, but at least 2 s."""
    samples = min(max(run.samples // 10, round(2.0 / run.sample_period), 2), run.samples)
    return slice(0, samples), slice(run.samples - samples, None)


def moving_rms(values: Array, sample_period: float) -> Array:
    """RMS over the ERROR_WINDOW_S before each value, less at the start; nan is left out."""
    known = np.isfinite(values)
    # Not a running sum, which would keep rounding errors of large values long after them.
    window = np.ones(max(round(ERROR_WINDOW_S / sample_period), 1))
    with np.errstate(over='ignore'):  # of a law that diverges
        squares = np.convolve(np.where(known, values, 0.0) ** 2, window)[:len(values)]
    count = np.convolve(known.astype(np.float64), window)[:len(values)]
    return np.where(count > 0.0, np.sqrt(squares / np.maximum(count, 1.0)), np.nan)


def compare_laws(run: RunRecord, parameters: Parameters) -> tuple[dict[str, RunRecord], list[str]]:
    """The run, and runs of every other law simulated with the same parameters (Figure 5).

    The second result says which laws could not be run, and why.
    """
    t, own, notes = run.column('t'), parameters.estimator.law, []
    samples = min(round(float(t[-1]) / run.sample_period) + 1, 10_000)
    beginning = run.rows[t < (samples - 0.5) * run.sample_period]
    runs = {f'{own} (this run)': replace(run, rows=beginning)}
    for law in (law for law in LAWS if law != own and law_fits(law, parameters.structure)):
        try:
            runs[law] = run_loop(build_closed_loop(parameters.replaced({
                'estimator.law': law, 'estimates.load': False})), samples)
        except (ParameterError, InputError, BrokenOffError) as error:
            notes.append(f'{law}: {error}')
    return runs, notes
