"""The messages of a rosbag2 bag (mcap or sqlite3), be it complete, torn or damaged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from backlash_ros.bags.content import CURE, BagError, is_being_written
from backlash_ros.bags.remains import open_remains, visible_damage
from backlash_ros.tools.cli.errors import InputError

Wanted = Callable[[str, str], bool]  # whether a topic of this name and type is to be read


@dataclass
class Content:
    """Stamps [ns] and messages of the topics that were wanted, under their recorded names.

    names: of all topics of the bag. damage: what is wrong with it and the cure, empty if it is
    complete.
    """

    names: set[str] = field(default_factory=set)
    messages: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)
    damage: str = ''

    def add(self, name: str, stamp_ns: int, message: Any) -> None:
        self.messages.setdefault(name, []).append((stamp_ns, message))


def read_content(path: Path, wanted_topic: Wanted) -> Content:
    """What is left of a bag; raises InputError, in one line, where nothing can be read."""
    if not path.is_dir():
        rule = 'is a file: give the folder of the bag' if path.exists() else 'does not exist'
        raise InputError(f'{path}: {rule}')
    reason = visible_damage(path)
    if not reason:
        try:
            return _read_complete(path, wanted_topic)
        # Whatever a damaged file makes the library stumble over, the file is damaged.
        except Exception as error:
            reason = f'is damaged ({" ".join(str(error).split()) or type(error).__name__})'
    try:
        return _read_remains(path, reason, wanted_topic)
    except BagError as error:
        raise InputError(f'{path}: {reason}, and nothing of it can be read: {error}') from None


def _read_complete(path: Path, wanted_topic: Wanted) -> Content:
    content = Content()
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        content.names = {connection.topic for connection in reader.connections}
        wanted = [
            found for found in reader.connections if wanted_topic(found.topic, found.msgtype)
        ]
        # No choice would be all of them.
        for connection, stamp_ns, raw in reader.messages(wanted) if wanted else ():
            message = reader.deserialize(raw, connection.msgtype)
            content.add(connection.topic, stamp_ns, message)
    return content


def _read_remains(path: Path, reason: str, wanted_topic: Wanted) -> Content:
    content, types = Content(), get_typestore(Stores.ROS2_JAZZY)
    remains = open_remains(path)
    first, last, count, garbled = 2**63, 0, 0, 0
    for topic, stamp_ns, raw in remains.messages():
        if wanted_topic(topic.name, topic.message_type):
            try:
                message = types.deserialize_cdr(raw, topic.message_type)
            # Whatever the damaged bytes make the library stumble over, the message is lost.
            except Exception:
                garbled += 1
                continue
            content.add(topic.name, stamp_ns, message)
        first, last, count = min(first, stamp_ns), max(last, stamp_ns), count + 1
    if not count:
        raise BagError('it holds no message')
    content.names = {topic.name for topic in remains.topics.values()}
    cure = 'stop the recorder' if is_being_written(path) else f'{CURE} {path}'
    content.damage = (
        f'{path} {reason}: this is what is left, {count} messages of {(last - first) * 1e-9:.1f} '
        f's{f", {garbled} more cannot be decoded" if garbled else ""}. To have it complete: {cure}'
    )
    return content
