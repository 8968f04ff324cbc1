"""Rows of what is more than a loop: late commands, faults, identification, gears of physics."""

import contextlib
import io
import json
import tempfile
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from cases.held_up import HeldUpProcesses
from cases.identification_cases import NO_PLAYS, Case, random_case, without_play
from cases.loops import motor
from contract.figures import Array, Figure, by_group, figure, share, upper
from faults import Result
from gears import gear_runs
from gears.gear_runs import PRESETS, Gear, close_loop, gear_of

from backlash_ros.core import Estimate, Parameters, Status, build_controller, fit_record
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.identify.command import main as identify

# Late commands: driver and controller held up by a busy machine, in simulated time.
HELD_UP_S = 6.0


class HeldUp(NamedTuple):
    """One run of held-up processes; errors of c_r or c_l, relative, the larger one."""

    group: str
    at_end: float
    settled_s: float
    wrong: float


def late_jobs(scale: float) -> list[tuple[float, str, int]]:
    return list(product((0.4, 1.0), ('auto', 'false'), range(1, 1 + max(round(10 * scale), 1))))


def run_late(job: tuple[float, str, int]) -> HeldUp:
    load, use, seed = job
    p = Parameters({**motor(), 'estimator.use_applied_control': use})
    heard = HeldUpProcesses(p, load, seed, reports=use != 'false').run(HELD_UP_S)
    settled = max((one.time_s for one in heard if not one.error <= 0.01), default=0.0)
    return HeldUp(f'load {load:g}, reports {use}', heard[-1].error, settled,
                  float(np.mean([one.wrong for one in heard])))


def late_figures(runs: Sequence[HeldUp]) -> dict[str, Figure]:
    return by_group(runs, lambda of: {
        f'error at {HELD_UP_S:g} s, median': figure([r.at_end for r in of]),
        f'error at {HELD_UP_S:g} s, 90 %': figure([r.at_end for r in of], upper),
        'seconds until within 1 %, median': figure([r.settled_s for r in of]),
        'wrong while tracking': share([r.wrong for r in of]),
    })


# Sequences of faults.
HURT = ('outside', 'too_fast', 'jumps', 'unbounded', 'broken')
FIRST_SEQUENCE = 101


def faults_jobs(scale: float) -> list[int]:
    return list(range(FIRST_SEQUENCE, FIRST_SEQUENCE + round(150 * scale)))


def faults_figures(results: Sequence[Result]) -> dict[str, Figure]:
    """Sequences that hurt, and of those in which a law claimed to know the ones that lied."""
    claimed = [r for r in results if r.claimed]
    return {
        **{kind: share([kind in r.found for r in results]) for kind in HURT},
        'said tracking': share([r.claimed for r in results], 'more'),
        **{f'{kind}, of those that said tracking': share([kind in r.found for r in claimed])
           for kind in ('wrong', 'wrong_uncertain', 'wrong_inherited')},
    }


# Identification.
Found = tuple[Mapping[str, Any], Parameters | None]


