"""OGC API - Processes - Part 1: Core 1.0 (OGC 18-062r2), each test named after its requirement."""

import json
from base64 import b64decode
from collections.abc import Callable
from email import message_from_bytes
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from jsonschema import Draft202012Validator, validate

from amers.app.db import engine
from amers.app.db.jobs import attempts
from amers.app.db.jobs.jobs import Job
from amers.app.storage import Storage
from amers.app.usecases import results
from amers.app.usecases.jobs import PROCESSES, error_details
from amers.services.errors import NotEnoughPoints
from tests.app.callers import Caller
from tests.app.job_queue import claim
from tests.statements import run_sql

EXCEPTIONS = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
OGC = "http://www.opengis.net/def/rel/ogc/1.0/"
EXECUTE = "/processes/register-scene/execution"
STATUS_INFO = {
    "type": "object",
    "required": ["jobID", "status", "type", "processID", "links"],
    "properties": {
        "processID": {"type": "string"},
        "type": {"const": "process"},
        "jobID": {"type": "string"},
        "status": {"enum": ["accepted", "running", "successful", "failed", "dismissed"]},
        "message": {"type": "string"},
        "created": {"type": "string"},
        "started": {"type": ["string", "null"]},
        "finished": {"type": ["string", "null"]},
        "updated": {"type": "string"},
        "progress": {"type": "integer", "minimum": 0, "maximum": 100},
        "links": {"type": "array", "items": {"type": "object", "required": ["href", "rel"]}},
    },
}
WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    ({"inputs": {}}, "scene"),
    ({"inputs": {"scene": 7}}, "scene"),
    ({"inputs": {"scene": str(uuid4()), "colour": "red"}}, "colour"),
    ({"inputs": [1]}, "inputs"),
    ({"response": "smoke"}, "response"),
    ({"outputs": {"painting": {}}}, "painting"),
    ({"outputs": {"report.json": {"transmissionMode": "pigeon"}}}, "transmissionMode"),
    ({"subscriber": {"successUri": "http://127.0.0.1/"}}, "subscriber"),
)
"""Bodies that are refused, and text that the refusal contains."""
REPORT, MODEL, PAGE = b'{"verdict": "good"}', b"LINE_OFF: 1\n", b"<html></html>"
LAYERS = bytes(range(256))


@pytest.fixture
def get(me: Caller) -> Callable[..., Any]:
    """GET with scope `register`."""
    return lambda path, **query: me.get(path, params=query or None)


@pytest.fixture
def scene(me: Caller) -> str:
    reply = me.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100))
    return str(reply.json()["id"])


@pytest.fixture
def ask(client: TestClient, me: Caller, scene: str) -> Callable[..., Any]:
    """Executes a registration; members of the body by name."""

    def ask(prefer: str | None = None, **more: Any) -> Any:
        headers = me if prefer is None else {**me, "Prefer": prefer}
        return client.post(EXECUTE, json={"inputs": {"scene": scene}, **more}, headers=headers)

    return ask


@pytest.fixture
def done(ask: Callable[..., Any], dsn: str, storage: Storage) -> Callable[..., str]:
    """The URL of a job with these members that has made a report, a model, a page and layers."""

    def done(**more: Any) -> str:
        reply = ask(**more)
        assert reply.status_code == 201, reply.text
        job = begun(dsn, reply.json()["jobID"])
        files = {
            "report.json": REPORT,
            "refined_RPC.TXT": MODEL,
            "report.html": PAGE,
            "residuals.gpkg": LAYERS,
        }
        keys = {
            name: storage.put(f"results/{job.id}/{job.attempt}/{name}", [content]).key
            for name, content in files.items()
        }
        with engine.connect(dsn) as connection:
            attempts.succeed(connection, job.id, job.attempt, {"verdict": "good", "files": keys})
        return str(reply.headers["location"])

    return done


def begun(dsn: str, job_id: str) -> Job:
    """The job after a worker has claimed it."""
    with engine.connect(dsn) as connection:
        job = claim(connection, UUID(job_id), "a worker", 30.0)
    assert job is not None
    return job


def href(document: dict[str, Any], rel: str) -> str:
    return next(link["href"] for link in document["links"] if link["rel"] == rel)


