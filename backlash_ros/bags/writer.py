"""Writes serialised messages to a rosbag2 bag of which a crash leaves all but the last moment."""

from __future__ import annotations

import fcntl
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from backlash_ros.core.parameters import ParameterError


class RecordingError(RuntimeError):
    """The bag cannot take any more: the message is the reason in a few words."""


class Bag:
    """An open bag. After a RecordingError it is closed, and holds what was flushed before.

    path: folder, must not exist. storage: mcap or sqlite3. Raises ParameterError.
    saved: messages that a crash leaves. saved_ns: the time from the first to the last of them.
    survives_a_crash: whether flush() works with the version of rosbags that is installed.
    """

    def __init__(self, path: str, storage: str) -> None:
        self.path = Path(path)
        self.saved = self.saved_ns = 0
        self.survives_a_crash = True
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._lock = ExitStack()
        if self.path.exists():
            raise ParameterError('bag', path, 'exists already', 'name a new folder')
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        try:
            with self._closed_on_error():
                self._writer.open()
                self._lock.enter_context(locked_folder(self.path))
                try:
                    self._flush()
                except AttributeError:
                    self.survives_a_crash = False
                sync_path(self.path)
                sync_path(self.path.parent)
        except RecordingError as error:
            # Half a bag would be in the way of the next attempt.
            shutil.rmtree(self.path, ignore_errors=True)
            raise ParameterError('bag', path, f'cannot be made: {error}',
                                 'name a folder where there is room and you may write') from None

    def add_topic(self, topic: str, message_type: str) -> Connection:
        """Announce a topic, with a type like std_msgs/msg/Float64; raises RecordingError."""
        with self._closed_on_error():
            return self._writer.add_connection(topic, message_type, typestore=self._types)

    def write(self, connection: Connection, stamp_ns: int, message: bytes) -> None:
        with self._closed_on_error():
            self._writer.write(connection, stamp_ns, message)

    def flush(self) -> None:
        """Let all that was written survive a crash and a power cut; raises RecordingError."""
        if self.survives_a_crash:
            with self._closed_on_error():
                self._flush()
            self._note_saved()

    def close(self) -> None:
        """Write what readers need to open the bag; raises RecordingError."""
        with self._closed_on_error():
            self._writer.close()
            for file in (*self.path.iterdir(), self.path):
                sync_path(file)
        self._note_saved()
        self._lock.close()

    def _flush(self) -> None:
        """The only place that looks inside of rosbags, which has no such function of its own."""
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
            # What does not fit on the disk now did not a moment ago.
            with suppress(OSError, sqlite3.Error):
                self._writer.abort()
            self._lock.close()
            text = (error.strerror or '') if isinstance(error, OSError) else ''
            reason = text or ' '.join(str(error).split()) or type(error).__name__
            raise RecordingError(reason) from error


@contextmanager
def locked_folder(path: Path) -> Iterator[None]:
    """Mark a bag as being written, at most until the process is gone.

    Raises BlockingIOError if another process writes it. Some file systems cannot lock folders.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if isinstance(error, BlockingIOError):
                raise
        yield
    finally:
        os.close(descriptor)


def sync_path(path: Path) -> None:
    """Let a file or the entries of a folder survive a power cut; raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        # Some file systems cannot do it for folders.
        if not path.is_dir():
            raise
    finally:
        os.close(descriptor)
