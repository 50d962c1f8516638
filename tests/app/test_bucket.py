"""The storage in a bucket behaves like the storage in a folder."""

import hashlib
import io
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import ClassVar

import numpy as np
import obstore
import pytest

from amers.app.config import Settings
from amers.app.errors import DamagedFile, InputError, NotFound, StorageOutage, TooLarge
from amers.app.storage import Storage, StoredChips, bucket, chips_key
from amers.services.conventions import CHIP_SIZE
from tests.app.s3_server import KEYS, running_bucket
from tests.unproven import unproven_storage

SEVERAL_PARTS = 12_000_000
"""Size of a file that is sent in several parts."""


@pytest.fixture(scope="module")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Storage]:
    with pytest.MonkeyPatch.context() as patch, running_bucket(patch) as url:
        folder = tmp_path_factory.mktemp("machine")
        yield unproven_storage(Settings(data_folder=folder, storage_url=url))


def unfinished(storage: Storage) -> list[Path]:
    return list(storage.scratch().iterdir())


def test_a_file_is_found_in_a_bucket_as_it_was_put(storage: Storage, tmp_path: Path):
    stored = storage.put("scenes/a/scene.tif", [b"one", b"", b"two"])
    assert (stored.size_bytes, stored.sha256) == (6, hashlib.sha256(b"onetwo").hexdigest())
    storage.put("scenes/a/scene_RPC.TXT", [b"x"])
    storage.put("scenes/ab/other", [b"y"])
    with storage.open("scenes/a/scene.tif") as file:
        assert file.read() == b"onetwo"
    assert storage.fetch("scenes/a/scene.tif", tmp_path).read_bytes() == b"onetwo"
    assert (storage.size("scenes/a/scene.tif"), storage.exists("scenes/a")) == (6, False)
    assert storage.keys("scenes/a") == ["scenes/a/scene.tif", "scenes/a/scene_RPC.TXT"]
    storage.delete("scenes/a/scene.tif")
    storage.delete("scenes/a/scene.tif")
    assert not storage.exists("scenes/a/scene.tif")
    assert unfinished(storage) == []


def test_a_file_that_is_moved_has_its_new_key_alone(storage: Storage):
    storage.put("scenes/moved/a", [b"one"])
    storage.move("scenes/moved/a", "trash/moved/a")
    assert (storage.keys("scenes/moved"), storage.keys("trash/moved")) == ([], ["trash/moved/a"])
    storage.move("scenes/moved/a", "trash/moved/a")
    with storage.open("trash/moved/a") as file:
        assert file.read() == b"one"


def test_a_file_of_many_parts_arrives_whole(storage: Storage, tmp_path: Path):
    data = np.random.default_rng(1).bytes(SEVERAL_PARTS)
    path = tmp_path / "large"
    path.write_bytes(data)
    assert storage.put_file("scenes/large", path).size_bytes == len(data)
    with storage.open("scenes/large") as file:
        assert file.read() == data
    assert storage.reader("scenes/large").read(5_000_000, 100) == data[5_000_000:5_000_100]


def test_the_rest_of_a_file_is_read_by_one_request(storage: Storage, monkeypatch: pytest.MonkeyPatch):
    asked, get_range = [], obstore.get_range

    def counted(store, key: str, *, start: int, length: int):
        asked.append((start, length))
        return get_range(store, key, start=start, length=length)

    storage.put("scenes/c", [data := bytes(range(250)) * 80_000])
    monkeypatch.setattr(bucket.obstore, "get_range", counted)
    with storage.open("scenes/c") as file:
        beginning = file.read(10)
        assert beginning + file.read() == data
    assert len(asked) == 2


def test_a_file_that_breaks_off_or_is_too_large_leaves_the_former_one(storage: Storage):
    storage.put("scenes/b", [b"former"])

    def breaking() -> Iterator[bytes]:
        yield b"lat"
        raise ConnectionError

    with pytest.raises(ConnectionError):
        storage.put("scenes/b", breaking())
    with pytest.raises(TooLarge):
        storage.put("scenes/b", [bytes(20)], limit_bytes=10)
    with storage.open("scenes/b") as file:
        assert file.read() == b"former"
    assert unfinished(storage) == []


