"""Jobs and their callers: requests, visibility, dismissal and quotas."""

import json
from collections.abc import Callable
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
from tests.app.job_queue import LEASE_S, claimed, tickets
from tests.statements import run_sql

Bearer = Callable[[str], dict[str, str]]
EXECUTE = "/processes/register-scene/execution"


@pytest.fixture
def me(bearer: Bearer) -> dict[str, str]:
    """Headers of a caller who may register."""
    return bearer("register")


@pytest.fixture
def scene(client: TestClient, me: dict[str, str]) -> str:
    """The id of an uploaded scene."""
    reply = client.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100), headers=me)
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


def test_a_request_for_work_becomes_a_job_in_the_queue(
    client: TestClient, me: dict[str, str], scene: str, dsn: str
):
    inputs = {"scene": scene, "options": {"max_points": 100, "matching": {"max_views": 2}}}
    reply = client.post(EXECUTE, json={"inputs": inputs}, headers=me)
    assert reply.status_code == 201, reply.text
    job = reply.json()
    assert (job["status"], job["progress"], job["processID"]) == ("accepted", 0, "register-scene")
    assert reply.headers["location"] == job["links"][0]["href"]
    document = client.get(reply.headers["location"], headers=me).json()
    assert document == {**job, "amers:queuePosition": 1}
    with engine.connect(dsn) as connection:
        assert tickets(connection) == 1
        stored = jobs.find(connection, UUID(job["jobID"]))
    assert stored is not None
    assert stored.inputs["options"]["max_points"] == 100
    assert stored.inputs["options"]["coarse"]["points"] == 60, "defaults are part of the record"


@pytest.mark.parametrize(
    ("inputs", "named"),
    [
        ({}, "scene"),
        ({"scene": str(uuid4()), "options": {"fine_stages": 0}}, "fine_stages"),
        ({"scene": "abc"}, "scene"),
        ({"scene": None}, "scene"),
        ({"options": {"max_points": "many"}}, "options.max_points"),
        ({"options": {"max_pionts": 10}}, "options.max_pionts"),
        ({"options": {"adjustment": {"order": "cubic"}}}, "options.adjustment.order"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_inputs_that_are_not_those_of_the_process_are_refused_by_name(
    client: TestClient, me: dict[str, str], scene: str, inputs: dict[str, Any], named: str
):
    given = inputs if not inputs or "scene" in inputs else {"scene": scene, **inputs}
    reply = client.post(EXECUTE, json={"inputs": given}, headers=me)
    assert reply.status_code == 422
    assert named in reply.json()["detail"]
    assert client.get("/jobs", headers=me).json()["jobs"] == []


def test_work_needs_a_token_that_allows_it(client: TestClient, bearer: Bearer, scene: str):
    body = {"inputs": {"scene": scene}}
    assert client.post(EXECUTE, json=body).status_code == 401
    assert client.post(EXECUTE, json=body, headers={"Authorization": "Bearer no"}).status_code == 401
    assert client.post(EXECUTE, json=body, headers=bearer("read")).status_code == 403


def test_a_scene_of_another_owner_cannot_be_registered(client: TestClient, bearer: Bearer, scene: str):
    reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=bearer("register"))
    assert reply.status_code == 404
    assert scene in reply.json()["detail"]


def test_a_scene_whose_image_arrives_still_cannot_be_registered(client: TestClient, me: dict[str, str]):
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "10", "Upload-Metadata": "filename YS50aWY="}
    arriving = client.post("/uploads", headers=me | tus).headers["amers-scene"]
    reply = client.post(EXECUTE, json={"inputs": {"scene": arriving}}, headers=me)
    assert reply.status_code == 409
    assert "is uploading" in reply.json()["detail"]


OF_SCENES = [name for name, one in PROCESSES.items() if "scene" in one.input_schema()["properties"]]
FILE_NAMES = ("model", "mask", "check_points", "dem", "geoid", "vectors")


def least_inputs(name: str, scene: str) -> dict[str, Any]:
    """What a process of one scene must be given."""
    files = {"vectors": "a.geojson", "dem": "dem.tif"}
    values = {"scene": scene, **files, "registration": str(uuid4())}
    return {one: values[one] for one in PROCESSES[name].input_schema()["required"]}


def test_no_process_works_on_a_scene_of_another_owner(
    client: TestClient, me: dict[str, str], bearer: Bearer, scene: str
):
    stranger = bearer("register")
    for name in OF_SCENES:
        body, execute = {"inputs": least_inputs(name, scene)}, f"/processes/{name}/execution"
        reply = client.post(execute, json=body, headers=stranger)
        assert (reply.status_code, f"no scene {scene}" in reply.json()["detail"]) == (404, True), name
        assert client.post(execute, json=body, headers=me).status_code in (201, 422), name


def test_no_process_reads_a_file_that_does_not_lie_beside_its_image(
    client: TestClient, me: dict[str, str], scene: str
):
    inputs = {name: PROCESSES[name].input_schema()["properties"] for name in OF_SCENES}
    fields = [(name, field) for name in OF_SCENES for field in FILE_NAMES if field in inputs[name]]
    assert {field for _, field in fields} == set(FILE_NAMES)
    for name, field in fields:
        for path in ("../x.geojson", "/etc/x.geojson", "a/b.geojson"):
            body = {"inputs": {**least_inputs(name, scene), field: path}}
            reply = client.post(f"/processes/{name}/execution", json=body, headers=me)
            assert reply.status_code == 422, (name, field)
            assert f"{field}: {path!r} is not the name of a file" in reply.json()["detail"]


def test_scenes_are_registered_together_by_their_owner(
    client: TestClient, me: dict[str, str], bearer: Bearer, scene: str
):
    execute, stranger = "/processes/register-scenes/execution", bearer("register")
    second = client.post("/scenes?name=b.tif", content=b"II*\0" + bytes(100), headers=stranger)
    both = {"inputs": {"scenes": [scene, second.json()["id"]]}}
    for caller in (me, stranger):
        assert client.post(execute, json=both, headers=caller).status_code == 404
    assert client.post(execute, json=both, headers=bearer("admin")).status_code == 201
    twice = {"inputs": {"scenes": [scene, scene]}}
    assert client.post(execute, json=twice, headers=me).status_code == 422
    joining = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"]
    join = {"inputs": {"scenes": [second.json()["id"]], "join": joining}}
    reply = client.post(execute, json=join, headers=stranger)
    assert (reply.status_code, f"no job {joining}" in reply.json()["detail"]) == (404, True)


def test_a_removed_scene_cannot_be_registered(client: TestClient, me: dict[str, str], scene: str):
    client.delete(f"/scenes/{scene}", headers=me)
    reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me)
    assert reply.status_code == 409
    assert "removed" in reply.json()["detail"]


