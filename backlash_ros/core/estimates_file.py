"""Estimates in a file, so that a controller that is restarted need not learn from nothing."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from math import isfinite, isnan, nan
from pathlib import Path

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError

VERSION = 1  # of the file format
LAW, FIXED = 'estimator.law', 'fixed'
# What a saved estimate depends on; a file for anything else is refused.
KEY = (
    LAW,
    'sample_period', 'plant.numerator', 'plant.denominator', 'control.delay_samples',
)
NEEDED, DEVIATIONS = ('m', 'c_r', 'c_l', 'f'), ('std_m', 'std_c_r', 'std_c_l')


def worth_saving(estimate: Estimate) -> bool:
    """Whether it was learned; a first guess is not, nor are constants that were given."""
    return not was_given(estimate) and (
        estimate.learned or estimate.status == Status.TRACKING
    )


def was_given(estimate: Estimate) -> bool:
    """Whether the constants are taken as they are: no law that learns is sure of them."""
    return estimate.std_m == estimate.std_c_r == estimate.std_c_l == 0.0


def save_estimate(path: Path, estimate: Estimate, p: Parameters) -> None:
    """Write the file, complete or not at all; raises OSError."""
    values = {name: asdict(estimate)[name] for name in (*NEEDED, *DEVIATIONS)}
    content = {
        'version': VERSION, 'key': _key(p),
        # JSON has no nan.
        'estimate': {name: None if isnan(value) else value for name, value in values.items()},
    }
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False) + '\n')


def load_estimate(p: Parameters) -> Estimate | None:
    """What estimates.file holds, None where it is not to be loaded or not there yet.

    Raises ParameterError for a file that is broken or belongs to another plant or law. The law
    `fixed` takes what any other one has learned. Files of the time before the law was saved serve
    the laws that know deviations if they hold some.
    """
    if not p.estimates.load:
        return None
    name = p.estimates.file
    if not name:
        raise ParameterError('estimates.file', '', 'must name a file for estimates.load: true')
    try:
        content = json.loads(Path(name).read_text(encoding='utf-8'))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ParameterError(
            'estimates.file', name, f'cannot be read: {error}', 'delete it or name another one'
        ) from None
    try:
        version, key, values = (content[part] for part in ('version', 'key', 'estimate'))
        m, c_r, c_l, f, std_m, std_c_r, std_c_l = (
            _number(values[part]) for part in (*NEEDED, *DEVIATIONS)
        )
    except (KeyError, TypeError):
        raise ParameterError(
            'estimates.file', name, 'holds no saved estimates', 'delete it or name another one'
        ) from None
    if version != VERSION:
        raise ParameterError(
            'estimates.file', name, f'has format {version!r}, not {VERSION}', 'delete it'
        )
    estimate = Estimate(m, c_r, c_l, f, std_m, std_c_r, std_c_l)
    if was_given(estimate):
        raise ParameterError(
            'estimates.file', name, 'holds constants that were given, not learned', 'delete it'
        )
    law = p.estimator.law
    if isinstance(key, dict) and LAW not in key and law != FIXED:
        if law in ('lms', 'printed', 'gradient') or not estimate.learned:
            raise ParameterError(
                'estimates.file', name, 'does not say by which law it was learned',
                'delete it or set estimates.load: false',
            )
        key = {**key, LAW: law}
    for part, value in _key(p).items():
        if part == LAW and law == FIXED:
            continue
        if not isinstance(key, dict) or key.get(part) != value:
            found = key.get(part) if isinstance(key, dict) else None
            raise ParameterError(
                'estimates.file', name,
                f'was learned with {part}={found!r}, which is now {value!r}',
                'name another file or set estimates.load: false',
            )
    return _checked(name, estimate, p)


def _checked(name: str, estimate: Estimate, p: Parameters) -> Estimate:
    for part in NEEDED:
        if not isfinite(getattr(estimate, part)):
            raise ParameterError('estimates.file', name, f'has no finite {part}', 'delete it')
    for part in ('m', 'c_r', 'c_l'):
        low, high = getattr(p.estimator.bounds, part)
        if not low <= getattr(estimate, part) <= high:
            raise ParameterError(
                'estimates.file', name,
                f'has {part}={getattr(estimate, part)!r} outside of estimator.bounds.{part}',
                'delete it',
            )
    if estimate.c_l > estimate.c_r:
        raise ParameterError(
            'estimates.file', name, f'has c_l={estimate.c_l!r} above c_r={estimate.c_r!r}',
            'delete it',
        )
    if not all(getattr(estimate, part) >= 0.0 for part in DEVIATIONS):
        return replace(estimate, std_m=nan, std_c_r=nan, std_c_l=nan)
    return estimate


def _key(p: Parameters) -> dict[str, object]:
    values = {name: p[name] for name in KEY}
    return {
        name: list(value) if isinstance(value, tuple) else value for name, value in values.items()
    }


def _number(value: object) -> float:
    if value is None:
        return nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError
    return float(value)
