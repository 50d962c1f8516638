"""Histories of points and views: recorded by registrations, and used for health and suspensions."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from amers.app.cli.main import app as amers
from amers.app.config import Settings
from amers.app.db import engine, history
from amers.app.db.engine import Connection, Database
from amers.app.db.history import NOT_ATTRIBUTABLE
from amers.app.db.jobs import attempts
from amers.app.db.jobs.attempts import LostJob
from amers.app.errors import Conflict, InputError, NotFound
from amers.app.storage import Storage
from amers.app.usecases.history import (
    find_history,
    list_histories,
    record_measures,
    reinstate_point,
    suspend_point,
)
from amers.app.usecases.registration.control_sources import points_of_block, points_of_store
from amers.app.usecases.registration.register import (
    ControlSources,
    RegisteredScene,
    SceneFiles,
    run_registration,
)
from amers.services.formats.block.check import check_block
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.types import health
from tests.app.callers import Bearer
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world
from tests.app.job_queue import claim, requested, store_registration
from tests.app.served import serve_block
from tests.statements import run_sql

VANISHED = 5
"""Number of points, of 40, whose ground is different in the scene."""
OPTIONS = RegistrationOptions(max_points=0)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block and a scene whose ground differs at five of the points."""
    made = make_flat_world(tmp_path_factory.mktemp("world"))
    points = check_block(made.block).points
    rng = np.random.default_rng(8)
    with rasterio.open(made.tagged, "r+") as file:
        pixels = file.read(1)
        for line, sample in made.true_model.project(points.lon_lat_h[:VANISHED]).round().astype(int):
            new = cv2.GaussianBlur(rng.normal(size=(71, 71)), (0, 0), 2.0)
            pixels[line - 35 : line + 36, sample - 35 : sample + 36] = 1500.0 + 300.0 * new / new.std()
        file.write(pixels, 1)
    return made


