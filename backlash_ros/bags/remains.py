"""What is left of a bag that was never closed, or has lost a part since."""

from __future__ import annotations

from pathlib import Path

from rosbags.rosbag2 import Reader

from backlash_ros.bags.content import (
    METADATA,
    SUFFIXES,
    BagError,
    Remains,
    message_files,
    the_message_file,
)
from backlash_ros.bags.mcap_remains import McapRemains
from backlash_ros.bags.sqlite_remains import SqliteRemains, torn_bytes


def open_remains(bag: Path) -> Remains:
    """Open what is left of a bag without changing it; raises BagError."""
    file = the_message_file(bag)
    try:
        return McapRemains(file) if SUFFIXES[file.suffix] == 'mcap' else SqliteRemains(file)
    except OSError as error:
        raise BagError(f'{file}: cannot be read: {error.strerror}') from None


def visible_damage(bag: Path) -> str:
    """What can be said to be wrong with a bag without reading it; empty if nothing."""
    if not (bag / METADATA).is_file():
        return 'was never closed'
    # SQLite itself would take what is missing for zeros.
    if any(file.suffix == '.db3' and torn_bytes(file) for file in message_files(bag)):
        return 'has lost its end'
    return ''


def damage(bag: Path) -> str:
    """What keeps a bag from being complete, in words; empty for one that is."""
    visible = visible_damage(bag)
    if visible:
        return visible
    try:
        with Reader(bag) as reader:
            found = sum(1 for _ in reader.messages())
            promised = reader.message_count
    # Whatever a damaged file makes the library stumble over, the file is damaged.
    except Exception as error:
        return f'is damaged ({" ".join(str(error).split()) or type(error).__name__})'
    return '' if found == promised else f'holds {found} of {promised} messages'
