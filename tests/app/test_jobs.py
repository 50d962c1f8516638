"""Jobs and their callers: requests, visibility, dismissal and quotas."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.errors import AmersError, Conflict, DamagedFile, NoSuchJob
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.jobs import PROCESSES, error_details, success_message
from amers.services.errors import FormatError, NotEnoughPoints
from amers.services.formats.block.problems import BlockProblems, Problem
from tests.app.callers import Bearer, Caller
from tests.app.job_queue import LEASE_S, claimed, tickets
from tests.app.sending import begun
from tests.statements import run_sql

EXECUTE = "/processes/register-scene/execution"


@pytest.fixture
def scene(me: Caller) -> str:
    """The id of an uploaded scene."""
    reply = me.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100))
    return str(reply.json()["id"])


def test_processes_are_described_with_the_schema_of_their_inputs(client: TestClient):
    names = [process["id"] for process in client.get("/processes").json()["processes"]]
    assert "register-scene" in names
    described = client.get("/processes/register-scene").json()
    assert described["inputs"]["scene"]["minOccurs"] == 1
    assert described["inputs"]["scene"]["schema"]["format"] == "uuid"
    options = described["inputs"]["options"]["schema"]["properties"]
    assert options["max_points"]["type"] == "integer"
    assert options["adjustment"]["type"] == "object", "no definition lies elsewhere"
    assert "report.json" in described["outputs"]
    assert "dismiss" in described["jobControlOptions"]
    assert client.get("/processes/no-such").status_code == 404


def test_a_request_for_work_becomes_a_job_in_the_queue(me: Caller, scene: str, dsn: str):
    inputs = {"scene": scene, "options": {"max_points": 100, "matching": {"max_views": 2}}}
    reply = me.post(EXECUTE, json={"inputs": inputs})
    assert reply.status_code == 201, reply.text
    job = reply.json()
    assert (job["status"], job["progress"], job["processID"]) == ("accepted", 0, "register-scene")
    assert reply.headers["location"] == job["links"][0]["href"]
    document = me.get(reply.headers["location"]).json()
    assert document == {**job, "amers:queuePosition": 1}
    with engine.connect(dsn) as connection:
        assert tickets(connection) == 1
        stored = jobs.find(connection, UUID(job["jobID"]))
    assert stored is not None
    assert stored.inputs["options"]["max_points"] == 100
    assert stored.inputs["options"]["coarse"]["points"] == 60, "defaults are part of the record"


def test_inputs_that_are_not_those_of_the_process_are_refused_by_name(me: Caller, scene: str):
    for inputs, named in [
        ({}, "scene"),
        ({"scene": str(uuid4()), "options": {"fine_stages": 0}}, "fine_stages"),
        ({"scene": "abc"}, "scene"),
        ({"scene": None}, "scene"),
        ({"options": {"max_points": "many"}}, "options.max_points"),
        ({"options": {"max_pionts": 10}}, "options.max_pionts"),
        ({"options": {"adjustment": {"order": "cubic"}}}, "options.adjustment.order"),
        ({"colour": "red"}, "colour"),
    ]:
        given = inputs if not inputs or "scene" in inputs else {"scene": scene, **inputs}
        reply = me.post(EXECUTE, json={"inputs": given})
        assert reply.status_code == 422, inputs
        assert named in reply.json()["detail"], inputs
        assert me.get("/jobs").json()["jobs"] == [], inputs


def test_work_needs_a_token_that_allows_it(client: TestClient, bearer: Bearer, scene: str):
    body = {"inputs": {"scene": scene}}
    assert client.post(EXECUTE, json=body).status_code == 401
    assert client.post(EXECUTE, json=body, headers={"Authorization": "Bearer no"}).status_code == 401
    assert bearer("read").post(EXECUTE, json=body).status_code == 403


def test_a_scene_of_another_owner_cannot_be_registered(bearer: Bearer, scene: str):
    reply = bearer("register").post(EXECUTE, json={"inputs": {"scene": scene}})
    assert reply.status_code == 404
    assert scene in reply.json()["detail"]


def test_a_scene_whose_image_arrives_still_cannot_be_registered(me: Caller):
    arriving = begun(me, 10, filename="a.tif").headers["amers-scene"]
    reply = me.post(EXECUTE, json={"inputs": {"scene": arriving}})
    assert reply.status_code == 409
    assert "is uploading" in reply.json()["detail"]


OF_SCENES = [name for name, one in PROCESSES.items() if "scene" in one.input_schema()["properties"]]
FILE_NAMES = ("model", "mask", "check_points", "dem", "geoid", "vectors")


def least_inputs(name: str, scene: str) -> dict[str, Any]:
    """What a process of one scene must be given."""
    files = {"vectors": "a.geojson", "dem": "dem.tif"}
    values = {"scene": scene, **files, "registration": str(uuid4())}
    return {one: values[one] for one in PROCESSES[name].input_schema()["required"]}


def test_no_process_works_on_a_scene_of_another_owner(me: Caller, bearer: Bearer, scene: str):
    stranger = bearer("register")
    for name in OF_SCENES:
        body, execute = {"inputs": least_inputs(name, scene)}, f"/processes/{name}/execution"
        reply = stranger.post(execute, json=body)
        assert (reply.status_code, f"no scene {scene}" in reply.json()["detail"]) == (404, True), name
        assert me.post(execute, json=body).status_code in (201, 422), name


def test_no_process_reads_a_file_that_does_not_lie_beside_its_image(me: Caller, scene: str):
    inputs = {name: PROCESSES[name].input_schema()["properties"] for name in OF_SCENES}
    fields = [(name, field) for name in OF_SCENES for field in FILE_NAMES if field in inputs[name]]
    assert {field for _, field in fields} == set(FILE_NAMES)
    for name, field in fields:
        for path in ("../x.geojson", "/etc/x.geojson", "a/b.geojson"):
            reply = me.execute(name, {**least_inputs(name, scene), field: path})
            assert reply.status_code == 422, (name, field)
            assert f"{field}: {path!r} is not the name of a file" in reply.json()["detail"]


def test_scenes_are_registered_together_by_their_owner(me: Caller, bearer: Bearer, scene: str):
    execute, stranger = "/processes/register-scenes/execution", bearer("register")
    second = stranger.post("/scenes?name=b.tif", content=b"II*\0" + bytes(100))
    both = {"inputs": {"scenes": [scene, second.json()["id"]]}}
    for caller in (me, stranger):
        assert caller.post(execute, json=both).status_code == 404
    assert bearer("admin").post(execute, json=both).status_code == 201
    twice = {"inputs": {"scenes": [scene, scene]}}
    assert me.post(execute, json=twice).status_code == 422
    joining = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()["jobID"]
    join = {"inputs": {"scenes": [second.json()["id"]], "join": joining}}
    reply = stranger.post(execute, json=join)
    assert (reply.status_code, f"no job {joining}" in reply.json()["detail"]) == (404, True)


def test_a_removed_scene_cannot_be_registered(me: Caller, scene: str):
    me.delete(f"/scenes/{scene}")
    reply = me.post(EXECUTE, json={"inputs": {"scene": scene}})
    assert reply.status_code == 409
    assert "removed" in reply.json()["detail"]


def test_the_same_request_with_the_same_key_creates_one_job(
    client: TestClient, me: Caller, bearer: Bearer, scene: str
):
    body = {"inputs": {"scene": scene}}
    keyed = {"Idempotency-Key": "k1"}
    first = client.post(EXECUTE, json=body, headers=me | keyed).json()
    again = client.post(EXECUTE, json=body, headers=me | keyed).json()
    assert again["jobID"] == first["jobID"]
    second = me | {"Idempotency-Key": "k2"}
    of_second = [client.post(EXECUTE, json=body, headers=second).json()["jobID"] for _ in range(2)]
    assert len({first["jobID"], *of_second}) == 2, "each key has a job of its own"
    assert client.post(EXECUTE, json=body, headers=me | keyed).json()["jobID"] == first["jobID"]
    other = {"inputs": {"scene": scene, "options": {"max_points": 7}}}
    assert client.post(EXECUTE, json=other, headers=me | keyed).status_code == 422
    stranger = client.post(EXECUTE, json=body, headers=bearer("admin") | keyed).json()
    assert stranger["jobID"] != first["jobID"], "keys are each owner's own"


def test_a_key_stands_for_all_of_its_request(client: TestClient, me: Caller, scene: str):
    keyed = me | {"Idempotency-Key": "k1"}
    report = {"outputs": {"report.json": {"transmissionMode": "value"}}}
    body = {"inputs": {"scene": scene}, **report, "response": "raw"}
    first = client.post(EXECUTE, json=body, headers=keyed)
    assert client.post(EXECUTE, json=body, headers=keyed).json()["jobID"] == first.json()["jobID"]
    by_reference = {"outputs": {"report.json": {"transmissionMode": "reference"}}}
    for change in ({"response": "document"}, {"outputs": {}}, by_reference):
        reply = client.post(EXECUTE, json={**body, **change}, headers=keyed)
        assert reply.status_code == 422, change
        assert "send a new key" in reply.json()["detail"]


def test_a_request_that_is_repeated_with_its_key_is_no_further_job(
    settings: Settings, me: dict[str, str], scene: str
):
    body, keyed = {"inputs": {"scene": scene}}, me | {"Idempotency-Key": "k1"}
    with TestClient(create_app(settings.model_copy(update={"quota_jobs": 1}))) as client:
        first = client.post(EXECUTE, json=body, headers=keyed).json()
        assert client.post(EXECUTE, json=body, headers=me).status_code == 429
        assert client.post(EXECUTE, json=body, headers=keyed).json()["jobID"] == first["jobID"]


def test_concurrent_requests_with_one_key_create_one_job(client: TestClient, me: Caller, scene: str):
    def ask(_: int) -> str:
        keyed = me | {"Idempotency-Key": "k1"}
        reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=keyed)
        return str(reply.json()["jobID"])

    with ThreadPoolExecutor(6) as threads:
        assert len(set(threads.map(ask, range(12)))) == 1


def test_an_owner_sees_his_jobs_and_an_administrator_all(
    client: TestClient, me: Caller, bearer: Bearer, scene: str
):
    job = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()
    here, stranger, admin = f"/jobs/{job['jobID']}", bearer("register"), bearer("admin")
    assert [one["jobID"] for one in me.get("/jobs").json()["jobs"]] == [job["jobID"]]
    assert stranger.get("/jobs").json()["jobs"] == []
    assert len(admin.get("/jobs").json()["jobs"]) == 1
    following = f"/jobs?after={job['jobID']}"
    assert me.get(following).status_code == 200
    for path in (here, f"{here}/results", f"{here}/results/report.json", following):
        assert stranger.get(path).status_code == 404
        assert client.get(path).status_code == 401
    assert stranger.delete(here).status_code == 404
    assert admin.get(here).json()["status"] == "accepted"


def test_a_dismissed_job_stays_dismissed_and_is_never_claimed(
    me: Caller, scene: str, database: Database
):
    job = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()
    here = f"/jobs/{job['jobID']}"
    assert me.delete(here).json()["status"] == "dismissed"
    assert me.get(here).json()["status"] == "dismissed"
    with database.transaction() as connection:
        assert attempts.claim_next(connection, "w", LEASE_S) is None
    assert me.get(f"{here}/results").status_code == 404


def test_a_failed_job_reports_the_reason_with_its_numbers(me: Caller, scene: str, database: Database):
    job = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()
    attempt = claimed(database, UUID(job["jobID"])).attempt
    error = {
        "type": "about:blank",
        "title": "Not enough points",
        "error": "NotEnoughPoints",
        "detail": "3 found, 6 needed",
        "found": 3,
    }
    with database.transaction() as connection:
        attempts.fail(connection, UUID(job["jobID"]), attempt, error)
    document = me.get(f"/jobs/{job['jobID']}").json()
    assert (document["status"], document["message"], document["error"]) == (
        "failed",
        error["detail"],
        error,
    )
    results = me.get(f"/jobs/{job['jobID']}/results")
    assert (results.status_code, results.json()["found"]) == (409, 3)
    assert results.headers["content-type"] == "application/problem+json"


def test_the_error_of_a_job_names_files_and_no_folder_of_the_machine(tmp_path: Path):
    storage, scene = Storage(tmp_path / "storage"), uuid4()
    message = (
        f"{storage.folder}/scenes/{scene}/a.tif, {storage.folder}/results/{scene}/3/a.json and "
        f"{gettempdir()}/amers-x1_y/b.tif cannot be read"
    )
    details = error_details(DamagedFile("scenes/a.tif", message), storage)
    assert str(tmp_path) not in details["detail"]
    assert gettempdir() not in details["detail"]
    assert all(name in details["detail"] for name in ("a.tif", "a.json", "b.tif cannot be read"))


@pytest.mark.parametrize(
    "error", [NotEnoughPoints(3, 6), NoSuchJob("no job"), Conflict("taken"), FormatError("no block")]
)
def test_the_title_of_an_error_is_its_name_in_words(tmp_path: Path, error: AmersError):
    details = error_details(error, Storage(tmp_path / "storage"))
    words = details["title"].split(" ")
    assert details["type"] == "about:blank", "by RFC 9457 the title is then all that there is to know"
    assert "".join(words).lower() == details["error"].lower() == type(error).__name__.lower()
    assert len(words) == sum(letter.isupper() for letter in details["error"])
    assert [letter for letter in details["title"] if letter.isupper()] == [details["title"][0]]


def test_the_error_of_a_job_has_the_numbers_and_problems_that_it_is_about(tmp_path: Path):
    storage = Storage(tmp_path / "storage")
    few = error_details(NotEnoughPoints(3, 6), storage)
    assert (few["found"], few["needed"]) == (3, 6)
    assert "problems" not in few
    row = Problem("points.parquet", "lon", 7, "181.0", "-180 to 180")
    broken = error_details(BlockProblems((row,), 30), storage)
    assert broken["count"] == 30
    (listed,) = broken["problems"]
    assert (listed["file"], listed["row"], listed["found"]) == (row.file, row.row, row.found)
    json.dumps(broken)


def test_the_last_message_of_a_job_warns_of_a_model_that_must_not_be_used():
    assert success_message({"files": {}}) == "done"
    for verdict in ("good", "usable"):
        assert success_message({"verdict": verdict}) == f"done, verdict {verdict}"
    assert "do not use" in success_message({"verdict": "failed"})


def test_a_job_shows_its_last_thousand_messages(me: Caller, scene: str, connection: Connection):
    job = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()["jobID"]
    run_sql(
        connection,
        "insert into job_message (job_id, attempt, progress, message)"
        " select %s, 1, 50, 'block ' || n from generate_series(1, 1500) n",
        [job],
    )
    connection.commit()
    shown = me.get(f"/jobs/{job}/messages").json()["messages"]
    assert [one["message"] for one in shown] == [f"block {n}" for n in range(501, 1501)]


def test_an_idempotency_key_has_one_to_two_hundred_characters(
    client: TestClient, me: Caller, scene: str
):
    for length, status in [(0, 422), (1, 201), (200, 201), (201, 422)]:
        keyed = me | {"Idempotency-Key": "k" * length}
        reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=keyed)
        assert reply.status_code == status, length


def test_the_inputs_of_a_job_have_at_most_64_kib(me: Caller, connection: Connection):
    def ask(letters: int) -> tuple[int, int]:
        """The status, and the size of the inputs as they are kept."""
        inputs = {"bbox": [5.2, 43.2, 5.3, 43.3], "title": "x" * letters}
        reply = me.execute("export-block", inputs)
        if not reply.is_success:
            return reply.status_code, 0
        job = jobs.find(connection, UUID(reply.json()["jobID"]))
        assert job is not None
        return reply.status_code, len(json.dumps(job.inputs))

    status, size_of_one_letter = ask(1)
    most = 1 + (64 << 10) - size_of_one_letter
    assert (status, ask(most), ask(most + 1)) == (201, (201, 64 << 10), (422, 0))


def test_a_job_names_all_of_its_scenes(me: Caller, scene: str):
    second = me.scene(b"II*\0" + bytes(100), "name=b.tif")
    together = me.execute("register-scenes", {"scenes": [second, scene]}).json()
    alone = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()
    listed = {job["jobID"]: job for job in me.get("/jobs").json()["jobs"]}
    assert listed[together["jobID"]]["amers:sceneNames"] == ["b.tif", "a.tif"]
    assert listed[alone["jobID"]]["amers:sceneNames"] == ["a.tif"]


def test_jobs_are_listed_page_by_page_and_by_kind_and_state(me: Caller, scene: str):
    def asked() -> str:
        return str(me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()["jobID"])

    made = [asked() for _ in range(5)]
    me.delete(f"/jobs/{made[0]}")
    seen, url = [], "/jobs?limit=2"
    while url:
        page = me.get(url).json()
        seen += [job["jobID"] for job in page["jobs"]]
        url = next((link["href"] for link in page["links"] if link["rel"] == "next"), "")
    assert seen == made[::-1]

    def listed(query: str) -> list[str]:
        return [job["jobID"] for job in me.get(f"/jobs?{query}").json()["jobs"]]

    assert listed("status=dismissed") == [made[0]]
    assert listed("status=dismissed&status=accepted") == made[::-1]
    assert listed("processID=ingest-block") == []
    assert me.get("/jobs?status=lost").status_code == 400


def test_a_page_with_exactly_all_jobs_has_no_next(me: Caller, scene: str):
    for _ in range(2):
        me.post(EXECUTE, json={"inputs": {"scene": scene}})
    for limit, links in ((1, ["self", "next"]), (2, ["self"]), (3, ["self"])):
        page = me.get(f"/jobs?limit={limit}").json()
        assert [link["rel"] for link in page["links"]] == links


def test_the_files_of_a_job_go_when_it_is_removed_and_not_when_it_is_dismissed(
    me: Caller, scene: str, database: Database, storage: Storage
):
    made = me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()["jobID"]
    claimed(database, UUID(made))
    key = storage.put(f"results/{made}/1/report.json", [b"{}"]).key
    assert me.delete(f"/jobs/{made}").json()["message"] == "dismissed"
    assert storage.keys("results") == [key], "a worker writes them still"
    assert me.delete(f"/jobs/{made}").json()["message"] == "removed"
    assert storage.keys("results") == []


def test_a_waiting_job_reports_its_queue_position_and_its_scene(
    me: Caller, scene: str, database: Database
):
    first, second = (
        me.post(EXECUTE, json={"inputs": {"scene": scene}}).json()["jobID"] for _ in range(2)
    )
    document = me.get(f"/jobs/{second}").json()
    assert document["amers:queuePosition"] == 2
    assert document["inputs"]["scene"] == scene
    assert any(
        link["rel"] == "related" and link["href"].endswith(f"/scenes/{scene}")
        for link in document["links"]
    )
    claimed(database, UUID(first))
    assert me.get(f"/jobs/{second}").json()["amers:queuePosition"] == 1
    assert "amers:queuePosition" not in me.get(f"/jobs/{first}").json()


def test_a_token_has_no_more_jobs_at_once_than_its_quota(
    settings: Settings, me: dict[str, str], scene: str
):
    few = settings.model_copy(update={"quota_jobs": 1})
    with TestClient(create_app(few)) as client:
        first = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me)
        assert first.status_code == 201
        assert client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).status_code == 429
        client.delete(first.headers["location"], headers=me)
        assert client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).status_code == 201
