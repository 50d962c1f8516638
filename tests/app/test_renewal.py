"""A base that renews itself: new views, nothing moved, vanished points out, nothing undecided served."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from amers.app.cli.main import app as amers
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Connection, Database, driver
from amers.app.db.jobs.attempts import LostJob
from amers.app.db.points import points_of_block
from amers.app.db.renewal import find_searches
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.listing import list_blocks
from amers.app.usecases.blocks.renewal import read_base, renew_block, stage_renewal
from amers.app.usecases.blocks.renewing_scenes import scene_of_image
from amers.app.usecases.damage import open_chips
from amers.app.usecases.garbage_collection import Bin, remove_unnamed_chips
from amers.app.usecases.history import suspend_point
from amers.app.usecases.registration.control_sources import points_of_store
from amers.app.usecases.registration.register import (
    ControlSources,
    RegisteredScene,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from amers.services.registration.options import RegistrationOptions
from amers.services.types import Measures, point_chips
from tests.app.callers import Bearer
from tests.app.conftest import stored_files
from tests.app.flat_world import SIGMA_M, publish_world
from tests.app.ledger import job_runner
from tests.app.renewal_world import POINTS, Years, make_years, write_scene
from tests.factories import make_block
from tests.statements import run_sql

pytestmark = pytest.mark.thorough

ALL_POINTS = RegistrationOptions(max_points=0)
DAYS = ("2024-04-10", "2024-07-20", "2024-10-15", "2025-01-15")
"""One in each quarter; the last one is in winter."""


@dataclass(frozen=True)
class Scenes:
    """Scenes of a world in a year.

    Attributes:
        years: the world.
        year: images of every quarter, the last one in winter.
        later: another one in winter, of the next year.
        changed: the point whose ground is a new one in all of them.
        clouded: the point that lies under a cloud in all of them.
    """

    years: Years
    year: list[Path]
    later: Path
    changed: int
    clouded: int


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    folder = tmp_path_factory.mktemp("years")
    years = make_years(folder / "world")
    inside = (np.abs(years.places - 600) < 300).all(axis=1)
    alone_px = cKDTree(years.places).query(years.places, 2)[0][:, 1]
    lonely = np.argsort(-np.where(inside, alone_px, 0.0))
    changed, clouded = int(lonely[0]), int(lonely[1])
    hidden: dict[str, Any] = {"changed": (changed,), "clouded": (clouded,)}
    paths = []
    for day in DAYS:
        ground = years.winter if day == DAYS[-1] else years.world.ground
        paths.append(write_scene(years, folder / f"{day}.tif", ground, day=day, **hidden))
    later = write_scene(years, folder / "later.tif", years.winter, day="2026-01-20", **hidden)
    return Scenes(years, paths, later, changed, clouded)


@pytest.fixture
def command(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Runs `amers …` on the test's store; returns what it prints with --json."""
    assert settings.database_url is not None
    monkeypatch.setenv("AMERS_DATABASE_URL", settings.database_url.get_secret_value())
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))

    def run(*words: object) -> Any:
        result = CliRunner().invoke(amers, [*map(str, words), "--json"])
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    return run


@pytest.fixture
def published(scenes: Scenes, dsn: str, storage: Storage) -> None:
    """The block of the world, served."""
    publish_world(dsn, storage, scenes.years.world)


def registered(database: Database, storage: Storage, image: Path, folder: Path) -> RegisteredScene:
    """A scene registered on the store and recorded, as `amers scene register` does it."""
    sources = ControlSources(points_of_store(database, storage))
    files = SceneFiles(image, sigma_m=SIGMA_M)
    made = run_registration(files, sources, folder / image.stem, options=ALL_POINTS)
    with database.transaction() as connection:
        record_registration(connection, made, image_key(image))
    return made


@pytest.fixture
def year(
    scenes: Scenes, published: None, database: Database, storage: Storage, tmp_path: Path
) -> list[Path]:
    """The images of a year, registered."""
    for image in scenes.year:
        made = registered(database, storage, image, tmp_path / "out")
        assert made.report.verdict == "good", made.report.verdict
    return scenes.year


