"""Live progress of a run: a bar on a terminal, now and then a plain line anywhere else."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from math import isfinite, nan
from typing import TextIO

from tqdm import tqdm

from backlash_ros.topics import BACKLASH

PLAIN_LINE_PERIOD_S = 2.0  # between two lines where there is no terminal


class ProgressDisplay:
    """Shows the progress events of one recorder.

    samples: how many make a whole run, 0 for one without end. sample_period [s]. stream: a
    terminal gets a bar that moves, a file or pipe a line every two seconds. axis: its name, if
    there are several, and line: the one of its bar among theirs.
    """

    def __init__(
        self, samples: int, sample_period: float, stream: TextIO, axis: str = '', line: int = 0,
    ) -> None:
        self._samples, self._sample_period, self._stream = samples, sample_period, stream
        self._title = f'{axis}: ' if axis else ''
        self._last_line = -PLAIN_LINE_PERIOD_S
        self._closed = False
        self._bar: tqdm[None] | None = None
        if _has_room(stream):
            tqdm.monitor_interval = 0  # no thread beside the loop that starts processes
            done = '{percentage:3.0f} % |{bar:16}| {n_fmt}/{total_fmt}' if samples else '{n_fmt}'
            self._bar = tqdm(
                total=samples or None, file=stream, dynamic_ncols=True, leave=True, position=line,
                bar_format=f'{self._title}{done}{{postfix}}',
            )

    def show(self, progress: Mapping[str, object], made: int) -> None:
        """Show one progress event; made: samples so far. After `close` nothing is shown."""
        if self._closed:
            return
        text = describe(progress)
        if self._bar is not None:
            self._bar.n = made
            self._bar.set_postfix_str(text)
        elif time.monotonic() >= self._last_line + PLAIN_LINE_PERIOD_S:
            self._last_line = time.monotonic()
            t = made * self._sample_period
            of_all = f'/{self._samples}' if self._samples else ''
            self.say(f'{self._title}{t:7.2f} s  {made}{of_all}  {text}')

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        if self._bar is not None and not self._closed:
            self._bar.write(line, file=self._stream)
        else:
            print(line, file=self._stream, flush=True)

    def close(self) -> None:
        """Leave the bar as it is and free the line below it."""
        self._closed = True
        if self._bar is not None:
            self._bar.close()


def _has_room(stream: TextIO) -> bool:
    # The terminals of containers and recorders may have no size; tqdm then shows nothing.
    if not stream.isatty():
        return False
    size = os.get_terminal_size(stream.fileno())
    return size.columns > 0 and size.lines > 1


def describe(progress: Mapping[str, object]) -> str:
    """The estimates with their errors in % of the truth, where that is known."""
    words = []
    for name in BACKLASH:
        estimate, truth = number(progress, name), number(progress, f'true_{name}')
        words.append(f'{name} {estimate:.4g}')
        if isfinite(truth) and truth != 0.0:
            words[-1] += f' ({100.0 * (estimate - truth) / abs(truth):+.1f} %)'
    words.append(f'lost {number(progress, "lost"):.0f}')
    return '  '.join(words)


def number(values: Mapping[str, object], name: str) -> float:
    """A number of an event, nan for null and for what is missing."""
    value = values.get(name)
    return float(value) if isinstance(value, (int, float)) else nan


def counts(values: Mapping[str, object], name: str) -> dict[str, int]:
    """The counts in an event by what was counted, empty where they are missing."""
    value = values.get(name)
    return value if isinstance(value, dict) else {}
