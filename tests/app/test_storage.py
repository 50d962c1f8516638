"""Files by key: complete or absent, limited in size, and never outside the folder."""

import errno
import hashlib
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest
import xxhash
from hypothesis import given
from hypothesis import strategies as st

from amers.app.errors import DamagedFile, InputError, NotFound, TooLarge
from amers.app.storage import RangeReader, Storage, StoredChips, chips_key, trash
from amers.app.storage.content import read_content
from amers.app.storage.trash import Moment
from amers.app.usecases.garbage_collection import Bin, Family
from amers.services.conventions import CHIP_SIZE


@pytest.fixture
def storage(tmp_path):
    return Storage(tmp_path / "storage")


@pytest.fixture
def stored_chips(storage):
    chips = StoredChips(storage, {}.get)
    yield chips
    chips.close()


def files(storage: Storage) -> list[str]:
    return sorted(
        str(path.relative_to(storage.folder)) for path in storage.folder.rglob("*") if path.is_file()
    )


def numbered(count: int, dtype: str = "uint8") -> np.ndarray:
    """Chips that are filled with their row number."""
    return np.broadcast_to(
        np.arange(count, dtype=dtype)[:, None, None], (count, CHIP_SIZE, CHIP_SIZE)
    ).copy()


def test_a_file_is_found_as_it_was_put(storage):
    stored = storage.put("scenes/a/scene.tif", [b"one", b"", b"two"])
    assert (stored.key, stored.size_bytes) == ("scenes/a/scene.tif", 6)
    assert stored.sha256 == hashlib.sha256(b"onetwo").hexdigest()
    with storage.open("scenes/a/scene.tif") as file:
        assert file.read() == b"onetwo"
    assert storage.keys("scenes") == ["scenes/a/scene.tif"]


def test_a_file_over_the_limit_leaves_nothing(storage):
    with pytest.raises(TooLarge, match="10 bytes"):
        storage.put("scenes/a", [b"x" * 8, b"x" * 3], limit_bytes=10)
    assert files(storage) == []
    assert storage.put("scenes/a", [b"x" * 10], limit_bytes=10).size_bytes == 10


def test_an_upload_that_breaks_off_leaves_the_former_file(storage):
    storage.put("scenes/a", [b"former"])

    def chunks():
        yield b"lat"
        raise ConnectionError

    with pytest.raises(ConnectionError):
        storage.put("scenes/a", chunks())
    with storage.open("scenes/a") as file:
        assert file.read() == b"former"
    assert files(storage) == ["scenes/a"]


def test_a_kill_while_writing_shows_no_part_of_the_file(storage):
    program = (
        "import os, sys; from pathlib import Path; from amers.app.storage import Storage\n"
        "with Storage(Path(sys.argv[1])).writing('scenes/a') as writing:\n"
        "    writing.write(b'x' * 100000); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", program, storage.folder], check=False)
    assert not storage.exists("scenes/a")
    assert storage.keys("scenes") == []
    assert len(storage.sweep_unfinished(0.0, "upload-")) == 1
    assert files(storage) == []


def test_unfinished_files_are_swept_when_they_are_old_and_nobody_writes_them_or_waits_for_more(storage):
    for name in ("left", "upload-1"):
        (storage.scratch() / name).write_bytes(b"x")
    with storage.writing("scenes/a") as writing, storage.scratch_folder("job-"):
        writing.write(b"x")
        assert storage.sweep_unfinished(3600.0, "upload-") == []
        assert storage.sweep_unfinished(0.0, "upload-") == ["left"]
        assert len(list(storage.scratch().iterdir())) == 3
    assert files(storage) == ["scenes/a", "unfinished/upload-1"]


def test_old_unfinished_files_are_swept_wherever_they_lie_between_young_ones(storage):
    for number in range(20):
        path = storage.scratch() / f"{number}"
        path.write_bytes(b"x")
        if number % 2:
            os.utime(path, (path.stat().st_mtime - 7200.0,) * 2)
    odd = [str(number) for number in range(1, 20, 2)]
    assert sorted(storage.sweep_unfinished(3600.0, "upload-")) == sorted(odd)
    assert {path.name for path in storage.scratch().iterdir()} == {str(n) for n in range(0, 20, 2)}


def test_a_deleted_file_is_gone_with_its_empty_folders(storage):
    storage.put("scenes/a/b/c", [b"x"])
    storage.put("scenes/d", [b"x"])
    storage.delete("scenes/a/b/c")
    storage.delete("scenes/a/b/c")
    assert not storage.exists("scenes/a/b/c")
    assert [path.name for path in (storage.folder / "scenes").iterdir()] == ["d"]
    with pytest.raises(NotFound):
        storage.path("scenes/a/b/c")


