"""The store keeps what a block states about the surface at its points, and gives it back."""

import csv
import io
from dataclasses import replace
from functools import partial

import geopandas
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from amers.app.db import points as point_store
from amers.app.db.stored_files import find_chip_checksums
from amers.app.storage import StoredChips
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.export import ExportBlock, select_points, write_selected
from amers.services.formats.block.check import check_block
from amers.services.formats.block.document import rectangle
from amers.services.formats.block.writer import write_block
from amers.services.types import ControlPoints, SurfaceHeights
from tests.factories import BOX, make_block, metadata, noise_chips
from tests.statements import run_sql

ITEMS = "/collections/points/items"
FIRST_POINT = 2**26
COUNT = 40
UNKNOWN = 3
"""Row of the one point of the block whose surface is unknown."""


@pytest.fixture
def surface(connection, storage, tmp_path) -> SurfaceHeights:
    """The heights in a published block, in the order of its ids."""
    points = make_block(tmp_path / "plain", COUNT).points
    height_m = points.lon_lat_h[:, 2] - np.linspace(-3.0, 3.0, COUNT)
    sigma_m = np.linspace(0.2, 3.0, COUNT)
    height_m[UNKNOWN] = sigma_m[UNKNOWN] = np.nan
    publish(
        connection,
        storage,
        tmp_path / "stated",
        replace(points, surface=SurfaceHeights(height_m, sigma_m)),
    )
    written = check_block(tmp_path / "stated").points.surface
    assert written is not None
    return written


def publish(connection, storage, folder, points: ControlPoints) -> None:
    write_block(folder, metadata(folder.name), points, noise_chips(points), {})
    lifecycle.ingest_block(connection, storage, folder)
    lifecycle.publish_block(connection, folder.name)
    connection.commit()


@pytest.fixture
def get(client, bearer):
    headers = bearer("read")
    return lambda path, **parameters: client.get(path, params=parameters or None, headers=headers)


def columns(height_m, sigma_m) -> tuple[np.ndarray, np.ndarray]:
    """Values of replies as arrays: NaN where unknown; a sigma is stored in single precision."""
    return np.array(height_m, dtype=float), np.array(sigma_m, dtype=float).astype(np.float32)


def assert_stated(found, surface: SurfaceHeights) -> None:
    height_m, sigma_m = found
    assert_array_equal(height_m, surface.height_m)
    assert_array_equal(sigma_m, surface.sigma_m.astype(np.float32))
    assert np.isnan(height_m).sum() == 1


def test_a_page_and_a_point_have_the_surface_beside_the_height_for_matching(surface, get):
    features = get(f"{ITEMS}?limit=100").json()["features"]
    stated = [
        (f["properties"]["surface_height_m"], f["properties"]["surface_sigma_m"]) for f in features
    ]
    assert_stated(columns(*map(list, zip(*stated, strict=True))), surface)
    assert (None, None) in stated
    row = int(np.nanargmax(surface.sigma_m))
    one = get(f"{ITEMS}/{FIRST_POINT + row}").json()
    assert one["properties"]["surface_height_m"] == surface.height_m[row]
    assert one["properties"]["surface_sigma_m"] == pytest.approx(surface.sigma_m[row], rel=1e-6)
    height_m = one["geometry"]["coordinates"][2]
    assert height_m == pytest.approx(features[row]["geometry"]["coordinates"][2], abs=1e-6)
    assert abs(height_m - surface.height_m[row]) > 1.0


def test_csv_leaves_an_unknown_surface_empty(surface, get):
    rows = list(csv.DictReader(io.StringIO(get(ITEMS, f="csv").text)))
    stated = [(row["surface_height_m"], row["surface_sigma_m"]) for row in rows]
    assert stated.count(("", "")) == 1
    height_m, sigma_m = ([value or "nan" for value in column] for column in zip(*stated, strict=True))
    assert_stated(columns(height_m, sigma_m), surface)


@pytest.mark.parametrize("form", ["fgb", "parquet", "gpkg"])
def test_files_for_a_gis_have_the_surface(surface, get, tmp_path, form):
    path = tmp_path / f"points.{form}"
    path.write_bytes(get(ITEMS, f=form).content)
    frame = geopandas.read_parquet(path) if form == "parquet" else geopandas.read_file(path)
    # A FlatGeobuf has its features in the order of its index.
    frame = frame.sort_values("id")
    assert_stated(columns(frame["surface_height_m"], frame["surface_sigma_m"]), surface)


def test_a_filter_finds_points_by_their_surface(surface, get):
    found = get(ITEMS, filter="surface_sigma_m < 1", limit="100").json()["features"]
    expected = np.flatnonzero(surface.sigma_m.astype(np.float32) < 1.0)
    assert [feature["id"] for feature in found] == (FIRST_POINT + expected).tolist()
    unknown = get(ITEMS, filter="surface_height_m is null").json()["features"]
    assert [f["id"] - FIRST_POINT for f in unknown] == np.flatnonzero(
        np.isnan(surface.height_m)
    ).tolist()


def test_an_export_gives_the_surface_back_and_ingests_again(connection, storage, surface, tmp_path):
    chips = StoredChips(storage, partial(find_chip_checksums, connection))
    write_selected(select_points(connection, ExportBlock(BOX, id="copy")), chips, tmp_path / "copy")
    chips.close()
    copy = check_block(tmp_path / "copy").points.surface
    assert copy is not None
    assert_stated(columns(copy.height_m, copy.sigma_m), surface)
    lifecycle.ingest_block(connection, storage, tmp_path / "copy")
    assert_stated(stored(connection, 2), surface)


def test_an_export_of_points_without_a_surface_has_no_columns_for_it(connection, storage, tmp_path):
    publish(connection, storage, tmp_path / "none", make_block(tmp_path / "plain", 5).points)
    assert select_points(connection, ExportBlock(BOX)).points.surface is None


def test_points_for_registration_come_without_the_surface(connection, surface):
    assert point_store.control_points(connection, rectangle(*BOX)).points.surface is None


def stored(connection, block_number: int) -> tuple[np.ndarray, np.ndarray]:
    """The columns of a block as the database has them."""
    rows = run_sql(
        connection,
        "select surface_height_m, surface_sigma_m from point where block_number = %s order by id",
        [block_number],
    ).fetchall()
    return columns(*([row[name] for row in rows] for name in ("surface_height_m", "surface_sigma_m")))
