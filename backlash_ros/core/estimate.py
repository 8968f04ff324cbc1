"""Estimates of the backlash: their values, how far to trust them, and their file.

With the file a controller that is restarted need not learn from nothing.
"""

import json
from dataclasses import dataclass, replace
from enum import IntEnum
from math import isnan, nan
from pathlib import Path
from typing import Any

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.parameters import ParameterError, Parameters

NEEDED, DEVIATIONS = ('m', 'c_r', 'c_l', 'f'), ('std_m', 'std_c_r', 'std_c_l')


class Status(IntEnum):
    """How much an estimate may be trusted; the code stands in `controller/signals`."""

    ACQUIRING = 0  # not enough known yet, the estimate still moves freely
    TRACKING = 1  # consistent with the data and updated by them
    NOT_EXCITED = 2  # frozen: v did not swing past the gap lately
    NO_DATA = 3  # frozen: y is missing
    INCONSISTENT = 4  # frozen: y does not follow from v through G and a backlash

    @property
    def word(self) -> str:
        return self.name.lower().replace('_', ' ')


@dataclass(frozen=True)
class Estimate:
    """m [u / v], c_r, c_l [v] and f of (3.2), and deviations, nan where the law has none."""

    m: float
    c_r: float
    c_l: float
    f: float
    std_m: float = nan
    std_c_r: float = nan
    std_c_l: float = nan
    status: Status = Status.ACQUIRING

    @property
    def learned(self) -> bool:
        """Whether it comes from data: a first guess has no deviations."""
        return not isnan(self.std_m)


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
        version, key, values = content['version'], dict(content['key']), content['estimate']
        numbers: Any = [nan if values[part] is None else float(values[part])
                        for part in (*NEEDED, *DEVIATIONS)]
    except FileNotFoundError:
        return None
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise refused(f'holds no saved estimates ({error})', 'delete it or name another one') \
            from None
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
        low, high = getattr(p.estimator.bounds, part, (-1e100, 1e100))
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