def of_block(dsn: str, number: int) -> Any:
    with engine.connect(dsn) as connection:
        return points_of_block(connection, number).points


def mean_score(measures: Measures, ids: Any) -> float:
    """Mean score over some points of those that were found."""
    return float(np.nanmean(measures.score[measures.active & np.isin(measures.point_id, ids)]))


def served(client: TestClient, reader: dict[str, str]) -> Any:
    """All that a reader sees of the points, and the blocks."""
    points = client.get("/collections/points/items?limit=1000", headers=reader).json()["features"]
    return points, client.get("/collections", headers=reader).json()


def test_a_later_scene_of_the_season_matches_better_and_nothing_has_moved(
    scenes: Scenes,
    year: list[Path],
    database: Database,
    storage: Storage,
    dsn: str,
    client: TestClient,
    bearer: Bearer,
    command: Callable[..., Any],
    tmp_path: Path,
) -> None:
    reader = bearer("read")
    before = registered(database, storage, scenes.later, tmp_path / "before").registration.measures
    seen_before = served(client, reader)
    old = of_block(dsn, 1)

    made = command("block", "renew", "flat", "--image", year[-1], "--image", year[1])
    assert (made["id"], made["version"], made["state"]) == ("flat", "2", "staged")
    assert served(client, reader) == seen_before
    shown = command("block", "show", "flat@2")["renewal"]
    assert shown == made["renewal"]
    assert shown["renews"] == "flat@1"
    assert [one["image"] for one in shown["scenes"]] == [DAYS[-1], DAYS[1]]

    withdrawn = [one["point"] - (1 << 26) for one in shown["proposed_withdrawals"]]
    assert withdrawn == [scenes.changed]
    evidence = shown["proposed_withdrawals"][0]
    assert evidence["scenes_that_missed_it"] == 5
    assert evidence["last_found"] is None
    assert evidence["probability_if_still_there"] < 1e-3

    new = of_block(dsn, made["number"])
    assert len(new) == made["points"] == POINTS - 1
    row_at = {place.tobytes(): row for row, place in enumerate(old.lon_lat_h)}
    rows = np.array([row_at[place.tobytes()] for place in new.lon_lat_h])
    assert set(range(POINTS)) - set(rows.tolist()) == {scenes.changed}
    assert (new.covariance_m2 == old.covariance_m2[rows]).all()
    assert (new.saliency == old.saliency[rows]).all()
    assert len(new.views.gsd_m) - shown["new_views"] == len(old.views.gsd_m) - 4
    chips = open_chips(database, storage)
    for row in range(0, len(new), 7):
        is_old = new.views.image[new.views.start[row] : new.views.start[row + 1]] < 2
        kept = point_chips(new, chips, row)
        assert (kept[is_old] == point_chips(old, chips, int(rows[row]))).all()
    chips.close()

    command("block", "publish", "flat@2")
    after = registered(database, storage, scenes.later, tmp_path / "after").registration.measures
    in_winter = (new.views.image == 2) & (new.views.gsd_m == 0.5)
    has_winter = np.unique(np.repeat(np.arange(len(new)), np.diff(new.views.start))[in_winter])
    assert len(has_winter) > 0.75 * POINTS
    score_before = mean_score(before, old.id[rows[has_winter]])
    score_after = mean_score(after, new.id[has_winter])
    assert score_before < 0.8
    assert score_after > score_before + 0.15
    assert after.matched.sum() > before.matched.sum()


