"""Make a record from messages of v and y, of a bag or of an actuator that is being moved."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from backlash_ros import topics
from backlash_ros.core.loop.command_history import REPORTED, without_origin
from backlash_ros.core.loop.diagnosis import TROUBLE
from backlash_ros.core.records.record import Record, RecordError
from backlash_ros.core.records.stamps import in_order
from backlash_ros.core.records.time_grid import Rows, on_grid, usable, without_turns
from backlash_ros.tools.runs.read_run import choose_namespace, read_topics, topic_ends_like

Messages = Sequence[tuple[int, float]]  # stamps [ns] and values

FEWEST_MESSAGES = 3  # needed for a motion


class Signal(NamedTuple):
    """Values of a topic, or of a joint in it. commanded: whether the topic is named like v."""

    messages: list[tuple[int, float]]
    commanded: bool
    joint: str = ''


def read_bag_record(
    path: Path, period: float | None, axis: str, columns: Mapping[str, str],
) -> Record | None:
    """Read v and y of a bag: topics of this package, or joint states and commands to joints.

    axis: one of several namespaces or joints. columns: names of the signals v and y. Returns None
    if only the controller's signals tell v and y: stamps of simulated time do not tell the order
    within a sample. Raises InputError and RecordError.
    """
    simulated_before_ns = 10**17  # stamps of real clocks are far beyond
    signals, damage = _signals(path)
    of_joints = any(each.joint or each.commanded for each in signals.values())
    native = any(topic_ends_like(name, topics.PLANT_OUTPUT) for name in signals)
    if columns or (of_joints and not native):
        v, y = _joint_pair(signals, axis, columns)
        heard: dict[str, Messages] = {
            topics.CONTROL: signals[v].messages, topics.PLANT_OUTPUT: signals[y].messages}
        note, of_axis = f'v is {v}, y is {y}', ''
    else:
        heard, note = _native(signals, axis)
        stamps = [stamp for stamp, _ in heard.get(topics.PLANT_OUTPUT, ())]
        if len(stamps) < FEWEST_MESSAGES or np.median(stamps) < simulated_before_ns:
            return None
        of_axis = f' of axis {axis}' if axis else ''
    record = from_messages(heard, period, of_axis)
    return replace(record, notes=tuple(filter(None, (note, *record.notes, damage))))


def from_messages(heard: Mapping[str, Messages], period: float | None, of_axis: str = '') -> Record:
    """Make a record of stamps [ns] and values by topic, plant_output among them.

    v is that of applied_control if it is reported, else that of control. period [s]: from the
    stamps if None. of_axis: for messages. Raises RecordError.
    """
    said, notes = list[str](), list[str]()
    begin_ns = int(np.median([stamp for stamp, _ in heard[topics.PLANT_OUTPUT]]))
    sent = {topic: np.array([[(stamp - begin_ns) * 1e-9 for stamp, _ in messages],
                             [value for _, value in messages]])
            for topic, messages in heard.items() if messages}  # times [s] and values
    for topic, pairs in sent.items():
        if len(pairs[0]) >= FEWEST_MESSAGES and np.unique(pairs[0]).size > 1:
            sent[topic] = pairs[:, in_order(pairs[0], said, 'message')]
    t, y = sent.pop(topics.PLANT_OUTPUT)
    commands, v = sent.get(topics.CONTROL), sent.get(topics.APPLIED_CONTROL)
    reported = v is not None and v.shape[1] >= REPORTED * len(t)
    if v is None or not reported:
        v, commands = commands, None
    if v is None:
        raise RecordError(f'holds no {topics.CONTROL}{of_axis}: record it as well')
    record = on_grid(Rows(t, v, y, commands, reported), period, late=True)
    step = record.sample_period
    if record.commands is not None:
        record = replace(record, v=without_origin(record.v, record.commands))
    for topic, (times, _) in sent.items():
        lost = np.count_nonzero((t > times[0] - step) & (t <= times[-1])) - len(times)
        # A topic with even fewer messages is published on change only.
        if TROUBLE * (lost + len(times)) < lost < 0.5 * (lost + len(times)):
            notes.append(f'{lost} messages of {topic} are missing: the one before is taken for '
                         'them')
            record = replace(record, commands=None)
    v, own = without_turns(
        step * np.arange(len(record.y), dtype=float), record.v, record.y, said, notes)
    return usable(replace(record, v=v, y=own), y, said, notes)


def _native(signals: Mapping[str, Signal], axis: str) -> tuple[dict[str, Messages], str]:
    """Messages by topic of this package, and a note on other axes."""
    chosen, about = dict[str, Messages](), ''
    for topic in (topics.PLANT_OUTPUT, topics.CONTROL, topics.APPLIED_CONTROL):
        ends = sorted(name for name in signals if topic_ends_like(name, topic))
        name, note = choose_namespace(ends, axis)
        if name:
            chosen[topic] = signals[name].messages
            axis = axis or (name.split('/')[0] if note else '')
        about = about or note
    return chosen, about


def _joint_pair(
    signals: Mapping[str, Signal], axis: str, columns: Mapping[str, str],
) -> tuple[str, str]:
    """The names of the signals v and y; raises RecordError if they are ambiguous."""
    names = ', '.join(sorted(signals)) or 'none'
    for name in columns.values():
        if name not in signals:
            raise RecordError(f'--columns {name}: the signals are {names}')
    meant = {name: each for name, each in signals.items()
             if axis in ('', each.joint, name.split('/')[0]) or (each.commanded and not each.joint)}
    commands = [name for name, each in meant.items() if each.commanded]
    outputs = [name for name, each in meant.items() if each.joint and not each.commanded]
    v = columns.get('v') or (commands[0] if len(commands) == 1 else '')
    y = columns.get('y') or (outputs[0] if len(outputs) == 1 else '')
    if not (v and y):
        raise RecordError(f'which signals are v and y? They are {names}: choose a joint with '
                          '--axis, or name them: --columns "v=…,y=…"')
    return v, y


def _signals(path: Path) -> tuple[dict[str, Signal], str]:
    """All signals of a bag that may be v or y, by name, and its damage or ''."""
    array = 'std_msgs/msg/Float64MultiArray'
    # For each number in a message: what to append to the topic, the joint, the value.
    numbers_of: Mapping[str, Callable[[Any], Sequence[tuple[str, str, float]]]] = {
        'std_msgs/msg/Float64': lambda message: [('', '', message.data)],
        array: lambda message: [(f'[{k}]', '', value) for k, value in enumerate(message.data)],
        'sensor_msgs/msg/JointState': lambda message: [
            (f'/{joint}', joint, value)
            for joint, value in zip(message.name, message.position, strict=False)],
    }

    def is_command(topic: str) -> bool:
        words = ('command', 'cmd', 'goal', 'target', 'setpoint')
        return any(word in topic.lower() for word in words)

    recorded, _, damage = read_topics(path, lambda topic: topic.message_type in numbers_of and (
        topic.message_type != array or is_command(topic.name)))
    signals = dict[str, Signal]()
    for topic, messages in sorted(recorded.items()):
        for stamp, message in messages:
            for part, joint, value in numbers_of[message.__msgtype__](message):
                signal = signals.setdefault(
                    topic.removeprefix('/') + part, Signal([], is_command(topic), joint))
                signal.messages.append((stamp, float(value)))
    return signals, damage
