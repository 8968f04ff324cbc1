"""What is asked of the estimation, point by point: each function measures one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from reporting import Check, parallel
from scipy.special import chdtri

from accuracy.estimation_runs import (
    EXACT,
    FIVE,
    MARKS_S,
    NAMES,
    QUIET,
    QUIET_NOISE,
    CaseResult,
    SeedJob,
    SeedResult,
    relative_errors,
    run_hour,
    run_quiet_case,
    run_random_case,
    run_seed,
    run_uncertain_case,
    run_wear,
)
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop

Array = NDArray[np.float64]

NOISES = (1e-4, 1e-3, 1e-2)
JUDGED_S = (2.0, 6.0)
EFFICIENCY = 1.1  # RMSE over the bound
LOSS = 0.2
ASIDE = 0.005  # relative bound beyond which a random case is set aside
CASE_ERROR, CASE_SHARE = 0.02, 0.99
SET_ASIDE = 0.25  # share of the random cases
# Where G is off. The bound is that of who knows the time constants as well as they are spread.
ASIDE_UNCERTAIN = 0.0075
UNCERTAIN_ERROR, UNCERTAIN_SHARE = 0.03, 0.97
OVERCONFIDENT = 1.0 / 200.0  # share of the cases with a G that is off
CASES = 500
QUIET_EVERY = 4  # of the cases again with hardly any noise
QUANTUM = 1e-3
DRIFT_STD = (0.01, 0.01, 0.01)  # about 1 % of m in a second
HOUR = 360_000  # samples at 100 Hz


@dataclass(frozen=True)
class Outcome:
    """Checks of one point, and lines that say which seeds fell short."""

    checks: list[Check]
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Batch:
    """Results of all seeds in one setting; arrays have the shape (seeds, marks, ...)."""

    results: Sequence[SeedResult]

    @cached_property
    def rmse(self) -> Array:
        """Root mean squared errors, shape (marks, 3)."""
        return np.asarray(np.sqrt(np.mean([r.error**2 for r in self.results], axis=0)))

    @cached_property
    def bound(self) -> Array:
        """Root mean squared Cramér–Rao bounds, shape (marks, 3)."""
        return np.asarray(np.sqrt(np.mean([r.bound**2 for r in self.results], axis=0)))

    @cached_property
    def nees(self) -> Array:
        """Normalised estimation errors squared, shape (seeds, marks)."""
        return np.array([r.nees for r in self.results])


class Benchmark:
    """Runs the points; runs that two of them need are made once.

    seeds: how many, from first_seed on. workers: processes.
    """

    def __init__(self, seeds: int, first_seed: int, cases: int, hour: int, workers: int) -> None:
        self.seeds, self.first_seed, self.cases = seeds, first_seed, cases
        self.hour, self.workers = hour, workers
        self._batches: dict[tuple[float, float], Batch] = {}

    def batch(self, noise: float, loss: float = 0.0) -> Batch:
        """The paper's example with so much noise on y and such a share of y lost."""
        key = noise, loss
        if key not in self._batches:
            changes = {'output_noise_std': noise, 'output_loss': loss}
            jobs = [
                SeedJob(seed, changes=changes)
                for seed in range(self.first_seed, self.first_seed + self.seeds)
            ]
            label = f'noise {noise:g}' + (f', {loss:.0%} lost' if loss else '')
            self._batches[key] = Batch(parallel(run_seed, jobs, label, self.workers))
        return self._batches[key]

    def noise_free(self) -> Outcome:
        """1: paper example without noise."""
        run = build_closed_loop(Parameters(EXACT)).run(1001)
        error, t = relative_errors(run).max(axis=1), run.column('t')
        checks = []
        for since, limit in ((0.35, 0.01), (1.0, 1e-5)):
            worst = float(error[t >= since - 1e-9].max())
            checks.append(_limit(f'noise-free, largest relative error from {since:g} s on',
                                 worst, limit))
        return Outcome(checks)

    def efficiency(self) -> Outcome:
        """2: RMSE beside the Cramér–Rao bound."""
        checks = []
        for noise in NOISES:
            batch = self.batch(noise)
            for mark in JUDGED_S:
                ratio = (batch.rmse / batch.bound)[MARKS_S.index(mark)]
                checks.append(Check(
                    f'RMSE / Cramér–Rao bound of m, c_r, c_l, noise {noise:g}, {mark:g} s',
                    f'<= {EFFICIENCY:g}', ', '.join(f'{value:.3f}' for value in ratio),
                    bool(np.all(ratio <= EFFICIENCY)),
                ))
        return Outcome(checks, self._far_off())

    def _far_off(self) -> list[str]:
        lines = []
        for noise in NOISES:
            for mark in JUDGED_S:
                i = MARKS_S.index(mark)
                for r in self.batch(noise).results:
                    off = float(np.abs(r.error[i] / r.bound[i]).max())
                    if off > 4.5:
                        lines.append(f'noise {noise:g}, {mark:g} s, seed {r.seed}: '
                                     f'{off:.1f} bounds off, status {r.status[i]}')
        return lines

    def honesty(self) -> Outcome:
        """3: normalised estimation error squared within its 95 % interval."""
        checks = []
        for noise in NOISES:
            for mark in JUDGED_S:
                nees = self.batch(noise).nees[:, MARKS_S.index(mark)]
                freedom = 3 * len(nees)
                low, high = chdtri(freedom, [0.975, 0.025]) / len(nees)
                mean = float(nees.mean())
                checks.append(Check(
                    f'mean NEES of (m, c_r, c_l), noise {noise:g}, {mark:g} s',
                    f'{low:.2f} to {high:.2f}', f'{mean:.2f}', bool(low <= mean <= high),
                ))
        return Outcome(checks, self._overconfident())

    def _overconfident(self) -> list[str]:
        lines = []
        for noise in NOISES:
            for mark in JUDGED_S:
                i = MARKS_S.index(mark)
                lines += [
                    f'noise {noise:g}, {mark:g} s, seed {r.seed}: NEES {r.nees[i]:.1f}'
                    for r in self.batch(noise).results if not r.nees[i] < 20.0
                ]
        return lines

    def random_cases(self) -> Outcome:
        """4: random plants, gaps, first guesses and references.

        Again with next to no noise, and with plants that are another one than G.
        """
        seeds = range(self.first_seed, self.first_seed + self.cases)
        results = parallel(run_random_case, seeds, 'random cases', self.workers)
        quiet = parallel(run_quiet_case, seeds[::QUIET_EVERY], 'without noise', self.workers)
        off = parallel(run_uncertain_case, seeds, 'G off', self.workers)
        exact = ASIDE, CASE_ERROR, CASE_SHARE
        return _joined([
            _judge_cases('random cases', results, *exact),
            _judge_cases(f'random cases with {QUIET_NOISE:g} of the noise', quiet, *exact),
            _judge_cases('random cases with G 10 % off', off, ASIDE_UNCERTAIN, UNCERTAIN_ERROR,
                         UNCERTAIN_SHARE),
            _judge_deviations(off),
        ])

    def imperfect_sensor(self) -> Outcome:
        """5: lost samples, quantised output."""
        whole, lossy = self.batch(1e-3), self.batch(1e-3, LOSS)
        limit = sqrt(1.0 / (1.0 - LOSS)) * 1.1
        checks = []
        for mark in JUDGED_S:
            ratio = (lossy.rmse / whole.rmse)[MARKS_S.index(mark)]
            checks.append(Check(
                f'RMSE of m, c_r, c_l with {LOSS:.0%} of y lost over that with none, noise 1e-3, '
                f'{mark:g} s', f'<= {limit:.3f}', ', '.join(f'{value:.3f}' for value in ratio),
                bool(np.all(ratio <= limit)),
            ))
        run = build_closed_loop(Parameters({**EXACT, 'output_quantum': QUANTUM})).run(101)
        error = float(relative_errors(run)[-1].max())
        return Outcome([
            *checks, _limit(f'y quantised to {QUANTUM:g}, relative error at 1 s', error, 0.002),
        ])

    def wear(self) -> Outcome:
        """6: drift and a step of a parameter."""
        changes = {'output_noise_std': 1e-3, 'estimator.drift_std': DRIFT_STD}
        jobs = [
            SeedJob(seed, changes=changes)
            for seed in range(self.first_seed, self.first_seed + max(self.seeds // 4, 1))
        ]
        results = parallel(run_wear, jobs, 'wear', self.workers)
        m = max(r.m for r in results)
        before, after = (max(r.c_r[i] for r in results) for i in (0, 1))
        of = f'largest over {len(results)} seeds'
        return Outcome([
            _limit(f'm falling by 1 %/s: relative error of m from 1 s on, {of}', m, 0.02),
            _limit(f'c_r before its step from 3 to 4, {of}', before, 0.03),
            _limit(f'c_r from 1 s after the step on, {of}', after, 0.03),
        ], [
            f'seed {r.seed}: m {r.m:.4f}, c_r {r.c_r[0]:.4f} before, {r.c_r[1]:.4f} after'
            for r in results if r.m > 0.02 or max(r.c_r) > 0.03
        ])

    def unexcited(self) -> Outcome:
        """7: an hour in which v does not swing over the gap."""
        jobs = [(what, self.hour) for what in QUIET]
        checks = []
        for r in parallel(run_hour, jobs, 'unexcited', self.workers):
            holds = r.always_frozen and r.moved == 0.0 and r.finite
            checks.append(Check(
                f'{self.hour} samples, {r.what}', 'frozen (not excited), unchanged, finite',
                f'frozen after {r.frozen_after_s:.2f} s'
                + ('' if r.always_frozen else ', not for good')
                + f', moved {r.moved:g}, covariance ' + ('finite' if r.finite else 'NOT finite'),
                holds,
            ))
        return Outcome(checks)

    def accuracy_rows(self) -> list[list[str]]:
        """Accuracy x noise x time beside the bound, for the document."""
        rows = []
        for noise in NOISES:
            batch = self.batch(noise)
            for i, mark in enumerate(MARKS_S):
                cells = [
                    f'{100.0 * rmse / size:.3g} % ({100.0 * bound / size:.3g} %)'
                    for rmse, bound, size in zip(
                        batch.rmse[i], batch.bound[i], (1.3, 3.0, 3.0), strict=True)
                ]
                rows.append([f'{noise:g}', f'{mark:g} s', *cells])
        return rows


ACCURACY_HEADER = ('noise std on y', 'after', *(f'RMSE {name} (bound)' for name in NAMES))


def _judge_cases(
    what: str, results: Sequence[CaseResult], most: float, error: float, least: float,
) -> Outcome:
    """Checks, and lines that name the cases that fell short.

    most: relative bound of a case that counts. error: relative one that is allowed, in the share
    `least` of the cases.
    """
    kept = [r for r in results if float(r.bound.max()) <= most]
    bad = [r for r in kept if not float(r.error.max()) <= error]
    troubled = [r for r in results if r.trouble]
    share = 1.0 - len(bad) / max(len(kept), 1)
    aside = 1.0 - len(kept) / len(results)
    return Outcome([
        Check(f'{what} within {error:.0%} after three periods, {len(kept)} of {len(results)}',
              f'>= {least:.0%}', f'{share:.2%}', share >= least),
        Check(f'{what} set aside: Cramér–Rao bound beyond {most:.2%}', f'< {SET_ASIDE:.0%}',
              f'{aside:.1%}', aside < SET_ASIDE),
        Check(f'{what} with a value not finite or outside its bounds', '0',
              str(len(troubled)), not troubled),
    ], [f'{what}: {_case_line(r)}' for r in [*bad, *(r for r in troubled if r not in bad)]])


def _judge_deviations(results: Sequence[CaseResult]) -> Outcome:
    """Whether the deviations that are published with a G that is off are honest."""
    wrong = [r for r in results if not r.deviations[0] <= FIVE]
    share = len(wrong) / len(results)
    ever = float(np.mean([r.overconfident for r in results]))
    return Outcome([
        Check(f'tracking and wrong by more than {FIVE:g} published deviations after three periods',
              f'<= {OVERCONFIDENT:.1%}', f'{share:.2%}', share <= OVERCONFIDENT),
    ], [
        f'{ever:.2%} of all samples are tracking and wrong by more than {FIVE:g} deviations',
        *(f'G off: {r.deviations[0]:.1f} deviations, {_case_line(r)}' for r in wrong),
    ])


def _joined(outcomes: Sequence[Outcome]) -> Outcome:
    return Outcome(
        [check for outcome in outcomes for check in outcome.checks],
        [note for outcome in outcomes for note in outcome.notes],
    )


def _limit(what: str, value: float, limit: float) -> Check:
    return Check(what, f'<= {limit:g}', f'{value:.3g}', value <= limit)


def _case_line(r: CaseResult) -> str:
    errors = ', '.join(f'{100.0 * e:.3g} %' for e in r.error)
    return (f'seed {r.seed} ({r.kind}): errors {errors}, largest bound '
            f'{100.0 * float(r.bound.max()):.2g} %, v swings {r.swing:.1f} gaps, '
            f'status {r.status} {r.trouble}'.rstrip())
