"""An exported block ingests again as the same points; an export writes outside of transactions."""

import zipfile
from dataclasses import replace
from functools import partial
from typing import Any
from uuid import UUID

import numpy as np
import psycopg
import pytest
from numpy.testing import assert_allclose

from amers.app.db import engine
from amers.app.db import points as point_store
from amers.app.db.stored_files import find_chip_checksums
from amers.app.errors import InputError, NotFound
from amers.app.storage import StoredChips
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.export import EXPORT_BLOCK, ExportBlock, select_points, write_selected
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.processes import Work
from amers.services.formats.block.check import check_block
from amers.services.formats.block.document import rectangle
from amers.services.formats.block.writer import write_block
from amers.services.types import Frame, point_chips
from tests.app.job_queue import claim, claimed, new_job
from tests.app.served import serve_block
from tests.factories import BOX, MadeBlock, control_points, make_block, metadata, noise_chips
from tests.statements import run_sql

COLUMNS = """st_asewkb(geom) as place, sigma_east_m, sigma_north_m, sigma_up_m, corr_east_north,
    corr_east_up, corr_north_up, n_views, saliency, typology, first_view, last_view, chip_count"""
OPEN_TRANSACTIONS = """select count(*) from pg_stat_activity
    where datname = current_database() and pid <> pg_backend_pid() and xact_start is not null"""


@pytest.fixture
def chips(connection, storage):
    chips = StoredChips(storage, partial(find_chip_checksums, connection))
    yield chips
    chips.close()


@pytest.fixture
def publish(connection, storage, tmp_path):
    """Makes a block of some points, and publishes it."""

    def publish(count: int = 5, name: str = "calanques", **of_block: Any) -> MadeBlock:
        made = make_block(tmp_path / name, count, name=name, **of_block)
        serve_block(connection, storage, made.folder)
        connection.commit()
        return made

    return publish


def rows(connection, number: int) -> list:
    points = run_sql(
        connection, f"select {COLUMNS} from point where block_number = %s order by id", [number]
    ).fetchall()
    views = run_sql(
        connection,
        """select v.view, v.gsd_m, v.incidence_deg, v.azimuth_deg, i.image_id, i.sensor, i.acquired_at
           from view v join image i on i.block_number = v.point_id >> 26 and i.image = v.image
           where v.point_id >> 26 = %s order by v.point_id, v.view""",
        [number],
    ).fetchall()
    return [points, views]


def test_a_block_that_is_exported_ingests_again_as_the_same_points_with_the_same_chips(
    connection, storage, chips, tmp_path, publish
):
    made = publish(40)
    first = lifecycle.find_block(connection, "calanques")
    selected = select_points(connection, ExportBlock(BOX, id="copy"))
    written = write_selected(selected, chips, tmp_path / "copy")
    assert written == 40
    second = lifecycle.ingest_block(connection, storage, tmp_path / "copy").block

    assert rows(connection, second.number) == rows(connection, first.number)
    assert (np.load(tmp_path / "copy/chips/0000.npy") == np.load(made.folder / "chips/0000.npy")).all()
    report = lifecycle.block_report(connection, second)
    assert report.accuracy == made.metadata.accuracy
    assert report.quality.points == 40


