"""The life of a block in the store, from ingestion to withdrawal, and the points that it serves."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import Geod
from shapely import Polygon

from amers.app.db import points as point_store
from amers.app.db.engine import driver
from amers.app.db.stored_files import find_chip_checksums
from amers.app.errors import Conflict, NotFound
from amers.app.storage import StoredChips
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.listing import list_blocks
from amers.app.usecases.garbage_collection import Bin, remove_unnamed_chips
from amers.services.formats.block.document import rectangle
from amers.services.types import point_chips
from tests.app.served import serve_block
from tests.factories import BOX, make_block

float32_rounding = 1e-6


@pytest.fixture
def ingested(connection, storage, tmp_path):
    """A staged block of 40 points, committed."""
    made = make_block(tmp_path / "block")
    result = lifecycle.ingest_block(connection, storage, made.folder)
    connection.commit()
    return made, result


def visible(connection) -> int:
    connection.commit()
    return len(point_store.control_points(connection, rectangle(*BOX)).points)


def test_an_ingested_block_is_staged_and_invisible(connection, ingested):
    _, result = ingested
    assert result.block.state == "staged"
    assert (result.block.n_points, result.block.n_views) == (40, 240)
    assert visible(connection) == 0
    assert lifecycle.find_block(connection, "calanques").number == result.block.number


def test_publishing_and_withdrawing_flip_all_points_at_once(connection, ingested):
    assert lifecycle.publish_block(connection, "calanques").block.state == "published"
    assert visible(connection) == 40
    assert lifecycle.withdraw_block(connection, "calanques").state == "withdrawn"
    assert visible(connection) == 0
    lifecycle.publish_block(connection, "calanques@1")
    assert visible(connection) == 40


def test_wrong_steps_are_conflicts_that_name_the_state(connection, ingested):
    with pytest.raises(Conflict, match="is staged: it cannot become withdrawn"):
        lifecycle.withdraw_block(connection, "calanques")
    lifecycle.publish_block(connection, "calanques")
    with pytest.raises(Conflict, match="is published: it cannot become published"):
        lifecycle.publish_block(connection, "calanques")


def test_the_same_version_twice_is_a_conflict_and_changes_nothing(connection, storage, ingested):
    made, result = ingested
    with pytest.raises(Conflict, match="calanques version 1 is already in the store"):
        lifecycle.ingest_block(connection, storage, made.folder)
    connection.rollback()
    assert [block.number for block, _ in list_blocks(driver(connection))] == [result.block.number]


def test_publishing_a_new_version_withdraws_the_old_one_in_the_same_step(
    connection, storage, tmp_path, ingested
):
    lifecycle.publish_block(connection, "calanques")
    newer = make_block(tmp_path / "newer", count=25, seed=2, version="2")
    lifecycle.ingest_block(connection, storage, newer.folder)
    assert visible(connection) == 40

    published = lifecycle.publish_block(connection, "calanques@2")

    assert published.superseded is not None
    assert (published.superseded.version, published.superseded.state) == ("1", "withdrawn")
    assert visible(connection) == 25


def test_an_id_of_several_versions_must_be_made_precise(connection, storage, tmp_path, ingested):
    lifecycle.ingest_block(connection, storage, make_block(tmp_path / "two", seed=2, version="2").folder)
    with pytest.raises(Conflict, match="calanques@1, calanques@2"):
        lifecycle.find_block(connection, "calanques")
    assert lifecycle.find_block(connection, "calanques@2").version == "2"
    assert lifecycle.find_block(connection, "1").version == "1"
    with pytest.raises(NotFound):
        lifecycle.find_block(connection, "calanques@3")


def test_an_id_of_several_versions_shows_the_published_one(connection, storage, tmp_path, ingested):
    for version in ("2", "3"):
        folder = make_block(tmp_path / version, seed=int(version), version=version).folder
        lifecycle.ingest_block(connection, storage, folder)
    with pytest.raises(Conflict, match="calanques@1, calanques@2, calanques@3"):
        lifecycle.find_shown_block(connection, "calanques")
    lifecycle.publish_block(connection, "calanques@2")
    assert lifecycle.find_shown_block(connection, "calanques").version == "2"
    assert lifecycle.find_shown_block(connection, "calanques@3").version == "3"


def test_the_store_gives_back_the_points_of_the_block(connection, storage, ingested):
    made, result = ingested
    lifecycle.publish_block(connection, "calanques")

    stored = point_store.control_points(connection, made.metadata.extent)

    points, expected = stored.points, made.points
    assert [(b.id, b.version) for b in stored.blocks] == [("calanques", "1")]
    assert (points.id == result.block.number * 2**26 + expected.id).all()
    assert (points.lon_lat_h == expected.lon_lat_h).all()
    assert_allclose(
        points.covariance_m2, expected.covariance_m2, rtol=float32_rounding, atol=float32_rounding
    )
    assert (points.saliency == expected.saliency).all()
    assert (points.views.start == expected.views.start).all()
    assert (points.views.gsd_m == expected.views.gsd_m).all()
    assert (points.views.image == expected.views.image).all()
    assert_allclose(points.views.azimuth_deg, expected.views.azimuth_deg, rtol=float32_rounding)
    assert repr(points.views.images) == repr(expected.views.images)
    chips = StoredChips(storage, partial(find_chip_checksums, connection))
    for row in range(len(points)):
        assert (point_chips(points, chips, row) == made.chips(row)).all()
    chips.close()


def test_the_store_mixes_blocks_without_mixing_their_images_and_chips(connection, storage, tmp_path):
    made = [
        make_block(tmp_path / "a", count=15, seed=3, name="a", n_images=3),
        make_block(
            tmp_path / "b", count=20, seed=4, name="b", n_images=5, gsds_m=(0.7,), dtype=np.uint16
        ),
    ]
    for block in made:
        serve_block(connection, storage, block.folder)

    points = point_store.control_points(connection, made[0].metadata.extent).points

    assert len(points) == 35
    assert len(points.views.images) == 8
    chips = StoredChips(storage, partial(find_chip_checksums, connection))
    for row in range(35):
        of, own = (made[0], row) if row < 15 else (made[1], row - 15)
        assert (point_chips(points, chips, row) == of.chips(own)).all()
        views = slice(points.views.start[row], points.views.start[row + 1])
        names = [points.views.images[i].image_id for i in points.views.image[views]]
        assert names == [f"IMG_{i:02d}" for i in range(3)] * 2 if row < 15 else names
        assert set(points.views.gsd_m[views]) == ({0.5, 2.0} if row < 15 else {0.7})
    chips.close()


def test_points_are_read_by_outline_and_thinned_evenly(connection, storage, tmp_path):
    made = make_block(tmp_path / "many", count=600)
    serve_block(connection, storage, made.folder)
    triangle = np.array([[BOX[0], BOX[1]], [BOX[2], BOX[1]], [BOX[0], BOX[3]]])
    inside = (made.points.lon_lat_h[:, :2] - [BOX[0], BOX[1]]).sum(axis=1) < 0.1

    stored = point_store.control_points(connection, triangle)
    assert (stored.points.lon_lat_h == made.points.lon_lat_h[inside]).all()

    some = point_store.control_points(connection, made.metadata.extent, limit=60).points
    assert len(some) == 60
    quarter = np.floor((some.lon_lat_h[:, :2] - [BOX[0], BOX[1]]) / 0.05).astype(int) @ [1, 2]
    assert np.bincount(quarter, minlength=4).min() >= 10


def test_no_published_points_is_an_empty_answer(connection, ingested):
    made, _ = ingested
    stored = point_store.control_points(connection, made.metadata.extent)
    assert len(stored.points) == 0
    assert stored.blocks == ()
    assert stored.points.views.start.tolist() == [0]


def test_an_outline_across_the_antimeridian_finds_both_sides(connection, storage, tmp_path):
    made = make_block(tmp_path / "far", count=30, box=(179.9, -17.0, -179.9, -16.9))
    serve_block(connection, storage, made.folder)
    east = point_store.control_points(connection, made.metadata.extent)
    west = point_store.control_points(connection, made.metadata.extent - [360.0, 0.0])
    assert len(east.points) == len(west.points) == 30


def test_quality_figures_are_those_of_the_points(connection, ingested):
    made, result = ingested
    quality = lifecycle.block_report(connection, lifecycle.find_block(connection, "calanques")).quality
    variance = np.diagonal(made.points.covariance_m2, axis1=1, axis2=2)
    assert quality.points == 40
    assert quality.points_per_km2 == pytest.approx(40 / quality.area_km2)
    geodesic_m2, _ = Geod(ellps="WGS84").geometry_area_perimeter(Polygon(made.metadata.extent))
    assert quality.area_km2 == pytest.approx(geodesic_m2 * 1e-6, rel=1e-4)
    assert quality.share_reaching_quarter == 1.0
    assert quality.share_reaching_half == 0.0
    assert quality.views_per_point.minimum == 6
    assert quality.images_per_point.maximum == 3
    assert quality.sigma_up_m.median == pytest.approx(np.median(np.sqrt(variance[:, 2])))
    assert quality.cells.points.sum() == 40
    assert repr(quality) == repr(result.quality)


def test_files_without_rows_are_swept_and_others_stay(connection, storage, tmp_path, ingested):
    orphan = make_block(tmp_path / "orphan", count=3, seed=9).folder / "chips/0000.npy"
    key = storage.put_chips(orphan).key
    assert remove_unnamed_chips(connection, Bin(storage)) == [key]
    assert not storage.exists(key)
    assert len(storage.keys("chips")) == 1