def test_the_same_request_with_the_same_key_creates_one_job(
    client: TestClient, me: dict[str, str], bearer: Bearer, scene: str
):
    body = {"inputs": {"scene": scene}}
    keyed = {"Idempotency-Key": "k1"}
    first = client.post(EXECUTE, json=body, headers=me | keyed).json()
    again = client.post(EXECUTE, json=body, headers=me | keyed).json()
    assert again["jobID"] == first["jobID"]
    other = {"inputs": {"scene": scene, "options": {"max_points": 7}}}
    assert client.post(EXECUTE, json=other, headers=me | keyed).status_code == 422
    stranger = client.post(EXECUTE, json=body, headers=bearer("admin") | keyed).json()
    assert stranger["jobID"] != first["jobID"], "keys are each owner's own"


def test_a_key_stands_for_all_of_its_request(client: TestClient, me: dict[str, str], scene: str):
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


def test_concurrent_requests_with_one_key_create_one_job(
    client: TestClient, me: dict[str, str], scene: str
):
    def ask(_: int) -> str:
        keyed = me | {"Idempotency-Key": "k1"}
        reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=keyed)
        return str(reply.json()["jobID"])

    with ThreadPoolExecutor(6) as threads:
        assert len(set(threads.map(ask, range(12)))) == 1


