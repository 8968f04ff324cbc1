"""Random sequences of faults: does any of them hurt the actuator, or make an estimate lie?

    python benchmarks/faults.py --sequences 20000
    python benchmarks/faults.py --seed 45       what happens in one of them
    python benchmarks/faults.py --results FILE  add to FILE, and go on from what it holds
    python benchmarks/faults.py --again          those that the campaign in docs/faults.md lists

Each sequence is a loop of a random plant, law, structure, limits and noise, in simulated time: the
core, the bookkeeping of samples and commands, and what the node decides around them; no middleware.
"""

import json
import os
import re
import sys
import warnings
from contextlib import nullcontext
from multiprocessing import Pool
from pathlib import Path
from typing import NamedTuple

# Before numpy is imported: the matrices are tiny, threads would only disturb the processes.
os.environ.setdefault('OMP_NUM_THREADS', '1')
sys.path.insert(1, str(Path(__file__).resolve().parents[1]))

from fault_loop.fault_sequences import KINDS, Sequence
from fault_loop.fault_world import PERIOD_S
from reporting import ROOT, format_table, markdown_table, parser_of, processors, write_between

DOCUMENT = ROOT / 'docs' / 'faults.md'
SEQUENCES, FIRST_SEED = 20_000, 1
SHOWN = 3  # findings of a kind in the report of one sequence


class Result(NamedTuple):
    """What a sequence led to: the kinds of what was found, with the first of each."""

    seed: int
    loop: str
    samples: int
    commands: int
    claimed: bool
    found: dict[str, str]


def play(seed: int) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        sequence = Sequence(seed)
        p = sequence.p
        loop = f'{p.estimator.law}, {p.structure}'
        try:
            found = sequence.run()
        except Exception as error:
            return Result(seed, loop, 0, 0, False, {'broken': repr(error)})
    first = {kind: texts[0] for kind, texts in found.items() if texts}
    return Result(seed, loop, sequence.samples, sequence.commands, sequence.claimed, first)


def show(seed: int) -> int:
    for kind, texts in Sequence(seed, print).run().items():
        for text in texts[:SHOWN]:
            print(f'{kind}, {len(texts)} in all: {text}')
    return 0


def listed() -> list[int]:
    """Seeds of the sequences in which the campaign of the document found anything."""
    campaign = DOCUMENT.read_text().partition('<!-- campaign:')[2].partition('<!-- end -->')[0]
    cells = re.findall(r'\| ([\d, ]+) \|$', campaign, re.MULTILINE)
    return sorted({int(seed) for cell in cells for seed in cell.split(',')})


def rows_of(results: list[Result]) -> list[list[str]]:
    seeds = {kind: [str(one.seed) for one in results if kind in one.found] for kind in KINDS}
    return [[what, str(len(seeds[kind])), ', '.join(seeds[kind])] for kind, what in KINDS.items()]


def summary(results: list[Result], which: str) -> str:
    hours = sum(result.samples for result in results) * PERIOD_S / 3600.0
    return (
        f'{len(results)} sequences {which}, {hours:.1f} h of simulated time, '
        f'{sum(result.commands for result in results)} commands; in '
        f'{sum(result.claimed for result in results)} of them a law with deviations said '
        '*tracking*.'
    )


def main() -> int:
    """Return 0 if no command has broken a limit and nothing ran away."""
    parser = parser_of(__doc__)
    parser.add_argument('--sequences', type=int, default=SEQUENCES, metavar='N')
    parser.add_argument('--first-seed', type=int, default=FIRST_SEED, metavar='S')
    parser.add_argument('--seed', type=int, metavar='K', help='show what happens in this one')
    parser.add_argument('--again', action='store_true',
                        help='only those in which the campaign of the document found anything')
    parser.add_argument('--processes', type=int, default=processors())
    parser.add_argument('--results', type=Path, metavar='FILE',
                        help='append what comes out; what it holds already is not played again')
    parser.add_argument('--write', action='store_true',
                        help=f'write the table into {DOCUMENT.relative_to(ROOT)}')
    arguments = parser.parse_args()
    if arguments.seed is not None:
        return show(arguments.seed)
    first = arguments.first_seed
    wanted = listed() if arguments.again else range(first, first + arguments.sequences)
    path = arguments.results
    lines = path.read_text().splitlines() if path and path.exists() else []
    results = [one for one in (Result(*json.loads(line)) for line in lines) if one.seed in wanted]
    known = {result.seed for result in results}
    target = arguments.results.open('a', encoding='utf-8') if arguments.results else nullcontext()
    with Pool(arguments.processes) as pool, target as file:
        seeds = [seed for seed in wanted if seed not in known]
        for result in pool.imap(play, seeds, chunksize=4):
            results.append(result)
            if file is not None:
                print(json.dumps(result), file=file, flush=True)
            for kind, text in result.found.items():
                print(f'{result.seed} ({result.loop}) {kind}: {text}', flush=True)
    said = summary(results, 'listed above' if arguments.again else f'from seed {first} on')
    table = ('found', 'sequences', 'seeds'), rows_of(results)
    print(f'{said}\n{format_table(*table)}')
    if arguments.write:
        name = 'again' if arguments.again else 'campaign'
        write_between(DOCUMENT, name, f'{said}\n\n{markdown_table(*table)}')
    found = {kind for result in results for kind in result.found}
    return int(bool(found & {'outside', 'too_fast', 'unbounded', 'broken'}))


if __name__ == '__main__':
    sys.exit(main())