def identified(t: Array, v: Array, y: Array, given: Mapping[str, Any] | None = None) -> Found:
    """What `identify` makes of a CSV: identified.json, and parameters of identified.yaml.

    given: parameters that it goes on from.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savetxt(folder / 'record.csv', np.column_stack([t, v, y]), '%.12g', ',',
                   header='t,v,y', comments='')
        arguments = [str(folder / 'record.csv'), '--out', name]
        if given is not None:
            text = yaml.safe_dump({'/**': {'ros__parameters': given}})
            (folder / 'given.yaml').write_text(text)
            arguments += ['--config', str(folder / 'given.yaml')]
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            identify(arguments)
        results = {path.suffix: path for path in folder.glob('identified.*')}
        found = json.loads(results['.json'].read_text()) if results else {'usable': False}
        p = Parameters(read_configuration(results['.yaml']).given()) if '.yaml' in results else None
    return found, p


class Identified(NamedTuple):
    """One random actuator. error: of the gap, and in a clean record of both crossings, in gaps.

    deviations: of the gap. fitted: errors of the gap by fit_record with the true G, in gaps and in
    its deviations; None for a record that is not clean.
    """

    group: str
    usable: bool
    error: float
    deviations: float
    delay_right: bool
    fitted: tuple[float, float] | None = None


CLEAN, SPOILT, NONE = 'clean', 'as people record', 'no play'
JITTER, REPEATED, LONGEST_DELAY = 0.1, 0.05, 12  # of the period; share of y; samples


def identification_jobs(scale: float) -> list[tuple[str, int]]:
    """Seeds of random actuators; as people record: with jitter, an offset, repeats and a delay."""
    return [(group, seed) for group, count in ((CLEAN, 24), (SPOILT, 16), (NONE, 20))
            for seed in range(round(count * scale))]


def run_identification(job: tuple[str, int]) -> Identified:
    group, seed = job
    if group == NONE:
        found = identified(*without_play(NO_PLAYS[seed % len(NO_PLAYS)], seed))[0]
        known = (found.get('known') or {}).get('backlash', {}).get('known', False)
        return Identified(group, bool(known and found['gap'] > 3.0 * found['std']['gap']), 0.0, 0.0,
                          False)
    case = random_case(seed)
    t, v, y, delay = case.period * np.arange(len(case.v)), case.v, case.y.copy(), case.delay
    truth = {'gap': case.gap}
    if group == SPOILT:
        rng = np.random.default_rng([seed, 31])
        more = int(rng.integers(LONGEST_DELAY + 1))
        delay += more
        y = np.concatenate([np.full(more, y[0]), y])[:len(y)]
        for k in 1 + np.flatnonzero(rng.random(len(y) - 1) < REPEATED):
            y[k] = y[k - 1]
        v = v + rng.uniform(-2.0, 2.0) * case.gap
        t = t + JITTER * case.period * rng.uniform(-1.0, 1.0, len(t))
    else:
        truth |= {'c_r': case.c_r, 'c_l': case.c_l}
    found, _ = identified(t, v, y)
    off = {name: abs(found[name] - true) if isinstance(found.get(name), float) else 1e3
           for name, true in truth.items()}
    std = (found.get('std') or {}).get('gap') or 1e-12
    return Identified(
        group, bool(found.get('usable')), min(max(off.values()) / case.gap, 1e3),
        min(off['gap'] / std, 1e3), found.get('delay_samples') == delay,
        _fitted(case) if group == CLEAN else None,
    )


def _fitted(case: Case) -> tuple[float, float]:
    model = TransferFunction((case.numerator / case.m).tolist(), case.denominator.tolist())
    fit = fit_record(case.v, case.y, model, 0.02, case.level, delays=(case.delay,))
    off = abs(fit.gap - case.gap)
    return min(off / case.gap, 1e3), off / max(fit.std_gap, 1e-12)


def identification_figures(runs: Sequence[Identified]) -> dict[str, Figure]:
    def of_group(of: Sequence[Identified]) -> dict[str, Figure]:
        if of[0].group == NONE:
            return {'a gap is promised': share([run.usable for run in of])}
        good = [run for run in of if run.usable]
        return {
            'called of use': share([run.usable for run in of], 'more'),
            'error, median [gap]': figure([run.error for run in good]),
            'error, 90 % [gap]': figure([run.error for run in good], upper),
            'beyond 2 % of error': share([run.error > 0.02 for run in good]),
            'promised wrongly': share([run.deviations > 5.0 for run in good]),
            'delay right': share([run.delay_right for run in good], 'more'),
        }

    fitted = [run.fitted for run in runs if run.fitted is not None]
    return by_group(runs, of_group) | {
        'fit_record, G given: error, median [gap]': figure([error for error, _ in fitted]),
        'fit_record, G given: error, 90 % [gap]': figure([error for error, _ in fitted], upper),
        'fit_record, G given: beyond five deviations': share([z > 5.0 for _, z in fitted]),
    }


# Gears that MuJoCo integrates: identified within their limits, then closed to loops.
MOTIONS = ('sine', 'triangle', 'moves and rests')
INERTIAS, BANDWIDTHS = (0.02, 0.3, 3.0), (4.0, 14.0, 60.0)
OFF = 0.1  # error of the gap from which on *tracking* is wrong, in lost motions


class GearOutcome(NamedTuple):
    """One gear and motion. gaps: over the lost motion, minus 1. removed: share of the error of y.

    wrong: largest error of the gap while *tracking* is beyond OFF.
    """

    group: str
    usable: bool
    identified: float
    at_end: float | None
    removed: float | None
    tracking: float
    wrong: bool


def gears_jobs(scale: float) -> list[str | tuple[float, float]]:
    """Presets, and cells of the map of inertia and bandwidth."""
    return [*PRESETS, *product(INERTIAS, BANDWIDTHS)]


def run_gears(job: str | tuple[float, float]) -> list[GearOutcome]:
    """Identify, and close the loop with what was found, for each motion."""
    if isinstance(job, str):
        gear, group, motions = PRESETS[job], 'presets', MOTIONS
        lost = gear_runs.lost_motion(*gear_runs.quasi_static(gear)[::2])
    else:
        gear, group, motions = gear_of(*job), 'map', MOTIONS[:1]
        lost = gear.lost_motion
    v, _, y = gear_runs.record(gear)
    found = identified(gear.sample_period * np.arange(len(v)), v, y, {
        **gear_runs.limits_of(gear), 'estimator.use_applied_control': 'false'})
    return [_closed(gear, group, motion, found, lost) for motion in motions]


def _closed(gear: Gear, group: str, motion: str, found: Found, lost: float) -> GearOutcome:
    json_file, p = found
    usable, off = bool(json_file['usable']), abs(float(json_file.get('gap') or 0.0) / lost - 1.0)
    if p is None:
        return GearOutcome(group, usable, off, None, None, 0.0, False)
    std, initial = json_file['std'], p.estimator.initial
    estimate = Estimate(
        initial.m, initial.c_r, initial.c_l, p.proportional.f,
        *(max(std[name], 1e-6 * abs(json_file['gap'])) for name in ('m', 'c_r', 'c_l')))
    try:
        run = close_loop(gear, build_controller(p, estimate), motion)
    except (ArithmeticError, ValueError):
        return GearOutcome(group, usable, off, 1e3, 0.0, 0.0, False)
    removed = None
    if group == 'presets':
        none = gear_runs.uncompensated(gear, p, motion).error
        removed = max((none - run.error) / none, -1.0)
    return GearOutcome(
        group, usable, off, abs(float(run.gap[-1]) / lost - 1.0), removed,
        float(np.mean(run.status[run.first:] == Status.TRACKING)),
        run.said_tracking_off_by(lost) > OFF,
    )


def gears_figures(gears: Sequence[Sequence[GearOutcome]]) -> dict[str, Figure]:
    runs = [run for gear in gears for run in gear]
    return by_group(runs, lambda of: {
        'called of use': share([r.usable for r in of], 'more'),
        'gap identified, median error': figure([r.identified for r in of]),
        'gap in the loop, median error': figure([r.at_end for r in of]),
        'gap in the loop, 90 %': figure([r.at_end for r in of], upper),
        'tracking': share([r.tracking for r in of], 'more'),
        'wrong while tracking': share([r.wrong for r in of]),
        **({'share of the error of y removed, median': figure(
            [r.removed for r in of], better='more')} if of[0].group == 'presets' else {}),
    })
