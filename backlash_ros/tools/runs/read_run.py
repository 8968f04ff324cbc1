"""Where runs come from: bags and folders of results, with what stands beside them; simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from backlash_ros.bags.reader import is_bag
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import ClosedLoop
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import WHOLE_SPAN, BrokenOffError, InputError, Span
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.runs import files
from backlash_ros.tools.runs.bag import read_bag
from backlash_ros.tools.runs.files import BAG, CONFIG_FILE, RECORD_FILE, SAMPLES_FILE, Run


def read_run(
    path: Path, config: Path | None = None, span: Span = WHOLE_SPAN, axis: str = '',
) -> Run:
    """Read a run; raises InputError.

    path: a bag, its .mcap or .db3 file, a folder of results, record.npz or samples.csv. config:
    parameters of the run; None looks for parameters.yaml beside it. axis: of several.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    parameters = _parameters(path, config, axis)
    period = parameters.sample_period if parameters else None
    if bag := find_bag(path):
        return replace(read_bag(bag, period, span, axis), parameters=parameters)
    inside = (path / name for name in (RECORD_FILE, SAMPLES_FILE) if (path / name).is_file())
    file = next(inside, None) if path.is_dir() else path
    if file is None:
        raise InputError(f'{path}: holds no bag, no {RECORD_FILE} and no {SAMPLES_FILE}')
    if file.suffix not in ('.npz', '.csv'):
        raise InputError(
            f'{path}: is neither a bag (its folder, .mcap or .db3) nor a folder of results, '
            f'{RECORD_FILE} or {SAMPLES_FILE}'
        )
    record = files.read_record(file) if file.suffix == '.npz' else files.read_samples(file, period)
    return Run(record if span == WHOLE_SPAN else _cut(record, span), parameters)


def _cut(record: RunRecord, span: Span) -> RunRecord:
    """The rows within the span, their time counted from the first one; raises InputError."""
    t = record.column('t')
    rows = record.rows[(t >= span.from_s) & (t < span.to_s)]
    if not len(rows):
        raise InputError('there is no sample between --from and --to')
    rows[:, COLUMNS.index('t')] -= rows[0, COLUMNS.index('t')]
    # G is recorded as it was believed at the end.
    learned = record.learned if t[-1] < span.to_s else None
    return RunRecord(rows, record.sample_period, record.lost_samples, learned)


def find_bag(path: Path) -> Path | None:
    """The bag at a path or in a folder of results, None where there is none."""
    return next((place for place in (path, path / BAG) if is_bag(place)), None)


def _parameters(path: Path, config: Path | None, axis: str) -> Parameters | None:
    """Those of the file, or of the one beside the run, None without; of the first joint if any."""
    folder = path if path.is_dir() else path.parent
    # A bag lies in the folder of the results to which the parameters belong.
    beside = [folder / CONFIG_FILE, *[folder.parent / CONFIG_FILE] * is_bag(path)]
    file = config or next(filter(Path.is_file, beside), None)
    if file is None:
        return None
    configuration = read_configuration(file)
    if axis not in (configuration.axes or configuration.joints):
        axis = configuration.joints[0] if configuration.joints else ''
    return configuration.parameters(axis)


def run_loop(
    loop: ClosedLoop, samples: int, on_sample: Callable[[int], None] | None = None,
) -> RunRecord:
    """Simulate a run; raises BrokenOffError when its signals grow beyond every number."""
    try:
        # The controller refuses what is not finite: numpy need not say so as well.
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
            return loop.run(samples, on_sample)
    except OverflowError as error:
        raise BrokenOffError('the run broke off: a signal grew beyond every number') from error
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        reason = ' '.join(str(error).split())
        raise BrokenOffError(f'the run broke off: {reason}') from error
