"""Estimates in a file, so that a controller that is restarted need not learn from nothing."""

import json
from dataclasses import replace
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Any

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.parameters import ParameterError, Parameters

NEEDED, DEVIATIONS = ('m', 'c_r', 'c_l', 'f'), ('std_m', 'std_c_r', 'std_c_l')


def worth_saving(estimate: Estimate) -> bool:
    """Whether it was learned; a first guess is not, nor are constants that were given."""
    return not was_given(estimate) and (estimate.learned or estimate.status == Status.TRACKING)


def was_given(estimate: Estimate) -> bool:
    """Whether the constants are taken as they are: no law that learns is sure of them."""
    return estimate.std_m == estimate.std_c_r == estimate.std_c_l == 0.0


def save_estimate(path: Path, estimate: Estimate, p: Parameters) -> None:
    """Write the file, complete or not at all; raises OSError."""
    values = {name: getattr(estimate, name) for name in (*NEEDED, *DEVIATIONS)}
    content = {
        'version': 1, 'key': _key(p),
        # JSON has no nan.
        'estimate': {name: None if isnan(value) else value for name, value in values.items()},
    }
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + '\n')


def load_estimate(p: Parameters) -> Estimate | None:
    """What estimates.file holds, None where it is not to be loaded or not there yet.

    Raises ParameterError for one that is broken or of another plant or law, `fixed` excepted.
    """
    if not p.estimates.load:
        return None
    name = p.estimates.file

    def refused(rule: str, cure: str = 'delete it') -> ParameterError:
        return ParameterError('estimates.file', name, rule, cure)

    if not name:
        raise refused('must name a file for estimates.load: true', '')
    try:
        content = json.loads(Path(name).read_text(encoding='utf-8'))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise refused(f'cannot be read: {error}', 'delete it or name another one') from None
    try:
        version, key, values = content['version'], dict(content['key']), content['estimate']
        numbers: Any = [nan if values[part] is None else float(values[part])
                        for part in (*NEEDED, *DEVIATIONS)]
    except (KeyError, TypeError, ValueError):
        raise refused('holds no saved estimates', 'delete it or name another one') from None
    estimate = Estimate(*numbers)
    if version != 1:
        raise refused(f'has format {version!r}, not 1')
    if was_given(estimate):
        raise refused('holds constants that were given, not learned')
    for part, value in _key(p).items():
        if key.get(part) != value and (part, value) != ('estimator.law', 'fixed'):
            raise refused(f'was learned with {part}={key.get(part)!r}, which is now {value!r}',
                          'name another file or set estimates.load: false')
    for part in NEEDED:
        value = getattr(estimate, part)
        low, high = getattr(p.estimator.bounds, part, (-inf, inf))
        if not isfinite(value):
            raise refused(f'has no finite {part}')
        if not low <= value <= high:
            raise refused(f'has {part}={value!r} outside of estimator.bounds.{part}')
    if estimate.c_l > estimate.c_r:
        raise refused(f'has c_l={estimate.c_l!r} above c_r={estimate.c_r!r}')
    if not all(getattr(estimate, part) >= 0.0 for part in DEVIATIONS):
        return replace(estimate, std_m=nan, std_c_r=nan, std_c_l=nan)
    return estimate


def _key(p: Parameters) -> dict[str, object]:
    """What a saved estimate depends on, as JSON has it; a file for anything else is refused."""
    names = ('estimator.law', 'sample_period', 'plant.numerator', 'plant.denominator',
             'control.delay_samples')
    return {name: list(value) if isinstance(value := p[name], tuple) else value for name in names}