@pytest.mark.parametrize(
    "key",
    [
        "",
        "/etc/passwd",
        "../x",
        "a/../../x",
        "a//b",
        "a/",
        "./a",
        ".a",
        "a/.b",
        "a\\b",
        "a\0b",
        "a\n",
        "é",
        "unfinished/x",
    ],
)
def test_a_key_that_could_lead_elsewhere_is_refused(storage, key):
    with pytest.raises(InputError):
        storage.put(key, [b"x"])
    with pytest.raises(InputError):
        storage.path(key)


@given(st.text())
def test_whatever_the_key_nothing_is_named_outside_the_folder(key):
    storage = Storage(Path("/nonexistent/storage"))
    try:
        file_path = storage.path(key)
    except (InputError, NotFound):
        return
    raise AssertionError(file_path)


def test_a_link_is_not_followed_out_of_the_folder(storage, tmp_path):
    storage.put("scenes/a", [b"x"])
    (tmp_path / "secret").write_bytes(b"secret")
    os.symlink(tmp_path / "secret", storage.folder / "scenes" / "file")
    os.symlink(tmp_path, storage.folder / "scenes" / "folder")
    for key in ("scenes/file", "scenes/folder/secret"):
        with pytest.raises(InputError, match="link"):
            storage.path(key)
    with pytest.raises(InputError, match="link"):
        storage.put("scenes/folder/new", [b"x"])
    assert storage.keys("scenes") == ["scenes/a"]


def test_a_storage_may_lie_below_a_link(tmp_path):
    """An operator mounts a disk somewhere and links to it: links inside alone are not followed."""
    (tmp_path / "disk").mkdir()
    os.symlink(tmp_path / "disk", tmp_path / "linked")
    for folder in (tmp_path / "linked" / "storage", tmp_path / "linked"):
        storage = Storage(folder)
        storage.put("scenes/a", [b"x"])
        assert storage.open("scenes/a").read() == b"x"
        assert storage.keys("scenes") == ["scenes/a"]
        storage.delete("scenes/a")
        assert folder.exists()


def test_nobody_else_on_the_machine_reads_what_is_stored(storage):
    storage.put("results/a/1/report.json", [b"x"])
    storage.put("results/a/1/model.txt", [b"y"])
    scratch = storage.scratch() / "arrived"
    scratch.touch(mode=0o600)
    storage.link(scratch, "scenes/b/a.tif")
    for key in ("results/a/1/report.json", "results/a/1/model.txt", "scenes/b/a.tif"):
        path = storage.path(key)
        assert [one.stat().st_mode & 0o077 for one in (path, path.parent, storage.scratch())] == [0] * 3


def test_the_sizes_of_files_are_those_of_what_was_put(storage, tmp_path):
    contents = {"scenes/a/x": b"one", "scenes/a/y/z": b"four", "scenes/b": b""}
    for key, content in contents.items():
        storage.put(key, [content])
    os.symlink(storage.path("scenes/b"), storage.folder / "scenes" / "linked")
    storage.put("results/a", [b"of another family"])
    assert storage.sizes("scenes") == {key: len(content) for key, content in contents.items()}
    assert storage.keys("scenes") == sorted(contents)
    assert {storage.size(key) for key in contents} == {3, 4, 0}
    assert (
        storage.fetch("scenes/a/x", tmp_path)
        == storage.path("scenes/a/x")
        == storage.local("scenes/a/x")
    )
    assert storage.keys("none") == []


def test_a_file_is_read_by_position_up_to_its_end(storage):
    data = bytes(range(200))
    storage.put("scenes/a", [data])
    reader = storage.reader("scenes/a")
    for start, length in ((0, 1), (0, 200), (17, 1), (199, 1), (50, 100), (7, 0)):
        assert reader.read(start, length) == data[start : start + length]
    assert reader.read(190, 100) == data[190:]
    reader.close()


def test_a_file_that_is_moved_replaces_what_has_its_new_key_and_leaves_no_empty_folders(storage):
    storage.put("scenes/a/b/c", [b"moved"])
    storage.put("scenes/d", [b"former"])
    storage.move("scenes/a/b/c", "scenes/d")
    storage.move("scenes/a/b/c", "scenes/d")
    assert files(storage) == ["scenes/d"]
    assert storage.open("scenes/d").read() == b"moved"
    assert [path.name for path in (storage.folder / "scenes").iterdir()] == ["d"]


