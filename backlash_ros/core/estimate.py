"""Estimates of the backlash: values, status, and a file to save them to.

With the file a restarted controller need not learn everything anew.
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
    """How far an estimate can be trusted; published as a code in `controller/signals`."""

    ACQUIRING = 0  # not enough is known yet; the estimate may still change freely
    TRACKING = 1  # consistent with the data, which update it
    NOT_EXCITED = 2  # frozen: v has not crossed the gap lately
    NO_DATA = 3  # frozen: y is missing
    INCONSISTENT = 4  # frozen: no backlash in front of G explains y

    @property
    def word(self) -> str:
        return self.name.lower().replace('_', ' ')


@dataclass(frozen=True)
class Estimate:
    """m [u/v], c_r, c_l [v], f of (3.2) and standard deviations, nan if the law gives none."""

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
        """Whether it was learned from data: a first guess has no standard deviations."""
        return not isnan(self.std_m)


def worth_saving(estimate: Estimate) -> bool:
    """Whether it was learned, and is neither a first guess nor given constants."""
    return not was_given(estimate) and (estimate.learned or estimate.status == Status.TRACKING)


def was_given(estimate: Estimate) -> bool:
    """Whether its constants were given: only then all standard deviations are 0."""
    return estimate.std_m == estimate.std_c_r == estimate.std_c_l == 0.0


def save_estimate(path: Path, estimate: Estimate, p: Parameters) -> None:
    """Write the file, completely or not at all. Raises OSError."""
    values = {name: getattr(estimate, name) for name in (*NEEDED, *DEVIATIONS)}
    content = {
        'version': 1, 'key': _key(p),
        # JSON cannot represent nan.
        'estimate': {name: None if isnan(value) else value for name, value in values.items()},
    }
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + '\n')


def load_estimate(p: Parameters) -> Estimate | None:
    """Read estimates.file; None if it is not to be loaded or does not exist yet.

    Raises ParameterError if it is broken, or of another plant or law; law `fixed` takes any law's.
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
    """Parameters that a saved estimate depends on, as in JSON; other files are refused."""
    names = ('estimator.law', 'sample_period', 'plant.numerator', 'plant.denominator',
             'control.delay_samples')
    return {name: list(value) if isinstance(value := p[name], tuple) else value for name in names}