def assert_exception(reply: Any, status: int, kind: str | None = None) -> None:
    assert reply.status_code == status, reply.text
    assert reply.headers["content-type"] == "application/problem+json"
    told = reply.json()
    assert told["title"]
    assert told["detail"]
    if kind is not None:
        assert told["type"] == EXCEPTIONS + kind


# Landing page, API, conformance


def test_req_core_landingpage_success(get):
    page = get("/").json()
    for rel in ("service-desc", "service-doc", "conformance", f"{OGC}processes", f"{OGC}job-list"):
        assert get(href(page, rel)).status_code == 200, rel


def test_req_core_api_definition_success(get):
    paths = get("/api").json()["paths"]
    assert {
        "/processes",
        "/processes/{process_id}",
        "/processes/{process_id}/execution",
        "/jobs",
        "/jobs/{job_id}",
        "/jobs/{job_id}/results",
    } <= set(paths)


def test_req_core_conformance_success(get):
    classes = get("/conformance").json()["conformsTo"]
    for name in ("core", "ogc-process-description", "json", "job-list", "dismiss"):
        assert f"http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/{name}" in classes
    assert not any(name.endswith("conf/callback") for name in classes), "nobody is called back"


# Processes


def test_req_core_process_list_success(get):
    listed = get("/processes").json()
    assert [process["id"] for process in listed["processes"]] == list(PROCESSES)
    for process in listed["processes"]:
        assert {"id", "title", "version", "jobControlOptions", "outputTransmission"} <= set(process)
        assert get(href(process, "self")).json()["id"] == process["id"]


def test_req_core_pl_limit_response(get):
    for limit in (1, 2, 3, 1000):
        seen, url = [], f"/processes?limit={limit}"
        while url:
            page = get(url).json()
            assert 0 < len(page["processes"]) <= limit
            seen += [process["id"] for process in page["processes"]]
            url = next((link["href"] for link in page["links"] if link["rel"] == "next"), "")
        assert seen == list(PROCESSES)
    assert get("/processes", limit=0).status_code == 400


def test_req_ogc_process_description_success(get):
    for name in PROCESSES:
        assert_described(get(f"/processes/{name}").json(), name)


def assert_described(told: dict[str, Any], name: str) -> None:
    assert told["jobControlOptions"] == ["async-execute", "dismiss"]
    assert told["outputTransmission"] == ["value", "reference"]
    assert told["inputs"]
    assert told["outputs"]
    for described in (*told["inputs"].values(), *told["outputs"].values()):
        Draft202012Validator.check_schema(described["schema"])
        assert described["title"]
    assert "#/$defs" not in json.dumps(told), "schemas stand alone"
    for described in told["inputs"].values():
        assert described["minOccurs"] in (0, 1)
        assert described["description"]
    assert href(told, f"{OGC}execute").endswith(f"/processes/{name}/execution")


def test_req_core_process_exception_no_such_process(get, me):
    assert_exception(get("/processes/paint"), 404, "no-such-process")
    reply = me.execute("paint", {})
    assert_exception(reply, 404, "no-such-process")


# Execution


def test_req_core_process_execute_success_async(get, ask):
    reply = ask("respond-async")
    assert reply.status_code == 201
    assert reply.headers["preference-applied"] == "respond-async"
    validate(reply.json(), STATUS_INFO)
    assert reply.json()["status"] == "accepted"
    assert get(reply.headers["location"]).json()["jobID"] == reply.json()["jobID"]


def test_req_core_process_execute_default_execution_mode(ask):
    # No process has synchronous execution.
    for prefer in (None, "respond-sync", "wait=10"):
        reply = ask(prefer)
        assert reply.status_code == 201
        assert "preference-applied" not in reply.headers


def test_req_core_process_execute_inputs(me, scene):
    def posted(value: Any) -> Any:
        return me.post(EXECUTE, json={"inputs": {"scene": value}})

    for said in (
        scene,
        {"value": scene},
        {"value": scene, "mediaType": "text/plain"},
        {"href": f"http://testserver/scenes/{scene}"},
        {"href": f"http://testserver/collections/scenes/items/{scene}", "type": "application/geo+json"},
    ):
        reply = posted(said)
        assert reply.status_code == 201, reply.text
        assert reply.json()["inputs"]["scene"] == scene
    for elsewhere in (
        "http://127.0.0.1:9/scenes/x",
        "file:///etc/passwd",
        "http://testserver/jobs/x",
        f"http://127.0.0.1:9/scenes/{scene}",
        f"http://testserver.example/scenes/{scene}",
        f"http://testserver/scenes/{scene}/files/{scene}",
    ):
        assert_exception(posted({"href": elsewhere}), 422)


