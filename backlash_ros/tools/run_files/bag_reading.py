"""From a rosbag2 bag (mcap or sqlite3) to the record of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backlash_ros import topics
from backlash_ros.core.loop.learned_model import LearnedModel, from_fields
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli.errors import InputError
from backlash_ros.tools.run_files.bag_content import Content, read_content
from backlash_ros.tools.run_files.bag_sections import WHOLE, Span, Table, choose, choose_namespace

LABELS = {
    topics.SIGNALS: topics.SIGNAL_LABELS,
    topics.ESTIMATES: topics.ESTIMATE_LABELS,
    topics.TRUTH: topics.TRUTH_LABELS,
}
# Columns of the record by topic, and the label each is read from.
SOURCES: dict[str, dict[str, str]] = {
    topics.SIGNALS: {
        name: name for name in ('y_m', 'y', 'u_d', 'v', 'u_hat', 'innovation', 'status')
    },
    topics.ESTIMATES: {
        name: name for name in ('m', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l')
    },
}
ARRAY, NUMBER = 'std_msgs/msg/Float64MultiArray', 'std_msgs/msg/Float64'
MODEL_LABELS = ('numerator', 'denominator', 'delay_samples')  # by which a renamed one is known
TRUE_BACKLASH = {'true_m': 'm', 'true_c_r': 'c_r', 'true_c_l': 'c_l'}


@dataclass(frozen=True)
class BagRun:
    """What a bag says about a run.

    latency_s: as topics.py defines it, shape (N,), nan where unknown.
    unpaired: samples left out because only one of signals and estimates was recorded. damage:
    what is wrong with the bag and the cure, empty if it is complete. notes: what else is in the
    bag, a sentence each.
    """

    run: RunRecord
    latency_s: NDArray[np.float64]
    unpaired: int
    damage: str = ''
    notes: tuple[str, ...] = ()


def read_bag(
    path: Path, sample_period: float | None = None, span: Span = WHOLE, axis: str = '',
) -> BagRun:
    """Join the signals, estimates and truth of a bag on their sample count.

    t = (sample - first) * sample_period; None takes the median distance of the stamps. A gap in
    the count is a lost sample. Of a bag that was never closed, or is damaged, what is left is
    read, and nothing is changed. Where the controller was restarted, it is what the last one
    did within the span. axis: of several, empty for the first one. Raises InputError, in one line,
    for a bag that cannot be read or holds no run.
    """
    content = read_content(path, _is_array_topic)
    try:
        tables, note, models = _find_tables(path, content, axis)
    except InputError as error:
        raise InputError(f'{error}; {content.damage}' if content.damage else str(error)) from None
    begin_ns = float(tables[topics.SIGNALS].stamps[0])
    signals, others, restart = choose(
        tables[topics.SIGNALS],
        {topic: table for topic, table in tables.items() if topic != topics.SIGNALS}, span,
    )
    tables = {topics.SIGNALS: signals, **others}
    estimates = others[topics.ESTIMATES]
    if not signals.stamps.size:
        raise InputError(f'{path}: holds no sample between --from and --to')
    count, of_signals, of_estimates = np.intersect1d(
        signals.sample, estimates.sample, assume_unique=True, return_indices=True
    )
    if count.size == 0:
        raise InputError(f'{path}: no sample has both {topics.SIGNALS} and {topics.ESTIMATES}')
    if sample_period is None:
        sample_period = _median_period(path, count, signals.stamps[of_signals])
    rows = np.full((count.size, len(COLUMNS)), np.nan)
    for topic, index in ((topics.SIGNALS, of_signals), (topics.ESTIMATES, of_estimates)):
        for name, label in SOURCES[topic].items():
            rows[:, COLUMNS.index(name)] = tables[topic].columns[label][index]
    _fill_truth(rows, count, tables[topics.TRUTH])
    rows[:, COLUMNS.index('t')] = (count - count[0]) * sample_period
    heard = np.union1d(signals.sample, estimates.sample)
    lost = int(heard[-1] - heard[0]) + 1 - heard.size
    latency = signals.columns['latency_s'][of_signals]
    learned = _newest_model(models, signals.stamps, begin_ns + span.to_s * 1e9)
    return BagRun(
        RunRecord(rows, sample_period, lost, learned), latency, heard.size - count.size,
        content.damage, tuple(text for text in (note, restart) if text),
    )


def _fill_truth(
    rows: NDArray[np.float64], count: NDArray[np.int64], truth: Table,
) -> None:
    """Fill in u where it was recorded, and the true backlash, of which the newest holds on.

    The last v of a run is computed but never applied: its sample has no u.
    """
    if truth.stamps.size == 0:
        return
    sample = truth.sample + _offset(rows[:, COLUMNS.index('v')], count, truth)
    _, here, there = np.intersect1d(count, sample, assume_unique=True, return_indices=True)
    rows[here, COLUMNS.index('u')] = truth.columns['u'][there]
    order = np.argsort(sample)
    newest = np.searchsorted(sample[order], count, side='right') - 1
    for name, label in TRUE_BACKLASH.items():
        rows[:, COLUMNS.index(name)] = truth.columns[label][order[np.maximum(newest, 0)]]


def _offset(v: NDArray[np.float64], count: NDArray[np.int64], truth: Table) -> int:
    """Count of the controller less that of the plant for the same sample.

    A controller that was started later counts otherwise. Then the same v tells the same sample.
    """
    if np.intersect1d(count, truth.sample).size:
        return 0
    commands, of_commands = _told_once(v)
    applied, of_applied = _told_once(truth.columns['v'])
    _, here, there = np.intersect1d(commands, applied, return_indices=True)
    if not here.size:
        return 0
    offsets, times = np.unique(
        count[of_commands[here]] - truth.sample[of_applied[there]], return_counts=True
    )
    return int(offsets[np.argmax(times)])


def _told_once(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Values that occur once, and where."""
    unique, rows, times = np.unique(values, return_index=True, return_counts=True)
    return unique[times == 1], rows[times == 1]


