"""Estimates of the backlash: their values, how far to trust them, and their bounds."""

from dataclasses import dataclass
from enum import IntEnum
from math import isnan, nan

from backlash_ros.core.parameters import ParameterError


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


@dataclass(frozen=True)
class Bounds:
    """Projection intervals (low, high) of the estimates; 0 < m, c_l <= c_r."""

    m: tuple[float, float] = (0.01, 100.0)
    c_r: tuple[float, float] = (-100.0, 100.0)
    c_l: tuple[float, float] = (-100.0, 100.0)

    def __post_init__(self) -> None:
        for name, (low, high) in vars(self).items():
            if not low < high:
                raise ParameterError(f'estimator.bounds.{name}', [low, high],
                                     'must be [low, high] with low < high')
        if not self.m[0] > 0.0:
            raise ParameterError('estimator.bounds.m', list(self.m), 'must have low > 0')
        if not self.c_l[0] < self.c_r[1]:
            raise ParameterError('estimator.bounds.c_l', list(self.c_l),
                                 f'must have low < {self.c_r[1]:g}, the largest c_r')

    def project(self, m: float, c_r: float, c_l: float) -> tuple[float, float, float]:
        """(m, c_r, c_l) inside the bounds, and c_l at c_r where it would lie to the right of it."""
        m = min(max(m, self.m[0]), self.m[1])
        c_r = min(max(c_r, self.c_r[0]), self.c_r[1])
        c_l = min(max(c_l, self.c_l[0]), self.c_l[1])
        if c_l > c_r:
            c_r = min(max(0.5 * (c_l + c_r), self.c_r[0], self.c_l[0]), self.c_r[1])
            c_l = min(c_r, self.c_l[1])
        return m, c_r, c_l

    def of_products(self, m: float, m_c_r: float, m_c_l: float) -> tuple[float, float, float]:
        """(m, c_r, c_l) inside the bounds, from m, m c_r and m c_l."""
        m = min(max(m, self.m[0]), self.m[1])
        return self.project(m, m_c_r / m, m_c_l / m)
