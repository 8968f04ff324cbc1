"""Writes serialised messages to a rosbag2 bag."""

from __future__ import annotations

from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from backlash_ros.core.errors import ParameterError

STORAGE = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}


class Bag:
    """An open bag.

    path: folder, must not exist. storage: a key of STORAGE. Raises ParameterError.
    """

    def __init__(self, path: str, storage: str) -> None:
        try:
            self._writer = Writer(Path(path), version=9, storage_plugin=STORAGE[storage])
            self._writer.open()
        except WriterError:
            raise ParameterError('bag', path, 'exists already', 'name a new folder') from None
        except OSError as error:
            raise ParameterError('bag', path, f'cannot be made: {error.strerror}') from None
        self._types = get_typestore(Stores.ROS2_JAZZY)

    def add_topic(self, topic: str, message_type: str) -> Connection:
        """Announce a topic, with a type like std_msgs/msg/Float64."""
        return self._writer.add_connection(topic, message_type, typestore=self._types)

    def write(self, connection: Connection, stamp_ns: int, message: bytes) -> None:
        """Append a message in CDR."""
        self._writer.write(connection, stamp_ns, message)

    def close(self) -> None:
        """Write what readers need to open the bag."""
        self._writer.close()