def discarded(storage: Storage, content: bytes, at: Moment) -> None:
    storage.put("scenes/a", [content])
    trash.discard(storage, ["scenes/a"], at)


def test_of_files_of_one_name_the_trash_gives_the_last_one_discarded(storage):
    day = date(2026, 11, 22)
    last = Moment(date(2026, 11, 23), 8)
    for moment in (Moment(day, 310), Moment(day, 95), Moment(date(2026, 11, 9), 400)):
        discarded(storage, moment.batch.encode(), moment)
    assert list(trash.batches(storage)) == ["2026-11-09_400h", "2026-11-22_95h", "2026-11-22_310h"]
    assert storage.open(trash.find(storage, "scenes/a")).read() == b"2026-11-22_310h"
    discarded(storage, b"last", last)
    assert storage.open(trash.find(storage, "scenes/a")).read() == b"last"
    assert trash.find(storage, "scenes/b") is None


def test_what_is_put_back_from_the_trash_replaces_nothing(storage):
    at = Moment(date(2026, 11, 22), 310)
    discarded(storage, b"old", at)
    storage.put("scenes/a", [b"new"])
    assert trash.put_back(storage, at.batch, ["scenes/a"]) == []
    assert storage.open("scenes/a").read() == b"new"
    storage.delete("scenes/a")
    assert trash.put_back(storage, at.batch, ["scenes/a"]) == ["scenes/a"]
    assert storage.open("scenes/a").read() == b"old"
    assert storage.keys("trash") == []


@pytest.mark.parametrize(
    ("days", "hours", "deleted"), [(7, 168, 1), (6, 168, 0), (7, 167, 0), (8, 100, 0), (100, 1000, 1)]
)
def test_the_trash_is_emptied_after_its_days_by_the_calendar_and_by_the_running_time(
    storage, days, hours, deleted
):
    day = date(2026, 11, 22)
    discarded(storage, b"old", Moment(day, 310))
    now = Moment(day + timedelta(days=days), 310 + hours)
    assert trash.delete_old(storage, now, 7.0) == deleted
    assert len(storage.keys("trash")) == 1 - deleted


def test_of_the_trash_old_batches_go_with_all_of_their_files_and_folders_of_others_stay(storage):
    day, hours = date(2026, 11, 22), 3100
    for days, count in ((30, 2), (20, 1), (0, 4)):
        at = Moment(day - timedelta(days=days), hours - 24 * days)
        for number in range(count):
            storage.put(f"scenes/{number}", [b"x"])
        trash.discard(storage, [f"scenes/{number}" for number in range(count)], at)
    storage.put("trash/of-an-operator/scenes/0", [b"x"])
    storage.put("trash/2020-01-01_1h_copy/scenes/0", [b"x"])
    assert trash.delete_old(storage, Moment(day, hours), 7.0) == 3
    assert len(storage.keys("trash")) == 4 + 2
    assert trash.delete_old(storage, Moment(day, hours), 7.0) == 0
    assert trash.empty(storage) == 6
    assert storage.keys("trash") == []


def test_a_batch_that_a_clock_gone_wrong_has_dated_keeps_no_other_one_in_the_trash(storage):
    """The clock went back to 2020 for a while; what was discarded then is young by the running time."""
    discarded(storage, b"old", Moment(date(2026, 1, 5), 1000))
    discarded(storage, b"dated wrongly", Moment(date(2020, 1, 5), 1300))
    assert trash.delete_old(storage, Moment(date(2026, 1, 20), 1310), 7.0) == 1
    assert storage.keys("trash") == ["trash/2020-01-05_1300h/scenes/a"]


@pytest.mark.parametrize(("n_files", "most"), [(120, 100), (2000, 100), (4000, 200)])
def test_a_sweep_removes_a_twentieth_of_the_files_or_a_hundred_and_of_more_unknown_ones_none(
    storage, n_files, most
):
    """Files that a row gives up are known: of them the first ones go, and the next sweep goes on."""
    given_up, unknown = ([f"scenes/{kind}{i}" for i in range(most + 1)] for kind in "gu")
    rubbish = Bin(storage)
    assert rubbish.remove_unnamed(Family("scenes", n_files, [], unknown[:most])) == unknown[:most]
    assert rubbish.remove_unnamed(Family("scenes", n_files, [], unknown)) == []
    assert rubbish.remove_unnamed(Family("scenes", n_files, given_up, [])) == given_up[:most]
    assert rubbish.remove_unnamed(Family("scenes", n_files, given_up, unknown)) == given_up[:most]
    everything = Bin(storage, limited=False).remove_unnamed(Family("scenes", n_files, given_up, unknown))
    assert set(everything) == {*given_up, *unknown}