def test_an_owner_sees_his_jobs_and_an_administrator_all(
    client: TestClient, me: dict[str, str], bearer: Bearer, scene: str
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    here, stranger, admin = f"/jobs/{job['jobID']}", bearer("register"), bearer("admin")
    assert [one["jobID"] for one in client.get("/jobs", headers=me).json()["jobs"]] == [job["jobID"]]
    assert client.get("/jobs", headers=stranger).json()["jobs"] == []
    assert len(client.get("/jobs", headers=admin).json()["jobs"]) == 1
    following = f"/jobs?after={job['jobID']}"
    assert client.get(following, headers=me).status_code == 200
    for path in (here, f"{here}/results", f"{here}/results/report.json", following):
        assert client.get(path, headers=stranger).status_code == 404
        assert client.get(path).status_code == 401
    assert client.delete(here, headers=stranger).status_code == 404
    assert client.get(here, headers=admin).json()["status"] == "accepted"


def test_a_dismissed_job_stays_dismissed_and_is_never_claimed(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    here = f"/jobs/{job['jobID']}"
    assert client.delete(here, headers=me).json()["status"] == "dismissed"
    assert client.get(here, headers=me).json()["status"] == "dismissed"
    with database.transaction() as connection:
        assert attempts.claim_next(connection, "w", LEASE_S) is None
    assert client.get(f"{here}/results", headers=me).status_code == 404


def test_a_failed_job_reports_the_reason_with_its_numbers(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
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
    document = client.get(f"/jobs/{job['jobID']}", headers=me).json()
    assert (document["status"], document["message"], document["error"]) == (
        "failed",
        error["detail"],
        error,
    )
    results = client.get(f"/jobs/{job['jobID']}/results", headers=me)
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


def test_a_job_shows_its_last_thousand_messages(
    client: TestClient, me: dict[str, str], scene: str, connection: Connection
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"]
    run_sql(
        connection,
        "insert into job_message (job_id, attempt, progress, message)"
        " select %s, 1, 50, 'block ' || n from generate_series(1, 1500) n",
        [job],
    )
    connection.commit()
    shown = client.get(f"/jobs/{job}/messages", headers=me).json()["messages"]
    assert [one["message"] for one in shown] == [f"block {n}" for n in range(501, 1501)]


@pytest.mark.parametrize(("length", "status"), [(0, 422), (1, 201), (200, 201), (201, 422)])
def test_an_idempotency_key_has_one_to_two_hundred_characters(
    client: TestClient, me: dict[str, str], scene: str, length: int, status: int
):
    keyed = me | {"Idempotency-Key": "k" * length}
    reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=keyed)
    assert reply.status_code == status


def test_the_inputs_of_a_job_have_at_most_64_kib(
    client: TestClient, me: dict[str, str], connection: Connection
):
    def ask(letters: int) -> tuple[int, int]:
        """The status, and the size of the inputs as they are kept."""
        inputs = {"bbox": [5.2, 43.2, 5.3, 43.3], "title": "x" * letters}
        reply = client.post("/processes/export-block/execution", json={"inputs": inputs}, headers=me)
        if not reply.is_success:
            return reply.status_code, 0
        job = jobs.find(connection, UUID(reply.json()["jobID"]))
        assert job is not None
        return reply.status_code, len(json.dumps(job.inputs))

    status, size_of_one_letter = ask(1)
    most = 1 + (64 << 10) - size_of_one_letter
    assert (status, ask(most), ask(most + 1)) == (201, (201, 64 << 10), (422, 0))


def test_a_job_names_all_of_its_scenes(client: TestClient, me: dict[str, str], scene: str):
    second = client.post("/scenes?name=b.tif", content=b"II*\0" + bytes(100), headers=me).json()["id"]
    both = {"inputs": {"scenes": [second, scene]}}
    together = client.post("/processes/register-scenes/execution", json=both, headers=me).json()
    alone = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    listed = {job["jobID"]: job for job in client.get("/jobs", headers=me).json()["jobs"]}
    assert listed[together["jobID"]]["amers:sceneNames"] == ["b.tif", "a.tif"]
    assert listed[alone["jobID"]]["amers:sceneNames"] == ["a.tif"]


def test_jobs_are_listed_page_by_page_and_by_kind_and_state(
    client: TestClient, me: dict[str, str], scene: str
):
    def asked() -> str:
        return str(client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"])

    made = [asked() for _ in range(5)]
    client.delete(f"/jobs/{made[0]}", headers=me)
    seen, url = [], "/jobs?limit=2"
    while url:
        page = client.get(url, headers=me).json()
        seen += [job["jobID"] for job in page["jobs"]]
        url = next((link["href"] for link in page["links"] if link["rel"] == "next"), "")
    assert seen == made[::-1]

    def listed(query: str) -> list[str]:
        return [job["jobID"] for job in client.get(f"/jobs?{query}", headers=me).json()["jobs"]]

    assert listed("status=dismissed") == [made[0]]
    assert listed("status=dismissed&status=accepted") == made[::-1]
    assert listed("processID=ingest-block") == []
    assert client.get("/jobs?status=lost", headers=me).status_code == 400


def test_a_page_with_exactly_all_jobs_has_no_next(client: TestClient, me: dict[str, str], scene: str):
    for _ in range(2):
        client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me)
    for limit, links in ((1, ["self", "next"]), (2, ["self"]), (3, ["self"])):
        page = client.get(f"/jobs?limit={limit}", headers=me).json()
        assert [link["rel"] for link in page["links"]] == links


def test_the_files_of_a_job_go_when_it_is_removed_and_not_when_it_is_dismissed(
    client: TestClient, me: dict[str, str], scene: str, database: Database, storage: Storage
):
    made = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"]
    claimed(database, UUID(made))
    key = storage.put(f"results/{made}/1/report.json", [b"{}"]).key
    assert client.delete(f"/jobs/{made}", headers=me).json()["message"] == "dismissed"
    assert storage.keys("results") == [key], "a worker writes them still"
    assert client.delete(f"/jobs/{made}", headers=me).json()["message"] == "removed"
    assert storage.keys("results") == []


def test_a_waiting_job_reports_its_queue_position_and_its_scene(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    first, second = (
        client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"]
        for _ in range(2)
    )
    document = client.get(f"/jobs/{second}", headers=me).json()
    assert document["amers:queuePosition"] == 2
    assert document["inputs"]["scene"] == scene
    assert any(
        link["rel"] == "related" and link["href"].endswith(f"/scenes/{scene}")
        for link in document["links"]
    )
    claimed(database, UUID(first))
    assert client.get(f"/jobs/{second}", headers=me).json()["amers:queuePosition"] == 1
    assert "amers:queuePosition" not in client.get(f"/jobs/{first}", headers=me).json()


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