def _median_period(
    path: Path, count: NDArray[np.int64], stamps: NDArray[np.int64],
) -> float:
    if count.size < 2:
        raise InputError(f'{path}: needs two samples to tell the sample period')
    period = float(np.median(np.diff(stamps) / np.diff(count))) * 1e-9
    if not period > 0.0:
        raise InputError(f'{path}: its stamps do not tell the sample period: give --config')
    return period


def read_plain_numbers(
    path: Path, ends: Sequence[str],
) -> tuple[dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]], str]:
    """Stamps [ns] and values of each Float64 topic whose name ends like one of these.

    Returns them with what is wrong with the bag, empty if it is complete. Raises InputError.
    """
    def wanted(name: str, message_type: str) -> bool:
        return message_type == NUMBER and _last_part(name) in ends

    content = read_content(path, wanted)
    found = {}
    for name, pairs in sorted(content.messages.items()):
        messages = [(stamp, float(message.data)) for stamp, message in pairs]
        stamps = np.array([stamp for stamp, _ in messages], dtype=np.int64)
        found[name] = stamps, np.array([value for _, value in messages])
    return found, content.damage


def read_reports(path: Path, y: NDArray[np.float64], axis: str = '') -> list[list[float]]:
    """What applied_control said between each output of a run and the one before it.

    y (N,): outputs of the run, by whose values they are found among the messages. Empty where the
    bag holds no applied_control, or the outputs are not all there. Raises InputError.
    """
    numbers, _ = read_plain_numbers(path, (topics.PLANT_OUTPUT, topics.APPLIED_CONTROL))
    chosen = []
    for topic in (topics.PLANT_OUTPUT, topics.APPLIED_CONTROL):
        names = sorted(name for name in numbers if f'/{name}'.endswith(f'/{topic}'))
        name = choose_namespace(names, axis)[0] if names else ''
        if not name:
            return []
        chosen.append(numbers[name])
    (output_ns, outputs), (report_ns, values) = chosen
    stamps, place = [], 0
    heard = outputs.tolist()
    for value in y.tolist():
        while place < len(heard) and heard[place] != value:
            place += 1
        if place == len(heard):
            return []
        stamps.append(output_ns[place])
        place += 1
    until = np.searchsorted(report_ns, stamps, side='right')
    return [[], *(values[a:b].tolist() for a, b in pairwise(until.tolist()))]


