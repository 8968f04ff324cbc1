"""Bags that lost their writer or their end: nothing that was flushed is lost by the repair."""

import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from backlash_ros.bags import Bag, BagError, BagReader, damage, repair, repair_command

FLOAT = 'std_msgs/msg/Float64'
CDR = b'\x00\x01\x00\x00'
MESSAGES, PER_FLUSH = 300, 60
PAGE = 4096  # of SQLite
MAGIC = b'\x89MCAP0\r\n'

STORAGES = ('mcap', 'sqlite3')


def number_message(i: int) -> bytes:
    return CDR + struct.pack('<d', float(i))


def write_numbers(path: Path, storage: str, each: Callable[[Bag], None] = Bag.flush) -> None:
    """Write messages 0, 1, 2, ... to a bag, and something on a second topic, out of order."""
    bag = Bag(str(path), storage)
    number, other = bag.add_topic('/number', FLOAT), bag.add_topic('/other', FLOAT)
    for i in range(MESSAGES):
        bag.write(number, 10**18 + i * 1_000_000, number_message(i))
        if i % 10 == 9:
            bag.write(other, 10**18 + (i - 5) * 1_000_000, number_message(-i))
        if i % PER_FLUSH == PER_FLUSH - 1:
            each(bag)
    bag.close()


def numbers_in(bag: Path) -> list[float]:
    with AnyReader([bag]) as reader:
        return [
            reader.deserialize(raw, connection.msgtype).data
            for connection, _, raw in reader.messages() if connection.topic == '/number']


def message_file(bag: Path) -> Path:
    (file,) = (file for file in bag.iterdir() if file.suffix in ('.mcap', '.db3'))
    return file


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob('*') if path.is_file()}


class Finished:
    """A finished bag, and how many numbers had been flushed at which size of its file."""

    def __init__(self, folder: Path, storage: str) -> None:
        self.bag = folder / f'{storage}_bag'
        self.flushed: list[tuple[int, int]] = [(0, 0)]
        def flush(bag: Bag) -> None:
            bag.flush()
            size = message_file(bag.path).stat().st_size
            self.flushed.append((size, self.flushed[-1][1] + PER_FLUSH))
        write_numbers(self.bag, storage, flush)
        self.data = message_file(self.bag).read_bytes()

    @contextmanager
    def with_file(self, data: bytes, metadata: bool) -> Iterator[Path]:
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / self.bag.name
            shutil.copytree(self.bag, bag)
            message_file(bag).write_bytes(data)
            if not metadata:
                (bag / 'metadata.yaml').unlink()
            yield bag


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Finished]:
    folder = tmp_path_factory.mktemp('finished')
    return {storage: Finished(folder, storage) for storage in STORAGES}


def repaired_numbers(bag: Path) -> list[float]:
    return numbers_in(bag) if is_complete_after_repair(bag) else []


def is_complete_after_repair(bag: Path) -> bool:
    """Repair a bag; False if it says that nothing can be saved, which then is as it was."""
    before = contents(bag.parent)
    try:
        repair(bag)
    except BagError:
        assert contents(bag.parent) == before
        return False
    assert damage(bag) == ''
    return True


def ends_of_records(data: bytes) -> list[int]:
    """Where the records of an mcap file end, those within chunks left aside (mcap.dev/spec)."""
    ends = [len(MAGIC)]
    while ends[-1] < len(data) - len(MAGIC):
        (length,) = struct.unpack_from('<Q', data, ends[-1] + 1)
        ends.append(ends[-1] + 9 + length)
    return [*ends, len(data)]


def test_mcap_cut_at_any_record_keeps_every_block_before_it(finished):
    whole = finished['mcap']
    ends = ends_of_records(whole.data)
    assert len(ends) > 2 * len(whole.flushed)
    for k, (begin, end) in enumerate(pairwise([0, *ends])):
        # After a power cut the file may have its old length, and zeros where nothing was written.
        for size, zeros in (end, (0, 1, 10_000)[k % 3]), ((begin + end) // 2, 0):
            # Whoever closes a bag writes the metadata last: at the end they may be there or not.
            with whole.with_file(whole.data[:size] + bytes(zeros), metadata=k % 2 == 0) as bag:
                found = repaired_numbers(bag)
            assert found == list(map(float, range(len(found)))), size
            assert len(found) >= max(n for end, n in whole.flushed if end <= size), size


@settings(max_examples=20)
@given(st.data())
def test_garbage_in_a_file_never_stops_the_repair_with_anything_but_its_own_error(finished, data):
    whole = finished[data.draw(st.sampled_from(STORAGES))]
    changed = bytearray(whole.data)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(changed) - 1))
        garbage = data.draw(st.binary(min_size=1, max_size=40))
        changed[at:at + len(garbage)] = garbage
    with whole.with_file(bytes(changed), data.draw(st.booleans())) as bag:
        complete = is_complete_after_repair(bag)
        assert (damage(bag) == '') == complete


