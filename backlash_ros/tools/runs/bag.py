"""From a bag to a run: signals, estimates and truth, joined on the number of the sample."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain, pairwise
from math import isnan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from backlash_ros import topics
from backlash_ros.bags.reader import REPAIR_COMMAND, BagError, BagReader, Topic
from backlash_ros.core.loop.learned_model import from_fields
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import WHOLE_SPAN, InputError, Span
from backlash_ros.tools.runs.files import Run

Array = NDArray[np.float64]
# Messages of an array topic by label, shape (N,) each, and their `stamp` [ns] since the first.
Table = dict[str, Array]


class Content(NamedTuple):
    """Stamps [ns] and messages of the wanted topics by recorded name, in the order of stamps.

    names: of all topics of the bag. damage: what is wrong with it and the cure, '' for nothing.
    """

    messages: dict[str, list[tuple[int, Any]]]
    names: set[str]
    damage: str


def read_topics(path: Path, wanted: Callable[[Topic], bool]) -> Content:
    """Decode the wanted topics of a bag, or what is left of them; raises InputError."""
    types = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, list[tuple[int, Any]]] = {}
    garbled, damage = 0, ''
    try:
        reader = BagReader(path)
    except BagError as error:
        raise InputError(str(error)) from None
    for topic, stamp_ns, raw in reader.messages(wanted):
        try:
            message = types.deserialize_cdr(raw, topic.message_type)
            found.setdefault(topic.name, []).append((stamp_ns, message))
        # Whatever damaged bytes make the library stumble over, the message is lost.
        except Exception:
            garbled += 1
    for messages in found.values():
        messages.sort(key=lambda each: each[0])
    if reader.damage and not reader.topics:
        raise InputError(f'{path}: {reader.damage}, and nothing of it can be read')
    if reader.damage or garbled:
        stamps = [stamp for messages in found.values() for stamp, _ in messages]
        lasted_s = 1e-9 * (max(stamps) - min(stamps)) if stamps else 0.0
        unread = f', {garbled} more cannot be decoded' if garbled else ''
        damage = (
            f'{path} {reader.damage or "is damaged"}: this is what is left, {len(stamps)} messages '
            f'of {lasted_s:.1f} s{unread}; once it is not being recorded any more, '
            f'`{REPAIR_COMMAND} {path}` completes it'
        )
    return Content(found, {topic.name for topic in reader.topics}, damage)


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


def read_reports(path: Path, y: Array, axis: str = '') -> list[list[float]]:
    """What applied_control reported between each output of a run and the one before it.

    y (N,): outputs of the run, by whose values they are found among the messages. Empty where the
    bag holds no applied_control, or the outputs are not all there. Raises InputError.
    """
    content = read_topics(path, lambda topic: topic.message_type == 'std_msgs/msg/Float64')
    outputs, reports = (
        content.messages.get(choose_namespace(sorted(
            name for name in content.messages if f'/{name}'.endswith(f'/{topic}')
        ), axis)[0], []) for topic in (topics.PLANT_OUTPUT, topics.APPLIED_CONTROL)
    )
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


def read_bag(
    path: Path, sample_period: float | None = None, span: Span = WHOLE_SPAN, axis: str = '',
) -> Run:
    """Read the run that a bag holds; nothing is said about its parameters.

    t = (sample - first) * sample_period; None takes the median distance of the stamps. A gap in
    the count is a lost sample. Of a damaged bag what is left is read. Where the controller was
    restarted, it is what the last one did within the span. axis: of several, '' for the first.
    Raises InputError, in one line, for a bag that cannot be read or holds no run.
    """
    last_parts = {topic.rpartition('/')[2] for topic in topics.LABELS_OF}
    content = read_topics(path, lambda topic: topic.name.rpartition('/')[2] in last_parts
                          and topic.message_type == 'std_msgs/msg/Float64MultiArray')
    try:
        tables, models, notes = _find_tables(content, axis)
        restarted = _choose_section(tables, span)
        signals, estimates, truth = tables
        if not signals['stamp'].size:
            raise InputError('holds no sample between --from and --to')
        count, of_signals, of_estimates = np.intersect1d(
            signals['sample'], estimates['sample'], assume_unique=True, return_indices=True
        )
        if count.size == 0:
            raise InputError(f'no sample has both {topics.SIGNALS} and {topics.ESTIMATES}')
        if sample_period is None:
            steps = np.diff(signals['stamp'][of_signals]) / np.diff(count)
            sample_period = 1e-9 * float(np.median(steps)) if steps.size else 0.0
            if not sample_period > 0.0:
                raise InputError('its stamps do not show the sample period: give --config')
            notes.append(
                f'the sample period of {sample_period:.6g} s was taken from the stamps of the bag, '
                'as no parameters were given'
            )
    except InputError as error:
        raise InputError('; '.join(filter(None, (f'{path}: {error}', content.damage)))) from None
    columns = {
        **_rows(signals, of_signals), **_rows(estimates, of_estimates),
        't': (count - count[0]) * sample_period,
    }
    columns |= _true_columns(columns['v'], count, truth)
    heard = np.union1d(signals['sample'], estimates['sample'])
    if heard.size > count.size:
        notes.append(
            f'{heard.size - count.size} samples were left out: only one of signals and estimates '
            'is in the bag'
        )
    unknown, learned = np.full(count.size, np.nan), None
    with suppress(KeyError, IndexError, ValueError):  # where it was not complete
        learned = from_fields([
            fields for stamp, fields in models
            if signals['stamp'][0] <= stamp < span.to_s * 1e9
        ][-1])
    record = RunRecord(
        np.column_stack([columns.get(name, unknown) for name in COLUMNS]), sample_period,
        int(heard[-1] - heard[0]) + 1 - heard.size, learned,
    )
    notes = [content.damage, *notes, restarted]
    return Run(record, None, columns['latency_s'], tuple(filter(None, notes)))


def _find_tables(
    content: Content, axis: str,
) -> tuple[list[Table], list[tuple[float, dict[str, list[float]]]], list[str]]:
    """Signals, estimates and truth of one axis or joint, G with its stamps, what else is there."""
    first = content.messages.get(choose_namespace(_names_of(content, topics.SIGNALS), '')[0], [])
    labels = _labels(first[0][1]) if first else []
    joints = list(dict.fromkeys(label.rpartition('.')[0] for label in labels if '.' in label))
    prefix, notes = '', []
    if joints and axis in ('', *joints):
        joint = axis or joints[0]
        if not axis and joints[1:]:
            notes = [f'this is joint {joint}; --axis chooses one of {", ".join(joints[1:])}']
        prefix, axis = f'{joint}.', ''
    begin_ns, found = 0, {}
    for topic in topics.LABELS_OF:  # signals first
        name, note = choose_namespace(_names_of(content, topic), axis)
        found[topic] = content.messages.get(name, [])
        if topic == topics.SIGNALS and name:
            begin_ns = found[topic][0][0]
            if note:
                notes.append(note)
                axis = name.strip('/').split('/')[0]
        if not name and topic in (topics.SIGNALS, topics.ESTIMATES):
            of_axis = f' of axis {axis}' if axis else ''
            raise InputError(f'holds no message of {topic}{of_axis}; its topics are '
                             f'{", ".join(sorted(content.names)) or "none"}')
    models = [(float(stamp - begin_ns), _fields_of(message, prefix))
              for stamp, message in found.pop(topics.MODEL)]
    # Of a joint that was not answered there is nothing but nan.
    known = [each for each in models if not all(map(isnan, chain(*each[1].values())))]
    return [_tabulate(*each, prefix, begin_ns) for each in found.items()], known, notes


def _labels(message: Any) -> list[str]:
    return [each.label for each in message.layout.dim]


def _names_of(content: Content, topic: str) -> list[str]:
    """Under which names a topic was recorded; nodes that were renamed stand behind the others."""
    last, wanted = topic.rpartition('/')[2], set(topics.LABELS_OF[topic])
    return sorted((
        name for name, messages in content.messages.items() if f'/{name}'.endswith(f'/{topic}')
        or (name.rpartition('/')[2] == last and wanted <= set(_labels(messages[0][1])))
    ), key=lambda name: (not f'/{name}'.endswith(f'/{topic}'), name))


def _tabulate(topic: str, messages: Sequence[tuple[int, Any]], prefix: str, begin_ns: int) -> Table:
    """The messages of a topic, of several joints what is about the one with this prefix."""
    if not messages:  # a real plant does not know its truth
        return {label: np.empty(0) for label in (*topics.LABELS_OF[topic], 'stamp')}
    given = _labels(messages[0][1]) or topics.LABELS_OF[topic]
    if any(len(message.data) != len(given) for _, message in messages):
        raise InputError(f'{topic} has a message without a value for each label')
    values = np.array([message.data for _, message in messages], dtype=np.float64).T
    table = {label.removeprefix(prefix): column for label, column in zip(given, values, strict=True)
             if label.startswith(prefix)}
    if missing := sorted(set(topics.LABELS_OF[topic]) - set(table)):
        raise InputError(f'{topic} lacks {", ".join(missing)}')
    # A joint that was not answered has a row of nan.
    answered = ~np.isnan(list(table.values())).all(axis=0)
    table['stamp'] = np.array([stamp - begin_ns for stamp, _ in messages], dtype=np.float64)
    return _rows(table, answered if prefix else slice(None))


def _rows(table: Table, chosen: Any) -> Table:
    """The rows that an index or a mask chooses."""
    return {label: column[chosen] for label, column in table.items()}


def _choose_section(tables: list[Table], span: Span) -> str:
    """Leave in the tables the rows of the span, and of its last run if there are several.

    Returns what was left out in one sentence, '' for nothing.
    """
    # In lockstep the stamp is that of the newest tick that the recorder had heard: what belongs to
    # the first signals may be stamped before them.
    begin = span.from_s * 1e9 if span.from_s > 0.0 else -np.inf
    for i, table in enumerate(tables):
        t = table['stamp']
        tables[i] = _rows(table, (t >= begin) & (t < span.to_s * 1e9))
    signals, note = tables[0], ''
    restarts = np.flatnonzero(np.diff(signals['sample']) <= 0) + 1
    # Where the count falls back that often, two nodes are at work.
    if restarts.size > 0.1 * signals['sample'].size:
        note = 'two controllers published at once: the first row of each sample is used'
    elif restarts.size:
        cut = signals['stamp'][restarts[-1]]
        note = (
            f'the controller restarted its count {restarts.size} time'
            f'{"s" if restarts.size > 1 else ""}: this is what follows the last restart, '
            f'{cut * 1e-9:.1f} s after the beginning; --from and --to choose another part'
        )
        # Signals by rows, as stamps of a simulated time may be equal.
        tables[:] = [_rows(signals, slice(restarts[-1], None)),
                     *(_rows(table, table['stamp'] >= cut) for table in tables[1:])]
    tables[:] = [_rows(table, np.unique(table['sample'], return_index=True)[1]) for table in tables]
    return note


def _true_columns(v: Array, count: Array, truth: Table) -> Table:
    """u where it was recorded, and the true backlash, of which the newest holds on.

    The last v of a run is computed but never applied: its sample has no u.
    """
    if truth['stamp'].size == 0:
        return {}
    sample = truth['sample']
    if not np.intersect1d(count, sample).size:
        # A controller that was started later counts from another beginning: the same v tells.
        sample_of = dict(zip(truth['v'].tolist(), sample.tolist(), strict=True))
        offsets = Counter(k - sample_of[value] for k, value in zip(count, v.tolist(), strict=True)
                          if value in sample_of)
        sample = sample + (offsets.most_common(1)[0][0] if offsets else 0)
    _, here, there = np.intersect1d(count, sample, assume_unique=True, return_indices=True)
    u = np.full(count.size, np.nan)
    u[here] = truth['u'][there]
    newest = np.maximum(np.searchsorted(sample, count, side='right') - 1, 0)
    return {'u': u, **{f'true_{name}': truth[name][newest] for name in topics.BACKLASH}}


def _fields_of(message: Any, prefix: str) -> dict[str, list[float]]:
    """What a message tells of G, of several joints what is about the one with this prefix."""
    ends = np.cumsum([each.size for each in message.layout.dim])
    parts = zip(_labels(message), np.split(message.data, ends), strict=False)
    return {label.removeprefix(prefix): values.tolist() for label, values in parts
            if label.startswith(prefix)}
