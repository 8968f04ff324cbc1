"""Reads an mcap file from its beginning for as long as it is sound (mcap.dev/spec).

Readers of whole files start from the index at the end, which a file that was never finished lacks.
Before it stand records of opcode, length and content; chunks hold further records. The recorder
finishes a chunk with every flush. rosbags writes chunks without a checksum, so that the
StreamReader of the package mcap (1.6) takes a message whose end is lost to a page of zeros for
sound, or gives up all that follows.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from backlash_ros.bags.content import BagError, Message, Topic

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6  # opcodes of records
OPCODES = range(1, 16)
RECORD = struct.Struct('<BQ')  # opcode, length
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, number, log time, publish time
CHUNK_HEAD = struct.Struct('<QQQI')  # first and last log time, size, checksum


class _TornError(Exception):
    """A record does not hold what it should."""


class McapRemains:
    """See Remains. Raises BagError for a file that does not begin like one of ROS 2."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._definitions: dict[int, tuple[str, str]] = {}  # type and definition by schema
        self._skipped = 0
        self.topics: dict[int, Topic] = {}
        self.cut = ''
        self.by_rosbags = self._is_by_rosbags()

    def messages(self) -> Iterator[Message]:
        """All sound messages in the order in which they were written; raises BagError."""
        self._skipped = 0
        with self._file.open('rb') as stream:
            size = os.fstat(stream.fileno()).st_size
            at = len(MAGIC)
            while (record := _head(stream, at, size)) is not None:
                opcode, length = record
                after = at + RECORD.size + length
                if opcode == CHUNK:
                    # A length that is garbage may be more than any memory holds.
                    content = stream.read(min(length, size))
                    yield from self._of_chunk(content, length, stream.read(1))
                elif opcode in (SCHEMA, CHANNEL, MESSAGE) and after <= size:
                    yield from self._of_records([(opcode, stream.read(length))])
                if after > size:
                    # What a torn chunk has given is not lost.
                    self._skipped += 0 if opcode == CHUNK else size - at
                    at = size
                    break
                at = after
                if opcode == FOOTER:
                    at += len(MAGIC)
                    break
        self._skipped += max(0, size - at)
        self.cut = f'{self._skipped} bytes that were not written in full' if self._skipped else ''

    def _is_by_rosbags(self) -> bool:
        with self._file.open('rb') as stream:
            begin = stream.read(4096)
        try:
            if begin[:len(MAGIC)] != MAGIC or begin[len(MAGIC)] != HEADER:
                raise _TornError
            profile, at = _text(begin, len(MAGIC) + RECORD.size)
            library, _ = _text(begin, at)
        except (_TornError, IndexError):
            raise BagError(f'{self._file}: holds nothing, its very beginning is damaged') from None
        if profile != 'ros2':
            raise BagError(f'{self._file}: was not recorded from ROS 2')
        return library.startswith('rosbags')

    def _of_chunk(self, content: bytes, length: int, following: bytes) -> Iterator[Message]:
        """Messages of a chunk of which `content` is there; it should be as long as `length`.

        following: the byte behind it, empty at the end of the file.
        """
        try:
            *_, checksum = CHUNK_HEAD.unpack_from(content)
            compression, at = _text(content, CHUNK_HEAD.size)
        except (_TornError, struct.error):
            self._skipped += len(content)
            return
        if compression:
            raise BagError(
                f'{self._file}: is compressed ({compression}), not a bag of the recorder: '
                'try `mcap recover`'
            )
        records = content[at + 8:]
        if checksum and len(content) == length and zlib.crc32(records) != checksum:
            self._skipped += len(records)
            return
        sound, end = _sound_records(records, following)
        self._skipped += len(records) - end
        yield from self._of_records(sound)

    def _of_records(self, records: list[tuple[int, bytes]]) -> Iterator[Message]:
        for i, (opcode, content) in enumerate(records):
            try:
                message = self._take(opcode, content)
            except (_TornError, struct.error):
                self._skipped += sum(RECORD.size + len(rest) for _, rest in records[i:])
                return
            if message is not None:
                yield message

    def _take(self, opcode: int, content: bytes) -> Message | None:
        if opcode == SCHEMA:
            (number,) = struct.unpack_from('<H', content)
            name, at = _text(content, 2)
            _, at = _text(content, at)  # ros2msg
            self._definitions[number] = (name, _text(content, at)[0])
        elif opcode == CHANNEL:
            number, schema = struct.unpack_from('<HH', content)
            name, _ = _text(content, 4)
            if schema not in self._definitions:
                raise _TornError
            self.topics[number] = Topic(name, *self._definitions[schema])
        elif opcode == MESSAGE:
            number, _, stamp_ns, _ = MESSAGE_HEAD.unpack_from(content)
            if number not in self.topics:
                raise _TornError
            return Message(self.topics[number], stamp_ns, content[MESSAGE_HEAD.size:])
        return None


def _head(stream: BinaryIO, at: int, size: int) -> tuple[int, int] | None:
    """Opcode and length of the record at a position; None where none begins."""
    stream.seek(at)
    head = stream.read(RECORD.size)
    if len(head) < RECORD.size:
        return None
    opcode, length = RECORD.unpack(head)
    return (opcode, length) if opcode in OPCODES else None


def _sound_records(data: bytes, following: bytes) -> tuple[list[tuple[int, bytes]], int]:
    """The records that data begins with, and how many bytes they take.

    After a power cut pages may be missing: they read as zeros, which are no opcode. A record that
    such a page follows may have lost its own end to it, and counts as lost. following: the byte
    behind data, empty at the end of the file; behind a chunk that was flushed more records stand.
    """
    records: list[tuple[int, bytes]] = []
    at = begin_of_last = 0
    while True:
        next_byte = data[at:at + 1] or following
        if not next_byte or next_byte[0] not in OPCODES:
            return records[:-1], begin_of_last
        if at + RECORD.size > len(data):
            break
        opcode, length = RECORD.unpack_from(data, at)
        after = at + RECORD.size + length
        if after > len(data):
            break
        records.append((opcode, data[at + RECORD.size:after]))
        at, begin_of_last = after, at
    return records, at


def _text(data: bytes, at: int) -> tuple[str, int]:
    """The text at a position, and the position behind it; raises _TornError."""
    begin = at + 4
    end = begin + int.from_bytes(data[at:begin], 'little')
    if begin > len(data) or end > len(data):
        raise _TornError
    try:
        return data[begin:end].decode('utf-8'), end
    except UnicodeDecodeError:
        raise _TornError from None
