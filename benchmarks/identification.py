"""Measure the identification: 200 random actuators, each from one record of 10 s.

`python benchmarks/identification.py` prints the table; `--write` puts it into the document.
`--loops N`: also N closed loops with what was found, beside the true one.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import time
from dataclasses import dataclass, replace
from math import inf, nan

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from cases.identification_cases import Case, random_case
from reporting import ROOT, machine, markdown_table, parallel, processors, text_table
from scipy.stats import chi2

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.identification.identification import Identification, identify
from backlash_ros.core.identification.uncertainty import crossings_covariance, response
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.metrics import delayed_tracking_error_rms
from backlash_ros.tools.identify.identified_file import as_estimate, identified_parameters

DOCUMENT = ROOT / 'docs' / 'identification.md'
CASES = 200
GAP_BOUND, RESPONSE_BOUND = 0.02, 0.03
NEES_BOUND = float(chi2.ppf(0.99, 2))  # of one case; and of the mean of all
FREQUENCIES = 30
LOOP_SAMPLES, LOOP_BOUND = 2000, 1.1
MARKS = re.compile(r'(<!-- identification: made by benchmarks -->\n).*?(<!-- end -->)', re.DOTALL)


@dataclass(frozen=True)
class Outcome:
    """Errors of one case. gap: of the gap and both crossings, the largest, over the gap; promised:
    deviation of the gap over it. response: largest relative error where y moves."""

    seed: int
    kind: str
    usable: bool
    reasons: tuple[str, ...]
    gap: float = nan
    promised: float = nan
    response: float = nan
    nees: float = nan
    delay_found: bool = False
    delay_within: bool = False
    integrator_right: bool = False
    seconds: float = nan
    loop: float = nan  # tracking error over that with the true G and backlash
    refused: str = ''


def examine(job: tuple[int, bool]) -> Outcome:
    """Identify one case and compare with the truth."""
    seed, with_loop = job
    case = random_case(seed)
    begin = time.process_time()
    found = identify(case.v, case.y, case.period)
    seconds = time.process_time() - begin
    kind = f'order {case.order}{" with integrator" if case.integrating else ""}, delay ' \
           f'{case.delay}, {"drive" if case.driven else "multisine"}, ' \
           f'{"quantised" if case.quantised else "noise"}, gap {case.gap / np.ptp(case.v):.0%}'
    if found.details is None:
        return Outcome(seed, kind, False, found.reasons)
    fit = found.details.fit
    covariance = crossings_covariance(fit, found.details.covariance)
    error = np.array([found.gap - case.gap, found.c_r - case.c_r])
    worst = max(abs(error[0]), abs(error[1]), abs(found.c_l - case.c_l))
    w = np.linspace(found.frequencies[0], found.frequencies[-1], FREQUENCIES)
    ratio = response(fit, w) * np.exp(-1j * w * found.delay) / case.response(w)
    loop, refused = loop_ratio(case, found) if with_loop and found.usable else (nan, '')
    return Outcome(
        seed, kind, found.usable, found.reasons, worst / case.gap, found.std['gap'] / case.gap,
        float(np.abs(ratio - 1.0).max()), float(error @ np.linalg.solve(covariance, error)),
        found.delay == case.delay, case.delay in found.delays,
        found.integrator == case.integrating, seconds, loop, refused,
    )


def loop_ratio(case: Case, found: Identification) -> tuple[float, str]:
    """Tracking error of the loop with what was found, over that of the loop that is told all."""
    try:
        told = identified_parameters(found, {'structure': 'tracking'})
    except ParameterError as error:
        return inf, str(error)
    noise = {'output_quantum': case.level, 'output_noise_std': 0.0} if case.quantised \
        else {'output_noise_std': case.level, 'output_quantum': 0.0}
    plant = {
        'backlash.m': 1.0, 'backlash.c_r': case.c_r, 'backlash.c_l': case.c_l,
        'truth.numerator': tuple(case.numerator.tolist()),
        'truth.denominator': tuple(case.denominator.tolist()),
        'truth.delay_samples': case.delay, **noise,
    }
    true = told.replaced({
        'plant.numerator': tuple(case.numerator.tolist()),
        'plant.denominator': tuple(case.denominator.tolist()), 'plant.uncertainty': 0.0,
        'control.delay_samples': case.delay, 'estimator.initial.c_r': case.c_r,
        'estimator.initial.c_l': case.c_l,
    })
    estimate = as_estimate(found, told)
    known = replace(estimate, c_r=case.c_r, c_l=case.c_l)
    errors = [
        tracking_error(p.replaced(plant), begin) for p, begin in ((told, estimate), (true, known))
    ]
    return errors[0] / errors[1], ''


def tracking_error(parameters: Parameters, begin: Estimate) -> float:
    """Relative RMS of y - y_m over the last half of a simulated run."""
    loop = build_closed_loop(parameters)
    loop.controller = build_controller(parameters, begin)
    run = loop.run(LOOP_SAMPLES)
    delay = build_controller(parameters).structure.delay
    error = delayed_tracking_error_rms(run, delay, float(run.column('t')[LOOP_SAMPLES // 2]))
    return nan if error is None else error


def percent(value: float) -> str:
    """A share as text."""
    return f'{100.0 * value:.{1 if value > 0.1 else 2}{"f" if value > 0.1 else "g"}} %'


def table(outcomes: list[Outcome]) -> list[list[str]]:
    """What was promised and what came out."""
    good = [one for one in outcomes if one.usable]
    gaps, responses = (np.array([getattr(one, name) for one in good])
                       for name in ('gap', 'response'))
    nees = np.array([one.nees for one in good])
    interval = chi2.ppf((0.005, 0.995), 2 * len(good)) / (2 * len(good))
    count = len(good)
    rows = [
        ['gap, c_r, c_l: median error', '0.5 %', percent(float(np.median(gaps)))],
        ['gap, c_r, c_l: within 2 %', 'all', f'{np.sum(gaps <= GAP_BOUND)} of {count}'],
        ['... of those promised to 0.6 %: within 2 %', 'all', _promised(good)],
        ['G where y moves: median of the largest error', '1 %',
         percent(float(np.median(responses)))],
        ['G where y moves: within 3 %', 'all', f'{np.sum(responses <= RESPONSE_BOUND)} of {count}'],
        ['delay among those that are told to fit alike', '98 %',
         percent(np.mean([one.delay_within for one in good]))],
        ['delay that was taken of them', '–', percent(np.mean([one.delay_found for one in good]))],
        ['integrator told', '–', percent(np.mean([one.integrator_right for one in good]))],
        ['(gap, c_r): mean of NEES / 2', f'{interval[0]:.2f} to {interval[1]:.2f}',
         f'{nees.mean() / 2.0:.2f}'],
        ['(gap, c_r): beyond the 99 % of one case', '1 %', percent(np.mean(nees > NEES_BOUND))],
        ['called not of use', '5 %', percent(1.0 - count / len(outcomes))],
        ['processor time, median and longest', '5 s',
         f'{np.median([one.seconds for one in good]):.1f} s, '
         f'{max(one.seconds for one in good):.1f} s'],
    ]
    loops = np.array([one.loop for one in good if not np.isnan(one.loop)])
    if len(loops):
        rows.append([
            f'tracking error within 10 % of that with the true G ({len(loops)} loops)', '95 %',
            percent(float(np.mean(loops <= LOOP_BOUND))),
        ])
    return rows


def _promised(good: list[Outcome]) -> str:
    sure = [one for one in good if one.promised <= 0.3 * GAP_BOUND]
    return f'{sum(one.gap <= GAP_BOUND for one in sure)} of {len(sure)}'


def failures(outcomes: list[Outcome]) -> list[list[str]]:
    """Cases that miss a bound, by seed."""
    rows = []
    for one in outcomes:
        what = list(one.reasons)
        if one.usable:
            what += [f'gap or crossing off by {percent(one.gap)}, promised ± '
                     f'{percent(one.promised)}'] if one.gap > GAP_BOUND else []
            what += [f'G off by {percent(one.response)}'] if one.response > RESPONSE_BOUND else []
            what += ['delay not among those told'] if not one.delay_within else []
            what += [f'NEES {one.nees:.1f}'] if one.nees > NEES_BOUND else []
            what += [f'tracking error {one.loop:.2f} times that with the true G'] \
                if one.loop > LOOP_BOUND else []
            what += [one.refused] if one.refused else []
        if what:
            rows.append([str(one.seed), one.kind, '; '.join(what)])
    return rows


def main() -> None:
    """Measure and print, or write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--cases', type=int, default=CASES)
    parser.add_argument('--first', type=int, default=0, help='seed of the first case')
    parser.add_argument('--loops', type=int, default=0, help='cases that are also closed to loops')
    parser.add_argument('--write', action='store_true', help=f'write into {DOCUMENT.name}')
    options = parser.parse_args()
    jobs = [(seed, seed - options.first < options.loops)
            for seed in range(options.first, options.first + options.cases)]
    outcomes = parallel(examine, jobs, 'identification', processors())
    header, failed = ('what', 'bound', 'measured'), ('seed', 'case', 'what')
    rows, bad = table(outcomes), failures(outcomes)
    print(text_table(header, rows))
    print(text_table(failed, bad))
    if options.write:
        text = f'{markdown_table(header, rows)}\n\nCases that miss a bound, on {machine()}:\n\n' \
               f'{markdown_table(failed, bad)}\n'
        page = DOCUMENT.read_text()
        DOCUMENT.write_text(MARKS.sub(lambda found: found[1] + text + found[2], page))


if __name__ == '__main__':
    sys.exit(main())
