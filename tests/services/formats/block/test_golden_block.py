"""Amers blocks compared with a golden block, which was made from the format description alone."""

import json
from pathlib import Path

import geopandas
import numpy as np
import pyarrow.parquet as pq
import pytest

from amers.services.formats.block.check import check_block
from amers.services.formats.block.reader import BlockContents, FolderChips
from amers.services.formats.block.writer import write_block
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.formats.text_files import read_text
from amers.services.types import point_chips

FOLDER = Path(__file__).parents[3] / "golden" / "invented_block"
MODEL = "models/left_RPC.TXT"

rounding = 1e-15


@pytest.fixture(scope="module")
def contents() -> BlockContents:
    return check_block(FOLDER)


@pytest.fixture(scope="module")
def written(contents: BlockContents, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden block, read and written again."""
    folder = tmp_path_factory.mktemp("golden") / "block"
    with FolderChips(FOLDER) as chips:
        order = write_block(
            folder,
            contents.document.metadata,
            contents.points,
            lambda row: point_chips(contents.points, chips, row),
            {"left": parse_rpc_text(read_text(FOLDER / MODEL))},
            typology=list(contents.typology),
        )
    assert order.tolist() == [0, 1, 2]
    return folder


def test_the_golden_block_is_read_as_the_format_describes(contents: BlockContents) -> None:
    points = contents.points
    assert points.lon_lat_h.tolist() == [
        [12.29, 41.86, 105.25],
        [12.41, 41.94, 612.5],
        [12.40, 41.87, -41.75],
    ]
    np.testing.assert_allclose(
        points.covariance_m2[1],
        [[0.0625, -0.03125, 0.015625], [-0.03125, 0.0625, 0.0], [0.015625, 0.0, 0.25]],
        rtol=rounding,
    )
    assert points.saliency.tolist() == [0.75, 0.875, 0.5]
    assert contents.typology.tolist() == ["crossing", "roof", None]
    assert points.views.start.tolist() == [0, 2, 4, 6]
    assert points.views.image.tolist() == [0, 1] * 3
    assert points.views.incidence_deg.tolist() == [12.625, 20.375] * 3
    assert [image.sensor for image in points.views.images] == ["invented A", "invented B"]
    assert points.views.images[1].acquired_at.isoformat() == "2024-07-02T10:45:00.500000+00:00"
    assert contents.document.metadata.accuracy[0].value == 2.5


def test_the_chips_of_a_point_are_its_rows_of_the_file(contents: BlockContents) -> None:
    number, row, column = np.indices((6, 101, 101))
    with FolderChips(FOLDER) as chips:
        actual = point_chips(contents.points, chips, 1)
    np.testing.assert_array_equal(actual, ((31 * number + 3 * row + 5 * column) % 255 + 1)[2:4])


def test_another_reader_of_geoparquet_finds_the_same_points(
    contents: BlockContents, written: Path
) -> None:
    for folder in (FOLDER, written):
        table = geopandas.read_parquet(folder / "points.parquet")
        assert table.crs.to_epsg() == 4979
        actual = np.column_stack([table.geometry.x, table.geometry.y, table.geometry.z])
        np.testing.assert_array_equal(actual, contents.points.lon_lat_h)


def test_written_chips_are_identical_to_the_byte(written: Path) -> None:
    assert (written / "chips/0000.npy").read_bytes() == (FOLDER / "chips/0000.npy").read_bytes()
    np.testing.assert_array_equal(
        np.load(written / "chips/0000.npy"), np.load(FOLDER / "chips/0000.npy")
    )


@pytest.mark.parametrize("name", ["points.parquet", "views.parquet"])
def test_written_tables_have_the_same_rows_and_types(written: Path, name: str) -> None:
    golden, actual = pq.read_table(FOLDER / name), pq.read_table(written / name)
    assert actual.schema.equals(golden.schema, check_metadata=False)
    assert [actual.schema.field(n).nullable for n in actual.schema.names] == [
        golden.schema.field(n).nullable for n in golden.schema.names
    ]
    for column in set(golden.schema.names) - {"corr_east_north", "corr_east_up", "corr_north_up"}:
        assert actual[column].equals(golden[column]), column
    if name == "points.parquet":
        for column in ("corr_east_north", "corr_east_up", "corr_north_up"):
            np.testing.assert_allclose(actual[column], golden[column], atol=rounding)
        geo = [json.loads(table.schema.metadata[b"geo"]) for table in (actual, golden)]
        assert geo[0] == geo[1]


def test_the_written_document_is_equal(written: Path) -> None:
    golden, actual = (json.loads((folder / "block.json").read_text()) for folder in (FOLDER, written))
    checksums = golden.pop("amers:checksums"), actual.pop("amers:checksums")
    assert actual == golden
    assert actual.keys() == golden.keys()
    assert checksums[1].keys() == checksums[0].keys()
    assert checksums[1]["chips/0000.npy"] == checksums[0]["chips/0000.npy"]


def test_a_written_model_has_the_same_numbers(written: Path) -> None:
    golden, actual = (parse_rpc_text(read_text(folder / MODEL)) for folder in (FOLDER, written))
    assert repr(actual) == repr(golden)
