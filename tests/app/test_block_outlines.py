"""Outlines of blocks: around their points, and not the boxes that their documents declare."""

import json
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import shapely
from sqlalchemy import text

from amers.app.db.blocks import ID_BITS, Block
from amers.app.db.engine import Connection
from amers.app.storage import Storage
from amers.app.usecases.blocks.lookup import block_extent
from amers.services.formats.block.writer import write_block
from amers.services.types import Array
from tests.app.served import serve_block
from tests.factories import affine_model, control_points, metadata, noise_chips
from tests.statements import run_sql

FILL = import_module("amers.migrations.versions.0014_outlines_of_blocks").FILL
GSDS_M = (0.5,)
SIDE_DEG = 0.1
"""Of the box that a block declares, in latitude."""
POINTS = 300
touching_deg = 1e-9

Ingest = Callable[..., Block]


def spread(shape: shapely.Geometry, count: int = POINTS) -> Array:
    """Random positions (n, 2) in a shape inside the unit square."""
    tried = np.random.default_rng(3).uniform(0.0, 1.0, (40 * count, 2))
    return tried[shapely.contains_xy(shape, tried)][:count]


CORNER = shapely.Polygon([(0, 0), (1, 0), (1, 0.35), (0.35, 0.35), (0.35, 1), (0, 1)])
ISLANDS = shapely.union_all([shapely.box(0, 0, 0.3, 0.4), shapely.box(0.65, 0.7, 1, 1)])


@pytest.fixture
def ingest(connection: Connection, storage: Storage, tmp_path: Path) -> Ingest:
    """Publishes a block of points that lie in a box of 0.1 degree as given in the unit square."""

    def run(positions: Array, west: float = 5.2, south: float = 43.2, version: str = "1") -> Block:
        box = (west, south, west + SIDE_DEG, south + SIDE_DEG)
        points = control_points(len(positions), np.random.default_rng(1), box, 2, GSDS_M)
        lon = west + SIDE_DEG * positions[:, 0]
        lat = south + SIDE_DEG * positions[:, 1]
        lon = np.where(lon > 180.0, lon - 360.0, lon)
        points = replace(points, lon_lat_h=np.column_stack([lon, lat, points.lon_lat_h[:, 2]]))
        described = metadata(version=version, box=box, gsds_m=GSDS_M)
        models = {"IMG_00": affine_model(described.extent.mean(axis=0))}
        folder = tmp_path / f"block-{version}"
        write_block(folder, described, points, noise_chips(points), models)
        block = serve_block(connection, storage, folder)
        connection.commit()
        return block

    return run


@pytest.fixture
def outline(client, bearer) -> Callable[[], shapely.Geometry]:
    """The outline of the only block, as the map page gets it."""

    def read() -> shapely.Geometry:
        (feature,) = bearer("read").get("/collections/blocks/items").json()["features"]
        return shapely.from_geojson(json.dumps(feature["geometry"]))

    return read


def in_unit_square(shape: shapely.Geometry, west: float = 5.2, south: float = 43.2) -> shapely.Geometry:
    return shapely.transform(shape, lambda lon_lat: (lon_lat - [west, south]) / SIDE_DEG)


def test_the_outline_of_a_corner_leaves_out_the_ground_that_has_no_points(ingest, outline, bearer):
    positions = spread(CORNER)
    block = ingest(positions)
    drawn = in_unit_square(outline())
    assert isinstance(drawn, shapely.Polygon)
    assert shapely.distance(drawn, shapely.points(positions)).max() <= touching_deg
    assert not shapely.contains_xy(drawn, 0.75, 0.75)
    assert shapely.area(shapely.symmetric_difference(drawn, CORNER)) < 0.15 * CORNER.area
    assert block_extent(block) == pytest.approx((5.2, 43.2, 5.3, 43.3))
    single = bearer("read").get(f"/collections/blocks/items/{block.number}").json()
    assert in_unit_square(shapely.from_geojson(json.dumps(single["geometry"]))).equals(drawn)
    box = f"{5.2 + 0.07},{43.2 + 0.07},{5.2 + 0.08},{43.2 + 0.08}"
    beside = bearer("read").get(f"/collections/blocks/items?bbox={box}").json()
    assert beside["features"] == []


