"""Archives are checked before anything is written; the message names a forbidden member."""

import gzip
import io
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amers.services.errors import FormatError
from amers.services.formats import archives
from amers.services.formats.archives import (
    HEAD_BYTES,
    ArchiveLimits,
    check_archive,
    is_archive,
    unpack_archive,
)

LIMITS = ArchiveLimits(total_bytes=1_000_000, members=20)
FILES = {"scene/IMG.TIF": b"II*\0" + bytes(1000), "scene/RPC.XML": b"<xml/>"}


def zipped(files: dict[str, bytes], change: Callable[[zipfile.ZipInfo], None] | None = None) -> bytes:
    """The bytes of a zip of some files."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = zipfile.ZIP_DEFLATED
            if change:
                change(info)
            archive.writestr(info, data)
    return out.getvalue()


def tarred(
    files: dict[str, bytes], change: Callable[[tarfile.TarInfo], None] | None = None, mode: str = "w"
) -> bytes:
    """The bytes of a tar of some files."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode=mode) as archive:  # type: ignore[call-overload]
        for name, data in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            if change:
                change(info)
            archive.addfile(info, io.BytesIO(data))
    return out.getvalue()


def written(folder: Path, data: bytes) -> Path:
    path = folder / "archive"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("make", [zipped, tarred, lambda files: tarred(files, mode="w:gz")])
def test_the_files_of_an_archive_are_listed_and_unpacked_to_given_paths(
    tmp_path: Path, make: Callable[[dict[str, bytes]], bytes]
):
    path = written(tmp_path, make(FILES))
    assert is_archive(path.read_bytes()[:HEAD_BYTES])
    members = check_archive(path, LIMITS)
    assert {str(one.path): one.size_bytes for one in members} == {k: len(v) for k, v in FILES.items()}
    unpack_archive(path, {PurePosixPath("scene/RPC.XML"): tmp_path / "a.xml"}, LIMITS)
    assert (tmp_path / "a.xml").read_bytes() == FILES["scene/RPC.XML"]
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.xml", "archive"]


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../up", "a/../../up", "a\\..\\b", "C:/x", "a\nb", "x" * 1001]
)
@pytest.mark.parametrize("make", [zipped, tarred])
def test_paths_that_leave_the_archive_are_refused_by_name(
    tmp_path: Path, make: Callable[[dict[str, bytes]], bytes], name: str
):
    path = written(tmp_path, make({name: b"x"}))
    with pytest.raises(FormatError, match="not accepted"):
        check_archive(path, LIMITS)


def link_in_zip(info: zipfile.ZipInfo) -> None:
    info.create_system = 3
    info.external_attr = (stat.S_IFLNK | 0o777) << 16


def link_in_tar(kind: bytes) -> Callable[[tarfile.TarInfo], None]:
    def change(info: tarfile.TarInfo) -> None:
        info.type, info.linkname, info.size = kind, "/etc/passwd", 0

    return change


@pytest.mark.parametrize(
    "data",
    [
        zipped({"a": b"/etc/passwd"}, link_in_zip),
        *(tarred({"a": b""}, link_in_tar(kind)) for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE)),
        *(tarred({"a": b""}, link_in_tar(kind)) for kind in (tarfile.CHRTYPE, tarfile.FIFOTYPE)),
    ],
)
def test_links_and_devices_are_refused(tmp_path: Path, data: bytes):
    with pytest.raises(FormatError, match="link"):
        check_archive(written(tmp_path, data), LIMITS)


def test_an_encrypted_member_is_refused(tmp_path: Path):
    data = bytearray(zipped({"a": b"x"}))
    at = data.rindex(b"PK\1\2")
    data[at + 8] |= 1
    with pytest.raises(FormatError, match="encrypted"):
        check_archive(written(tmp_path, bytes(data)), LIMITS)


@pytest.mark.parametrize("make", [zipped, lambda files: tarred(files, mode="w:gz")])
def test_a_bomb_is_refused_by_what_it_declares(
    tmp_path: Path, make: Callable[[dict[str, bytes]], bytes]
):
    path = written(tmp_path, make({"zeros": bytes(2_000_000)}))
    assert path.stat().st_size < 10_000
    with pytest.raises(FormatError, match="more than 1000000 bytes"):
        check_archive(path, LIMITS)


