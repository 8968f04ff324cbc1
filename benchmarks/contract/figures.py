"""Figures with their scatter, what is worse or better than before, and how right a run was."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import hypot, log, sqrt
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from reporting import Array

from backlash_ros.core import Status
from backlash_ros.core.simulation.run_record import RunRecord

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


def from_json(rows: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> dict[str, Row]:
    return {name: {what: Figure(**values) for what, values in row.items()}
            for name, row in rows.items()}


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


FAR, DEVIATIONS = 0.01, 5.0  # error in gaps, in published deviations, of a wrong estimate
CAPPED = 10.0  # deviations: a change that is not noticed yet would outweigh everything


@dataclass(frozen=True)
class Judged:
    """Errors of c_r and c_l of one run, and of m.

    t [s], shape (N,). error: of the worse one, in gaps (N,). m: relative (N,). std: published
    deviations of c_r and c_l, in gaps (N, 2). z: errors over them (N, 2). status (N,).
    """

    t: Array
    error: Array
    m: Array
    std: Array
    z: Array
    status: NDArray[np.int_]

    def at(self, time_s: float) -> float:
        """Error at the last sample until then."""
        return float(self.error[int(np.searchsorted(self.t, time_s + 1e-9)) - 1])

    @property
    def tracking(self) -> NDArray[np.bool_]:
        return self.status == Status.TRACKING

    @property
    def rms(self) -> float | None:
        """RMS of error over deviation while *tracking*, CAPPED; None where it never was."""
        if not self.tracking.any():
            return None
        return rms(np.minimum(np.nan_to_num(self.z[self.tracking], nan=CAPPED), CAPPED))

    @property
    def beyond(self) -> float | None:
        """Share of the *tracking* samples with more than five deviations."""
        return float(np.mean(self._beyond[self.tracking])) if self.tracking.any() else None

    @property
    def wrong(self) -> float:
        """Share of all samples: *tracking*, off by 1 % of the gap and five deviations."""
        return float(np.mean(self.tracking & self._beyond & ~(self.error <= FAR)))

    @property
    def wrong_if_tracking(self) -> float | None:
        """The same share of the *tracking* samples; None where there is none."""
        return self.wrong / float(self.tracking.mean()) if self.tracking.any() else None

    @property
    def _beyond(self) -> NDArray[np.bool_]:
        return ~(self.z.max(axis=1) <= DEVIATIONS)


def judged(run: RunRecord, shift: float | Array = 0.0) -> Judged:
    """Beside the true backlash of the run. shift: of both crossings by what is added to u."""
    gap = run.column('true_c_r') - run.column('true_c_l')
    off = np.abs(np.column_stack(
        [run.column(name) - run.column(f'true_{name}') + shift for name in ('c_r', 'c_l')]))
    std = np.column_stack([run.column('std_c_r'), run.column('std_c_l')])
    with np.errstate(divide='ignore', invalid='ignore'):
        return Judged(
            run.column('t'), off.max(axis=1) / gap,
            np.abs(run.column('m') / run.column('true_m') - 1.0), std / gap[:, None], off / std,
            run.column('status').astype(int),
        )


def figures_of(runs: Sequence[Judged | None], marks_s: Sequence[float]) -> dict[str, Figure]:
    """The figures that every row of simulated runs has; None for a run that broke off."""
    whole = [run for run in runs if run is not None]

    def of(value: Callable[[Judged], float | None], broken: float) -> list[float | None]:
        return [broken if run is None else value(run) for run in runs]

    return {
        **{f'error at {mark:g} s, {name} [gap]': figure(of(lambda r, s=mark: r.at(s), 1e3), how)
           for name, how in (('median', np.median), ('90 %', upper)) for mark in marks_s},
        'tracking': share(of(lambda r: float(r.tracking.mean()), 0.0), 'more'),
        'error / deviation, RMS': figure([r.rms for r in whole], rms, 'one'),
        'beyond five deviations': share([r.beyond for r in whole]),
        'wrong while tracking': share(of(lambda r: r.wrong, 1.0)),
    }