def _is_array_topic(name: str, message_type: str) -> bool:
    return message_type == ARRAY and any(
        _last_part(name) == _last_part(topic) for topic in (*LABELS, topics.MODEL)
    )


def _last_part(name: str) -> str:
    return name.rpartition('/')[2]


def _newest_model(
    messages: Sequence[tuple[int, Any]], stamps: NDArray[np.int64], end_ns: float,
) -> LearnedModel | None:
    """The last G that was published from the first of the stamps on and before end_ns.

    One that is not complete is none.
    """
    within = [message for stamp, message in messages if stamps[0] <= stamp < end_ns]
    if not within:
        return None
    newest, fields, first = within[-1], {}, 0
    for dimension in newest.layout.dim:
        fields[dimension.label] = newest.data[first:first + dimension.size].tolist()
        first += dimension.size
    try:
        return from_fields(fields)
    except (KeyError, IndexError, ValueError):
        return None


def _find_tables(
    path: Path, content: Content, axis: str,
) -> tuple[dict[str, Table], str, list[tuple[int, Any]]]:
    """The array topics of one axis, what other axes there are, and its models."""
    tables, about = {}, ''
    for topic, labels in LABELS.items():
        names = _names_of(content, topic, labels)
        name, note = choose_namespace(names, axis) if names else ('', '')
        if topic == topics.SIGNALS:
            about = note
            axis = axis or name.strip('/').split('/')[0] if note else axis
        if name:
            tables[topic] = _tabulate(path, name, labels, content.messages.get(name, []))
        elif topic == topics.TRUTH:
            tables[topic] = Table()  # a real plant does not know its truth
        else:
            heard = ', '.join(sorted(content.names)) or 'nothing'
            of_axis = f' of axis {axis}' if axis else ''
            raise InputError(f'{path}: holds no {topic}{of_axis}, only {heard}')
    names = _names_of(content, topics.MODEL, MODEL_LABELS)
    name = choose_namespace(names, axis)[0] if names else ''
    return tables, about, content.messages.get(name, [])


def _names_of(content: Content, topic: str, labels: Sequence[str]) -> list[str]:
    """Under which names a topic was recorded; nodes that were renamed stand behind the others."""
    kept = {name for name in content.names if f'/{name}'.endswith(f'/{topic}')}
    renamed = {
        name for name, messages in content.messages.items()
        if _last_part(name) == _last_part(topic)
        and {each.label for each in messages[0][1].layout.dim} >= set(labels)
    }
    return [*sorted(kept), *sorted(renamed - kept)]


def _tabulate(
    path: Path, topic: str, labels: Sequence[str], messages: Sequence[tuple[int, Any]],
) -> Table:
    if not messages:
        if f'/{topic}'.endswith(f'/{topics.TRUTH}'):
            return Table()
        raise InputError(f'{path}: holds no message of {topic}')
    given = [dimension.label for dimension in messages[0][1].layout.dim] or list(labels)
    missing = set(labels) - set(given)
    if missing:
        raise InputError(f'{path}: {topic} lacks {", ".join(sorted(missing))}')
    if any(len(message.data) != len(given) for _, message in messages):
        raise InputError(f'{path}: {topic} has a message without a value for each label')
    values = np.array([message.data for _, message in messages], dtype=np.float64)
    columns: Mapping[str, NDArray[np.float64]] = dict(zip(given, values.T, strict=True))
    return Table(dict(columns), np.array([stamp for stamp, _ in messages], dtype=np.int64))
