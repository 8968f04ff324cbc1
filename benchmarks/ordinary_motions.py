"""Measure what the estimator learns from the motions that most machines make.

A geared motor with a worn gear and a 14-bit encoder follows slow sines and triangles, squares, and
moves from point to point with rests, while the true plant differs from the nominal G(z).

All cases, one seed each:     python benchmarks/ordinary_motions.py
Some of them, three seeds:    ... --cases 'sine|moves' exact --seeds 3 --by motion
Drawn from all that is usual: ... --random 40 --first-seed 7 --samples 20000
The table of the document:    ... --by motion --seeds 3 --write
"""

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import pi

# Before numpy is imported: the matrices are tiny, threads would only disturb the processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from cases.loops import NINE_DIGITS, load_model, loop_on, motor, random_backlash
from contract.figures import FAR, Array, Figure, by_group, figure, judged, rms, share, upper
from numpy.typing import NDArray
from reporting import ROOT, format_table, markdown_table, parallel, parser_of, write_between

from backlash_ros.core import Status

AMPLITUDE = 0.5  # of y_m [rad]
FIVE_PERIODS = 10  # reversals
IN_TIME = 6  # reversals within which *tracking* is due
CLOSE = 0.005  # error at five periods [gap]
LEAST_S = 12.0  # of a periodic motion
FIRST_SEED = 3

PLANTS: dict[str, dict[str, object]] = {
    'exact': {}, 'G known': {'plant.uncertainty': 0.0},
    'ω × 0.85': {'truth.scale_frequency': 0.85}, 'ω × 1.15': {'truth.scale_frequency': 1.15},
    'lag 10 ms': {'truth.extra_lag': 0.01}, 'delay 1': {'truth.delay_samples': 1},
    'offset 0.02': {'input_disturbance': 0.02}, 'offset 0.06': {'input_disturbance': 0.06},
}


@dataclass(frozen=True)
class Periodic:
    """Sine, triangle or square at omega [rad/s], for five periods and a bit.

    swing: from end to end, over the lost motion; None for that of AMPLITUDE.
    """

    shape: str
    omega: float
    swing: float | None = None

    @property
    def seconds(self) -> float:
        return max(5.3 * 2.0 * pi / self.omega, LEAST_S)

    def __call__(self, rng: np.random.Generator, period_s: float, lost_motion: float) -> Array:
        sine = np.sin(self.omega * np.arange(0.0, self.seconds, period_s))
        wave = {'sine': sine, 'triangle': 2.0 / pi * np.arcsin(sine),
                'square': np.where(sine >= 0.0, 1.0, -1.0)}[self.shape]
        amplitude = AMPLITUDE if self.swing is None else 0.5 * self.swing * lost_motion
        return np.asarray(amplitude * rng.choice([-1.0, 1.0]) * wave)


@dataclass(frozen=True)
class Moves:
    """Trapezoidal moves with rests between them.

    speed [rad/s], acceleration [rad/s^2], rests: shortest and longest [s]. reach: of the targets to
    both sides, over the lost motion; None for 1 rad. one_way: three to five moves ahead, then a
    short one back.
    """

    seconds: float
    speed: float
    acceleration: float
    rests: tuple[float, float]
    reach: float | None = None
    one_way: bool = False
    omega = 0.0

    def __call__(self, rng: np.random.Generator, period_s: float, lost_motion: float) -> Array:
        pieces, x, length, ahead = [np.zeros(1)], 0.0, 1, 0
        reach = self.reach * lost_motion if self.reach else 0.5 if self.one_way else 1.0
        while length * period_s < self.seconds:
            if self.one_way:
                back = ahead == 0
                ahead = int(rng.integers(3, 6)) if back else ahead - 1
                goal = x + (-lost_motion * rng.uniform(1.2, 3.0) if back and length > 1
                            else rng.uniform(0.2, 0.8) * reach)
            else:
                goal = rng.uniform(-reach, reach)
            move = x + np.sign(goal - x) * self._way(abs(goal - x), period_s)
            x = goal
            pieces += [move, np.full(round(rng.uniform(*self.rests) / period_s), x)]
            length += len(pieces[-1]) + len(move)
        return np.concatenate(pieces)

    def _way(self, distance: float, period_s: float) -> Array:
        """Way along one move from rest to rest, at every sample."""
        peak = min(self.speed, np.sqrt(distance * self.acceleration))
        ramp = peak / self.acceleration
        end = ramp + distance / peak
        t = np.arange(0.0, end, period_s)
        way = np.where(t < ramp, 0.5 * self.acceleration * t**2, peak * (t - 0.5 * ramp))
        left = np.maximum(end - t, 0.0)
        return np.where(left < ramp, distance - 0.5 * self.acceleration * left**2, way)


