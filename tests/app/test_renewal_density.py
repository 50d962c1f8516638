"""A renewal fills a hole of a block from scenes that were registered on it; the other points stay."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from amers.app.cli.main import app as amers
from amers.app.config import Settings
from amers.app.db import blocks, engine
from amers.app.db.engine import Database
from amers.app.db.points import points_of_block
from amers.app.storage import Storage
from amers.services.formats.block.document_json import parse_block_json
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import write_raster
from amers.services.geodesy import east_north_up
from amers.services.types import Array, ControlPoints, point_chips
from tests.app.callers import Bearer
from tests.app.ledger import job_runner
from tests.app.served import serve_block
from tests.factories import metadata
from tests.services.block_with_hole import HOLE_M, PER_KM2, SIGMA_M, older, simulated

pytestmark = [pytest.mark.long, pytest.mark.thorough]

VIEWS = 2


def publish_block_with_hole(dsn: str, storage: Storage, folder: Path) -> Array:
    """Publish the block; returns its outline."""
    _, block, outline = older()
    stated = metadata("holed", "1", gsds_m=tuple(np.unique(block.points.views.gsd_m).tolist()))
    specification = replace(stated.specification, points_per_km2=PER_KM2)
    write_block(
        folder,
        replace(stated, extent=outline, specification=specification, frame=block.points.frames[0]),
        block.points,
        lambda row: point_chips(block.points, block.chips, row),
        {},
    )
    with engine.connect(dsn) as connection:
        serve_block(connection, storage, folder)
    return outline


def of_version(database: Database, version: str) -> tuple[ControlPoints, Array]:
    """The points of a version of the block, and what they share by its document."""
    with database.reading() as connection:
        number = next(
            one.number for one in blocks.find_blocks(connection, "holed") if one.version == version
        )
        document = parse_block_json(blocks.find_document(connection, number))
        return points_of_block(connection, number).points, document.metadata.frame.shared_m2


@dataclass(frozen=True)
class Holed:
    """A published block with a hole, and scenes registered on it by jobs.

    Attributes:
        outline: of the block.
        run: runs a process to its end as an administrator.
        headers: of the administrator.
        jobs: that registered the scenes.
    """

    outline: Array
    run: Callable[..., Any]
    headers: dict[str, str]
    jobs: list[str]


@pytest.fixture
def holed(
    dsn: str,
    client: TestClient,
    bearer: Bearer,
    database: Database,
    settings: Settings,
    storage: Storage,
    tmp_path: Path,
) -> Holed:
    outline = publish_block_with_hole(dsn, storage, tmp_path / "holed")
    admin = bearer("admin")
    run = job_runner(client, database, settings, admin)
    jobs = []
    for number, view in enumerate(simulated(21, SIGMA_M)[:VIEWS]):
        image = tmp_path / f"later_{number}.tif"
        write_raster(image, view.pixels, view.geometry.delivered)
        address = f"/scenes?name={image.name}&sigma_m={SIGMA_M}"
        scene = admin.post(address, content=image.read_bytes()).json()["id"]
        registered = run("register-scene", scene=scene, options={"max_points": 0})
        assert registered["status"] == "successful", registered
        jobs.append(registered["jobID"])
    return Holed(outline, run, admin, jobs)


def test_a_renewal_fills_the_hole_of_a_block(
    holed: Holed, client: TestClient, database: Database
) -> None:
    renewed = holed.run("renew-block", block="holed", jobs=holed.jobs)
    assert renewed["status"] == "successful", renewed
    results = client.get(f"/jobs/{renewed['jobID']}/results", headers=holed.headers).json()
    page = client.get(results["renewal.json"]["href"], headers=holed.headers)
    document: dict[str, Any] = page.json()
    assert "shown by two scenes" in document["new_points_note"]
    assert document["proposed_withdrawals"] == []

    (old, nothing), (new, shared_m2) = of_version(database, "1"), of_version(database, "2")
    assert results["new_points"] == document["new_points"] == len(new) - len(old) >= 6
    kept = {place.tobytes(): row for row, place in enumerate(old.lon_lat_h)}
    old_row = np.array([kept.get(place.tobytes(), -1) for place in new.lon_lat_h])
    is_new = old_row < 0
    assert is_new.sum() == document["new_points"]
    assert (new.covariance_m2[~is_new] == old.covariance_m2[old_row[~is_new]]).all()
    enu = east_north_up(new.lon_lat_h[is_new], np.array([*holed.outline.mean(axis=0), 0.0]))
    assert (np.abs(enu[:, :2]) < HOLE_M).all(axis=1).sum() >= 6
    of_view = np.repeat(np.arange(len(new)), np.diff(new.views.start))
    names = np.array([image.image_id for image in new.views.images])[new.views.image]
    assert set(names[is_new[of_view]].tolist()) == {f"later_{number}" for number in range(VIEWS)}
    # What the new points share is stated, and a part of what each of them declares.
    assert not nothing.any()
    assert np.linalg.eigvalsh(shared_m2).min() > 0.0
    own_m2 = new.covariance_m2[is_new] - shared_m2
    assert np.median(np.linalg.eigvalsh(own_m2)[:, 0]) > 0.0


@pytest.mark.endurance
def test_the_command_adds_the_points_that_the_job_adds(
    holed: Holed, database: Database, dsn: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    renewed = holed.run("renew-block", block="holed", jobs=holed.jobs)
    assert renewed["status"] == "successful", renewed
    monkeypatch.setenv("AMERS_DATABASE_URL", dsn)
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))
    words = ["block", "renew", "holed", "--version", "by-command"]
    words += [word for job in holed.jobs for word in ("--job", job)]
    printed = CliRunner().invoke(amers, words)
    assert printed.exit_code == 0, printed.output
    (by_job, _), (by_command, _) = of_version(database, "2"), of_version(database, "by-command")
    assert len(by_job) > len(of_version(database, "1")[0])
    np.testing.assert_array_equal(by_command.lon_lat_h, by_job.lon_lat_h)
    np.testing.assert_array_equal(by_command.covariance_m2, by_job.covariance_m2)
