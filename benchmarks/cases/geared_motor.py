"""Parameters of config/geared_motor.yaml, its load at other rates, random backlashes for it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from math import pi
from typing import Any

import numpy as np
import yaml
from reporting import ROOT
from scipy.signal import cont2discrete


def flat(sections: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of all sections of a parameter file, by their flat names."""
    found: dict[str, Any] = {}

    def flatten(values: Mapping[str, Any], prefix: str) -> None:
        for key, value in values.items():
            if isinstance(value, dict):
                flatten(value, f'{prefix}{key}.')
            else:
                found[prefix + key] = value

    for section in sections.values():
        flatten(section['ros__parameters'], '')
    return found


@lru_cache
def motor() -> dict[str, Any]:
    """Parameters of config/geared_motor.yaml and its simulated plant."""
    return flat(yaml.safe_load((ROOT / 'config' / 'geared_motor.yaml').read_text()))


def random_backlash(seed: int) -> dict[str, float]:
    """A slope, and a gap that is split at random between c_r and -c_l."""
    rng = np.random.default_rng([seed, 12])
    gap, share = rng.uniform(0.2, 2.0), rng.uniform(0.2, 0.8)
    return {'backlash.m': float(rng.uniform(0.06, 0.15)), 'backlash.c_r': float(gap * share),
            'backlash.c_l': float(gap * (share - 1.0))}


def load_model(period_s: float) -> tuple[list[float], list[float]]:
    """Numerator, without the delay of one sample, and denominator of its load at a period."""
    corner, damping = 2.0 * pi * 20.0, 0.5
    b, a, _ = cont2discrete(([corner**2], [1.0, 2.0 * damping * corner, corner**2]), period_s)
    return b[0, 1:].tolist(), a.tolist()
