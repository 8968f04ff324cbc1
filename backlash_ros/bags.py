"""Write rosbag2 bags so that a crash costs a moment at most, read them even if torn, repair them.

Torn bags are read by the stream reader of mcap and the recovery of SQLite, which need neither the
index nor the metadata.yaml that only a closed bag has.
"""

import fcntl
import os
import shutil
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import mcap.records
from mcap.stream_reader import StreamReader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from backlash_ros.core.parameters import ParameterError
from backlash_ros.options import BAD_INPUT, DONE, FAILED

BAG_METADATA = 'metadata.yaml'  # written last, when a bag is closed
STORAGE_OF_SUFFIX = {'.mcap': 'mcap', '.db3': 'sqlite3'}
REPAIR_COMMAND = 'ros2 run backlash_ros recorder --repair'


class RecordingError(RuntimeError):
    """Nothing more can be written to the bag: the message is the reason in a few words."""


class BagError(ValueError):
    """A bag cannot be read or repaired: one line says which, why, and the cure if it is known."""


class NoBagError(BagError):
    """There is no bag at the given path."""


class Topic(NamedTuple):
    """A recorded topic. definition: the .msg file and all it refers to, as text, if recorded."""

    name: str
    message_type: str
    definition: str


BagMessage = tuple[Topic, int, bytes]  # stamp [ns], content in CDR


