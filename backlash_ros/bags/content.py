"""What a rosbag2 bag is made of, and what can be wrong with one."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

METADATA = 'metadata.yaml'  # written last, when a bag is closed
SUFFIXES = {'.mcap': 'mcap', '.db3': 'sqlite3'}  # of the file with the messages, and its storage
CURE = 'ros2 run backlash_ros recorder --repair'


class BagError(ValueError):
    """A bag cannot be read or repaired: one line says which, why and, if known, the cure."""


class NoBagError(BagError):
    """There is no bag where one was looked for."""


@dataclass(frozen=True)
class Topic:
    """A recorded topic; definition: text of the .msg file with all it refers to."""

    name: str
    message_type: str
    definition: str


class Message(NamedTuple):
    """A recorded message in CDR."""

    topic: Topic
    stamp_ns: int
    data: bytes


class Remains(Protocol):
    """What can be read of the file of a bag, be it whole or not.

    topics: those met so far, by number. cut: in words, what messages() had to leave out, empty if
    nothing. by_rosbags: whether the recorder of this package, or its library, has written it.
    """

    topics: dict[int, Topic]
    cut: str
    by_rosbags: bool

    def messages(self) -> Iterator[Message]:
        """All sound messages in the order in which they were written; raises BagError."""


def is_bag(path: Path) -> bool:
    """Whether path is the folder of a bag, properly closed or not."""
    return (path / METADATA).is_file() or bool(message_files(path))


def message_files(path: Path) -> list[Path]:
    """The files with the messages of a bag."""
    return sorted(file for file in path.glob('*') if file.suffix in SUFFIXES)


def the_message_file(path: Path) -> Path:
    """The one file with the messages of a bag; raises BagError."""
    files = message_files(path)
    if not files:
        raise BagError(f'{path}: its file with the messages is gone')
    if len(files) > 1:
        raise BagError(f'{path}: has {len(files)} files with messages: give each a folder')
    return files[0]


def lock_folder(path: Path) -> int | None:
    """Mark a bag as being written until the descriptor is closed, or the process gone.

    Raises BlockingIOError if somebody else writes it; None where folders cannot be locked.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def is_being_written(path: Path) -> bool:
    """Whether a process that is alive has locked the bag."""
    try:
        descriptor = lock_folder(path)
    except BlockingIOError:
        return True
    except OSError:
        return False
    if descriptor is not None:
        os.close(descriptor)
    return False


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