Motion = Periodic | Moves
MOTIONS: dict[str, Motion] = {
    **{f'sine {w:g} rad/s': Periodic('sine', w) for w in (0.2, 0.5, 1.0, 2.0)},
    **{f'triangle {w:g} rad/s': Periodic('triangle', w) for w in (0.5, 1.0)},
    'square 1 rad/s': Periodic('square', 1.0),
    'moves, rests 0.5 to 1.5 s': Moves(45.0, 1.0, 5.0, (0.5, 1.5)),
    'slow moves, rests 1 to 3 s': Moves(90.0, 0.3, 1.0, (1.0, 3.0)),
    'fast moves, rests 3 to 8 s': Moves(100.0, 2.0, 20.0, (3.0, 8.0)),
    'moves, rests 10 to 20 s': Moves(250.0, 1.0, 5.0, (10.0, 20.0)),
    'small moves, rests 0.2 to 0.6 s': Moves(30.0, 0.3, 3.0, (0.2, 0.6), reach=0.8),
    'one-way moves, rests 0.5 to 1.5 s': Moves(90.0, 1.0, 5.0, (0.5, 1.5), one_way=True),
}
RATES = (200.0, 50.0, 1000.0)  # [Hz]; all combinations at the first, some at the others
AT_OTHER_RATES = (
    ('sine 1 rad/s', 'triangle 1 rad/s', 'moves, rests 0.5 to 1.5 s'), ('exact', 'ω × 1.15'),
)


@dataclass(frozen=True)
class Case:
    """One run: a motion, what the true plant differs in, a rate [Hz] and a seed.

    shape, differs: the motion and the parameters that these words stand for.
    """

    motion: str
    plant: str
    rate: float
    seed: int
    shape: Motion
    differs: Mapping[str, object]

    @property
    def name(self) -> str:
        """How it is chosen and shown."""
        return f'{self.motion}; {self.plant}; {self.rate:g} Hz'


@dataclass(frozen=True)
class Result:
    """What came of one run; errors are those of c_r or c_l, the worse one.

    reversals: those that reached the load. learned: as many until the first sample that is
    *tracking* with at most 1 % of the gap of error; first: until the first *tracking*; None for
    never.
    at_five: error at five periods (ten reversals, or the end), in gaps; std_five: its published
    deviation in gaps, None without one. Of the *tracking* samples, None without any: rms: RMS of
    error over deviation, no larger than ten; beyond: share with more than five deviations; wrong:
    share with these and more than 1 % of the gap. shares: of every status.
    """

    motion: str
    plant: str
    rate: float
    seed: int
    reversals: int = 0
    learned: int | None = None
    first: int | None = None
    at_five: float = 1e9
    std_five: float | None = None
    rms: float | None = None
    beyond: float | None = None
    wrong: float | None = None
    shares: Mapping[str, float] = field(default_factory=dict)
    problem: str = ''

    @property
    def faults(self) -> list[str]:
        """What is not as due: in time, close or honest about it, and never wrong."""
        honest = self.std_five is not None and self.std_five < 0.03 \
            and self.at_five <= 3.0 * self.std_five
        found = {
            'never tracking': self.first is None and self.reversals > IN_TIME,
            'late': self.first is not None and self.first > IN_TIME,
            'far': self.first is not None and self.at_five > CLOSE and not honest,
            'beyond five deviations': (self.beyond or 0.0) > 0.02, 'wrong': bool(self.wrong),
            'inconsistent': self.shares.get('inconsistent', 1.0) > 0.01,
            'broke off': bool(self.problem),
        }
        return [name for name, there in found.items() if there]


def all_cases(seeds: Sequence[int]) -> Iterator[Case]:
    for rate in RATES:
        motions, plants = (MOTIONS, PLANTS) if rate == RATES[0] else AT_OTHER_RATES
        for motion in motions:
            for plant in plants:
                yield from (Case(motion, plant, rate, seed, MOTIONS[motion], PLANTS[plant])
                           for seed in seeds)


