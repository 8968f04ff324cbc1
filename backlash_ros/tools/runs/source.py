"""Any run: a bag, a folder of results, record.npz or samples.csv, with what stands beside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from backlash_ros.bags.reading import is_bag
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import WHOLE, InputError, Span
from backlash_ros.tools.config.configuration import effective_parameters, load_config
from backlash_ros.tools.runs.bag import read_bag
from backlash_ros.tools.runs.files import (
    CONFIG,
    RECORD,
    SAMPLES,
    SUMMARY,
    read_record,
    read_samples,
)
from backlash_ros.tools.runs.run import Run, cut
from backlash_ros.topics import BACKLASH

BAG = 'bag'  # folder of the bag within the results


def read_run(
    path: Path, config: Path | None = None, span: Span = WHOLE, axis: str = '',
) -> Run:
    """Read a run; raises InputError.

    path: a bag, its .mcap or .db3 file, a folder of results, record.npz or samples.csv. config:
    parameters of the run; None looks for parameters.yaml beside it. span, axis: the part that is
    wanted, where there are several.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    parameters = _parameters_beside(path) if config is None else effective_parameters(config)
    period = parameters.get_float('sample_period') if parameters else None
    bag = find_bag(path)
    if bag is not None:
        return replace(read_bag(bag, period, span, axis), parameters=parameters)
    if path.is_dir():
        files = [path / name for name in (RECORD, SAMPLES) if (path / name).is_file()]
        if not files:
            raise InputError(f'{path}: holds no bag, no {RECORD} and no {SAMPLES}')
        path = files[0]
    if path.suffix == '.npz':
        return Run(cut(read_record(path), span), parameters)
    if path.suffix == '.csv':
        record = _with_truth(read_samples(path, period), path.parent / SUMMARY, parameters)
        return Run(cut(record, span), parameters)
    raise InputError(
        f'{path}: is neither a bag (its folder, .mcap or .db3) nor a folder of results, {RECORD} '
        f'or {SAMPLES}'
    )


def find_bag(path: Path) -> Path | None:
    """The bag at a path or in a folder of results, None where there is none."""
    return next((place for place in (path, path / BAG) if is_bag(place)), None)


def _parameters_beside(path: Path) -> Parameters | None:
    # A bag lies in the folder of the results to which the parameters belong.
    places = [path, path.parent] if path.is_dir() and is_bag(path) else \
        [path] if path.is_dir() else [path.parent, path.parent.parent]
    for place in places:
        if (place / CONFIG).is_file():
            return Parameters(load_config(place / CONFIG))
    return None


def _with_truth(run: RunRecord, summary: Path, parameters: Parameters | None) -> RunRecord:
    """The run with the truth of its summary.json, unless the truth changed on the way."""
    wears = parameters is None or any(
        any(parameters.get_triple(name)) for name in ('backlash.rate', 'backlash.jump'))
    if wears or not summary.is_file():
        return run
    try:
        truth = json.loads(summary.read_text(encoding='utf-8'))['truth']
        values = [float(truth[name]) for name in BACKLASH if truth[name] is not None]
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f'{summary}: is not the summary of a run') from None
    if len(values) == len(BACKLASH):
        for name, value in zip(BACKLASH, values, strict=True):
            run.rows[:, COLUMNS.index(f'true_{name}')] = value
    return run