def test_a_chip_file_is_stored_once_under_its_checksum(storage, tmp_path):
    np.save(tmp_path / "0000.npy", numbered(3))
    first, second = storage.put_chips(tmp_path / "0000.npy"), storage.put_chips(tmp_path / "0000.npy")
    assert first == second
    assert first.key == chips_key(hashlib.sha256((tmp_path / "0000.npy").read_bytes()).hexdigest())
    assert files(storage) == [first.key]


def test_a_chip_file_that_is_not_the_one_expected_is_named_and_not_stored(storage, tmp_path):
    np.save(tmp_path / "0000.npy", numbered(3))
    sha256 = hashlib.sha256((tmp_path / "0000.npy").read_bytes()).hexdigest()
    refused = storage.put_chips(tmp_path / "0000.npy", expected_sha256="0" * 64)
    assert (refused.sha256, files(storage)) == (sha256, [])
    stored = storage.put_chips(tmp_path / "0000.npy", expected_sha256=sha256)
    assert files(storage) == [stored.key]


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_chips_are_read_by_row(storage, stored_chips, tmp_path, dtype):
    np.save(tmp_path / "0000.npy", numbered(9, dtype))
    key = storage.put_chips(tmp_path / "0000.npy").key
    read = stored_chips.read(key, 4, 3)
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, numbered(9, dtype)[4:7])
    assert stored_chips.read(key, 9, 0).shape == (0, CHIP_SIZE, CHIP_SIZE)


@pytest.mark.parametrize(("row", "count"), [(-1, 1), (0, 10), (9, 1), (8, 2), (3, -1)])
def test_rows_that_a_chip_file_does_not_have_are_refused(storage, stored_chips, tmp_path, row, count):
    np.save(tmp_path / "0000.npy", numbered(9))
    with pytest.raises(DamagedFile, match="9 chips"):
        stored_chips.read(storage.put_chips(tmp_path / "0000.npy").key, row, count)


def checked_chips(storage: Storage, chips: np.ndarray) -> tuple[StoredChips, str]:
    """Stored chips with their checksums recorded, and the key of their file."""
    content = npy(chips)
    storage.put("chips/a.npy", [content])
    read = read_content(io.BytesIO(content), lambda _: None, of_chips=True)
    assert read.chip_checksums is not None
    return StoredChips(storage, {"chips/a.npy": read.chip_checksums.tobytes()}.get), "chips/a.npy"


@pytest.mark.parametrize("damaged", [[3], [0, 7, 19], list(range(10)), list(range(11))])
def test_chips_that_are_not_what_they_were_are_named_the_first_ten_of_them(storage, damaged):
    chips, key = checked_chips(storage, numbered(20))
    changed = numbered(20)
    changed[damaged, 50, 50] ^= 1
    storage.put(key, [npy(changed)])
    with pytest.raises(DamagedFile) as raised:
        chips.read(key, 0, 20)
    named = ", ".join(map(str, damaged[:10])) + (" …" if len(damaged) > 10 else "")
    assert f": rows {named}. " in str(raised.value)
    assert f"{len(damaged)} of its 20 chips" in str(raised.value)
    whole = [row for row in range(20) if row not in damaged]
    np.testing.assert_array_equal(chips.read(key, whole[-1], 1)[0], numbered(20)[whole[-1]])
    storage.put(key, [npy(numbered(20))])
    np.testing.assert_array_equal(chips.read(key, 0, 20), numbered(20), err_msg="it was repaired")
    chips.close()


@pytest.mark.parametrize("count", [19, 21])
def test_a_file_with_more_or_fewer_chips_than_were_recorded_is_damaged(storage, count):
    chips, key = checked_chips(storage, numbered(20))
    storage.put(key, [npy(numbered(count))])
    with pytest.raises(DamagedFile, match=f"{count} chips in its header, 20 recorded"):
        chips.read(key, 0, 1)