def test_the_extent_of_a_block_holds_its_outline_and_a_tenth_of_a_metre_more_at_most(ingest):
    """Its west is above its east where the outline goes on beyond 180 degrees, and nowhere else."""
    block = ingest(spread(CORNER))
    rng = np.random.default_rng(6)
    for ends in 9 * [(5.2, 5.3), (179.9, 180), (-180, -179.9), (179.95, 180.05), (-180.03, -179.93)]:
        lon, lat = np.array([*ends, *rng.uniform(*ends, 3)]), rng.uniform(-43.2, -43.1, 5)
        outline = np.column_stack([lon, lat])
        west, south, east, north = block_extent(replace(block, outline=outline))
        assert (west > east) == (np.abs(lon).max() > 180.0)
        to_west, to_east = ((side - lon + 180.0) % 360.0 - 180.0 for side in (west, east))
        beyond = np.array([side.min() for side in (-to_west, to_east, lat - south, north - lat)])
        assert (beyond >= -1e-12).all()
        assert (beyond <= 1.01e-6).all()


def test_islands_are_outlined_one_by_one(ingest, outline):
    positions = spread(ISLANDS)
    ingest(positions)
    drawn = in_unit_square(outline())
    assert shapely.get_num_geometries(drawn) == 2
    assert shapely.distance(drawn, shapely.points(positions)).max() <= touching_deg


def test_an_outline_is_that_of_the_points_of_its_own_version(ingest, outline, connection):
    east = shapely.box(0.7, 0.0, 1.0, 1.0)
    first = ingest(spread(shapely.box(0.0, 0.0, 0.3, 1.0)))
    second = ingest(spread(east), version="2")
    at_once = outline()
    drawn = in_unit_square(at_once)
    assert shapely.area(shapely.symmetric_difference(drawn, east)) < 0.3 * east.area
    for block in (first, second):
        ids = {"first": block.number << ID_BITS, "end": (block.number + 1) << ID_BITS}
        connection.execute(text(FILL), {"number": block.number, **ids})
    connection.commit()
    assert outline().equals(at_once)


def test_an_outline_across_180_degrees_is_cut_there(ingest, outline):
    positions = spread(CORNER)
    ingest(positions, 179.95, -17.0)
    drawn = outline()
    west, _, east, _ = drawn.bounds
    assert (west, east) == (-180.0, 180.0)
    lon = shapely.get_coordinates(drawn)[:, 0]
    assert (np.abs(lon) > 179.9).all()
    together = in_unit_square(
        shapely.union_all(
            [
                shapely.transform(part, lambda at: at + [360.0 * (at[:, :1].min() < 0.0), 0.0])
                for part in shapely.get_parts(drawn)
            ]
        ),
        179.95,
        -17.0,
    )
    assert shapely.distance(together, shapely.points(positions)).max() <= touching_deg
    assert not shapely.contains_xy(together, 0.75, 0.75)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_block_of_few_points_has_an_outline_too(ingest, outline, count):
    positions = spread(CORNER, count)
    ingest(positions)
    drawn = in_unit_square(outline())
    assert 0.0 < drawn.area <= 1.0 + touching_deg
    assert shapely.distance(drawn, shapely.points(positions)).max() <= touching_deg


def test_blocks_of_an_earlier_release_get_the_outline_of_their_points(ingest, outline, connection):
    block = ingest(spread(ISLANDS))
    ingested = outline()
    run_sql(connection, "update block set outline = null")
    connection.commit()
    assert in_unit_square(outline()).area == pytest.approx(1.0)
    ids = {"first": block.number << ID_BITS, "end": (block.number + 1) << ID_BITS}
    connection.execute(text(FILL), {"number": block.number, **ids})
    connection.commit()
    assert outline().equals(ingested)