def random_cases(count: int, seed: int, samples: int) -> Iterator[Case]:
    """Motions and plants drawn from all that is ordinary; samples: of the longest run."""
    made = 0
    while count:
        made += 1
        rng = np.random.default_rng([seed, made, 14])
        rate = float(50.0 * 20.0 ** rng.uniform())
        omega = float(0.02 * 1e3 ** rng.uniform())
        swing = float(1.2 * (100.0 / 1.2) ** rng.uniform())
        kind = str(rng.choice(['sine', 'triangle', 'square', 'moves', 'one-way'],
                              p=[0.2, 0.15, 0.1, 0.4, 0.15]))
        differs = {
            'truth.scale_frequency': round(rng.uniform(0.85, 1.15), 3),
            'truth.extra_lag': round(rng.uniform(0.0, 0.01), 4), 'truth.delay_samples': 1,
            'input_disturbance': round(rng.uniform(-0.06, 0.06), 3),
        }
        differs = {name: value for name, value in differs.items() if rng.uniform() < 0.5}
        rests = (0.0, 0.0)
        if rng.uniform() < 0.8:
            longest = float(0.2 * 100.0 ** rng.uniform())
            rests = (longest * float(rng.uniform(0.1, 0.5)), longest)
        backlash = random_backlash(made + 1000 * seed)
        gap = backlash['backlash.c_r'] - backlash['backlash.c_l']
        way = 0.5 * swing * backlash['backlash.m'] * gap  # of an average move [rad]
        speed, turn_s = 1.3 * way * omega / pi, pi / omega  # 30 % of a move is acceleration
        shape: Motion
        if kind in ('moves', 'one-way'):
            each = turn_s + 0.5 * sum(rests)
            shape = Moves((35.0 if kind == 'one-way' else 22.0) * each, 2.0 * speed,
                          6.0 * speed / turn_s, rests, swing / 2.0, kind == 'one-way')
        else:
            shape = Periodic(kind, omega, swing)
        # As fast as the motor turns, and no longer than asked for.
        if 0.5 * swing * gap * omega > 200.0 or shape.seconds * rate > samples:
            continue
        count -= 1
        words = f'{kind} {omega:.2g} rad/s, swing {swing:.2g}'
        if kind in ('moves', 'one-way'):
            words += f', rests to {rests[1]:.2g} s'
        plant = ', '.join(f'{name.split(".")[-1]} {value}' for name, value in differs.items())
        yield Case(words, plant or 'exact', rate, made + 1000 * seed, shape, differs)


def run_case(case: Case) -> Result:
    """Simulate; a run that breaks off is a result as well."""
    period, key = 1.0 / case.rate, (case.motion, case.plant, case.rate, case.seed)
    backlash = random_backlash(case.seed)
    lost_motion = backlash['backlash.m'] * (backlash['backlash.c_r'] - backlash['backlash.c_l'])
    y_m = case.shape(np.random.default_rng([case.seed, 13]), period, lost_motion)
    numerator, denominator = load_model(period)
    loop = loop_on({
        **motor(), **backlash, **case.differs, 'seed': case.seed,
        'sample_period': period, 'plant.numerator': numerator, 'plant.denominator': denominator,
        # A way that is longer than that of the example.
        'control.min': -1e4, 'control.max': 1e4,
    }, y_m, NINE_DIGITS)
    try:
        record = loop.run(len(y_m))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return Result(*key, problem=f'broke off: {error}')
    # A constant that is added to u moves both crossings.
    offset = float(str(case.differs.get('input_disturbance', 0.0)))
    run = judged(record, offset / backlash['backlash.m'])
    # A reversal that stays within the gap does not reach the load; u also turns at a step of v.
    reversals = np.minimum(reversals_of(y_m), reversals_of(record.column('u')))
    omega = case.shape.omega
    five = round(5 * 2 * pi * case.rate / omega) if omega \
        else int(np.argmax(reversals >= FIVE_PERIODS)) or len(y_m)
    five = min(five, len(y_m) - 1)
    std = float(run.std[five].max())

    def first(rows: NDArray[np.bool_]) -> int | None:
        return int(reversals[np.argmax(rows)]) if rows.any() else None

    return Result(
        *key, int(reversals[-1]), first(run.tracking & (run.error <= FAR)), first(run.tracking),
        float(run.error[five]), std if np.isfinite(std) else None, run.rms, run.beyond,
        run.wrong_if_tracking,
        {word.word: float(np.mean(run.status == word)) for word in Status},
    )


