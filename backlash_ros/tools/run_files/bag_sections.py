"""Which part of a bag is reported: one namespace, one section between restarts, a span of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np
from numpy.typing import NDArray

# Share of the rows at which the count falls back; more is no restart but two nodes at once.
MIXED = 0.1


@dataclass(frozen=True)
class Span:
    """A part of a bag, in seconds from its first message of signals."""

    from_s: float = 0.0
    to_s: float = inf


WHOLE = Span()


@dataclass
class Table:
    """Messages of one array topic: columns by label, and a stamp [ns] for each row."""

    columns: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    stamps: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def sample(self) -> NDArray[np.int64]:
        """The count of each row."""
        return self.columns['sample'].astype(np.int64)

    def between(self, begin_ns: float, end_ns: float) -> Table:
        """Rows that were stamped from begin_ns on and before end_ns."""
        return self._chosen((self.stamps >= begin_ns) & (self.stamps < end_ns))

    def first_of_each(self) -> Table:
        """The first row of every sample, in their order."""
        if not self.columns:
            return self
        _, rows = np.unique(self.sample, return_index=True)
        return self._chosen(rows)

    def after(self, row: int) -> Table:
        """This row and those behind it."""
        return self._chosen(np.arange(row, len(self.stamps)))

    def _chosen(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Table:
        columns = {name: column[rows] for name, column in self.columns.items()}
        return Table(columns, self.stamps[rows])


def choose(
    signals: Table, others: Mapping[str, Table], span: Span,
) -> tuple[Table, dict[str, Table], str]:
    """The rows of the span, and of its last run if the controller restarted its count in it.

    Returns the signals, the others, and in one sentence what was left out, empty for nothing.
    """
    begin_ns = float(signals.stamps[0])
    window = (begin_ns + span.from_s * 1e9, begin_ns + span.to_s * 1e9)
    signals = signals.between(*window)
    others = {name: table.between(*window) for name, table in others.items()}
    falls = np.flatnonzero(np.diff(signals.sample) <= 0) + 1
    note = ''
    if falls.size > MIXED * len(signals.stamps):
        note = 'two controllers published at once: the first row of each sample is used'
    elif falls.size:
        cut_ns = float(signals.stamps[falls[-1]])
        note = (
            f'the controller restarted its count {falls.size} time'
            f'{"s" if falls.size > 1 else ""}: this is what follows the last time, '
            f'{(cut_ns - begin_ns) * 1e-9:.1f} s after the beginning; --from and --to choose '
            'another part'
        )
        # By rows, as stamps of a simulated time may be equal.
        signals = signals.after(falls[-1])
        others = {name: table.between(cut_ns, inf) for name, table in others.items()}
    return (
        signals.first_of_each(),
        {name: table.first_of_each() for name, table in others.items()}, note,
    )


def choose_namespace(names: Sequence[str], wanted: str) -> tuple[str, str]:
    """One of the topics that end alike, and a sentence about the others, empty for none.

    wanted: the axis, empty for the first one.
    """
    axes = [name.strip('/').split('/')[0] for name in names]
    if wanted:
        return names[axes.index(wanted)] if wanted in axes else '', ''
    if len(names) == 1:
        return names[0], ''
    return names[0], (
        f'holds {", ".join(names)}: this is {axes[0]}, --axis {axes[1]} chooses another one'
    )
