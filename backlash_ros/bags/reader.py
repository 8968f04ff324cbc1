"""Reads rosbag2 bags, whole or torn: mcap with its stream reader, SQLite with its own recovery.

Neither needs the index or the metadata.yaml that only a bag that was closed has.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Chunk, McapRecord, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk

BAG_METADATA = 'metadata.yaml'  # written last, when a bag is closed
# Of the file with the messages.
STORAGE_OF_SUFFIX = {'.mcap': 'mcap', '.db3': 'sqlite3'}
REPAIR_COMMAND = 'ros2 run backlash_ros recorder --repair'


class BagError(ValueError):
    """A bag cannot be read or repaired: one line says which, why and, if known, the cure."""


class NoBagError(BagError):
    """There is no bag where one was looked for."""


class Topic(NamedTuple):
    """A recorded topic; definition: text of the .msg file with all it refers to, if recorded."""

    name: str
    message_type: str
    definition: str


class BagMessage(NamedTuple):
    """A recorded message in CDR."""

    topic: Topic
    stamp_ns: int
    data: bytes


def is_bag(path: Path) -> bool:
    """Whether path is the folder of a bag, properly closed or not, or a file of one."""
    return (path / BAG_METADATA).is_file() or bool(message_files(path))


def message_files(path: Path) -> list[Path]:
    """The files with the messages of a bag in their order; itself, if it is one."""
    files = [path] if path.is_file() else path.glob('*')
    # bag_10 comes after bag_9.
    return sorted((file for file in files if file.suffix in STORAGE_OF_SUFFIX),
                  key=lambda file: (len(file.name), file.name))


class BagReader:
    """The messages of a bag: its folder, or a lone .mcap or .db3 file. Raises NoBagError.

    topics: those of the bag, complete once messages() has ended. damage: what is wrong with the
    bag, in words, '' for nothing, likewise.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.files = path, message_files(path)
        self.topics: set[Topic] = set()
        self.damage = ''
        if not self.files:
            rule = 'does not exist' if not path.exists() else \
                'holds no .mcap and no .db3 file' if path.is_dir() else \
                'is neither the folder of a bag nor an .mcap or .db3 file'
            raise NoBagError(f'{path}: {rule}')

    def messages(
        self, wanted: Callable[[Topic], bool] = lambda topic: True,
    ) -> Iterator[BagMessage]:
        """Every sound message of the wanted topics, in the order in which they were written."""
        self.damage = ''

        def met(topic: Topic) -> bool:
            self.topics.add(topic)
            return wanted(topic)

        for file in self.files:
            read = _read_mcap if STORAGE_OF_SUFFIX[file.suffix] == 'mcap' else _read_sqlite
            try:
                yield from read(file, met)
            # Whatever damaged bytes make a library stumble over, the file is damaged.
            except Exception:
                closed = (self.path / BAG_METADATA).is_file() or self.path.is_file()
                self.damage = 'is damaged' if closed else 'was never closed'


def _read_mcap(file: Path, wanted: Callable[[Topic], bool]) -> Iterator[BagMessage]:
    """Messages up to the first record that is not sound; a chunk that is not is left out."""
    topics: dict[int, Topic] = {}  # the wanted ones by the number of their channel
    schemas: dict[int, Schema] = {}
    broken = 0
    with file.open('rb') as stream:
        # A length that is garbage may be more than any memory holds.
        size = os.fstat(stream.fileno()).st_size
        for found in StreamReader(stream, emit_chunks=True, record_size_limit=size).records:
            records: list[McapRecord] = [found]
            if isinstance(found, Chunk):
                try:
                    records = breakup_chunk(found, validate_crc=True)
                except Exception:
                    broken += 1
                    continue
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas[record.schema_id]
                    topic = Topic(record.topic, schema.name, schema.data.decode())
                    if wanted(topic):
                        topics[record.id] = topic
                elif isinstance(record, McapMessage) and record.channel_id in topics:
                    yield BagMessage(topics[record.channel_id], record.log_time, record.data)
    if broken:
        raise BagError(f'{file}: {broken} chunks are damaged')


def _read_sqlite(file: Path, wanted: Callable[[Topic], bool]) -> Iterator[BagMessage]:
    """Messages of all transactions that were committed, up to the first page that is not sound."""
    # Opened for writing as well, SQLite takes back what a crash has left half done.
    uri = f'{file.resolve().as_uri()}?mode=rw'
    with closing(sqlite3.connect(uri, uri=True)) as database:
        # Otherwise a file that has lost its end is refused as a whole.
        database.execute('PRAGMA writable_schema = ON')
        topics = {number: Topic(*rest) for number, *rest in database.execute(
            'SELECT topics.id, name, type, encoded_message_definition FROM topics '
            'LEFT JOIN message_definitions ON type = topic_type ORDER BY topics.id'
        )}
        chosen = [number for number, topic in topics.items() if wanted(topic)]
        # By number, not by time: the index of the times may be the part that is damaged.
        for number, stamp_ns, data in database.execute(
            'SELECT topic_id, timestamp, data FROM messages NOT INDEXED '
            f'WHERE topic_id IN ({", ".join(map(str, chosen))}) ORDER BY id'
        ):
            yield BagMessage(topics[number], int(stamp_ns), bytes(data))
        if not database.execute('SELECT count(*) FROM metadata').fetchone()[0]:
            raise BagError(f'{file}: was never closed')