def test_sqlite_that_lost_its_end_gives_the_messages_before_it(finished):
    whole = finished['sqlite3']
    with whole.with_file(whole.data[:-2 * PAGE], metadata=True) as bag:
        assert MESSAGES // 2 < len(repaired_numbers(bag)) < MESSAGES


@pytest.mark.parametrize('storage', STORAGES)
def test_flush_reaches_into_the_installed_rosbags(tmp_path: Path, storage: str) -> None:
    bag = Bag(str(tmp_path / 'bag'), storage)
    assert bag.survives_a_crash, 'rosbags has changed: see Bag._flush'
    bag.write(bag.add_topic('/number', FLOAT), 1, number_message(7))
    assert list(BagReader(bag.path).messages()) == []
    bag.flush()
    assert [data for _, _, data in BagReader(bag.path).messages()] == [number_message(7)]
    bag.close()
    assert damage(bag.path) == ''


def nothing_flushed(bag: Path) -> None:
    file = message_file(bag)
    file.write_bytes(file.read_bytes()[:60])


def file_gone(bag: Path) -> None:
    message_file(bag).unlink()


def file_shut(bag: Path) -> None:
    file = message_file(bag)
    file.unlink()
    file.mkdir()  # root may read any file


@pytest.mark.parametrize(('spoil', 'code', 'words'), [
    (shutil.rmtree, 2, 'does not exist'),
    (lambda bag: (shutil.rmtree(bag), bag.touch()), 2, 'is a file: give the folder'),
    (lambda bag: (shutil.rmtree(bag), bag.mkdir()), 2, 'holds no .mcap and no .db3 file'),
    (nothing_flushed, 1, 'holds no message that could be saved'),
    (file_gone, 2, 'holds no .mcap and no .db3 file'),
    (file_shut, 1, 'cannot be read: Is a directory'),
    (lambda bag: (shutil.rmtree(bag), bag.symlink_to(bag)), 2, 'does not exist'),
])
def test_what_cannot_be_repaired_is_refused_in_one_line_and_left_as_it_is(
    tmp_path: Path, finished: dict[str, Finished], capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], object], code: int, words: str,
) -> None:
    bag = tmp_path / finished['mcap'].bag.name
    shutil.copytree(finished['mcap'].bag, bag)
    if spoil not in (file_gone, file_shut):
        (bag / 'metadata.yaml').unlink()
    spoil(bag)
    before = contents(tmp_path)
    assert repair_command(bag) == code
    said = capsys.readouterr()
    assert said.out == ''
    assert words in said.err
    assert (said.err.count('\n'), contents(tmp_path)) == (1, before)


@pytest.mark.parametrize('torn', [False, True])
def test_sqlite_without_definitions_is_read_and_repaired(tmp_path, finished, torn):
    bag = tmp_path / finished['sqlite3'].bag.name
    shutil.copytree(finished['sqlite3'].bag, bag)
    with sqlite3.connect(message_file(bag)) as database:  # as ROS 2 Humble writes it
        database.execute('DROP TABLE message_definitions')
    database.close()
    assert damage(bag) == ''
    if torn:
        (bag / 'metadata.yaml').unlink()
        assert is_complete_after_repair(bag)
        assert numbers_in(bag) == list(map(float, range(MESSAGES)))
    assert sum(topic.name == '/number' for topic, *_ in BagReader(bag).messages()) == MESSAGES


def test_second_repair_keeps_both_originals(tmp_path, finished):
    bag = tmp_path / finished['mcap'].bag.name
    shutil.copytree(finished['mcap'].bag, bag)
    for original in ('mcap_bag.damaged', 'mcap_bag.damaged.1'):
        file = message_file(bag)
        file.write_bytes(file.read_bytes()[:-10])
        assert repair(bag)[-1].endswith(f'/{original}')
    assert repair(bag) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'mcap_bag', 'mcap_bag.damaged', 'mcap_bag.damaged.1']
