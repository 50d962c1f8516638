"""Every error that a delivered Amers block may have is detected and named."""

import hashlib
import json
import os
from collections.abc import Callable
from datetime import date
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amers.services.errors import FormatError
from amers.services.formats.block.check import check_block
from amers.services.formats.block.problems import BlockProblems
from amers.services.formats.block.reader import FolderChips
from tests.factories import MadeBlock, make_block


@pytest.fixture
def block(tmp_path: Path) -> MadeBlock:
    return make_block(tmp_path / "block")


def resigned(folder: Path) -> None:
    """Recompute the checksums, so that only the deliberate change is wrong."""
    path = folder / "block.json"
    document = json.loads(path.read_text())
    document["amers:checksums"] = {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file != path
    }
    path.write_text(json.dumps(document))


def edit_json(folder: Path, edit: Callable[[dict], None]) -> None:
    document = json.loads((folder / "block.json").read_text())
    edit(document)
    (folder / "block.json").write_text(json.dumps(document))


def edit_column(folder: Path, table: str, column: str, row: int, value: object) -> None:
    """Change one value in a table of the block."""
    path = folder / f"{table}.parquet"
    table = pq.read_table(path)
    index = table.schema.get_field_index(column)
    values = table[column].to_pylist()
    values[row] = value
    field = table.schema.field(index)
    pq.write_table(table.set_column(index, field, pa.array(values, field.type)), path)
    resigned(folder)


def problems_of(folder: Path) -> BlockProblems:
    with pytest.raises(BlockProblems) as caught:
        check_block(folder)
    return caught.value


def test_a_changed_byte_is_found_by_its_checksum(block):
    with (block.folder / "chips/0000.npy").open("r+b") as file:
        file.seek(5000)
        file.write(b"\xff\xee\xdd")
    problems = problems_of(block.folder)
    assert problems.count == 1
    assert problems.problems[0].file == "chips/0000.npy"
    assert "sha256" in str(problems)


@pytest.mark.parametrize("name", ["chips/0000.npy", "points.parquet", "models/IMG_00_RPC.TXT"])
def test_a_missing_file_is_named(block, name):
    (block.folder / name).unlink()
    problems = problems_of(block.folder)
    assert [(p.file, p.found) for p in problems.problems] == [(name, "no file")]


def test_an_unlisted_file_is_named(block):
    (block.folder / "chips/extra.bin").write_bytes(b"?")
    assert problems_of(block.folder).problems[0].file == "chips/extra.bin"


def test_a_folder_without_a_block_is_refused(tmp_path):
    with pytest.raises(FormatError, match=r"block\.json"):
        check_block(tmp_path)


def with_geometry(values: list[float]) -> bytes:
    return b"\x01" + np.array(1001, "<u4").tobytes() + np.array(values, "<f8").tobytes()


WRONG_VALUES = [
    ("points", "geometry", with_geometry([np.nan, 43.25, 100.0]), "geometry lon", "nan"),
    ("points", "geometry", with_geometry([5.25, np.nan, 100.0]), "geometry lat", "nan"),
    ("points", "geometry", with_geometry([5.25, 43.25, np.nan]), "geometry height", "nan"),
    ("points", "geometry", with_geometry([5.25, 43.25, 9500.0]), "geometry height", "9500.0"),
    ("points", "geometry", with_geometry([5.25, 43.25, -501.0]), "geometry height", "-501.0"),
    ("points", "geometry", with_geometry([185.25, 43.25, 100.0]), "geometry lon", "185.25"),
    ("points", "geometry", with_geometry([5.35, 43.25, 100.0]), "geometry", "5.35"),
    ("points", "sigma_east_m", 0.0, "sigma_east_m", "0.0"),
    ("points", "sigma_up_m", float("inf"), "sigma_up_m", "inf"),
    ("points", "sigma_north_m", float("nan"), "sigma_north_m", "nan"),
    ("points", "corr_east_up", 1.5, "corr_east_up", "1.5"),
    ("points", "corr_east_up", 1.0, "corr_*", "1."),
    ("points", "corr_north_up", float("nan"), "corr_north_up", "nan"),
    ("points", "saliency", 1.25, "saliency", "1.25"),
    ("points", "id", 8, "id", "8"),
    ("points", "id", 40, "id", "40"),
    ("points", "id", -1, "id", "-1"),
    ("points", "n_views", 1, "n_views", "1"),
    ("points", "n_views", 5, "n_views", "5"),
    ("points", "chip_row", 235, "chip_row", "235"),
    ("points", "chip_file", "chips/0001.npy", "chip_file", "chips/0001.npy"),
    ("points", "chip_file", "../chips/0000.npy", "chip_file", "../chips/0000.npy"),
    ("points", "chip_file", "/etc/passwd", "chip_file", "/etc/passwd"),
    ("points", "first_view", date(2030, 1, 1), "first_view", "2030-01-01"),
    ("views", "point_id", 3, "point_id", "3"),
    ("views", "view", 4, "view", "4"),
    ("views", "gsd_m", 0.7, "gsd_m", "0.7"),
    ("views", "gsd_m", 2.0, "gsd_m", "0.5"),
    ("views", "image_id", "IMG_99", "image_id", "IMG_99"),
    ("views", "chip_row", 43, "chip_row", "43"),
    ("views", "chip_file", "chips/0009.npy", "chip_file", "chips/0009.npy"),
]