def test_evidence_of_older_versions_is_not_lost(
    scenes: Scenes,
    published: None,
    database: Database,
    storage: Storage,
    command: Callable[..., Any],
    tmp_path: Path,
) -> None:
    """Two scenes before a renewal and two after it tell only together that a point has vanished."""
    for version, images in (("1", scenes.year[:2]), ("2", scenes.year[2:])):
        for image in images:
            registered(database, storage, image, tmp_path / "out")
        made = command("block", "renew", "flat", "--image", images[-1])
        withdrawals = [one["lon_lat_h"] for one in made["renewal"]["proposed_withdrawals"]]
        if version == "1":
            assert withdrawals == []
        command("block", "publish", f"flat@{made['version']}")
    model = scenes.years.world.true_model
    assert len(withdrawals) == 1
    place = model.project(np.array(withdrawals))[0]
    assert np.abs(place - scenes.years.places[scenes.changed]).max() < 1.0


def test_a_scene_that_is_registered_again_searches_each_point_once(
    scenes: Scenes, published: None, database: Database, storage: Storage, tmp_path: Path
) -> None:
    """What a scene missed twice is no more evidence than what it missed once."""
    made = registered(database, storage, scenes.year[0], tmp_path / "out")
    with database.transaction() as connection:
        record_registration(connection, made, image_key(scenes.year[0]))
    with database.reading() as connection:
        stored = find_searches(connection, "flat", [])
    assert stored.days.tolist() == [date.fromisoformat(DAYS[0])]
    assert len(np.unique(stored.lon_lat_h, axis=0)) == len(stored.lon_lat_h) > 0
    assert stored.found.sum() == made.registration.measures.active.sum()


def refused(words: list[object]) -> str:
    result = CliRunner().invoke(amers, [*map(str, words)])
    assert result.exit_code != 0, result.output
    return str(result.exception) + result.output


def test_scenes_that_cannot_renew_a_block_are_refused_by_name(
    scenes: Scenes,
    published: None,
    database: Database,
    storage: Storage,
    connection: Connection,
    command: Callable[..., Any],
    tmp_path: Path,
) -> None:
    other = make_block(tmp_path / "other", name="other").folder
    lifecycle.publish_block(
        connection, str(lifecycle.ingest_block(connection, storage, other).block.number)
    )
    connection.commit()
    image, unknown = scenes.year[0], scenes.year[1]
    registered(database, storage, image, tmp_path / "out")
    renew = ["block", "renew"]

    assert f"{unknown}: no registration" in refused([*renew, "flat", "--image", unknown])
    assert "nowhere.tif: no such file" in refused([*renew, "flat", "--image", "nowhere.tif"])
    message = refused([*renew, "other", "--image", image])
    assert f"{image}: was registered on flat@1, and block other is to be renewed" in message
    assert "no scene given" in refused([*renew, "flat"])
    assert "flat@1 is already in the store" in refused(
        [*renew, "flat", "--image", image, "--version", "1"]
    )
    for verdict in ("usable", "failed"):
        run_sql(connection, "update registration set verdict = %s", [verdict])
        connection.commit()
        message = refused([*renew, "flat", "--image", image])
        assert f"{image}: the verdict on its registration is '{verdict}'" in message
    run_sql(connection, "update registration set verdict = 'good'")
    connection.commit()
    twice = refused([*renew, "flat", "--image", image, "--image", image])
    assert f"{image.name}: the block has views of an image {image.stem} already" in twice
    assert {block.id: block.state for block, _ in list_blocks(driver(connection))} == {
        "flat": "published",
        "other": "published",
    }
    command("block", "renew", "flat", "--image", image)
    command("block", "publish", "flat@2")
    again = refused([*renew, "flat", "--image", image])
    assert f"{image.name}: the block has views of an image {image.stem} already" in again


def test_a_suspended_point_does_not_come_back(
    scenes: Scenes,
    published: None,
    database: Database,
    storage: Storage,
    connection: Connection,
    command: Callable[..., Any],
    tmp_path: Path,
) -> None:
    registered(database, storage, scenes.year[0], tmp_path / "out")
    suspended = (1 << 26) + 5
    suspend_point(connection, suspended, "a roundabout was built there")
    connection.commit()
    place = points_of_block(connection, 1).points.lon_lat_h[5]
    made = command("block", "renew", "flat", "--image", scenes.year[0])
    assert made["renewal"]["suspended_points_left_out"] == [suspended]
    assert made["points"] == POINTS - 1
    renewed = points_of_block(connection, made["number"]).points
    assert not (renewed.lon_lat_h == place).all(axis=1).any()