@pytest.mark.parametrize("make", [zipped, lambda files: tarred(files, mode="w:gz")])
def test_an_archive_of_zeros_is_refused_before_it_is_unpacked(
    tmp_path: Path, make: Callable[[dict[str, bytes]], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gzip of 32 MB unpacks to 32 GiB, within the limit of an upload: a minute of work."""
    monkeypatch.setattr(archives, "ALWAYS_UNPACKED_BYTES", 100_000)
    path = written(tmp_path, make({"scene/IMG.TIF": bytes(900_000)}))
    with pytest.raises(
        FormatError, match=r"declares 900000 bytes or more in .* at most 100 bytes for each"
    ):
        check_archive(path, LIMITS)
    assert check_archive(written(tmp_path, make({"scene/IMG.TIF": bytes(90_000)})), LIMITS)


def test_a_zip_that_unpacks_to_more_than_it_declares_is_refused(tmp_path: Path):
    data = bytearray(zipped({"zeros": bytes(500_000)}))
    for record, offset in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        at = data.rindex(record) + offset
        data[at : at + 4] = (10).to_bytes(4, "little")
    path = written(tmp_path, bytes(data))
    check_archive(path, LIMITS)
    with pytest.raises(FormatError):
        unpack_archive(path, {PurePosixPath("zeros"): tmp_path / "out"}, LIMITS)
    assert (tmp_path / "out").stat().st_size <= 10


@pytest.mark.parametrize("make", [zipped, tarred])
def test_too_many_members_are_refused(tmp_path: Path, make: Callable[[dict[str, bytes]], bytes]):
    as_many = written(tmp_path, make({f"f{i}": b"" for i in range(20)}))
    assert len(check_archive(as_many, LIMITS)) == 20
    path = written(tmp_path, make({f"f{i}": b"" for i in range(21)}))
    with pytest.raises(FormatError, match="more than 20 members"):
        check_archive(path, LIMITS)


def test_a_name_that_occurs_twice_is_refused(tmp_path: Path):
    with pytest.raises(FormatError, match="twice"):
        check_archive(written(tmp_path, tarred({"IMG.TIF": b"a", "img.tif": b"b"})), LIMITS)


def test_a_tar_whose_header_is_a_bomb_is_refused_before_it_is_read(tmp_path: Path):
    header = tarfile.TarInfo("x")
    header.type, header.size = tarfile.XHDTYPE, 1 << 33
    bomb = header.tobuf(tarfile.GNU_FORMAT) + bytes(10_000)
    with pytest.raises(FormatError, match="header"):
        check_archive(written(tmp_path, gzip.compress(bomb)), LIMITS)


BLOCK = tarfile.BLOCKSIZE
THREE = {name: b"x" * 700 for name in ("first", "second", "third")}
SECOND = 3 * BLOCK
"""Where the header of the second member of THREE begins: header and two blocks of data come before."""
LAST_DATA = 9 * BLOCK
"""Where the data of the third end, and the zeros begin."""


def wrong_name(tar: bytes) -> bytes:
    """A tar with a changed byte in a later header, whose checksum no longer matches."""
    return tar[:SECOND] + b"S" + tar[SECOND + 1 :]


def zeroed(tar: bytes) -> bytes:
    """A tar with a later header overwritten by zeros, which look like its end."""
    return tar[:SECOND] + bytes(BLOCK) + tar[SECOND + BLOCK :]


@pytest.mark.parametrize(
    "spoil",
    [
        wrong_name,
        zeroed,
        lambda tar: tar[: SECOND + 100],
        lambda tar: tar[:SECOND],
        lambda tar: tar[: SECOND - 10],
        lambda tar: tar[:LAST_DATA],
        lambda tar: tar + b"x",
        lambda tar: tar + bytes(20 << 20),
    ],
    ids=["wrong", "zeroed", "cut", "cut between", "cut in data", "no end", "more", "endless"],
)
@pytest.mark.parametrize("pack", [bytes, gzip.compress], ids=["tar", "tar.gz"])
def test_a_tar_that_is_broken_after_its_first_member_is_refused_before_anything_is_kept(
    tmp_path: Path, pack: Callable[[bytes], bytes], spoil: Callable[[bytes], bytes]
):
    whole = tarred(THREE)
    assert len(check_archive(written(tmp_path, pack(whole)), LIMITS)) == len(THREE)
    with pytest.raises(FormatError):
        check_archive(written(tmp_path, pack(spoil(whole))), LIMITS)


def test_a_gzipped_tar_whose_checksum_is_wrong_is_refused(tmp_path: Path):
    packed = bytearray(gzip.compress(tarred(THREE)))
    packed[-8] ^= 1
    with pytest.raises(FormatError, match="broken"):
        check_archive(written(tmp_path, bytes(packed)), LIMITS)


@pytest.mark.parametrize("blocks", [1, 2, 20, 2048])
def test_a_tar_may_end_with_any_number_of_zeros(tmp_path: Path, blocks: int):
    data = tarred(THREE)[:LAST_DATA] + bytes(blocks * BLOCK)
    assert len(check_archive(written(tmp_path, data), LIMITS)) == len(THREE)


def test_a_zip_whose_index_is_a_bomb_is_refused_before_it_is_read(tmp_path: Path):
    data = bytearray(zipped({"a": b"x"}))
    at = data.rindex(b"PK\5\6")
    data[at + 12 : at + 16] = (1 << 30).to_bytes(4, "little")
    with pytest.raises(FormatError, match="index"):
        check_archive(written(tmp_path, bytes(data)), LIMITS)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([zipped(FILES), tarred(FILES), tarred(FILES, mode="w:gz")]), st.data())
def test_a_garbled_or_truncated_archive_is_read_or_raises_a_format_error(
    tmp_path: Path, data: bytes, draw: st.DataObject
):
    garbled = bytearray(data)
    for _ in range(draw.draw(st.integers(0, 4))):
        garbled[draw.draw(st.integers(0, len(data) - 1))] = draw.draw(st.integers(0, 255))
    path = written(tmp_path, bytes(garbled[: draw.draw(st.integers(1, len(data)))]))
    target = tmp_path / "out"
    target.unlink(missing_ok=True)
    try:
        members = check_archive(path, LIMITS)
        for member in members[:1]:
            unpack_archive(path, {member.path: target}, LIMITS)
    except FormatError:
        return