@pytest.mark.parametrize("count", [0, 1, 250])
def test_what_is_read_of_a_chip_file_at_once_is_what_its_parts_have(count):
    """Over a megabyte of chips comes in several pieces, whose borders lie within chips."""
    chips = np.random.default_rng(3).integers(0, 4096, (count, CHIP_SIZE, CHIP_SIZE), dtype=np.uint16)
    content, pieces = npy(chips), list[int]()
    read = read_content(io.BytesIO(content), pieces.append, of_chips=True)
    assert (read.size_bytes, sum(pieces)) == (len(content), len(content))
    assert (len(pieces) > 1) == (len(content) > 1 << 20)
    assert read.sha256 == hashlib.sha256(content).hexdigest()
    assert read.chip_checksums is not None
    expected = [xxhash.xxh3_64_intdigest(chip.tobytes()) % 2**32 for chip in chips]
    assert read.chip_checksums.tolist() == expected


@pytest.mark.parametrize("content", [b"", b"no chips", bytes(3 << 20)])
def test_what_is_no_file_of_chips_has_no_checksums_of_them(content):
    for of_chips in (True, False):
        read = read_content(io.BytesIO(content), lambda _: None, of_chips=of_chips)
        assert (read.size_bytes, read.chip_checksums) == (len(content), None)
        assert read.sha256 == hashlib.sha256(content).hexdigest()
    assert (
        read_content(io.BytesIO(npy(numbered(2))), lambda _: None, of_chips=False).chip_checksums is None
    )


class WatchedStorage(Storage):
    """A storage that notes which files are open to be read by position."""

    def reader(self, key: str) -> "WatchedReader":
        OPEN.append(key)
        return WatchedReader(super().reader(key), key)


@dataclass
class WatchedReader:
    """An open file that is noted until it is closed."""

    opened: RangeReader
    key: str

    def read(self, start: int, length: int) -> bytes:
        if FAULTS:
            raise OSError(FAULTS[0], "no data")
        return self.opened.read(start, length)

    def close(self) -> None:
        OPEN.remove(self.key)
        self.opened.close()


OPEN: list[str] = []
FAULTS: list[int] = []


@pytest.fixture
def watched_chips(tmp_path: Path) -> Iterator[StoredChips]:
    """Chips of the files `a`, `b` and `c` of a watched storage."""
    storage = WatchedStorage(tmp_path / "storage")
    for name in "abc":
        storage.put(f"chips/{name}.npy", [npy(numbered(2))])
    chips = StoredChips(storage, {}.get)
    yield chips
    FAULTS.clear()
    chips.close()
    assert OPEN == []


def test_the_files_that_were_read_last_stay_open_and_no_more_than_may(watched_chips, monkeypatch):
    monkeypatch.setattr("amers.app.storage.chips.OPEN_CHIP_FILES", 2)
    still_open = []
    for name in "abaca":
        watched_chips.read(f"chips/{name}.npy", 0, 1)
        still_open.append("".join(sorted(key[6] for key in OPEN)))
    assert still_open == ["a", "ab", "ab", "ac", "ac"]


@pytest.mark.parametrize(
    ("number", "error"), [(errno.EIO, DamagedFile), (errno.EMFILE, OSError), (errno.ENOMEM, OSError)]
)
def test_a_disk_that_cannot_read_is_damage_and_a_service_without_means_is_not(
    watched_chips, number, error
):
    watched_chips.read("chips/a.npy", 0, 1)
    FAULTS.append(number)
    with pytest.raises(error) as raised:
        watched_chips.read("chips/a.npy", 0, 1)
    assert isinstance(raised.value, DamagedFile) == (number == errno.EIO)


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a NumPy file",
        npy(numbered(2))[:20],
        npy(numbered(2).astype("float32")),
        npy(numbered(2)[:, :100]),
        npy(numbered(2, "uint16").astype(">u2")),
        npy(np.asfortranarray(numbered(2))),
        npy(numbered(2))[:-1],
    ],
    ids=[
        "empty",
        "noise",
        "cut header",
        "floats",
        "wrong size",
        "big endian",
        "Fortran order",
        "cut data",
    ],
)
def test_a_file_that_is_not_of_chips_is_refused(storage, stored_chips, content):
    storage.put("chips/x.npy", [content])
    with pytest.raises(DamagedFile):
        stored_chips.read("chips/x.npy", 0, 2)


def test_more_files_than_may_be_open_are_read_by_many_threads(storage, stored_chips, monkeypatch):
    monkeypatch.setattr("amers.app.storage.chips.OPEN_CHIP_FILES", 2)
    for number in range(6):
        storage.put(f"chips/{number}.npy", [npy(np.full((4, CHIP_SIZE, CHIP_SIZE), number, np.uint8))])

    def read(number: int) -> set[int]:
        return set(np.unique(stored_chips.read(f"chips/{number % 6}.npy", 1, 2)))

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(read, range(120))) == [{number % 6} for number in range(120)]