def test_some_points_of_an_outline_are_spread_evenly_over_all_of_them(connection, publish):
    publish(40)
    everything = point_store.control_points(connection, rectangle(*BOX)).points.id
    for limit in (1, 7, 10, 39, 40, 41, 10_000):
        some = point_store.control_points(connection, rectangle(*BOX), limit).points.id
        assert len(some) == min(limit, len(everything))
        places = np.searchsorted(everything, some)
        steps = np.diff([*places, len(everything)])
        assert set(steps) <= {len(everything) // limit, -(-len(everything) // limit), 1}, limit


def test_a_footprint_over_two_blocks_holds_what_is_served_of_both(connection, publish, chips, tmp_path):
    half = (BOX[0], BOX[1], (BOX[0] + BOX[2]) / 2, BOX[3])
    for name, kind, seed in (("a", np.uint8, 1), ("b", np.uint16, 2)):
        publish(30, name, seed=seed, dtype=kind)
    expected = point_store.control_points(connection, rectangle(*half))

    written = write_selected(select_points(connection, ExportBlock(half)), chips, tmp_path / "out")

    contents = check_block(tmp_path / "out")
    assert written == len(contents.points) == len(expected.points) > 10
    assert contents.document.metadata.provenance.sources == ("a@1", "b@1")
    images = [image.image_id for image in contents.document.images]
    assert len(set(images)) == len(images) == 6
    by_place = {tuple(place): row for row, place in enumerate(expected.points.lon_lat_h)}
    with_chips = np.load(tmp_path / "out/chips/0000.npy")
    assert with_chips.dtype == np.uint16
    for row, place in enumerate(contents.points.lon_lat_h):
        source = by_place[tuple(place)]
        first = int(contents.points.chip_row[row])
        assert (with_chips[first : first + 6] == point_chips(expected.points, chips, source)).all()
        assert_allclose(
            contents.points.covariance_m2[row],
            expected.points.covariance_m2[source],
            rtol=1e-6,
            atol=1e-9,
        )


@pytest.mark.parametrize(
    ("inputs", "error", "named"),
    [
        ({"bbox": (5.0, 44.0, 6.0, 43.0)}, InputError, "bbox"),
        ({"bbox": (5.0, 43.0, 600.0, 44.0)}, InputError, "bbox"),
        ({"bbox": (50.0, 43.0, 51.0, 44.0)}, NotFound, "no points"),
        ({"bbox": BOX, "id": "../x"}, InputError, "cannot name a block"),
        ({"bbox": BOX, "id": "x", "version": ""}, InputError, "cannot name a block"),
    ],
)
def test_an_export_that_cannot_be_is_refused_and_writes_nothing(
    connection, publish, chips, tmp_path, inputs, error, named
):
    publish()
    with pytest.raises(error, match=named):
        write_selected(select_points(connection, ExportBlock(**inputs)), chips, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_as_many_points_as_are_allowed_are_exported_and_not_one_more(connection, publish):
    publish(5)
    assert len(select_points(connection, ExportBlock(BOX), most=5).points) == 5
    with pytest.raises(InputError, match="more than 4 points"):
        select_points(connection, ExportBlock(BOX), most=4)


@pytest.fixture
def side_by_side(connection, storage, tmp_path):
    """Publishes a block `a` in the western half of the box and `b` in the eastern half."""
    west, south, east, north = BOX
    halves = {"a": (west, (west + east) / 2), "b": ((west + east) / 2, east)}

    def publish(stated: dict[str, dict[str, Any]], n_images: dict[str, int]) -> None:
        for name, (first, last) in halves.items():
            box = (first, south, last, north)
            document = replace(metadata(name, box=box), **stated[name])
            contents = control_points(5, np.random.default_rng(7), box, n_images[name])
            write_block(tmp_path / name, document, contents, noise_chips(contents), {})
            serve_block(connection, storage, tmp_path / name)

    return publish


def test_an_export_of_several_blocks_claims_what_all_of_them_do_and_nothing_else(
    connection, side_by_side
):
    """Also of the number of images, which no point has more of than in its own block."""
    west, south, east, north = BOX
    stated = {
        "a": {"license": "CC-BY-4.0", "epoch": 2020.0},
        "b": {"license": "ODbL-1.0", "epoch": 2024.5},
    }
    side_by_side(stated, {"a": 4, "b": 2})
    whole = select_points(connection, ExportBlock(BOX)).metadata
    assert (whole.license, whole.epoch) == ("CC-BY-4.0 AND ODbL-1.0", None)
    assert whole.accuracy == (), "neither states how well its frame is known"
    assert whole.specification.min_views == 2
    western = select_points(connection, ExportBlock((west, south, (west + east) / 2, north))).metadata
    assert (western.license, western.epoch) == ("CC-BY-4.0", 2020.0)
    assert western.accuracy == metadata("a").accuracy
    assert western.specification.min_views == 4


@pytest.mark.parametrize("axes", [(0, 1), (1, 0)])
def test_the_frame_of_an_export_of_several_blocks_is_as_good_as_its_worse_horizontal_axis(
    connection, side_by_side, axes
):
    """Heights are another figure: they may be better or worse than both."""
    variances = {"a": (1.0, 9.0, 100.0), "b": (4.0, 16.0, 0.01)}
    frames = {
        name: {"frame": Frame(np.diag([*np.array(of)[[*axes]], of[2]]))}
        for name, of in variances.items()
    }
    side_by_side(frames, {"a": 3, "b": 3})
    whole = select_points(connection, ExportBlock(BOX)).metadata
    (figure,) = whole.accuracy
    own_m2 = np.diagonal(whole.frame.covariance_m2)
    assert figure.value == pytest.approx(np.sqrt(own_m2[axes.index(1)]))
    assert figure.value > np.sqrt(own_m2[axes.index(0)])
    assert 3.0 < figure.value < 4.0, "between those of the blocks"


def test_no_transaction_is_open_while_an_export_writes_files(publish, database, dsn, settings, storage):
    publish()
    open_transactions = []

    def count_transactions(fraction: float, message: str) -> None:
        if fraction > 0.1:
            with psycopg.connect(dsn, autocommit=True) as watcher:
                open_transactions.append(watcher.execute(OPEN_TRANSACTIONS).fetchone()[0])

    job = claimed(database, new_job(database).id)
    work = Work(job, ExportBlock(BOX), database, storage, settings, count_transactions)
    EXPORT_BLOCK.run(work)
    assert set(open_transactions) == {0}


def test_a_block_is_exported_by_a_job_as_an_archive(settings, publish, bearer, tmp_path):
    publish()
    reader = bearer("read")
    response = reader.execute("export-block", {"bbox": list(BOX)})
    assert response.status_code == 201, response.text
    job_id = UUID(response.json()["jobID"])
    with engine.opened(settings) as database:
        with database.transaction() as own:
            job = claim(own, job_id, "a worker", 30.0)
        do_attempt(database, settings, job_id, job.attempt)
    reply = reader.get(f"/jobs/{job_id}/results/block.zip")
    assert reply.status_code == 200, reply.text
    (tmp_path / "block.zip").write_bytes(reply.content)
    zipfile.ZipFile(tmp_path / "block.zip").extractall(tmp_path / "out")
    assert len(check_block(tmp_path / "out/block").points) == 5
