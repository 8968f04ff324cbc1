"""Figures with their scatter, and what is worse or better than in a reference."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import hypot, log, sqrt
from typing import Any, Literal, TypeVar

import numpy as np
from reporting import Array

Run = TypeVar('Run')
Better = Literal['less', 'more', 'one']  # one: the nearer to 1 on a logarithmic scale

RESAMPLED, SEED = 400, 1
BEYOND = 3.0  # standard deviations of a difference that count
LEAST_SCATTER = 0.02  # relative: a smaller difference is none, however alike the runs are
FEWEST = 3  # runs that show a scatter
LARGEST = 1e6  # stands for a value that is not finite, or larger


@dataclass(frozen=True)
class Figure:
    """One number. scatter: its standard deviation. runs: that it is made of."""

    value: float
    scatter: float
    runs: int
    better: Better = 'less'

    def beyond(self, reference: 'Figure') -> float:
        """By how many standard deviations it is worse, negative where it is better."""
        (bad, scatter), (before, scatter_before) = self.badness, reference.badness
        return (bad - before) / max(hypot(scatter, scatter_before), 1e-12)

    @property
    def badness(self) -> tuple[float, float]:
        """What is better where it is less, and its standard deviation."""
        if self.better == 'one':
            value = max(self.value, 1e-9)
            return abs(log(value)), self.scatter / value
        return self.value if self.better == 'less' else -self.value, self.scatter


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def figure(
    values: Sequence[float | None], how: Callable[[Array], Any] = np.median,
    better: Better = 'less', least_scatter: float = LEAST_SCATTER,
) -> Figure:
    """What `how` makes of one value for each run, and how that scatters over other runs.

    None where a run has no such value.
    """
    known = np.array([value for value in values if value is not None], dtype=float)
    known = np.clip(np.nan_to_num(known, nan=LARGEST, posinf=LARGEST), None, LARGEST)
    if not known.size:
        return Figure(LARGEST if better != 'more' else 0.0, 0.0, 0, better)
    rng = np.random.default_rng(SEED)
    draws = rng.integers(known.size, size=(RESAMPLED, known.size))
    scatter = float(np.std([how(known[draw]) for draw in draws]))
    value = float(how(known))
    if known.size < FEWEST:
        scatter = abs(value)
    return Figure(value, max(scatter, least_scatter * abs(value)), known.size, better)


def share(values: Sequence[float | bool | None], better: Better = 'less') -> Figure:
    """Mean of shares, of which none or all in a few runs is no certainty."""
    plain = figure(values, np.mean, better)
    p = (plain.value * plain.runs + 1.0) / (plain.runs + 2.0)
    least = sqrt(p * (1.0 - p) / plain.runs) if plain.runs else 0.0
    return replace(plain, scatter=max(plain.scatter, least))


def upper(values: Array) -> float:
    """The value that nine of ten runs stay below."""
    return float(np.quantile(values, 0.9))


Row = Mapping[str, Figure]


def by_group(
    runs: Sequence[Run], figures: Callable[[Sequence[Run]], Row],
    group: Callable[[Run], str] = lambda run: run.group,  # type: ignore[attr-defined]
) -> dict[str, Figure]:
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(group(run), []).append(run)
    return {f'{name}: {what}': one for name, of in found.items()
            for what, one in figures(of).items()}


def as_json(rows: Mapping[str, Row]) -> dict[str, dict[str, dict[str, Any]]]:
    return {name: {
        what: {**asdict(one), 'value': float(f'{one.value:.5g}'),
               'scatter': float(f'{one.scatter:.3g}')} for what, one in row.items()
    } for name, row in rows.items()}


COMPARED_HEADER = ('row', 'figure', 'reference', 'now', 'deviations')
Cells = list[list[str]]


def compare(rows: Mapping[str, Row], reference: Mapping[str, Row]) -> tuple[Cells, Cells]:
    """Cells of what is worse, and of what is better, than in the reference, beyond the scatter.

    A figure that the reference has and a row does not is worse.
    """
    worse: Cells = []
    better: Cells = []
    for name, row in rows.items():
        for what, before in reference.get(name, {}).items():
            now = row.get(what)
            if now is None or (before.runs and not now.runs):
                worse.append([name, what, show(before), 'not there', '–'])
            elif abs(by := now.beyond(before)) > BEYOND:
                (worse if by > 0.0 else better).append(
                    [name, what, show(before), show(now), f'{abs(by):.1f}'])
    return worse, better


def show(one: Figure) -> str:
    return f'{one.value:.4g} ± {one.scatter:.2g}' if one.runs else '–'
