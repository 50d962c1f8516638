"""What the store tells of a scene: its registrations, its files, those of its last registration."""

from datetime import datetime, timedelta
from typing import Any
from uuid import UUID

import pytest

from amers.app.db import scenes
from amers.app.db.engine import Connection
from amers.app.db.jobs import attempts, jobs
from amers.app.db.scene_files import SceneFiles, read_scene_files
from amers.app.db.scene_registrations import SceneRegistration, last_registrations
from amers.app.usecases.stored_scenes import stored_scenes
from amers.app.usecases.tokens import create_token
from tests.app.job_queue import claim, requested, store_registration
from tests.statements import run_sql


@pytest.fixture
def owner(connection: Connection) -> UUID:
    """The owner of the scenes."""
    return create_token(connection, "owner", ["register"]).token.id


@pytest.fixture
def scene(connection: Connection, owner: UUID) -> UUID:
    """A scene with a model beside its image."""
    return new_scene(connection, owner)


def new_scene(connection: Connection, owner: UUID) -> UUID:
    scene_id = scenes.begin_upload(connection, owner, "harbour", "a.tif", sigma_m=None)
    scenes.finish_upload(connection, scene_id, f"scenes/{scene_id}/a.tif", 100, "0" * 64)
    scenes.add_model(connection, scene_id, "a_RPC.TXT", 7, "0" * 64)
    return scene_id


def asked(connection: Connection, owner: UUID, *scene_ids: UUID) -> UUID:
    """The id of a job that registers a scene, or several together, claimed by a worker."""
    names = [str(one) for one in scene_ids]
    kind, inputs = ("register-scenes", {"scenes": names})
    if len(names) == 1:
        kind, inputs = "register-scene", {"scene": names[0]}
    job = requested(connection, kind, inputs, owner)
    assert claim(connection, job.id)
    return job.id


RING = [[5.0, 43.0], [5.1, 43.0], [5.1, 43.1], [5.0, 43.0]]


def registered(connection: Connection, job_id: UUID, scene_id: UUID, verdict: str) -> None:
    """Store the registration of a scene, whose report and files have the name of its job."""
    store_registration(
        connection,
        job_id=job_id,
        scene_id=scene_id,
        report={
            "verdict_scope": str(job_id),
            "on_the_earth": {"ce90_m": 2.0},
            "coverage": {"percent": 81.5, "polygons_lon_lat": [[RING]]},
        },
        verdict=verdict,
        files={"report.json": f"results/{job_id}/1/report.json"},
    )
    # All rows of one transaction have the same time.
    run_sql(
        connection,
        "update registration set created_at = clock_timestamp() where job_id = %s and scene_id = %s",
        [job_id, scene_id],
    )


def done(connection: Connection, owner: UUID, scene_id: UUID, verdict: str = "good") -> UUID:
    """The id of a job that registered a scene."""
    job_id = asked(connection, owner, scene_id)
    registered(connection, job_id, scene_id, verdict)
    attempts.succeed(connection, job_id, 1, {"verdict": verdict, "files": {}})
    return job_id


def every_scene(connection: Connection) -> list[UUID]:
    """All scenes, asked for at once as a list does: each has what it would have alone."""
    return [row["id"] for row in run_sql(connection, "select id from scene")]


def shown(
    connection: Connection, scene_id: UUID, caller: UUID, most: int = 10
) -> list[SceneRegistration]:
    return last_registrations(connection, every_scene(connection), caller, most).get(scene_id, [])


def files_of(connection: Connection, scene_id: UUID) -> SceneFiles:
    return read_scene_files(connection, every_scene(connection))[scene_id]


@pytest.mark.parametrize(
    ("verdict", "outcome"), [("good", "registered"), ("usable", "registered"), ("failed", "failed")]
)
def test_a_scene_is_registered_when_its_model_can_be_used(connection, owner, scene, verdict, outcome):
    job = done(connection, owner, scene, verdict)
    (one,) = shown(connection, scene, owner)
    assert (one.job_id, one.process, one.outcome, one.verdict) == (
        job,
        "register-scene",
        outcome,
        verdict,
    )
    assert one.on_the_earth == {"ce90_m": 2.0}