class Bag:
    """A bag open for writing. A RecordingError closes it; what was flushed before is kept.

    saved: number of messages that survive a crash. saved_ns: time from the first to the last one.
    survives_a_crash: whether flush() works with the installed version of rosbags.
    """

    def __init__(self, path: str, storage: str) -> None:
        """path: folder, must not exist. storage: mcap or sqlite3. Raises ParameterError."""
        self.path = Path(path)
        self.saved = self.saved_ns = 0
        self.survives_a_crash = True
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._lock = ExitStack()
        with suppress(OSError):  # then it cannot be made, either
            if self.path.exists():
                raise ParameterError('bag', path, 'exists already', 'name a new folder')
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        try:
            with self._closed_on_error():
                self._writer.open()
                self._lock.enter_context(_locked_folder(self.path))
                try:
                    self._flush()
                except AttributeError:
                    self.survives_a_crash = False
                _sync(self.path, self.path.parent)
        except RecordingError as error:
            # A half-made bag would be in the way of the next attempt.
            shutil.rmtree(self.path, ignore_errors=True)
            raise ParameterError('bag', path, f'cannot be made: {error}',
                                 'name a folder where there is room and you may write') from None

    def add_topic(self, topic: str, message_type: str) -> Connection:
        with self._closed_on_error():
            return self._writer.add_connection(topic, message_type, typestore=self._types)

    def write(self, connection: Connection, stamp_ns: int, message: bytes) -> None:
        with self._closed_on_error():
            self._writer.write(connection, stamp_ns, message)

    def flush(self) -> None:
        """Make all that was written survive a crash and a power cut."""
        if self.survives_a_crash:
            with self._closed_on_error():
                self._flush()
            self._note_saved()

    def close(self) -> None:
        with self._closed_on_error():
            self._writer.close()
            _sync(*self.path.iterdir(), self.path)
        self._note_saved()
        self._lock.close()

    def _flush(self) -> None:
        """The only use of internals of rosbags, which has no flush of its own."""
        storage: Any = self._writer.storage
        if self._writer.storage_plugin is StoragePlugin.SQLITE3:
            storage.conn.commit()
            return
        # A chunk without messages would have no time.
        if storage.chunk.msgs:
            storage.close_chunk()
        storage.bio.flush()
        os.fsync(storage.bio.fileno())

    def _note_saved(self) -> None:
        writer = self._writer
        self.saved = sum(writer.counts.values())
        self.saved_ns = max(0, writer.max_timestamp - writer.min_timestamp)

    @contextmanager
    def _closed_on_error(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            # If the disk is full, closing the bag fails as well.
            with suppress(OSError, sqlite3.Error):
                self._writer.abort()
            self._lock.close()
            text = error.strerror if isinstance(error, OSError) else ''
            reason = text or ' '.join(str(error).split()) or type(error).__name__
            raise RecordingError(reason) from error


@contextmanager
def _locked_folder(path: Path) -> Iterator[None]:
    """Mark a bag as being written; raises BlockingIOError if another process writes it."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # Some file systems cannot lock folders.
            if isinstance(error, BlockingIOError):
                raise
        yield
    finally:
        os.close(descriptor)


def _sync(*paths: Path) -> None:
    """Make files and the entries of folders survive a power cut."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        except OSError:
            # Some file systems cannot sync folders.
            if not path.is_dir():
                raise
        finally:
            os.close(descriptor)


def is_bag(path: Path) -> bool:
    """Whether path is the folder of a bag, properly closed or not, or a file of one."""
    return (path / BAG_METADATA).is_file() or bool(message_files(path))


def message_files(path: Path) -> list[Path]:
    """The files with the messages of a bag, in order; path itself, if it is such a file."""
    files = [path] if path.is_file() else path.glob('*')
    # bag_10 comes after bag_9.
    return sorted((file for file in files if file.suffix in STORAGE_OF_SUFFIX),
                  key=lambda file: (len(file.name), file.name))


class BagReader:
    """The messages of a bag: its folder, or a lone .mcap or .db3 file. Raises NoBagError.

    topics: those found so far; damage: in words, '' if none. Complete once messages() has ended.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: set[Topic] = set()
        self.damage = ''
        try:
            self.files = message_files(path)
            rule = 'does not exist' if not path.exists() else \
                'holds no .mcap and no .db3 file' if path.is_dir() else \
                'is neither the folder of a bag nor an .mcap or .db3 file'
        except OSError as error:
            raise NoBagError(f'{path}: cannot be read: {error.strerror}') from None
        if not self.files:
            raise NoBagError(f'{path}: {rule}')

    def messages(
        self, wanted: Callable[[Topic], bool] = lambda topic: True,
    ) -> Iterator[BagMessage]:
        """Every intact message of the wanted topics, in the order in which they were written.

        Raises BagError if a file cannot be opened.
        """
        self.damage = ''

        def met(topic: Topic) -> bool:
            self.topics.add(topic)
            return wanted(topic)

        for file in self.files:
            read = _read_mcap if STORAGE_OF_SUFFIX[file.suffix] == 'mcap' else _read_sqlite
            try:
                file.open('rb').close()
            except OSError as error:
                raise BagError(f'{file}: cannot be read: {error.strerror}') from None
            try:
                yield from read(file, met)
            # Damaged bytes may make a library raise anything.
            except Exception:
                closed = (self.path / BAG_METADATA).is_file() or self.path.is_file()
                self.damage = 'is damaged' if closed else 'was never closed'


def _read_mcap(file: Path, wanted: Callable[[Topic], bool]) -> Iterator[BagMessage]:
    """Messages up to the first damaged record."""
    topics: dict[int, Topic] = {}  # the wanted ones by channel number
    schemas: dict[int, mcap.records.Schema] = {}
    with file.open('rb') as stream:
        # A damaged length may be larger than the memory.
        size = os.fstat(stream.fileno()).st_size
        for record in StreamReader(stream, validate_crcs=True, record_size_limit=size).records:
            if isinstance(record, mcap.records.Schema):
                schemas[record.id] = record
            elif isinstance(record, mcap.records.Channel):
                schema = schemas[record.schema_id]
                topic = Topic(record.topic, schema.name, schema.data.decode())
                if wanted(topic):
                    topics[record.id] = topic
            elif isinstance(record, mcap.records.Message) and record.channel_id in topics:
                yield topics[record.channel_id], record.log_time, record.data


def _read_sqlite(file: Path, wanted: Callable[[Topic], bool]) -> Iterator[BagMessage]:
    """Messages of all committed transactions, up to the first damaged page."""
    # If opened for writing, SQLite rolls back what a crash has left half done.
    uri = f'{file.resolve().as_uri()}?mode=rw'
    with closing(sqlite3.connect(uri, uri=True)) as database:
        # Otherwise SQLite refuses a file that has lost its end.
        database.execute('PRAGMA writable_schema = ON')
        # ROS 2 Humble and older write no definitions.
        defined, = database.execute(
            "SELECT count(*) FROM sqlite_master WHERE name = 'message_definitions'").fetchone()
        definition, of_types = (
            'encoded_message_definition', 'LEFT JOIN message_definitions ON type = topic_type',
        ) if defined else ("''", '')
        topics = {number: Topic(name, kind, text or '') for number, name, kind, text in
                  database.execute(f'SELECT topics.id, name, type, {definition} FROM topics '
                                   f'{of_types} ORDER BY topics.id')}
        chosen = [number for number, topic in topics.items() if wanted(topic)]
        # By number, not by time: the index of the times may be the part that is damaged.
        for number, stamp_ns, data in database.execute(
                'SELECT topic_id, timestamp, data FROM messages NOT INDEXED '
                f'WHERE topic_id IN ({", ".join(map(str, chosen))}) ORDER BY id'):
            yield topics[number], int(stamp_ns), bytes(data)
        if not database.execute('SELECT count(*) FROM metadata').fetchone()[0]:
            raise BagError(f'{file}: was never closed')


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
    """Why a bag is not complete, in words; '' if it is."""
    reader = BagReader(bag)
    for _ in reader.messages():
        pass
    return reader.damage or ('' if (bag / BAG_METADATA).is_file() else f'has no {BAG_METADATA}')


def repair(bag: Path) -> list[str]:
    """Replace a damaged bag by a complete one; the original is kept beside it.

    Returns lines that say what was saved, none if the bag is complete; raises BagError.
    """
    bag = Path(os.path.realpath(bag))
    if bag.is_file():
        raise NoBagError(f'{bag}: is a file: give the folder of the bag')
    reader = BagReader(bag)
    try:
        with _locked_folder(bag):
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
        # The file of a bag has the name of the bag.
        repaired = Path(folder) / bag.name
        with Writer(repaired, version=9, storage_plugin=storage) as writer:
            for topic, stamp_ns, data in reader.messages():
                for new in reader.topics - connections.keys():
                    connections[new] = _announce(writer, new)
                writer.write(connections[topic], stamp_ns, data)
        if not any(writer.counts.values()):
            raise BagError(f'{bag}: {why}, and holds no message that could be saved')
        _sync(*repaired.iterdir(), repaired)
        names = (f'{bag.name}.damaged{f".{n}" if n else ""}' for n in count())
        original = next(path for path in map(bag.with_name, names) if not path.exists())
        bag.rename(original)
        repaired.rename(bag)
        _sync(bag.parent)
    width = max(len(topic.name) for topic in connections)
    return [
        f'{bag} {why}; saved: {(writer.max_timestamp - writer.min_timestamp) * 1e-9:.3f} s',
        *sorted(f'  {topic.name:<{width}}  {writer.counts[connection.id]:>8} messages'
                for topic, connection in connections.items()),
        f'the original is kept: {original}',
    ]


def _announce(writer: Writer, topic: Topic) -> Connection:
    if not topic.definition:
        jazzy = get_typestore(Stores.ROS2_JAZZY)
        if topic.message_type not in jazzy.fielddefs:
            raise BagError(f'{topic.name}: the definition of {topic.message_type} is missing')
        return writer.add_connection(topic.name, topic.message_type, typestore=jazzy)
    types = get_typestore(Stores.EMPTY)
    try:
        types.register(get_types_from_msg(topic.definition, topic.message_type))
        digest = types.hash_rihs01(topic.message_type)
    except (TypesysError, KeyError) as error:
        raise BagError(f'the definition of {topic.message_type} is damaged: {error}') from None
    return writer.add_connection(
        topic.name, topic.message_type, msgdef=topic.definition, rihs01=digest)