def reversals_of(signal: Array) -> NDArray[np.int_]:
    """How often a signal (N,) has turned back up to every sample, shape (N,)."""
    moves = np.sign(np.diff(signal, prepend=signal[:1]))
    moving = np.flatnonzero(moves)
    turned = np.zeros(len(signal), dtype=int)
    turned[moving[1:]] = moves[moving[1:]] != moves[moving[:-1]]
    return np.asarray(np.cumsum(turned))


def contract_cases(scale: float) -> list[Case]:
    return list(all_cases(range(FIRST_SEED, FIRST_SEED + max(round(scale), 1))))


# Motions that are alike; a row of figures for each at 200 Hz, and one for the other rates.
ALIKE = {
    'slow waves': r'sine|triangle', 'squares': r'square', 'moves': r'^moves|^slow|^fast',
    'small moves': r'^small', 'one-way moves': r'^one-way',
}


def contract_figures(results: Sequence[Result]) -> dict[str, Figure]:
    """Figures of motions that are alike, and of every plant."""
    def kind(result: Result) -> str:
        if result.rate != RATES[0]:
            return 'other rates'
        return next(name for name, words in ALIKE.items() if re.search(words, result.motion))

    usual = [result for result in results if result.rate == RATES[0]]
    return by_group(results, figures_of, kind) | by_group(usual, figures_of, lambda r: r.plant)


def figures_of(of: Sequence[Result]) -> dict[str, Figure]:
    return {
        'as due': share([not r.faults for r in of], 'more'),
        'learned': share([r.learned is not None for r in of], 'more'),
        'reversals until learned, median': figure([r.learned for r in of]),
        'error at five periods, median [gap]': figure([r.at_five for r in of]),
        'error at five periods, 90 % [gap]': figure([r.at_five for r in of], upper),
        'tracking': share([r.shares.get('tracking', 0.0) for r in of], 'more'),
        'inconsistent': share([r.shares.get('inconsistent', 1.0) for r in of]),
        'error / deviation, RMS': figure([r.rms for r in of], rms, 'one'),
        'beyond five deviations': share([r.beyond for r in of]),
        'wrong while tracking': share([r.wrong for r in of]),
    }


HEADER = ('case', 'runs', 'as due', 'learned', 'reversals', 'error at 5 [gap]', '90 %', 'tracking',
          'inconsistent', 'RMS of e/std', 'beyond 5', 'wrong')


def row(name: str, results: Sequence[Result]) -> list[str]:
    figures = [f'{one.value:.3g}' if one.runs else '–' for one in figures_of(results).values()]
    return [name, str(len(results)), *figures]


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument('--cases', nargs='+', default=[], metavar='REGEX',
                        help='cases in whose name each of these is found')
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED)
    parser.add_argument('--random', type=int, metavar='N',
                        help='so many cases drawn from all that is ordinary by the first seed')
    parser.add_argument('--samples', type=int, default=60_000, help='of the longest of these')
    parser.add_argument('--workers', type=int, default=1, help='processes, default 1')
    parser.add_argument('--by', choices=('case', 'motion', 'plant'), default='case',
                        help='what a row of the table is')
    parser.add_argument('--write', action='store_true', help='write it into docs/estimation.md')
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    drawn = random_cases(arguments.random, arguments.first_seed, arguments.samples) \
        if arguments.random else all_cases(seeds)
    cases = [case for case in drawn
             if all(re.search(word, case.name) for word in arguments.cases)]
    if not cases:
        names = '; '.join(dict.fromkeys(case.name for case in all_cases(seeds)))
        parser.error(f'--cases {" ".join(arguments.cases)}: no case has such a name, of: {names}')
    results = parallel(run_case, cases, 'ordinary motions', arguments.workers)
    label = (lambda case: case.name) if arguments.by == 'case' \
        else (lambda case: f'{getattr(case, arguments.by)}; {case.rate:g} Hz')
    groups: dict[str, list[Result]] = {}
    for case, result in zip(cases, results, strict=True):
        groups.setdefault(label(case), []).append(result)
    table = HEADER, [row(*group) for group in [*groups.items(), ('all', results)]]
    print(format_table(*table))
    if arguments.write:
        write_between(ROOT / 'docs' / 'estimation.md', 'ordinary_motions', markdown_table(*table))
    for result in results:
        if result.faults:
            print(f'    {result.motion}; {result.plant}; {result.rate:g} Hz, seed {result.seed}: '
                  f'{", ".join(result.faults)} {result.problem}')
    return 0 if not any(result.faults for result in results) else 1


if __name__ == '__main__':
    sys.exit(main())
