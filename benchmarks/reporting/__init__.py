"""What the benchmarks share: bounds with verdicts, tables as text and Markdown, the machine."""

import argparse
import os
import platform
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from multiprocessing import Pool
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL.Image import Dither, Image
from tqdm import tqdm

from backlash_ros.tools.cli import format_table as format_table

Item = TypeVar('Item')
Result = TypeVar('Result')

Array = NDArray[np.float64]
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
        return [self.what, self.bound, self.measured, 'holds' if self.holds else 'FAILS']


Measured = tuple[list[list[str]], list[Check]]  # rows of a table, and the bounds
CHECK_HEADER = ('what', 'bound', 'measured', 'verdict')


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table for a document."""
    lines = [header, ['---'] * len(header), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def write_between(page: Path, name: str, text: str) -> None:
    """Write what is made by a program between its marks in a page, `<!-- name: ... -->`."""
    marks = re.compile(rf'(<!-- {name}: made by .*? -->\n).*?(<!-- end -->)', re.DOTALL)
    page.write_text(marks.sub(lambda mark: f'{mark[1]}{text}\n{mark[2]}', page.read_text()))


def save_film(
    path: Path, frames: Sequence[Image], palette: Image, frame_s: float, last_s: float,
) -> None:
    """Write a GIF: one palette for all, else colours flicker; dithering would not compress."""
    first, *others = (frame.quantize(palette=palette, dither=Dither.NONE) for frame in frames)
    first.save(path, save_all=True, append_images=others, loop=0, optimize=False,
               duration=[*[round(1e3 * frame_s)] * len(others), round(1e3 * last_s)])


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def processors() -> int:
    return len(os.sched_getaffinity(0))


def machine() -> str:
    """Processor model, number of processors and Python, without any name of a computer."""
    names = re.findall('^model name.*: (.+)', Path('/proc/cpuinfo').read_text(), re.MULTILINE)
    model = (names or [platform.machine()])[0]
    return f'{model}, {processors()} processors, Python {platform.python_version()}'


def parallel(
    function: Callable[[Item], Result], items: Sequence[Item], label: str, workers: int,
) -> list[Result]:
    """Results in the order of the items, computed in processes, with a progress bar."""
    # disable=None: no bar where stderr is not a terminal.
    with Pool(workers) as pool:
        results = pool.imap(function, items, chunksize=1)
        return list(tqdm(results, label, len(items), unit='run', disable=None))