def test_a_registration_is_under_way_until_its_job_ends_and_gone_when_it_was_dismissed(
    connection, owner, scene
):
    failed, under_way, dismissed = (asked(connection, owner, scene) for _ in range(3))
    attempts.fail(connection, failed, 1, {"title": "Not enough points"}, {"verdict": "failed"})
    jobs.dismiss(connection, dismissed)
    found = {one.job_id: (one.outcome, one.verdict) for one in shown(connection, scene, owner)}
    assert found == {under_way: ("under way", None), failed: ("failed", "failed")}


def test_the_newest_registrations_come_first_and_older_ones_are_left_out(connection, owner, scene):
    """Of each scene as many, whatever others have that were registered in between and later."""
    other = new_scene(connection, owner)
    made = [done(connection, owner, one) for one in (scene, scene, other, scene, scene, other, other)]
    day = datetime.now().astimezone()
    for number, job in enumerate(made):
        run_sql(
            connection,
            "update job set created_at = %s where id = %s",
            [day + timedelta(hours=number), job],
        )
    for one, places in ((scene, [4, 3, 1, 0]), (other, [6, 5, 2])):
        newest = [made[place] for place in places]
        assert [found.job_id for found in shown(connection, one, owner)] == newest
        assert [found.job_id for found in shown(connection, one, owner, most=2)] == newest[:2]


def test_a_registration_is_shown_to_the_owners_of_the_scene_and_of_the_job_alone(
    connection, owner, scene
):
    other = create_token(connection, "administrator", ["admin"]).token.id
    own, others = done(connection, owner, scene), done(connection, other, scene)
    assert {one.job_id for one in shown(connection, scene, owner)} == {own}
    assert {one.job_id for one in shown(connection, scene, other)} == {own, others}


def test_scenes_registered_together_have_each_its_own_outcome(connection, owner, scene):
    second, third = new_scene(connection, owner), new_scene(connection, owner)
    job = asked(connection, owner, scene, second)
    registered(connection, job, scene, "good")
    registered(connection, job, second, "failed")
    attempts.succeed(connection, job, 1, {"files": {}})
    outcomes: dict[UUID, Any] = {
        one: [(found.process, found.outcome) for found in shown(connection, one, owner)]
        for one in (scene, second, third)
    }
    assert outcomes == {
        scene: [("register-scenes", "registered")],
        second: [("register-scenes", "failed")],
        third: [],
    }


def test_the_files_of_a_scene_are_those_of_its_last_registration_that_has_files_still(
    connection, owner, scene
):
    older, newer = done(connection, owner, scene), done(connection, owner, scene)
    done(connection, owner, new_scene(connection, owner))
    files = files_of(connection, scene)
    assert (files.image, files.models, files.job_id) == ("a.tif", ["a_RPC.TXT"], newer)
    assert files.results == {"report.json": f"results/{newer}/1/report.json"}
    assert files.accuracy is not None
    assert files.accuracy["verdict_scope"] == str(newer)
    assert (files.accuracy["held_percent"], files.accuracy["held_polygons"]) == (81.5, [[RING]])
    run_sql(connection, "update job set results_removed_at = now() where id = %s", [newer])
    files = files_of(connection, scene)
    assert (files.job_id, files.results) == (older, {"report.json": f"results/{older}/1/report.json"})
    assert files.accuracy is not None
    assert files.accuracy["verdict_scope"] == str(newer), "its report is in the store for ever"


def test_of_the_jobs_that_registered_a_scene_the_model_of_the_last_in_the_list_is_used(
    connection, owner, scene
):
    """Whichever ran last; one that registered another scene is passed over."""
    made = []
    for registered_scene in (scene, scene, new_scene(connection, owner)):
        job = asked(connection, owner, registered_scene)
        files = {"correction.json": f"results/{job}/1/correction.json"}
        store_registration(connection, job_id=job, scene_id=registered_scene, files=files)
        made.append(job)
    first, second, of_another = made
    for order in ([first, second, of_another], [of_another, second, first]):
        (stored,) = stored_scenes(connection, [scene], order)
        used = second if order[0] == first else first
        assert stored.model == [f"results/{used}/1/correction.json"]


def test_a_removed_scene_offers_no_files_of_its_own(connection, owner, scene):
    job = done(connection, owner, scene)
    scenes.remove_scene(connection, scene)
    files = files_of(connection, scene)
    assert (files.image, files.models, files.job_id) == (None, [], job)
