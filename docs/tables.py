"""The tables with numbers that `make docs` writes into the pages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from printed_law import (
    Reading,
    error_growth,
    first_not_finite,
    last_estimate,
    moves_after_the_first,
)
from runs import simulate

from backlash_ros.core import early_fits, gap_choice, gap_search, kalman
from backlash_ros.core.metrics import control_error_rms, settling_time
from backlash_ros.core.transfer_function import TransferFunction

NAMES = ('m', 'c_r', 'c_l')
SECONDS = 10.0
DISTURBANCE = 2.0


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def plant_facts() -> str:
    """What G(z) of the example is like."""
    p = simulate(SECONDS).parameters
    model = TransferFunction(p.reals('plant.numerator'), p.reals('plant.denominator'))
    period, frequency = p.real('sample_period'), p.real('frequency')
    gain = abs(model.response(np.exp(1j * np.array([frequency * period])))[0])
    poles = sorted(np.abs(model.poles), reverse=True)
    return markdown(('of G(z)', 'value', 'and therefore'), (
        ('poles', ', '.join(f'{pole:.5f}' for pole in poles),
         'an integrator and two lags: a constant error of u makes y drift'),
        ('zeros', ', '.join(f'{zero.real:.3f}' for zero in sorted(model.zeros, key=abs)),
         'one outside the unit circle: u cannot be had by running 1/G forwards in time'),
        (f'gain at {frequency:g} rad/s', f'{gain:.4f}',
         f'with u_d ≈ y_m, y swings by about ±{gain * p.real("amplitude"):.2f}, not by ±10'),
    ))


def laws() -> str:
    """What each law reaches on the paper's example."""
    rows = []
    for law in ('printed', 'lms', 'kalman'):
        run = simulate(SECONDS, {'estimator.law': law}).record
        t = run.column('t')
        settled = [settling_time(t, run.column(n), run.column(f'true_{n}')) for n in NAMES]
        error = control_error_rms(run)
        rows.append((
            f'`{law}`', *(f'{run.column(name)[-1]:.5g}' for name in NAMES),
            'never' if None in settled else f'{max(s for s in settled if s is not None):.2f} s',
            '-' if error is None else f'{error:.2g}',
        ))
    return markdown(
        ('`estimator.law`', *NAMES, 'all within 1 % from', 'RMS of u − u_d, last second'),
        [('truth', '1.3', '3', '-3', '', ''), *rows],
    )


def printed_moves() -> str:
    """Consequence 1 of the printed law."""
    moves = moves_after_the_first()
    return markdown(
        ('mean change of', 'newest values', 'all values old'),
        [(name, f'{new:.1g}', f'{old:.2g}') for name, (new, old) in moves.items()],
    )


def printed_not_finite() -> str:
    """Consequence 2 of the printed law."""
    sample, name = first_not_finite()
    return markdown(
        ('without guards', ''),
        [('first quotient that is 0/0', f'`{name}`'), ('at sample', str(sample))],
    )


def printed_growth() -> str:
    """Consequence 3 of the printed law."""
    return markdown(
        ('f', 'measured e(t+1) / e(t)', 'm / f'),
        [(f'{f:g}', f'{error_growth(f):.4f}', f'{1.3 / f:.4f}') for f in (0.22, 0.5, 1.0)],
    )


def printed_readings() -> str:
    """Where a dozen readings of the printed law end."""
    rows = []
    for newest, learns_f, relaxation in product((True, False), (True, False), (1.0, 0.1, 0.01)):
        e = last_estimate(Reading(newest, relaxation, learns_f), SECONDS)
        rows.append((
            'newest' if newest else 'old', 'learned' if learns_f else 'kept', f'{relaxation:g}',
            f'{e.m:.3g}', f'{e.c_r:.3g}', f'{e.c_l:.3g}',
        ))
    return markdown(('values used', 'f', 'step', 'm', 'c_r', 'c_l'),
                    [('truth', '', '', '1.3', '3', '-3'), *rows])


def disturbance() -> str:
    """Effective crossings under a constant disturbance of u."""
    run = simulate(6.0, {'input_disturbance': f'{DISTURBANCE:g}'}).record
    m, c_r, c_l = (float(run.column(f'true_{name}')[-1]) for name in NAMES)
    shift = -DISTURBANCE / m
    last = run.column('t') > run.column('t')[-1] - 1.0
    e = (run.column('u') + DISTURBANCE - run.column('u_d'))[last]
    expected = {'m': m, 'c_r': c_r + shift, 'c_l': c_l + shift}
    rows = [
        (f'`{name}`', f'{run.column(f"true_{name}")[-1]:.6g}', f'{value:.6g}',
         f'{run.column(name)[-1]:.6g}')
        for name, value in expected.items()
    ]
    rows.append(('RMS of u + d − u_d, last second', '', '0', f'{np.sqrt(np.mean(e**2)):.1g}'))
    return markdown(('', 'backlash alone', 'shifted by −d/m', 'estimated'), rows)


def estimator_constants() -> str:
    """The constants of the method, as they stand in the code."""
    k, s, g = kalman, gap_search, gap_choice
    rows = (
        ('coarse bank: hypotheses, besides "v never engaged"', f'{len(g.coarse_gaps(1.0))}',
         'gap_choice.py'),
        ('ratio of neighbouring gaps', f'{g.GRID_RATIO:g}', 'gap_choice.py'),
        ('smallest gap, as a share of the widest one within the bounds', f'{g.SMALLEST_GAP:g}',
         'gap_choice.py'),
        ('fine bank: hypotheses', f'{g.FINE}', 'gap_choice.py'),
        ('fine bank: reach to either side, in standard deviations of the gap', f'{g.REACH:g}',
         'gap_choice.py'),
        ('record: longest, in samples', f'{s.CAPACITY}', 'gap_search.py'),
        ('recorded samples read again with each new one', f'{s.REPLAY_SPEED}', 'gap_search.py'),
        ('... while none may be published', f'{s.SLOWEST_FIRST} to {s.FASTEST_FIRST}',
         'gap_search.py'),
        ('record: samples up to which it is fitted as a whole', f'{early_fits.LONGEST}',
         'early_fits.py'),
        ('... bank once the relative deviation of the gap is below',
         f'{early_fits.PRECISION_OF_GAP:g}', 'early_fits.py'),
        ('... and that of m below', f'{early_fits.PRECISION_OF_M:g}', 'early_fits.py'),
        ('outlier: innovation beyond, in standard deviations', f'{k.GATE:g}', 'kalman.py'),
        ('contradiction: outliers in a row', f'{k.REFUSED_IN_A_ROW}', 'kalman.py'),
        ('contradiction: mean normalised innovation squared above', f'{k.NIS_LIMIT:g}',
         'kalman.py'),
        ('samples that a new search must fit before it takes over', f'{k.PROVEN}', 'kalman.py'),
        ('published once the relative deviation of m is below', f'{k.PRECISE_SLOPE:g}',
         'kalman.py'),
        ('... and that of the gap below', f'{k.PRECISE_GAP:g}', 'kalman.py'),
    )
    return markdown(('constant', 'value', 'file'), [
        (what, value, f'[{file}](../backlash_ros/core/{file})') for what, value, file in rows
    ])


TABLES: dict[str, Callable[[], str]] = {
    'plant_facts': plant_facts, 'laws': laws, 'printed_moves': printed_moves,
    'printed_not_finite': printed_not_finite, 'printed_growth': printed_growth,
    'printed_readings': printed_readings, 'disturbance': disturbance,
    'estimator_constants': estimator_constants,
}