def test_a_file_that_is_not_in_the_bucket_is_not_found(storage: Storage, tmp_path: Path):
    for ask in (storage.open, storage.size, storage.reader, lambda key: storage.fetch(key, tmp_path)):
        with pytest.raises(NotFound):
            ask("scenes/none")
        with pytest.raises(InputError):
            ask("../none")
    with pytest.raises(InputError):
        storage.put("../up", [b"x"])


def test_a_file_of_the_scratch_folder_is_stored_and_stays_there(storage: Storage):
    path = storage.scratch() / "arrived"
    path.write_bytes(b"II*")
    storage.link(path, "scenes/c/a.tif")
    assert storage.size("scenes/c/a.tif") == 3
    assert unfinished(storage) == [path]
    path.unlink()


def test_a_file_without_a_folder_is_copied_under_its_name(storage: Storage, tmp_path: Path):
    storage.put("installation.json", [b"{}"])
    path = storage.fetch("installation.json", tmp_path)
    assert (path, path.read_bytes()) == (tmp_path / "installation.json", b"{}")


def test_a_file_is_read_by_position_and_in_small_steps(storage: Storage):
    data = bytes(range(200))
    storage.put("scenes/steps", [data])
    reader = storage.reader("scenes/steps")
    for start, length in ((0, 1), (0, 200), (17, 1), (199, 1), (50, 100), (7, 0), (200, 0)):
        assert reader.read(start, length) == data[start : start + length]
    with storage.open("scenes/steps") as file:
        assert [file.read(70) for _ in range(4)] == [data[:70], data[70:140], data[140:], b""]
    with storage.open("scenes/steps") as file:
        assert [file.read(70), file.read(), file.read()] == [data[:70], data[70:], b""]
    with storage.open("scenes/steps") as file:
        assert isinstance(file, io.BufferedReader)
        buffer = bytearray(150)
        assert [file.readinto(buffer), file.readinto(buffer), file.readinto(buffer)] == [150, 50, 0]
    assert storage.sizes("scenes")["scenes/steps"] == 200


def test_a_storage_that_is_opened_twice_is_one(storage: Storage):
    settings = Settings(data_folder=storage.folder.parent, storage_url=storage.place)
    again, elsewhere = (
        unproven_storage(settings),
        unproven_storage(settings.model_copy(update={"storage_url": f"{storage.place}/other"})),
    )
    assert again == storage != elsewhere
    assert len({storage, again, elsewhere}) == 2


class Unwilling(BaseHTTPRequestHandler):
    """A storage service that answers no request."""

    asked: ClassVar[list[str]] = []

    def do_HEAD(self) -> None:
        """Refuse."""
        self.asked.append(self.path)
        self.send_response(503)
        self.end_headers()

    def log_message(self, *arguments: object) -> None:
        """Keep quiet."""


def test_a_request_that_fails_is_repeated_and_not_for_long(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    with ThreadingHTTPServer(("127.0.0.1", 0), Unwilling) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
            unwilling = unproven_storage(Settings(data_folder=tmp_path, storage_url="s3://bucket/test"))
            with pytest.raises(StorageOutage, match="scenes/a: the storage does not answer"):
                unwilling.size("scenes/a")
        finally:
            server.shutdown()
            thread.join()
    assert 3 <= len(Unwilling.asked) <= 5
    assert set(Unwilling.asked) == {"/bucket/test/scenes/a"}


def test_chips_are_read_from_a_bucket_by_ranges(storage: Storage, tmp_path: Path):
    chips = np.random.default_rng(2).integers(0, 4096, (50, CHIP_SIZE, CHIP_SIZE)).astype(np.uint16)
    np.save(tmp_path / "chips.npy", chips)
    first, again = (storage.put_chips(tmp_path / "chips.npy") for _ in range(2))
    assert first == again
    assert first.key == chips_key(first.sha256)
    stored = StoredChips(storage, {}.get)
    np.testing.assert_array_equal(stored.read(first.key, 17, 3), chips[17:20])
    with pytest.raises(DamagedFile, match="50 chips"):
        stored.read(first.key, 49, 2)
    storage.put("chips/none.npy", [b"none"])
    with pytest.raises(DamagedFile, match="cannot be read as a NumPy array"):
        stored.read("chips/none.npy", 0, 1)


def test_an_address_that_is_none_is_refused_by_name(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("AMERS_STORAGE_URL", "http://elsewhere/bucket")
    from amers.app.config import read_settings

    with pytest.raises(InputError, match="AMERS_STORAGE_URL"):
        read_settings()