@pytest.mark.parametrize(("table", "column", "value", "field", "found"), WRONG_VALUES)
def test_a_wrong_value_is_named_with_its_file_field_row_and_what_was_found(
    block, table, column, value, field, found
):
    edit_column(block.folder, table, column, 7, value)
    problems = problems_of(block.folder)
    match = [p for p in problems.problems if p.field == field and found in p.found]
    assert match, str(problems)
    assert match[0].file == f"{table}.parquet"
    assert match[0].expected


def test_a_number_of_views_that_differs_from_the_number_of_chips_is_reported(block):
    edit_column(block.folder, "points", "chip_count", 7, 5)
    problems = problems_of(block.folder)
    assert "views.parquet: 240 rows found, 239, the sum of chip_count expected" in str(problems)


def test_a_point_with_a_wrong_number_of_images_is_named(block):
    for row in (1, 4):
        edit_column(block.folder, "views", "image_id", row, "IMG_00")
    problem = problems_of(block.folder).problems[0]
    assert (problem.file, problem.field, problem.row, problem.found) == (
        "points.parquet",
        "n_views",
        0,
        "3",
    )


def test_many_problems_are_listed_up_to_a_limit_and_counted(block):
    path = block.folder / "points.parquet"
    table = pq.read_table(path)
    for name in ("sigma_east_m", "sigma_north_m", "sigma_up_m", "corr_east_up", "corr_east_north"):
        index = table.schema.get_field_index(name)
        table = table.set_column(index, table.schema.field(index), pa.array(np.full(40, -7.0)))
    pq.write_table(table, path)
    resigned(block.folder)
    problems = problems_of(block.folder)
    assert problems.count == 5 * 40
    assert len(problems.problems) <= 20
    assert "and " in str(problems)
    assert "more" in str(problems)


def wrong_shape(path: Path) -> None:
    np.save(path, np.load(path)[:, :100])


def wrong_type(path: Path) -> None:
    np.save(path, np.load(path).astype(np.float32))


def column_major(path: Path) -> None:
    np.save(path, np.asfortranarray(np.load(path)))


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def pickled(path: Path) -> None:
    np.save(path, np.array([{"a": 1}], dtype=object))


def fewer(path: Path) -> None:
    np.save(path, np.load(path)[:-1])


@pytest.mark.parametrize("spoil", [wrong_shape, wrong_type, column_major, truncated, pickled, fewer])
def test_a_wrong_chip_file_is_refused(block, spoil):
    spoil(block.folder / "chips/0000.npy")
    resigned(block.folder)
    assert "chips/0000.npy" in str(problems_of(block.folder))


@pytest.mark.parametrize("name", ["points.parquet", "views.parquet"])
@pytest.mark.parametrize("keep", [0, 3, 100, 0.5, 0.99])
def test_a_truncated_table_is_refused(block, name, keep):
    path = block.folder / name
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    resigned(block.folder)
    with pytest.raises(FormatError, match=name):
        check_block(block.folder)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
