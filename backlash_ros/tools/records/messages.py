"""A record from messages of v and y: of a bag, or of an actuator that is being moved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros import topics
from backlash_ros.bags.reader import Topic
from backlash_ros.core.loop.command_history import REPORTED, v_of_intervals
from backlash_ros.core.records.readings import quantum
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.rows import in_order
from backlash_ros.core.records.rows_to_record import record_of_samples, usable
from backlash_ros.core.records.timing import LONGEST, numbered, rounded, seconds
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.runs.bag import choose_namespace, read_topics
from backlash_ros.tools.runs.read_run import read_run

Array = NDArray[np.float64]
Messages = tuple[NDArray[np.int64], Array]  # stamps [ns] and values

NUMBER, NUMBERS = 'std_msgs/msg/Float64', 'std_msgs/msg/Float64MultiArray'
JOINTS = 'sensor_msgs/msg/JointState'
NATIVE = (topics.PLANT_OUTPUT, topics.CONTROL, topics.APPLIED_CONTROL)
COMMAND_WORDS = ('command', 'cmd', 'goal', 'target', 'setpoint')
SIMULATED_BEFORE_NS = 10**17  # stamps: the clock of a machine is far beyond
FEWEST = 3  # messages that are a motion


class Signal(NamedTuple):
    """Numbers of one topic, or of one joint of it. commanded: v, by the name of the topic."""

    messages: Messages
    commanded: bool
    joint: str = ''


def read_bag_record(
    path: Path, period: float | None, axis: str, columns: Mapping[str, str],
) -> Record:
    """v and y of a bag: topics of this package, or joint states and commands to joints.

    axis: of several, the namespace or the joint. columns: names of the signals that are v and y.
    Raises InputError and RecordError.
    """
    signals, damage = _signals(path)
    notes = [damage] if damage else []
    if not columns:
        heard, note = _native(signals, axis)
        output = heard.get(topics.PLANT_OUTPUT)
        if output is not None and len(output[0]) >= FEWEST and \
                np.median(output[0]) >= SIMULATED_BEFORE_NS:
            record = from_messages(heard, period, f' of axis {axis}' if axis else '')
            return replace(record, notes=(*record.notes, *filter(None, [note]), *notes))
    pair = _joint_pair(path, signals, axis, columns)
    if isinstance(pair, str):
        of_joints = any(each.joint or each.commanded for each in signals.values())
        native = any(name.endswith(topics.PLANT_OUTPUT) for name in signals)
        if columns or (of_joints and not native):
            raise InputError(f'{path}: {pair}')
        # Stamps of a simulated time do not tell what came first within a sample.
        return _from_signals(path, period, axis)
    v, y = pair
    record = from_messages({
        topics.CONTROL: signals[v].messages, topics.PLANT_OUTPUT: signals[y].messages,
    }, period)
    return replace(record, notes=(f'v is {v}, y is {y}', *record.notes, *notes))


def from_messages(
    heard: Mapping[str, Messages], period: float | None, of_axis: str = '',
) -> Record:
    """From stamps [ns] and values by topic, plant_output among them.

    v is that of applied_control where it is reported, else that of control. period [s]: from sample
    to sample, None tells it from the stamps. Raises RecordError.
    """
    said: list[str] = []
    begin = np.median(heard[topics.PLANT_OUTPUT][0])
    heard = {topic: _by_time(messages, int(begin), said) for topic, messages in heard.items()
             if len(messages[0])}
    output = heard[topics.PLANT_OUTPUT]
    commands = heard.get(topics.APPLIED_CONTROL)
    reported = commands is not None and len(commands[0]) >= REPORTED * len(output[0])
    if not reported:
        commands = heard.get(topics.CONTROL)
    if commands is None or not len(commands[0]):
        raise RecordError(f'holds no {topics.CONTROL}{of_axis}: record it as well')
    times = (output[0] - output[0][0]).astype(float) * 1e-9
    step = float(np.median(np.diff(times))) if period is None else period
    if not step > 0.0:
        raise RecordError('its stamps do not tell the sample period: give --period S')
    index = numbered(times / step)
    if index[-1] >= LONGEST:
        raise RecordError(f'spans {index[-1]:.3g} sample periods of {seconds(step)}: cut it')
    if period is None:
        # All stamps together tell it better than one step does, but for how late the ends were.
        slope, offset = np.polyfit(index, times, 1).tolist()
        late = float(np.std(times - slope * index - offset))
        # The first and the last stamp are late independently of each other.
        step = rounded(slope, 2.0**0.5 * late / float(index[-1]))
    y = np.full(int(index[-1]) + 1, np.nan)
    y[index] = output[1]
    v = v_of_intervals(index, output[0], *commands, reported)
    sent = heard.get(topics.CONTROL) if reported else None
    sent_v = None if sent is None else v_of_intervals(index, output[0], *sent, False)
    missing = len(y) - len(index)
    timing = '; '.join([
        f'{len(index)} messages of y, one every {seconds(step)}'
        + (f', {missing} missing' if missing else ''), *said,
    ])
    return usable(Record(v, y, step, quantum(y), timing=timing, commands=sent_v))


def _by_time(messages: Messages, begin_ns: int, said: list[str]) -> Messages:
    """In the order of their stamps, without those that are none."""
    stamps, values = messages
    if len(stamps) < FEWEST or np.unique(stamps).size < 2:
        return messages
    ordered = in_order((stamps - begin_ns).astype(float) * 1e-9)
    for text in ordered.said:
        said.append(text.replace('row', 'message'))
    return stamps[ordered.rows], values[ordered.rows]


def _native(signals: Mapping[str, Signal], axis: str) -> tuple[dict[str, Messages], str]:
    """The topics of this package by their own names, and which others there are."""
    chosen: dict[str, Messages] = {}
    about = ''
    for topic in NATIVE:
        ends = sorted(name for name in signals if f'/{name}'.endswith(f'/{topic}'))
        if not ends:
            continue
        name, note = choose_namespace(ends, axis)
        if name:
            chosen[topic] = signals[name].messages
            axis = axis or (name.strip('/').split('/')[0] if note else '')
        if topic == topics.PLANT_OUTPUT:
            about = note
    return chosen, about


def _joint_pair(
    path: Path, signals: Mapping[str, Signal], axis: str, columns: Mapping[str, str],
) -> tuple[str, str] | str:
    """Names of v and y, or why they cannot be told."""
    for name in columns.values():
        if name not in signals:
            return f'--columns {name}: the signals are {", ".join(sorted(signals)) or "none"}'
    def meant(name: str, joint: str) -> bool:
        return axis in ('', joint, name.split('/')[0])

    outputs = [name for name, each in signals.items()
               if each.joint and not each.commanded and meant(name, each.joint)]
    commands = [name for name, each in signals.items()
                if each.commanded and (not each.joint or meant(name, each.joint))]
    y = columns.get('y') or (outputs[0] if len(outputs) == 1 else '')
    v = columns.get('v') or (commands[0] if len(commands) == 1 else '')
    if not (v and y):
        names = ', '.join(sorted(signals)) or 'none'
        return (
            f'which signals are v and y? They are {names}: choose a joint with --axis, or name '
            'them: --columns "v=…,y=…"'
        )
    return v, y


def _from_signals(path: Path, period: float | None, axis: str) -> Record:
    """From what the controller says that it heard and sent."""
    source = read_run(path, axis=axis)
    run = source.record
    record = record_of_samples(
        run.column('t'), run.column('v'), run.column('y'), period or run.sample_period
    )
    return replace(record, notes=(*record.notes, *source.notes))


def _signals(path: Path) -> tuple[dict[str, Signal], str]:
    """Every number of a bag that may be v or y, by name, and what is wrong with the bag."""
    def wanted(topic: Topic) -> bool:
        of_joints = topic.message_type == NUMBERS and _is_command(topic.name)
        return of_joints or topic.message_type in (NUMBER, JOINTS)

    content = read_topics(path, wanted)
    series: dict[tuple[str, str], tuple[list[int], list[float]]] = {}
    for topic, messages in sorted(content.messages.items()):
        for stamp, message in messages:
            for part, value in _numbers_of(message):
                stamps, values = series.setdefault((topic, part), ([], []))
                stamps.append(stamp)
                values.append(value)
    found = {}
    for (topic, part), (stamps, values) in series.items():
        joint = '' if part.startswith('[') else part.removeprefix('/')
        name = topic.removeprefix('/') + part
        messages_of = np.array(stamps, dtype=np.int64), np.array(values)
        found[name] = Signal(messages_of, _is_command(topic), joint)
    return found, content.damage


def _numbers_of(message: Any) -> Iterator[tuple[str, float]]:
    """Its numbers, each with what its name has behind that of the topic."""
    if hasattr(message, 'name'):
        for joint, value in zip(message.name, message.position, strict=False):
            yield f'/{joint}', float(value)
    elif hasattr(message, 'layout'):
        for place, value in enumerate(message.data):
            yield f'[{place}]', float(value)
    else:
        yield '', float(message.data)


def _is_command(topic: str) -> bool:
    """Whether a topic is one of commands, by its name."""
    return any(word in topic.lower() for word in COMMAND_WORDS)