def test_an_interrupted_renewal_leaves_nothing(
    scenes: Scenes,
    published: None,
    database: Database,
    storage: Storage,
    connection: Connection,
    tmp_path: Path,
) -> None:
    registered(database, storage, scenes.year[0], tmp_path / "out")
    files_before = set(stored_files(storage))
    with database.snapshot() as snapshot:
        base = read_base(snapshot, "flat")
        one = scene_of_image(snapshot, base.block, scenes.year[0])

    def interrupted_at(step: str) -> Callable[[float, str], None]:
        def progress(fraction: float, message: str) -> None:
            if message.startswith(step):
                raise LostJob(step)

        return progress

    work = tmp_path / "work"
    work.mkdir()
    for step in ("registering", "qualifying", "looking for vanished", "writing chips"):
        with pytest.raises(LostJob, match=step):
            renew_block(database, storage, base, [one], work / "block", progress=interrupted_at(step))
        assert list(work.iterdir()) == []
    renew_block(database, storage, base, [one], work / "block")
    for step in ("storing chips", "loading images", "loading rows"):
        with pytest.raises(LostJob, match=step), database.transaction() as transaction:
            stage_renewal(transaction, storage, base, work / "block", interrupted_at(step))
    assert [block.version for block, _ in list_blocks(driver(connection))] == ["1"]
    connection.commit()
    remove_unnamed_chips(connection, Bin(storage, limited=False))
    assert set(stored_files(storage)) == files_before


def test_an_administrator_renews_a_block_by_a_job(
    scenes: Scenes,
    published: None,
    client: TestClient,
    bearer: Bearer,
    database: Database,
    settings: Settings,
    storage: Storage,
    dsn: str,
) -> None:
    admin, me = bearer("admin"), bearer("register")
    assert admin.patch("/blocks/flat", json={"priority": 3}).status_code == 200
    register = job_runner(client, database, settings, me)
    image = scenes.year[0]
    name = f"/scenes?name={image.name}&sigma_m={SIGMA_M}"
    scene = me.post(name, content=image.read_bytes()).json()["id"]
    few = register("register-scene", scene=scene, options={"max_points": 90})
    assert few["status"] == "successful", few
    execution = "/processes/renew-block/execution"
    body: dict[str, Any] = {"inputs": {"block": "flat", "jobs": [few["jobID"]]}}
    assert me.post(execution, json=body).status_code == 403
    for wrong, status in (
        ({"block": "none"}, 404),
        ({"jobs": []}, 422),
        ({"jobs": [few["jobID"], few["jobID"]]}, 422),
        ({"jobs": [scene]}, 404),
        ({"version": "1"}, 409),
    ):
        reply = admin.post(execution, json={"inputs": {**body["inputs"], **wrong}})
        assert reply.status_code == status, reply.text
    renew = job_runner(client, database, settings, admin)
    job = renew("renew-block", **body["inputs"])
    assert job["status"] == "successful", job
    results = admin.get(f"/jobs/{job['jobID']}/results").json()
    assert (results["id"], results["version"], results["state"]) == ("flat", "2", "staged")
    with database.reading() as connection:
        assert [block.priority for block, _ in list_blocks(driver(connection))] == [3, 3]
    document = admin.get(results["renewal.json"]["href"]).json()
    assert document["new_views"] == results["new_views"]
    # All points get views, not only the ninety that the registration tried.
    assert document["points_with_new_views"] > 0.85 * POINTS
    of_itself = admin.post(execution, json={"inputs": {"block": "flat", "jobs": [job["jobID"]]}})
    assert of_itself.status_code == 422
    assert f"job {job['jobID']}: is of the process renew-block" in of_itself.json()["detail"]