def test_req_core_process_execute_input_validation(ask):
    for body, named in WRONG:
        reply = ask(**body)
        assert_exception(reply, 422)
        assert named in reply.json()["detail"]


# Jobs


def test_req_core_job_success(get, ask, dsn):
    job = ask().json()
    told = get(f"/jobs/{job['jobID']}").json()
    validate(told, STATUS_INFO)
    begun(dsn, job["jobID"])
    told = get(f"/jobs/{job['jobID']}").json()
    validate(told, STATUS_INFO)
    assert told["status"] == "running"
    assert told["created"] <= told["started"] <= told["updated"]


def test_req_core_job_exception_no_such_job(get, me):
    for job in (str(uuid4()), "none", "1"):
        for path in (f"/jobs/{job}", f"/jobs/{job}/results", f"/jobs/{job}/messages"):
            assert_exception(get(path), 404, "no-such-job")
        assert_exception(me.delete(f"/jobs/{job}"), 404, "no-such-job")


# Results


def test_req_core_process_execute_default_outputs(get, done):
    results = get(f"{done()}/results").json()
    assert results["verdict"] == "good"
    assert set(results) == {
        "verdict", "report.json", "refined_RPC.TXT", "report.html", "residuals.gpkg"
    }  # fmt: skip
    for name, content in (("report.json", REPORT), ("residuals.gpkg", LAYERS)):
        assert get(results[name]["href"]).content == content


def test_req_core_job_results_async_document(get, done):
    wanted: dict[str, Any] = {
        "report.json": {},
        "refined_RPC.TXT": {"transmissionMode": "value"},
        "residuals.gpkg": {"transmissionMode": "value"},
        "report.html": {"transmissionMode": "reference"},
        "verdict": {},
        "correction.json": {},
    }
    job = done(outputs=wanted, response="document")
    results = get(f"{job}/results").json()
    assert set(results) == set(wanted) - {"correction.json"}, "what was not made is left out"
    assert results["verdict"] == "good"
    assert results["report.json"] == {"value": json.loads(REPORT), "mediaType": "application/json"}
    assert results["refined_RPC.TXT"] == {"value": MODEL.decode(), "mediaType": "text/plain"}
    assert results["residuals.gpkg"]["encoding"] == "base64"
    assert b64decode(results["residuals.gpkg"]["value"]) == LAYERS
    assert get(results["report.html"]["href"]).content == PAGE


def test_req_core_job_results_async_raw_value_one(get, done):
    for name, kind, content in (
        ("report.json", "application/json", REPORT),
        ("residuals.gpkg", "application/geopackage+sqlite3", LAYERS),
        ("verdict", "application/json", b'"good"'),
    ):
        reply = get(f"{done(outputs={name: {}}, response='raw')}/results")
        assert (reply.status_code, reply.content) == (200, content)
        assert reply.headers["content-type"] == kind


def test_req_core_job_results_async_large_values_go_by_reference_or_alone(get, done, monkeypatch):
    monkeypatch.setattr(results, "LARGEST_VALUE_BYTES", len(LAYERS) - 1)
    several: dict[str, Any] = {"residuals.gpkg": {}, "report.json": {}}
    told = get(f"{done(outputs=several)}/results").json()
    assert get(told["residuals.gpkg"]["href"]).content == LAYERS
    assert told["report.json"]["value"] == json.loads(REPORT)
    alone = get(f"{done(outputs={'residuals.gpkg': {}}, response='raw')}/results")
    assert (alone.status_code, alone.content) == (200, LAYERS)


