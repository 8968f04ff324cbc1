"""From a bag to a run: signals, estimates and truth, joined on the number of the sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf, isnan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from backlash_ros import topics
from backlash_ros.bags.reader import REPAIR_COMMAND, BagError, BagReader, Topic
from backlash_ros.core.loop.learned_model import LearnedModel, from_fields
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import WHOLE_SPAN, InputError, Span
from backlash_ros.tools.runs.files import Run

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

# By which a topic is known whose node was renamed.
ARRAY_LABELS = {
    topics.SIGNALS: topics.SIGNAL_LABELS, topics.ESTIMATES: topics.ESTIMATE_LABELS,
    topics.TRUTH: topics.TRUTH_LABELS, topics.MODEL: ('numerator', 'denominator', 'delay_samples'),
}


@dataclass
class Content:
    """Stamps [ns] and messages of the wanted topics by recorded name, in the order of stamps.

    names: of all topics of the bag. damage: what is wrong with it and the cure, '' for nothing.
    """

    names: set[str] = field(default_factory=set)
    messages: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)
    damage: str = ''


@dataclass(frozen=True)
class Table:
    """Messages of an array topic: values (N, len(labels)) and their stamps [ns], shape (N,)."""

    labels: tuple[str, ...]
    values: Array
    stamps: Stamps

    def column(self, label: str) -> Array:
        """One label, shape (N,)."""
        return self.values[:, self.labels.index(label)]

    @property
    def sample(self) -> Stamps:
        """The count of each row."""
        return self.column('sample').astype(np.int64)

    def rows(self, chosen: Any) -> Table:
        """The rows that an index or a mask chooses."""
        return Table(self.labels, self.values[chosen], self.stamps[chosen])

    def between(self, begin_ns: float, end_ns: float) -> Table:
        """The rows stamped from begin_ns on and before end_ns."""
        return self.rows((self.stamps >= begin_ns) & (self.stamps < end_ns))

    def first_of_each_sample(self) -> Table:
        """Rows without those that repeat a sample, in the order of the samples."""
        return self.rows(np.unique(self.sample, return_index=True)[1])


def read_bag(
    path: Path, sample_period: float | None = None, span: Span = WHOLE_SPAN, axis: str = '',
) -> Run:
    """Read the run that a bag holds; nothing is said about its parameters.

    t = (sample - first) * sample_period; None takes the median distance of the stamps. A gap in
    the count is a lost sample. Of a damaged bag what is left is read. Where the controller was
    restarted, it is what the last one did within the span. axis: of several, '' for the first.
    Raises InputError, in one line, for a bag that cannot be read or holds no run.
    """
    wanted = set(map(last_part, ARRAY_LABELS))
    content = read_topics(path, lambda topic: last_part(topic.name) in wanted
                          and topic.message_type == 'std_msgs/msg/Float64MultiArray')
    try:
        tables, models, joint, notes = _find_tables(path, content, axis)
    except InputError as error:
        raise InputError(f'{error}; {content.damage}' if content.damage else str(error)) from None
    begin_ns = float(tables[topics.SIGNALS].stamps[0])
    restarted = _choose_section(tables, span)
    signals, estimates, truth = (
        tables[topic] for topic in (topics.SIGNALS, topics.ESTIMATES, topics.TRUTH)
    )
    if not signals.stamps.size:
        raise InputError(f'{path}: holds no sample between --from and --to')
    count, of_signals, of_estimates = np.intersect1d(
        signals.sample, estimates.sample, assume_unique=True, return_indices=True
    )
    if count.size == 0:
        raise InputError(f'{path}: no sample has both {topics.SIGNALS} and {topics.ESTIMATES}')
    if sample_period is None:
        sample_period = _median_period(path, count, signals.stamps[of_signals])
        notes.append(
            f'the sample period of {sample_period:.6g} s was taken from the stamps of the bag, '
            'as no parameters were given'
        )
    rows = np.full((count.size, len(COLUMNS)), np.nan)
    for table, index in ((signals, of_signals), (estimates, of_estimates)):
        for i, name in enumerate(COLUMNS):
            if name in table.labels:
                rows[:, i] = table.column(name)[index]
    _fill_in_truth(rows, count, truth)
    rows[:, COLUMNS.index('t')] = (count - count[0]) * sample_period
    heard = np.union1d(signals.sample, estimates.sample)
    if heard.size > count.size:
        notes.append(
            f'{heard.size - count.size} samples were left out: only one of signals and estimates '
            'is in the bag'
        )
    learned = _newest_model(models, joint, signals.stamps[0], begin_ns + span.to_s * 1e9)
    record = RunRecord(
        rows, sample_period, int(heard[-1] - heard[0]) + 1 - heard.size, learned
    )
    notes = [content.damage, *notes, restarted]
    latency_s = signals.column('latency_s')[of_signals]
    return Run(record, None, latency_s, tuple(note for note in notes if note))


def read_topics(path: Path, wanted: Callable[[Topic], bool]) -> Content:
    """Decode the wanted topics of a bag, or what is left of them; raises InputError."""
    types = get_typestore(Stores.ROS2_JAZZY)
    content = Content()
    count = garbled = 0
    first, last = 2**63, 0
    try:
        reader = BagReader(path)
    except BagError as error:
        raise InputError(str(error)) from None
    for topic, stamp_ns, raw in reader.messages(wanted):
        try:
            message = types.deserialize_cdr(raw, topic.message_type)
        # Whatever damaged bytes make the library stumble over, the message is lost.
        except Exception:
            garbled += 1
            continue
        content.messages.setdefault(topic.name, []).append((stamp_ns, message))
        first, last, count = min(first, stamp_ns), max(last, stamp_ns), count + 1
    content.names = {topic.name for topic in reader.topics}
    if reader.damage and not content.names:
        raise InputError(f'{path}: {reader.damage}, and nothing of it can be read')
    if reader.damage or garbled:
        unread = f', {garbled} more cannot be decoded' if garbled else ''
        content.damage = (
            f'{path} {reader.damage or "is damaged"}: this is what is left, {count} messages of '
            f'{max(last - first, 0) * 1e-9:.1f} s{unread}; once it is not being recorded any more, '
            f'`{REPAIR_COMMAND} {path}` completes it'
        )
    for messages in content.messages.values():
        messages.sort(key=lambda each: each[0])
    return content


def read_reports(path: Path, y: Array, axis: str = '') -> list[list[float]]:
    """What applied_control reported between each output of a run and the one before it.

    y (N,): outputs of the run, by whose values they are found among the messages. Empty where the
    bag holds no applied_control, or the outputs are not all there. Raises InputError.
    """
    content = read_topics(path, lambda topic: topic.message_type == 'std_msgs/msg/Float64')
    chosen: list[list[tuple[int, Any]]] = []
    for topic in (topics.PLANT_OUTPUT, topics.APPLIED_CONTROL):
        names = sorted(name for name in content.messages if f'/{name}'.endswith(f'/{topic}'))
        chosen.append(content.messages.get(choose_namespace(names, axis)[0], []))
    outputs, reports = chosen
    stamps: list[int] = []
    remaining = iter(outputs)
    for value in y.tolist():
        found = next((stamp for stamp, message in remaining if message.data == value), None)
        if found is None:
            return []
        stamps.append(found)
    until = np.searchsorted([stamp for stamp, _ in reports], stamps, side='right').tolist()
    values = [float(message.data) for _, message in reports]
    return [[], *(values[a:b] for a, b in pairwise(until))] if values else []


def choose_namespace(names: Sequence[str], axis: str) -> tuple[str, str]:
    """One of the topics that end alike, '' for none, and a sentence about the others, or ''.

    axis: the one that is wanted, '' for the first.
    """
    axes = [name.strip('/').split('/')[0] for name in names]
    if axis or not names:
        return names[axes.index(axis)] if axis in axes else '', ''
    if len(names) == 1:
        return names[0], ''
    return names[0], (
        f'the bag holds {", ".join(names)}: this is {axes[0]}; --axis {axes[1]} chooses another one'
    )


def last_part(name: str) -> str:
    """The name of a topic without its namespaces."""
    return name.rpartition('/')[2]


def _find_tables(
    path: Path, content: Content, axis: str,
) -> tuple[dict[str, Table], Sequence[tuple[int, Any]], str, list[str]]:
    """The array topics of one axis, the messages of its model, its joint, what else is there."""
    tables: dict[str, Table] = {}
    models: Sequence[tuple[int, Any]] = ()
    notes: list[str] = []
    joint, note = _choose_joint(content, axis)
    if joint:
        notes.append(note)
        axis = ''
    for topic, labels in ARRAY_LABELS.items():
        name, note = choose_namespace(_names_of(content, topic, labels), axis)
        if topic == topics.SIGNALS and note:
            notes.append(note)
            axis = name.strip('/').split('/')[0]
        messages = content.messages.get(name, ())
        if topic == topics.MODEL:
            models = messages
        elif messages:
            tables[topic] = _tabulate(path, name, labels, messages, joint)
        elif topic == topics.TRUTH:  # which a real plant does not know
            tables[topic] = Table(labels, np.empty((0, len(labels))), np.empty(0, np.int64))
        elif name:
            raise InputError(f'{path}: holds no message of {name}')
        else:
            heard = ', '.join(sorted(content.names)) or 'nothing'
            of_axis = f' of axis {axis}' if axis else ''
            raise InputError(f'{path}: holds no {topic}{of_axis}, only {heard}')
    return tables, models, joint, notes


def _names_of(content: Content, topic: str, labels: Sequence[str]) -> list[str]:
    """Under which names a topic was recorded; nodes that were renamed stand behind the others."""
    kept = {name for name in content.names if f'/{name}'.endswith(f'/{topic}')}
    renamed = {
        name for name, messages in content.messages.items()
        if last_part(name) == last_part(topic)
        and {each.label for each in messages[0][1].layout.dim} >= set(labels)
    }
    return [*sorted(kept), *sorted(renamed - kept)]


def _choose_joint(content: Content, axis: str) -> tuple[str, str]:
    """A joint of the controller of an arm, '' for no such controller, and which others it has.

    axis: the one that is wanted, '' for the first.
    """
    name, _ = choose_namespace(_names_of(content, topics.SIGNALS, ()), '')
    messages = content.messages.get(name, ())
    labels = [each.label for each in messages[0][1].layout.dim] if messages else []
    joints = list(dict.fromkeys(label.rpartition('.')[0] for label in labels))
    if joints in ([], ['']) or (axis and axis not in joints):
        return '', ''
    chosen = axis or joints[0]
    others = ', '.join(joint for joint in joints if joint != chosen)
    note = f'this is joint {chosen}; --axis chooses one of {others}' if others and not axis else ''
    return chosen, note


def _tabulate(
    path: Path, topic: str, labels: Sequence[str], messages: Sequence[tuple[int, Any]], joint: str,
) -> Table:
    """The messages of a topic, of several joints what is about one; '' for all of it."""
    given = tuple(each.label for each in messages[0][1].layout.dim) or tuple(labels)
    if any(len(message.data) != len(given) for _, message in messages):
        raise InputError(f'{path}: {topic} has a message without a value for each label')
    of_joint = {
        label.removeprefix(f'{joint}.'): i for i, label in enumerate(given)
        if not joint or label.startswith(f'{joint}.')
    }
    missing = sorted(set(labels) - set(of_joint))
    if missing:
        raise InputError(f'{path}: {topic} lacks {", ".join(missing)}')
    values = np.array([message.data for _, message in messages], dtype=np.float64)
    values = values[:, list(of_joint.values())]
    stamps = np.array([stamp for stamp, _ in messages], dtype=np.int64)
    # A joint that was not answered has a row of nan.
    answered = slice(None) if not joint else ~np.isnan(values).all(axis=1)
    return Table(tuple(of_joint), values[answered], stamps[answered])


def _choose_section(tables: dict[str, Table], span: Span) -> str:
    """Leave in the tables the rows of the span, and of its last run if there are several.

    Returns what was left out in one sentence, '' for nothing.
    """
    begin_ns = float(tables[topics.SIGNALS].stamps[0])
    for topic, table in tables.items():
        tables[topic] = table.between(begin_ns + span.from_s * 1e9, begin_ns + span.to_s * 1e9)
    signals = tables[topics.SIGNALS]
    restarts = np.flatnonzero(np.diff(signals.sample) <= 0) + 1
    note = ''
    # Where the count falls back that often, two nodes are at work.
    if restarts.size > 0.1 * len(signals.stamps):
        note = 'two controllers published at once: the first row of each sample is used'
    elif restarts.size:
        cut_ns = float(signals.stamps[restarts[-1]])
        note = (
            f'the controller restarted its count {restarts.size} time'
            f'{"s" if restarts.size > 1 else ""}: this is what follows the last restart, '
            f'{(cut_ns - begin_ns) * 1e-9:.1f} s after the beginning; --from and --to choose '
            'another part'
        )
        for topic, table in tables.items():
            tables[topic] = table.between(cut_ns, inf)
        # By rows, as stamps of a simulated time may be equal.
        tables[topics.SIGNALS] = signals.rows(slice(restarts[-1], None))
    for topic, table in tables.items():
        tables[topic] = table.first_of_each_sample()
    return note


def _fill_in_truth(rows: Array, count: Stamps, truth: Table) -> None:
    """Fill in u where it was recorded, and the true backlash, of which the newest holds on.

    The last v of a run is computed but never applied: its sample has no u.
    """
    if truth.stamps.size == 0:
        return
    sample = truth.sample + _offset(rows[:, COLUMNS.index('v')], count, truth)
    _, here, there = np.intersect1d(count, sample, assume_unique=True, return_indices=True)
    rows[here, COLUMNS.index('u')] = truth.column('u')[there]
    newest = np.maximum(np.searchsorted(sample, count, side='right') - 1, 0)
    for name in topics.BACKLASH:
        rows[:, COLUMNS.index(f'true_{name}')] = truth.column(name)[newest]


def _offset(v: Array, count: Stamps, truth: Table) -> int:
    """Count of the controller less that of the plant for the same sample.

    A controller that was started later counts from another beginning. Then a v that occurs once
    on either side shows which samples are the same.
    """
    if np.intersect1d(count, truth.sample).size:
        return 0
    once = []
    for values in (v, truth.column('v')):
        unique, rows, times = np.unique(values, return_index=True, return_counts=True)
        once.append((unique[times == 1], rows[times == 1]))
    (commands, of_commands), (applied, of_applied) = once
    _, here, there = np.intersect1d(commands, applied, return_indices=True)
    if not here.size:
        return 0
    offsets, times = np.unique(
        count[of_commands[here]] - truth.sample[of_applied[there]], return_counts=True
    )
    return int(offsets[np.argmax(times)])


def _median_period(path: Path, count: Stamps, stamps: Stamps) -> float:
    if count.size < 2:
        raise InputError(f'{path}: one sample does not show the sample period: give --config')
    period = float(np.median(np.diff(stamps) / np.diff(count))) * 1e-9
    if not period > 0.0:
        raise InputError(f'{path}: its stamps do not show the sample period: give --config')
    return period


def _newest_model(
    messages: Sequence[tuple[int, Any]], joint: str, begin_ns: float, end_ns: float,
) -> LearnedModel | None:
    """The last G that was published within the span; one that is not complete is none."""
    fields: dict[str, list[float]] = {}
    for stamp, message in messages:
        if begin_ns <= stamp < end_ns:
            ends = np.cumsum([each.size for each in message.layout.dim])
            found = {
                each.label.removeprefix(f'{joint}.'): values.tolist()
                for each, values in zip(
                    message.layout.dim, np.split(message.data, ends), strict=False
                ) if not joint or each.label.startswith(f'{joint}.')
            }
            # Of a joint that was not answered there is nothing but nan.
            if not all(isnan(value) for values in found.values() for value in values):
                fields = found
    try:
        return from_fields(fields) if fields else None
    except (KeyError, IndexError, ValueError):
        return None