@pytest.fixture(scope="module")
def registered(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> RegisteredScene:
    """The scene registered on all points of the block, with the ids of the block."""
    files = SceneFiles(world.tagged, sigma_m=SIGMA_M)
    return run_registration(
        files,
        ControlSources(points_of_block(world.block)),
        tmp_path_factory.mktemp("out"),
        options=OPTIONS,
    )


@pytest.fixture
def database(dsn: str, settings: Settings) -> Iterator[Database]:
    """The database of the test with its pools."""
    with engine.pooled(dsn, settings) as database:
        yield database


@pytest.fixture
def first_id(world: FlatWorld, connection: Connection, storage: Storage) -> int:
    """The id in the store of the first point of the published block."""
    block = serve_block(connection, storage, world.block)
    connection.commit()
    return block.number << 26


@pytest.fixture
def stored(registered: RegisteredScene, first_id: int) -> Registration:
    """The registration with the ids of the points in the store."""
    measures = registered.registration.measures
    measures = replace(measures, point_id=measures.point_id + first_id)
    return replace(registered.registration, measures=measures)


def remembered(connection: Connection, registration: Registration, scene: str) -> None:
    """Record a registration of a scene of this name."""
    registration_id = store_registration(connection, verdict=registration.qualification.verdict)
    record_measures(connection, registration_id, registration, scene)


def failing(registration: Registration, verdict: str = "failed") -> Registration:
    """The same registration with the verdict "failed"."""
    return replace(registration, qualification=replace(registration.qualification, verdict=verdict))


def counters(connection: Connection) -> dict[int, tuple[int, int]]:
    """Attempts and successes of every point that has a history."""
    rows = run_sql(connection, "select point_id, attempts, successes from point_history").fetchall()
    return {row["point_id"]: (row["attempts"], row["successes"]) for row in rows}


def test_the_world_is_as_the_tests_need_it(registered: RegisteredScene) -> None:
    measures = registered.registration.measures
    assert registered.registration.qualification.verdict in ("good", "usable")
    assert len(measures.point_id) == 40
    assert not measures.active[measures.point_id < VANISHED].any()
    assert measures.active[measures.point_id >= VANISHED].mean() > 0.7


def test_every_point_and_view_that_was_tried_leaves_a_row(
    connection: Connection, stored: Registration
) -> None:
    remembered(connection, stored, "a")
    measures, views = stored.measures, stored.views
    rows = run_sql(connection, "select * from measure order by point_id").fetchall()
    assert [row["point_id"] for row in rows] == measures.point_id.tolist()
    assert [row["active"] for row in rows] == measures.active.tolist()
    assert [row["reason"] for row in rows] == measures.reason.tolist()
    lines = np.array([row["line"] for row in rows], dtype=float)
    np.testing.assert_array_equal(lines, measures.line_sample[:, 0])
    east = np.array([row["residual_east_m"] for row in rows], dtype=float)
    np.testing.assert_allclose(east, measures.residual_m[:, 0], rtol=1e-6)
    rows = run_sql(connection, "select * from view_measure order by point_id, view").fetchall()
    assert [row["point_id"] for row in rows] == measures.point_id[views.point].tolist()
    assert [row["view"] for row in rows] == views.view.tolist()
    assert [row["agreed"] for row in rows] == views.agreed.tolist()
    assert {row["registration_id"] for row in rows} == {rows[0]["registration_id"]}


def test_each_figure_of_a_measure_is_kept_as_it_is(connection: Connection, stored: Registration) -> None:
    """Figures that differ from each other everywhere, some of them unknown."""
    rng = np.random.default_rng(4)
    count, n_views = len(stored.measures.point_id), len(stored.views.point)
    measures = replace(
        stored.measures,
        line_sample=rng.uniform(0.0, 4e4, (count, 2)),
        sigma_px=rng.uniform(0.0, 1.0, count),
        score=rng.uniform(0.0, 1.0, count),
        residual_px=rng.normal(0.0, 1.0, (count, 2)),
        residual_m=rng.normal(0.0, 1.0, (count, 2)),
    )
    for unknown in (measures.line_sample, measures.residual_px, measures.residual_m):
        unknown[3] = np.nan
    views = replace(stored.views, score=rng.uniform(0.0, 1.0, n_views))
    remembered(connection, replace(stored, measures=measures, views=views), "a")
    names = "line sample sigma_px score residual_line_px residual_sample_px"
    columns = f"{names} residual_east_m residual_north_m".split()
    rows = run_sql(connection, "select * from measure order by point_id").fetchall()
    kept = np.array([[row[name] for name in columns] for row in rows], dtype=float)
    given = (
        *measures.line_sample.T,
        measures.sigma_px,
        measures.score,
        *measures.residual_px.T,
        *measures.residual_m.T,
    )
    np.testing.assert_allclose(kept, np.column_stack(given), rtol=1e-6)
    rows = run_sql(connection, "select * from view_measure order by point_id, view").fetchall()
    np.testing.assert_allclose([row["score"] for row in rows], views.score, rtol=1e-6)
    assert [row["reason"] for row in rows] == views.reason.tolist()


def test_what_a_history_states_of_a_point_is_the_mean_over_its_matches(
    connection: Connection, stored: Registration
) -> None:
    rng, count = np.random.default_rng(5), len(stored.measures.point_id)
    scenes = []
    for scene in ("a", "b", "c"):
        scenes.append(
            replace(
                stored.measures,
                residual_px=rng.normal(2.0, 1.0, (count, 2)),
                residual_m=rng.normal(2.0, 1.0, (count, 2)),
                matched=stored.measures.active & (rng.uniform(size=count) < 0.7),
            )
        )
        scenes[-1].residual_px[~scenes[-1].matched] = np.nan
        scenes[-1].residual_m[~scenes[-1].matched] = np.nan
        remembered(connection, replace(stored, measures=scenes[-1]), scene)
    n_matched = np.sum([one.matched for one in scenes], axis=0)
    assert set(n_matched.tolist()) >= {0, 1, 2}
    for row, point_id in enumerate(stored.measures.point_id.tolist()):
        history_of_point = find_history(connection, point_id)
        means = [
            history_of_point.mean_residual_px,
            history_of_point.mean_east_m,
            history_of_point.mean_north_m,
        ]
        if not n_matched[row]:
            assert means == [None, None, None]
            continue
        figures = [
            [np.hypot(*one.residual_px[row]), *one.residual_m[row]] for one in scenes if one.matched[row]
        ]
        np.testing.assert_allclose(np.array(means, float), np.mean(figures, axis=0), rtol=1e-5)


def tried(connection: Connection, point_id: int, attempts: int, successes: int, expected: float) -> None:
    """Give a point these sums."""
    run_sql(
        connection,
        "insert into point_history (point_id, attempts, successes, expected) values (%s, %s, %s, %s)",
        [point_id, attempts, successes, expected],
    )


def test_a_point_is_proposed_after_six_failures_where_others_serve_or_twelve_where_half_do(
    connection: Connection, first_id: int
) -> None:
    scenes = [(5, 1.0), (6, 1.0), (10, 0.5), (12, 0.5)]
    for row, (failures, share) in enumerate(scenes):
        tried(connection, first_id + row, failures, 0, failures * share)
    states = [find_history(connection, first_id + row).state for row in range(len(scenes))]
    assert states == ["served", "proposed", "served", "proposed"]
    assert find_history(connection, first_id).health == pytest.approx(0.5)


def test_the_worst_points_are_listed_first_and_of_equal_ones_those_tried_most(
    connection: Connection, first_id: int
) -> None:
    rows = {0: (20, 9.0), 1: (9, 9.0), 2: (7, 7.0), 3: (20, 9.0), 4: (30, 20.0)}
    for row, (failures, expected) in rows.items():
        tried(connection, first_id + row, failures, 0, expected)
    listed = [point.id - first_id for point in list_histories(connection, "proposed")]
    assert listed == [4, 0, 3, 1, 2]
    assert [point.id - first_id for point in list_histories(connection, "proposed", 2)] == listed[:2]


def test_each_point_that_was_tried_is_listed_in_one_state(connection: Connection, first_id: int) -> None:
    for row, expected in enumerate((3.0, 9.0, 2.0, 12.0)):
        tried(connection, first_id + row, 12, 0, expected)
    suspend_point(connection, first_id + 3, "a house was built")

    def listed(state: str) -> list[int]:
        points = list_histories(connection, state)
        assert {point.state for point in points} == {state}
        return [point.id - first_id for point in points]

    assert [listed(state) for state in history.STATES] == [[0, 2], [1], [3]]


def test_a_point_without_any_history_is_served_in_full_health(
    connection: Connection, first_id: int
) -> None:
    untried = find_history(connection, first_id)
    assert (untried.state, untried.health, untried.attempts) == ("served", 1.0, 0)
    assert (untried.successes, untried.expected, untried.last_attempt) == (0, 0.0, None)


@pytest.mark.parametrize("point_id", [1, -1, 2**63 - 1, 2**63, -(2**63) - 1, 10**30])
def test_a_number_that_is_no_point_has_no_history(connection: Connection, point_id: int) -> None:
    with pytest.raises(NotFound, match=f"no point {point_id}:"):
        find_history(connection, point_id)


def test_a_reinstated_point_has_no_reason_and_begins_again(
    connection: Connection, first_id: int
) -> None:
    tried(connection, first_id, 9, 0, 9.0)
    suspend_point(connection, first_id, "  a house was built  ")
    suspended = find_history(connection, first_id)
    assert (suspended.suspended_because, suspended.attempts) == ("a house was built", 9)
    back = reinstate_point(connection, first_id)
    assert (back.state, back.suspended_at, back.suspended_because) == ("served", None, None)
    assert (back.attempts, back.health) == (0, 1.0)
    with pytest.raises(Conflict, match="is not suspended"):
        reinstate_point(connection, first_id)


def test_the_history_of_a_point_is_the_sum_of_its_rows(
    connection: Connection, stored: Registration
) -> None:
    for scene in ("a", "b", "c"):
        remembered(connection, stored, scene)
    kept = run_sql(connection, "select * from point_history order by point_id").fetchall()
    summed = run_sql(
        connection,
        """select point_id, count(*) as attempts, count(*) filter (where active) as successes,
               avg(residual_east_m) filter (where matched) as east
           from measure group by point_id order by point_id""",
    ).fetchall()
    for ours, theirs in zip(kept, summed, strict=True):
        assert (ours["point_id"], ours["attempts"], ours["successes"]) == (
            theirs["point_id"],
            theirs["attempts"],
            theirs["successes"],
        )
        if theirs["east"] is not None:
            assert ours["sum_east_m"] / ours["matched"] == pytest.approx(theirs["east"], rel=1e-5)
    share = stored.measures.active.mean()
    np.testing.assert_allclose([row["expected"] for row in kept], 3 * share, rtol=1e-12)


def test_a_point_that_fails_keeps_the_time_when_it_last_served(
    connection: Connection, stored: Registration
) -> None:
    remembered(connection, stored, "a")
    connection.commit()
    times = "select last_attempt, last_success from point_history where point_id = %s"
    point = int(stored.measures.point_id[stored.measures.active][0])
    served = run_sql(connection, times, [point]).fetchone()
    assert served["last_success"] == served["last_attempt"]
    missed = replace(
        stored.measures, active=stored.measures.active & (stored.measures.point_id != point)
    )
    remembered(connection, replace(stored, measures=missed), "b")
    failed = run_sql(connection, times, [point]).fetchone()
    assert failed["last_success"] == served["last_success"] < failed["last_attempt"]


def test_a_scene_counts_once_however_often_it_is_registered(
    connection: Connection, stored: Registration
) -> None:
    remembered(connection, stored, "a")
    once = counters(connection)
    remembered(connection, stored, "a")
    assert counters(connection) == once
    remembered(connection, stored, "b")
    assert {tries for tries, _ in counters(connection).values()} == {2}


def test_a_failed_registration_is_stored_and_does_not_count(
    connection: Connection, stored: Registration
) -> None:
    remembered(connection, failing(stored), "a")
    assert counters(connection) == {}
    kept = run_sql(connection, "select count(*) as n from measure").fetchone()
    assert kept == {"n": 40}
    remembered(connection, stored, "a")
    assert len(counters(connection)) == 40


def test_an_attempt_that_has_lost_its_job_counts_nothing(
    connection: Connection, database: Database, stored: Registration
) -> None:
    job = requested(connection, "register-scene", {})
    for attempt in (1, 2):
        assert claim(connection, job.id, "a worker", 30.0)
        if attempt == 1:
            attempts.try_again(connection, job.id, 1, 0.0)
    connection.commit()

    def end(attempt: int) -> None:
        with database.transaction() as own:
            remembered(own, stored, "a")
            attempts.succeed(own, job.id, attempt, {})

    with pytest.raises(LostJob):
        end(1)
    assert counters(connection) == {}
    end(2)
    with pytest.raises(LostJob):
        end(2)
    assert {tries for tries, _ in counters(connection).values()} == {1}


def test_ground_that_a_scene_does_not_show_is_no_failure_of_a_point(
    connection: Connection, stored: Registration
) -> None:
    reason = stored.measures.reason.copy()
    reason[:5] = "nodata", "saturated", "cloud", "no_chip", "not_tried"
    hidden = replace(stored, measures=replace(stored.measures, reason=reason))
    remembered(connection, hidden, "a")
    assert set(counters(connection)) == set(stored.measures.point_id[5:].tolist())


def test_a_view_counts_only_where_its_expected_position_is_known(
    connection: Connection, stored: Registration
) -> None:
    remembered(connection, stored, "a")
    active = set(stored.measures.point_id[stored.measures.active].tolist())
    rows = run_sql(connection, "select * from view_history").fetchall()
    assert {row["point_id"] for row in rows} == active
    agreed = {
        (int(stored.measures.point_id[point]), int(view)): bool(agreed)
        for point, view, agreed in zip(
            stored.views.point, stored.views.view, stored.views.agreed, strict=True
        )
    }
    for row in rows:
        assert row["successes"] == agreed[row["point_id"], row["view"]]


def test_views_of_several_scenes_add_up_without_those_that_a_scene_does_not_show(
    connection: Connection, stored: Registration
) -> None:
    reason = stored.views.reason.copy()
    active = stored.measures.active[stored.views.point]
    hidden = np.flatnonzero(active)[: len(NOT_ATTRIBUTABLE)]
    reason[hidden] = NOT_ATTRIBUTABLE
    remembered(connection, replace(stored, views=replace(stored.views, reason=reason)), "a")
    remembered(connection, stored, "b")
    expected = {
        (int(stored.measures.point_id[stored.views.point[row]]), int(stored.views.view[row])): (
            1 if row in hidden else 2,
            int(stored.views.agreed[row]) * (1 if row in hidden else 2),
        )
        for row in np.flatnonzero(active)
    }
    rows = run_sql(connection, "select * from view_history").fetchall()
    assert {
        (row["point_id"], row["view"]): (row["attempts"], row["successes"]) for row in rows
    } == expected


def test_the_health_of_points_and_views_is_read_with_them(
    connection: Connection, database: Database, storage: Storage, stored: Registration, first_id: int
) -> None:
    outline = np.array([[5.2, 43.2], [5.3, 43.2], [5.3, 43.3], [5.2, 43.3]])
    fresh = points_of_store(database, storage)(outline).points
    assert (fresh.health == 1.0).all()
    assert (fresh.views.health == 1.0).all()
    for scene in ("a", "b"):
        remembered(connection, stored, scene)
    run_sql(
        connection,
        "update view_history set successes = 0 where point_id = %s and view = 1",
        [first_id + 30],
    )
    connection.commit()
    read = points_of_store(database, storage)(outline).points
    share = stored.measures.active.mean()
    expected = np.where(stored.measures.active, 1.0, health(2 * share * np.ones(40), np.zeros(40)))
    np.testing.assert_allclose(read.health, expected)
    views, active = stored.views, stored.measures.active
    shown = ~np.isin(views.reason, history.NOT_ATTRIBUTABLE)
    disagreed = active[views.point] & ~views.agreed & shown
    rows = read.views.start[views.point] + views.view
    lower = set(np.flatnonzero(read.views.health < 1.0).tolist())
    assert lower == {*rows[disagreed].tolist(), int(read.views.start[30]) + 1}


@pytest.mark.thorough
def test_the_next_registration_prefers_points_that_have_served(
    world: FlatWorld,
    connection: Connection,
    database: Database,
    storage: Storage,
    stored: Registration,
    first_id: int,
    tmp_path: Path,
) -> None:
    few = RegistrationOptions(max_points=14)
    files = SceneFiles(world.tagged, sigma_m=SIGMA_M)

    def vanished_tried(folder: str) -> int:
        sources = ControlSources(points_of_store(database, storage))
        made = run_registration(files, sources, tmp_path / folder, options=few)
        measures = made.registration.measures
        return int(((measures.reason != "not_tried") & (measures.point_id < first_id + VANISHED)).sum())

    before = vanished_tried("before")
    for scene in ("a", "b", "c"):
        remembered(connection, stored, scene)
    connection.commit()
    assert vanished_tried("after") < before


def test_a_failing_point_is_proposed_for_suspension_and_served_until_the_decision(
    connection: Connection, bearer: Bearer, stored: Registration, first_id: int
) -> None:
    reader, admin = bearer("read"), bearer("admin")

    def proposed() -> list[int]:
        parameters = {"filter": "state = 'proposed'", "limit": 100}
        page = reader.get("/collections/point-history/items", params=parameters).json()
        return [feature["id"] for feature in page["features"]]

    def served() -> set[int]:
        page = reader.get("/collections/points/items?limit=100").json()
        assert page["numberMatched"] == page["numberReturned"]
        return {feature["id"] for feature in page["features"]}

    for scene in range(10):
        remembered(connection, stored, str(scene))
    connection.commit()
    failed = [point for point, (_, successes) in counters(connection).items() if successes == 0]
    assert proposed() == sorted(failed)
    assert set(range(first_id, first_id + VANISHED)) <= set(failed)
    assert len(served()) == 40

    bad = first_id
    because = {"because": "a roundabout was built there"}
    assert reader.post(f"/points/{bad}/suspend", json=because).status_code == 403
    assert admin.post("/points/1/suspend", json=because).status_code == 404
    assert admin.post(f"/points/{bad}/suspend", json={"because": " "}).status_code == 422
    reply = admin.post(f"/points/{bad}/suspend", json=because)
    assert (reply.status_code, reply.json()["state"]) == (200, "suspended")
    assert admin.post(f"/points/{bad}/suspend", json=because).status_code == 409
    assert served() == set(range(first_id, first_id + 40)) - {bad}
    assert bad not in proposed()
    one = reader.get(f"/collections/points/items/{bad}").json()["properties"]
    assert (one["attempts"], one["successes"], one["last_success"]) == (10, 0, None)
    assert one["suspended_because"] == because["because"]
    assert one["health"] < 0.5
    good = reader.get(f"/collections/points/items/{first_id + 30}").json()["properties"]
    assert (good["attempts"], good["successes"], good["state"], good["health"]) == (10, 10, "served", 1)
    assert 0.0 < good["mean_residual_px"] < 1.0
    assert good["last_success"] is not None

    back = admin.post(f"/points/{bad}/reinstate")
    assert (back.status_code, back.json()["attempts"], back.json()["state"]) == (200, 0, "served")
    assert admin.post(f"/points/{bad}/reinstate").status_code == 409
    assert bad in served()
    changes = admin.get(f"/audit?kind=point&subject={bad}").json()["changes"]
    assert [change["after"]["suspended_because"] for change in changes] == [None, because["because"]]
    assert {change["actor_name"] for change in changes} == {"a token to admin"}


def test_a_suspended_point_is_not_given_to_registrations(
    connection: Connection, database: Database, storage: Storage, first_id: int
) -> None:
    outline = np.array([[5.2, 43.2], [5.3, 43.2], [5.3, 43.3], [5.2, 43.3]])
    assert history.suspend(connection, first_id + 3, "moved")
    connection.commit()
    ids = points_of_store(database, storage)(outline).points.id
    assert set(ids.tolist()) == set(range(first_id, first_id + 40)) - {first_id + 3}


def test_a_suspension_has_a_reason_and_a_list_an_end(connection: Connection, first_id: int):
    for because in ("", "  ", "x" * 501):
        with pytest.raises(InputError, match="because"):
            suspend_point(connection, first_id, because)
    assert suspend_point(connection, first_id, "x" * 500).suspended_because == "x" * 500
    with pytest.raises(Conflict, match="already suspended"):
        suspend_point(connection, first_id, "again")
    for limit in (1, 1000):
        assert [point.id for point in list_histories(connection, "suspended", limit)] == [first_id]
    for limit in (0, 1001):
        with pytest.raises(InputError, match="limit"):
            list_histories(connection, "suspended", limit)


def test_suspensions_are_decided_on_the_command_line(
    connection: Connection,
    settings: Settings,
    stored: Registration,
    first_id: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert settings.database_url is not None
    monkeypatch.setenv("AMERS_DATABASE_URL", settings.database_url.get_secret_value())

    def points(*words: object) -> list[dict]:
        result = CliRunner().invoke(amers, ["points", *(str(word) for word in words), "--json"])
        assert result.exit_code == 0, result.output
        printed: list[dict] = json.loads(result.stdout)
        return printed

    for scene in range(10):
        remembered(connection, stored, str(scene))
    connection.commit()
    proposed = [point["id"] for point in points("suspensions")]
    assert first_id in proposed
    points("suspend", first_id, "--because", "gone")
    assert [point["id"] for point in points("suspensions", "--suspended")] == [first_id]
    assert [point["id"] for point in points("suspensions")] == [p for p in proposed if p != first_id]
    points("reinstate", first_id)
    assert points("suspensions", "--suspended") == []
