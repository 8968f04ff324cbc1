"""Any run: a bag, a folder of results, record.npz or samples.csv, with what stands beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from backlash_ros.bags.reading import is_bag
from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.cli import WHOLE, InputError, Span
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.runs.bag import read_bag
from backlash_ros.tools.runs.files import CONFIG, RECORD, SAMPLES, read_record, read_samples
from backlash_ros.tools.runs.run import Run, cut

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
    parameters = _parameters(path, config, axis)
    period = parameters.sample_period if parameters else None
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
        return Run(cut(read_samples(path, period), span), parameters)
    raise InputError(
        f'{path}: is neither a bag (its folder, .mcap or .db3) nor a folder of results, {RECORD} '
        f'or {SAMPLES}'
    )


def find_bag(path: Path) -> Path | None:
    """The bag at a path or in a folder of results, None where there is none."""
    return next((place for place in (path, path / BAG) if is_bag(place)), None)


def _parameters(path: Path, config: Path | None, axis: str) -> Parameters | None:
    """Those of the file, or of the one beside the run, None without; of the first joint if any."""
    places = [path if path.is_dir() else path.parent]
    if is_bag(path):
        # A bag lies in the folder of the results to which the parameters belong.
        places.append(places[0].parent)
    files = [config] if config else [file for place in places if (file := place / CONFIG).is_file()]
    if not files:
        return None
    configuration = read_configuration(files[0])
    known = configuration.axes or configuration.joints
    if axis not in known:
        axis = configuration.joints[0] if configuration.joints else ''
    return configuration.parameters(axis)
