"""How right a run was, and how honest about it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core import Status
from backlash_ros.core.simulation.run_record import RunRecord
from contract.figures import Array, Figure, figure, rms, share, upper

FAR, BEYOND = 0.01, 5.0  # error in gaps, in published deviations, of a wrong estimate
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

    def first_s(self) -> float:
        """Time of the first *tracking* [s], inf for never."""
        return float(self.t[np.argmax(self.tracking)]) if self.tracking.any() else np.inf

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
        return ~(self.z.max(axis=1) <= BEYOND)


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
