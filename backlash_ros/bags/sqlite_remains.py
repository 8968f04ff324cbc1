"""Reads an SQLite file of a bag as it was when its last transaction was complete."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from backlash_ros.bags.content import BagError, Message, Topic

TOPICS = """
    SELECT topics.id, name, type, encoded_message_definition
    FROM topics JOIN message_definitions ON type = topic_type ORDER BY topics.id
"""
# By the number, not by the time: the index of the times may be the part that is damaged.
MESSAGES = 'SELECT topic_id, timestamp, data FROM messages NOT INDEXED ORDER BY id'


class SqliteRemains:
    """See Remains. Raises BagError for a file that holds no table of messages."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.topics: dict[int, Topic] = {}
        self.cut = ''
        self.by_rosbags = False
        try:
            with self._database() as database:
                (distribution,) = database.execute('SELECT ros_distro FROM schema').fetchone()
                self.by_rosbags = distribution == 'rosbags'
                self.topics = {number: Topic(*rest) for number, *rest in database.execute(TOPICS)}
                database.execute('SELECT id FROM messages LIMIT 0')
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
            raise BagError(f'{file}: holds nothing that can be read: {error}') from None

    def messages(self) -> Iterator[Message]:
        """All sound messages in the order in which they were written; raises BagError."""
        self.cut = ''
        found = 0
        with self._database() as database:
            try:
                for number, stamp_ns, data in database.execute(MESSAGES):
                    if number not in self.topics or type(data) is not bytes:
                        raise sqlite3.DatabaseError('a message is not what it should be')
                    yield Message(self.topics[number], int(stamp_ns), data)
                    found += 1
            except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
                self.cut = f'all that followed the first {found} messages ({error})'

    @contextmanager
    def _database(self) -> Iterator[sqlite3.Connection]:
        """The database, and nothing in the folder of the bag is changed."""
        torn = torn_bytes(self._file)
        try:
            database = None if torn else _connect(self._file, 'ro')
        except sqlite3.OperationalError:
            # The last transaction was torn. SQLite takes it back, for which it has to write.
            if not any(part.is_file() for part in self._journals()):
                raise
            database = None
        if database is not None:
            with closing(database):
                yield database
            return
        with TemporaryDirectory(prefix='backlash_ros-') as folder:
            copy = self._copy_to(Path(folder))
            # What is missing of a page would read as zeros, in messages too.
            os.truncate(copy, copy.stat().st_size - torn)
            with closing(_connect(copy, 'rw')) as database:
                yield database

    def _copy_to(self, folder: Path) -> Path:
        try:
            for part in (self._file, *self._journals()):
                if part.is_file():
                    shutil.copyfile(part, folder / part.name)
        except OSError as error:
            raise BagError(
                f'{self._file}: cannot be copied to {folder}: {error.strerror}'
            ) from None
        return folder / self._file.name

    def _journals(self) -> list[Path]:
        return [self._file.with_name(self._file.name + suffix) for suffix in ('-journal', '-wal')]


def torn_bytes(file: Path) -> int:
    """How many bytes of a page that is not all there an SQLite file ends with."""
    with file.open('rb') as stream:
        page = int.from_bytes(stream.read(18)[16:], 'big')
    return 0 if page < 512 else file.stat().st_size % page


def _connect(file: Path, mode: str) -> sqlite3.Connection:
    database = sqlite3.connect(f'{file.resolve().as_uri()}?mode={mode}', uri=True)
    try:
        # Otherwise a file that has lost its end is refused as a whole.
        database.execute('PRAGMA writable_schema = ON')
        database.execute('SELECT count(*) FROM sqlite_master').fetchone()
    except BaseException:
        database.close()
        raise
    return database
