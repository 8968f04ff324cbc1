"""What the benchmarks share: bounds with verdicts, tables as text and Markdown, the machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing import Pool
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

Item = TypeVar('Item')
Result = TypeVar('Result')

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Check:
    """One bound, what was measured, and whether it holds."""

    what: str
    bound: str
    measured: str
    holds: bool

    @property
    def row(self) -> list[str]:
        """Cells of a table."""
        return [self.what, self.bound, self.measured, 'holds' if self.holds else 'FAILS']


CHECK_HEADER = ('what', 'bound', 'measured', 'verdict')


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns as wide as they need to be, for a terminal."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return '\n'.join(
        '  '.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """The same table for a document."""
    lines = [list(header), ['---'] * len(header), *map(list, rows)]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """Processor model, number of processors and Python, without any name of a computer."""
    model = platform.machine()
    info = Path('/proc/cpuinfo')
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith('model name')]
        model = names[0].split(':')[1].strip() if names else model
    return f'{model}, {processors()} processors, Python {platform.python_version()}'


def parallel(
    function: Callable[[Item], Result], items: Sequence[Item], label: str, workers: int,
) -> list[Result]:
    """Results in the order of the items, computed in processes, with a progress bar."""
    # disable=None: no bar where stderr is not a terminal.
    with Pool(workers) as pool:
        results = pool.imap(function, items, chunksize=1)
        return list(tqdm(results, label, len(items), unit='run', disable=None))