def test_req_core_job_results_async_raw_value_and_mixed_multi(get, done):
    wanted: dict[str, Any] = {
        "verdict": {},
        "report.json": {},
        "residuals.gpkg": {},
        "report.html": {"transmissionMode": "reference"},
    }
    reply = get(f"{done(outputs=wanted, response='raw')}/results")
    kind = reply.headers["content-type"]
    assert (reply.status_code, kind.split(";")[0]) == (200, "multipart/related")
    message = message_from_bytes(f"Content-Type: {kind}\r\n\r\n".encode() + reply.content)
    parts = {part["Content-ID"]: part for part in message.get_payload()}
    assert set(parts) == {f"<{name}>" for name in wanted}
    assert parts["<report.json>"].get_payload(decode=True) == REPORT
    assert parts["<report.html>"].get_payload() == ""
    assert get(parts["<report.html>"]["Content-Location"]).content == PAGE


def test_req_core_job_results_async_raw_ref(get, done):
    by_reference = {"transmissionMode": "reference"}
    wanted = {"report.json": by_reference, "report.html": by_reference}
    reply = get(f"{done(outputs=wanted, response='raw')}/results")
    assert (reply.status_code, reply.content) == (204, b"")
    links = [part.split(">")[0].lstrip(" <") for part in reply.headers["link"].split(",")]
    assert {get(link).content for link in links} == {REPORT, PAGE}


def test_req_core_job_results_exception_results_not_ready(get, ask, dsn):
    job = ask().json()
    assert_exception(get(f"/jobs/{job['jobID']}/results"), 404, "result-not-ready")
    begun(dsn, job["jobID"])
    assert_exception(get(f"/jobs/{job['jobID']}/results"), 404, "result-not-ready")


def test_req_core_job_results_failed(get, ask, dsn, storage):
    job = ask().json()
    attempt = begun(dsn, job["jobID"]).attempt
    error = error_details(NotEnoughPoints(3, 6), storage)
    with engine.connect(dsn) as connection:
        attempts.fail(connection, UUID(job["jobID"]), attempt, error)
    reply = get(f"/jobs/{job['jobID']}/results")
    assert_exception(reply, 409)
    assert (reply.json()["found"], reply.json()["needed"]) == (3, 6)
    assert get(f"/jobs/{job['jobID']}").json()["message"] == "3 usable points found, 6 needed"


# Job list


def test_req_job_list_job_list_success(get, ask):
    made = [ask().json()["jobID"] for _ in range(3)]
    listed = get("/jobs").json()
    assert [job["jobID"] for job in listed["jobs"]] == made[::-1]
    for job in listed["jobs"]:
        validate(job, STATUS_INFO)
    assert href(listed, "self")


def test_req_job_list_parameters(get, ask, dsn):
    waiting, running, ended = (ask().json() for _ in range(3))
    begun(dsn, running["jobID"])
    attempt = begun(dsn, ended["jobID"]).attempt
    with engine.connect(dsn) as connection:
        attempts.succeed(connection, UUID(ended["jobID"]), attempt, {})
        run_sql(
            connection,
            "update job set started_at = finished_at - interval '1 hour' where id = %s",
            [ended["jobID"]],
        )

    def listed(**query: Any) -> list[str]:
        reply = get("/jobs", **query)
        assert reply.status_code == 200, reply.text
        return [job["jobID"] for job in reply.json()["jobs"]]

    everything = [ended["jobID"], running["jobID"], waiting["jobID"]]
    assert listed(type="process") == listed(processID="register-scene") == everything
    assert listed(processID="orthorectify") == []
    assert listed(status="running") == [running["jobID"]]
    assert listed(datetime=f"{running['created']}/..") == everything[:2]
    assert listed(datetime="2000-01-01/2001-01-01") == []
    assert listed(minDuration=3599) == listed(minDuration=3599, maxDuration=3601) == [ended["jobID"]]
    assert listed(maxDuration=3599) == [running["jobID"]]
    assert listed(limit=2) == everything[:2]
    for wrong in ({"type": "dance"}, {"datetime": "soon"}, {"minDuration": -1}, {"limit": 0}):
        assert get("/jobs", **wrong).status_code == 400, wrong


# Dismiss


def test_req_dismiss_job_dismiss_success(get, ask, me, dsn):
    waiting, running = (ask().json() for _ in range(2))
    begun(dsn, running["jobID"])
    for job in (waiting, running):
        reply = me.delete(f"/jobs/{job['jobID']}")
        assert reply.status_code == 200
        validate(reply.json(), STATUS_INFO)
        assert reply.json()["status"] == "dismissed"
        assert get(f"/jobs/{job['jobID']}").json()["status"] == "dismissed"
