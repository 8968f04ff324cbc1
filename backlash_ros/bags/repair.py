"""Makes a damaged bag readable for everyone: what is left of it, rewritten and closed."""

from __future__ import annotations

import sqlite3
import sys
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from backlash_ros.bags.reader import (
    BAG_METADATA,
    STORAGE_OF_SUFFIX,
    BagError,
    BagReader,
    NoBagError,
    Topic,
)
from backlash_ros.bags.writer import locked_folder, sync_path
from backlash_ros.options import BAD_INPUT, DONE, FAILED


def repair_command(path: Path) -> int:
    """Repair a bag and print the outcome; returns the exit code."""
    try:
        print('\n'.join(repair(path) or [f'{path} is complete: nothing to repair']))
    except BagError as error:
        print(f'recorder: {error}', file=sys.stderr)
        return BAD_INPUT if isinstance(error, NoBagError) else FAILED
    except KeyboardInterrupt:
        print(f'recorder: interrupted, nothing of {path} is lost', file=sys.stderr)
        return FAILED
    return DONE


def damage(bag: Path) -> str:
    """What keeps a bag from being complete, in words; empty for one that is."""
    reader = BagReader(bag)
    for _ in reader.messages():
        pass
    return reader.damage or ('' if (bag / BAG_METADATA).is_file() else f'has no {BAG_METADATA}')


def repair(bag: Path) -> list[str]:
    """Put a complete bag in the place of a damaged one, which is kept beside it.

    Returns what was saved, in lines, nothing for a bag that is complete. Raises BagError,
    NoBagError where there is none.
    """
    bag = bag.resolve()
    if bag.is_file():
        raise NoBagError(f'{bag}: is a file: give the folder of the bag')
    reader = BagReader(bag)
    try:
        with locked_folder(bag):
            why = damage(bag)
            return _rewrite(reader, why) if why else []
    except BlockingIOError:
        raise BagError(f'{bag}: is being recorded: stop its recorder first') from None
    except (OSError, sqlite3.Error, WriterError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise BagError(f'{bag}: cannot be repaired: {reason}: is there room for a second copy, and '
                       'may you write there? The bag is as it was') from None


def _rewrite(reader: BagReader, why: str) -> list[str]:
    bag = reader.path
    connections: dict[Topic, Connection] = {}
    storage = StoragePlugin[STORAGE_OF_SUFFIX[reader.files[0].suffix].upper()]
    with TemporaryDirectory(dir=bag.parent, prefix=f'{bag.name}.') as folder:
        # The name of a bag is that of its file as well.
        repaired = Path(folder) / bag.name
        with Writer(repaired, version=9, storage_plugin=storage) as writer:
            for topic, stamp_ns, data in reader.messages():
                for new in reader.topics - connections.keys():
                    connections[new] = _announce(writer, new)
                writer.write(connections[topic], stamp_ns, data)
        if not any(writer.counts.values()):
            raise BagError(f'{bag}: {why}, and holds no message that could be saved')
        for file in (*repaired.iterdir(), repaired):
            sync_path(file)
        names = (f'{bag.name}.damaged{f".{n}" if n else ""}' for n in count())
        original = next(path for path in map(bag.with_name, names) if not path.exists())
        bag.rename(original)
        repaired.rename(bag)
        sync_path(bag.parent)
    width = max(len(topic.name) for topic in connections)
    return [
        f'{bag} {why}; saved: {(writer.max_timestamp - writer.min_timestamp) * 1e-9:.3f} s',
        *sorted(f'  {topic.name:<{width}}  {writer.counts[connection.id]:>8} messages'
                for topic, connection in connections.items()),
        f'the original is kept: {original}',
    ]


def _announce(writer: Writer, topic: Topic) -> Connection:
    types = get_typestore(Stores.EMPTY)
    try:
        types.register(get_types_from_msg(topic.definition, topic.message_type))
        digest = types.hash_rihs01(topic.message_type)
    except (TypesysError, KeyError) as error:
        raise BagError(f'the definition of {topic.message_type} is damaged: {error}') from None
    return writer.add_connection(
        topic.name, topic.message_type, msgdef=topic.definition, rihs01=digest)
