"""Makes a damaged bag readable for everyone: what is left of it, rewritten and closed."""

from __future__ import annotations

import os
import shutil
import sqlite3
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from backlash_ros.bags.content import (
    SUFFIXES,
    BagError,
    NoBagError,
    Remains,
    Topic,
    is_bag,
    lock_folder,
    sync_path,
    the_message_file,
)
from backlash_ros.bags.remains import damage, open_remains
from backlash_ros.bags.writer import STORAGE
from backlash_ros.options import BAD_INPUT, DONE, FAILED


@dataclass(frozen=True)
class Repair:
    """What was saved: messages by topic, and the time from the first to the last of them."""

    why: str
    messages: dict[str, int]
    duration_s: float
    cut: str
    original: Path


def repair_command(path: Path) -> int:
    """Repair a bag and say what came of it; returns the exit code."""
    try:
        done = repair(path)
    except BagError as error:
        print(f'recorder: {error}', file=sys.stderr)
        return BAD_INPUT if isinstance(error, NoBagError) else FAILED
    except KeyboardInterrupt:
        print(f'recorder: interrupted, nothing of {path} is lost', file=sys.stderr)
        return FAILED
    if done is None:
        print(f'{path} is complete: nothing to repair')
        return DONE
    print(f'{path} {done.why}; saved: {done.duration_s:.3f} s')
    width = max(map(len, done.messages))
    for topic, count in sorted(done.messages.items()):
        print(f'  {topic:<{width}}  {count:>8} messages')
    print(f'cut: {done.cut or "nothing of what was on disk"}')
    print(f'the original is kept: {done.original}')
    return DONE


def repair(bag: Path) -> Repair | None:
    """Put a complete bag in the place of a damaged one, which is kept beside it.

    None for a bag that is complete. Raises BagError, NoBagError where there is none.
    """
    bag = bag.resolve()
    if not bag.is_dir():
        raise NoBagError(f'{bag}: ' + (
            'is a file: give the folder of the bag' if bag.exists() else 'does not exist'
        ))
    if not is_bag(bag):
        raise NoBagError(f'{bag}: is no bag: has no metadata.yaml, no .mcap and no .db3 file')
    try:
        with _locked(bag):
            why = damage(bag)
            return _rewrite(bag, why) if why else None
    except (OSError, sqlite3.Error, WriterError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise BagError(
            f'{bag}: cannot be repaired: {reason}: is there room for a second copy, and may you '
            'write there? The bag is as it was'
        ) from None


@contextmanager
def _locked(bag: Path) -> Iterator[None]:
    try:
        descriptor = lock_folder(bag)
    except BlockingIOError:
        raise BagError(f'{bag}: is being recorded: stop its recorder first') from None
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _rewrite(bag: Path, why: str) -> Repair:
    storage = SUFFIXES[the_message_file(bag).suffix]
    remains = open_remains(bag)
    if not remains.by_rosbags:
        raise BagError(
            f'{bag}: {why}, but was not written by the recorder: try `ros2 bag reindex`'
        )
    workshop = _beside(bag, 'repairing')
    workshop.mkdir()
    try:
        # The name of a bag is that of its file as well.
        repaired = workshop / bag.name
        counts, duration_s = _write(remains, repaired, STORAGE[storage])
        if not counts:
            raise BagError(f'{bag}: {why}, and holds no message that could be saved')
        for file in (*repaired.iterdir(), repaired):
            sync_path(file)
        original = _beside(bag, 'damaged')
        try:
            bag.rename(original)
            repaired.rename(bag)
        except BaseException:
            if not bag.exists():
                original.rename(bag)
            raise
        sync_path(bag.parent)
    finally:
        shutil.rmtree(workshop)
    return Repair(why, counts, duration_s, remains.cut, original)


def _write(
    remains: Remains, path: Path, storage: StoragePlugin,
) -> tuple[dict[str, int], float]:
    """Write all that is left to a new bag; returns messages by topic, and the time they span."""
    counts: Counter[str] = Counter()
    first, last = 2**63, 0
    connections: dict[Topic, Connection] = {}
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for message in remains.messages():
            topic = message.topic
            if topic not in connections:
                connections[topic] = _announce(writer, topic)
            writer.write(connections[topic], message.stamp_ns, message.data)
            counts[topic.name] += 1
            first, last = min(first, message.stamp_ns), max(last, message.stamp_ns)
        for topic in remains.topics.values():
            if topic not in connections:
                connections[topic] = _announce(writer, topic)
                counts[topic.name] += 0
    return (dict(counts), (last - first) * 1e-9) if counts.total() else ({}, 0.0)


def _announce(writer: Writer, topic: Topic) -> Connection:
    types = get_typestore(Stores.EMPTY)
    try:
        types.register(get_types_from_msg(topic.definition, topic.message_type))
        digest = types.hash_rihs01(topic.message_type)
    except (TypesysError, KeyError) as error:
        raise BagError(f'the definition of {topic.message_type} is damaged: {error}') from None
    return writer.add_connection(
        topic.name, topic.message_type, msgdef=topic.definition, rihs01=digest
    )


def _beside(bag: Path, what: str) -> Path:
    """A name beside the bag that nothing has yet."""
    number = 0
    while True:
        path = bag.with_name(f'{bag.name}.{what}{f".{number}" if number else ""}')
        if not path.exists():
            return path
        number += 1