@pytest.mark.long
def test_garbled_tables_raise_nothing_but_format_errors(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "garbled"
    if not folder.exists():
        make_block(folder, count=5)
    name = data.draw(st.sampled_from(["points.parquet", "views.parquet", "chips/0000.npy"]))
    path = folder / name
    original = path.read_bytes()
    garbled = bytearray(original)
    reach = 128 if name.endswith("npy") else len(garbled)
    for at in data.draw(st.lists(st.integers(0, reach - 1), min_size=1, max_size=8)):
        garbled[at] = data.draw(st.integers(0, 255))
    try:
        path.write_bytes(bytes(garbled))
        resigned(folder)
        check_block(folder)
    except FormatError:
        pass
    finally:
        path.write_bytes(original)


@pytest.mark.parametrize("table", ["points.parquet", "views.parquet"])
def test_a_table_with_column_names_that_are_not_text_is_refused(block, table):
    path = block.folder / table
    path.write_bytes(path.read_bytes().replace(b"chip_file", b"chip_\x80ile"))
    resigned(block.folder)
    with pytest.raises(FormatError, match=table):
        check_block(block.folder)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["amers:format"], "amers-block/9"),
        (["amers:vertical_datum"], "EGM96"),
        (["id"], "../x"),
        (["amers:version"], None),
        (["amers:created"], "yesterday"),
        (["amers:created"], "2024-05-06T07:08:09"),
        (["amers:created"], "0001-01-01T00:00:00+14:00"),
        (["amers:counts", "points"], "40"),
        (["amers:counts", "points"], True),
        (["amers:specification", "chip_size"], 51),
        (["amers:specification", "gsds_m"], []),
        (["amers:specification", "gsds_m"], [0.0]),
        (["amers:outline"], [[0, 0], [1, 1]]),
        (["amers:outline"], [[0, 0], [1, "x"], [2, 2]]),
        (["amers:outline"], [[0, 0], [1, 91], [2, 2]]),
        (["amers:images"], {"image_id": "IMG_00"}),
        (["amers:images"], [7]),
        (["amers:checksums"], {"points.parquet": 7}),
        (["amers:provenance"], []),
    ],
)
def test_a_wrong_field_of_the_document_is_named(block, path, value):
    def edit(document: dict) -> None:
        for name in path[:-1]:
            document = document[name]
        document[path[-1]] = value

    edit_json(block.folder, edit)
    with pytest.raises(FormatError) as caught:
        check_block(block.folder)
    assert path[-1] in str(caught.value)
    assert "expected" in str(caught.value)


@pytest.mark.parametrize(
    "name", ["../outside.npy", "/etc/passwd", "chips/../../outside.npy", "chips\\x", ""]
)
def test_paths_that_leave_the_folder_are_refused_and_not_read(block, name):
    (block.folder.parent / "outside.npy").write_bytes((block.folder / "chips/0000.npy").read_bytes())
    edit_json(block.folder, lambda document: document["amers:checksums"].update({name: "0" * 64}))
    assert "a path inside the block, without links expected" in str(problems_of(block.folder))
    with (
        FolderChips(block.folder) as chips,
        pytest.raises(FormatError, match="a relative path inside the block expected"),
    ):
        chips.read(name, 0, 1)


def test_links_are_refused_even_to_the_right_file(block):
    path = block.folder / "chips/0000.npy"
    outside = block.folder.parent / "outside.npy"
    os.rename(path, outside)
    path.symlink_to(outside)
    assert "link" in str(problems_of(block.folder))
    with FolderChips(block.folder) as chips, pytest.raises(FormatError, match="link"):
        chips.read("chips/0000.npy", 0, 1)


@pytest.mark.parametrize(("row", "count"), [(-1, 2), (0, 241), (240, 1), (239, 2)])
def test_chips_beyond_the_end_of_a_file_are_refused(block, row, count):
    with FolderChips(block.folder) as chips, pytest.raises(FormatError, match="the file has 240 chips"):
        chips.read("chips/0000.npy", row, count)


SINGULAR = [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (-0.5, -0.5, -0.5)]
"""Correlations east-north, east-up, north-up of errors in a plane or on a line."""


@pytest.mark.parametrize("correlations", SINGULAR)
def test_a_covariance_without_volume_is_refused_and_one_that_has_nearly_none_is_not(
    block: MadeBlock, correlations: tuple[float, float, float]
) -> None:
    """The exact ones are singular whatever the sigmas are; the others have a determinant above zero."""
    for shrunk in (1.0, 0.999):
        for name, value in zip(CORRELATIONS, correlations, strict=True):
            edit_column(block.folder, "points", name, 3, shrunk * value)
        if shrunk < 1.0:
            check_block(block.folder)
        else:
            assert "positive definite" in str(problems_of(block.folder))


def test_a_table_of_more_rows_than_stated_is_refused_before_it_is_unpacked(block):
    path = block.folder / "views.parquet"
    table = pq.read_table(path)
    row, count = table.slice(0, 1), 5_000_000
    with pq.ParquetWriter(path, table.schema, compression="zstd") as writer:
        many = pa.Table.from_arrays(
            [pa.repeat(column[0], count // 5) for column in row.columns], schema=table.schema
        )
        for _ in range(5):
            writer.write_table(many, row_group_size=count // 5)
    assert path.stat().st_size < 1_000_000
    resigned(block.folder)
    with pytest.raises(FormatError, match=rf"views.parquet: {count} rows found, \d+ expected"):
        check_block(block.folder)


CORRELATIONS = ("corr_east_north", "corr_east_up", "corr_north_up")
