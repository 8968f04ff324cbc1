"""Live progress of a run: a bar on a terminal, now and then a plain line anywhere else."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from math import isfinite, nan
from typing import TextIO

from tqdm import tqdm

SHOWN = ('m', 'c_r', 'c_l')
PLAIN_LINE_PERIOD_S = 2.0


class ProgressDisplay:
    """Shows the progress events of the recorder.

    samples: how many make a whole run. sample_period [s]. stream: a terminal gets a bar that
    moves, a file or pipe a line every two seconds.
    """

    def __init__(self, samples: int, sample_period: float, stream: TextIO) -> None:
        self._samples, self._sample_period, self._stream = samples, sample_period, stream
        self._last_line = -PLAIN_LINE_PERIOD_S
        self._closed = False
        self._bar: tqdm[None] | None = None
        if _has_room(stream):
            tqdm.monitor_interval = 0  # no thread beside the loop that starts processes
            self._bar = tqdm(
                total=samples, file=stream, dynamic_ncols=True, leave=True,
                bar_format='{percentage:3.0f} % |{bar:16}| {n_fmt}/{total_fmt}{postfix}',
            )

    def show(self, progress: Mapping[str, object]) -> None:
        """Show one progress event; after `close` nothing is shown."""
        if self._closed:
            return
        made = int(number(progress, 'sample')) + 1
        text = describe(progress)
        if self._bar is not None:
            self._bar.n = made
            self._bar.set_postfix_str(text)
        elif time.monotonic() >= self._last_line + PLAIN_LINE_PERIOD_S:
            self._last_line = time.monotonic()
            t = made * self._sample_period
            print(f'{t:7.2f} s  {made}/{self._samples}  {text}', file=self._stream, flush=True)

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
    for name in SHOWN:
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
