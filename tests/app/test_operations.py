"""Operations: the audit record, metrics, the log, quotas of tokens, and access to them."""

import json
import logging
from uuid import UUID

import psycopg
import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from amers.app import logs
from amers.app.db import engine, metrics, scenes
from amers.app.db.audit import list_changes
from amers.app.db.jobs import attempts, jobs
from amers.app.errors import TooLarge, TooMany
from amers.app.main import create_app
from amers.app.request_context import Origin, working_for
from amers.app.usecases import quotas
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.history import suspend_point
from amers.app.usecases.tokens import create_token
from amers.app.usecases.usage import read_all_usage
from tests.app.job_queue import claim
from tests.app.served import serve_block
from tests.factories import make_block
from tests.statements import run_sql


def changes(connection, **chosen) -> list:
    """The recorded changes, the oldest first."""
    filters = {"before": None, "kind": None, "subject": None, **chosen}
    return list_changes(connection, 1000, **filters)[::-1]


def test_every_step_of_a_block_is_recorded_with_its_state_before_and_after(
    connection, storage, tmp_path
):
    serve_block(connection, storage, make_block(tmp_path / "block", 5).folder)
    lifecycle.withdraw_block(connection, "calanques")
    recorded = changes(connection, kind="block", subject="calanques@1")
    assert [change.action for change in recorded] == ["created", "changed", "changed"]
    assert recorded[0].before is None
    assert [(change.after or {})["state"] for change in recorded] == ["staged", "published", "withdrawn"]
    assert recorded[2].before is not None
    assert recorded[2].before["state"] == "published"
    assert recorded[0].actor_name.endswith("on the command line")


@pytest.mark.parametrize(
    "statement", ["update audit set actor_name = 'x'", "delete from audit", "truncate audit"]
)
def test_the_record_only_grows(connection, statement):
    create_token(connection, "a", ["read"])
    with pytest.raises(psycopg.errors.InsufficientPrivilege, match="only grows"):
        run_sql(connection, statement)


def test_a_change_over_the_api_names_caller_and_request(client, connection, admin):
    made = client.post(
        "/tokens",
        json={"name": "office", "scopes": ["read"], "days": 3},
        headers={**admin, "X-Request-ID": "morning-1"},
    )
    assert made.headers["X-Request-ID"] == "morning-1"
    recorded = changes(connection, kind="token", subject=made.json()["id"])
    (change,) = recorded
    assert (change.actor_name, change.request_id) == ("a token to admin", "morning-1")
    assert "secret_hash" not in (change.after or {})
    listed = admin.get("/audit", params={"kind": "token", "limit": 1}).json()
    assert listed["changes"][0]["subject"] == made.json()["id"]
    assert any(link["rel"] == "next" for link in listed["links"])


def test_the_states_of_a_job_are_recorded_and_its_progress_is_not(connection):
    job = jobs.create(connection, "register-scene", {})
    attempt = claim(connection, job.id, "w", 30.0)
    attempts.report(connection, job.id, attempt.attempt, 10, "on the way")
    attempts.succeed(connection, job.id, attempt.attempt, {})
    recorded = changes(connection, kind="job")
    assert [(change.after or {})["state"] for change in recorded] == [
        "accepted",
        "running",
        "successful",
    ]


def test_work_of_a_job_is_recorded_with_the_owner_of_the_job(dsn, connection):
    owner = create_token(connection, "owner", ["register"]).token
    job = jobs.create(connection, "ingest-block", {}, owner.id)
    connection.commit()
    with working_for(Origin(actor_name="worker 7", job_id=job.id)), engine.connect(dsn) as own:
        scenes.begin_upload(own, owner.id, "a", "a.tif", sigma_m=None)
    (change,) = changes(connection, kind="scene")
    assert (change.actor, change.actor_name, change.job_id) == (owner.id, "worker 7", job.id)


@pytest.mark.parametrize("path", ["/audit", "/tokens"])
def test_the_record_and_the_tokens_are_for_administrators(client, bearer, path):
    assert client.get(path).status_code == 401
    assert bearer("register").get(path).status_code == 403
    assert bearer("admin").get(path).status_code == 200


def test_an_administrator_makes_lists_and_revokes_tokens_over_the_api(client, admin):
    body = {"name": "office", "scopes": ["register"], "job_quota": 2}
    made = admin.post("/tokens", json=body)
    assert made.status_code == 201
    token = made.json()
    own = {"Authorization": f"Bearer {token['secret']}"}
    assert client.get("/tokens/self", headers=own).json()["scopes"] == ["register"]
    listed = admin.get("/tokens").json()["tokens"]
    assert token["id"] in [one["id"] for one in listed]
    assert "secret" not in json.dumps(listed)
    revoked = admin.delete(f"/tokens/{token['id']}")
    assert revoked.json()["revoked_at"] is not None
    assert client.get("/tokens/self", headers=own).status_code == 401
    assert client.get("/tokens/self").status_code == 401
    assert admin.delete(f"/tokens/{token['id']}").status_code == 404


def test_a_token_with_unusable_properties_is_refused_over_the_api(bearer):
    for body in [
        {"name": "x", "scopes": ["everything"]},
        {"name": "", "scopes": ["read"]},
        {"name": "x", "scopes": []},
        {"name": "x", "scopes": ["read"], "days": 0},
        {"name": "x", "scopes": ["read"], "job_quota": -1},
        {"name": "x", "scopes": ["read"], "storage_quota_bytes": 2**63},
        {"name": "x", "scopes": ["read"], "surprise": 1},
    ]:
        assert bearer("admin").post("/tokens", json=body).status_code == 422, body


def test_a_token_has_no_more_open_jobs_than_its_quota(connection, settings):
    few = create_token(connection, "few", ["register"], job_quota=1).token
    quotas.require_free_job(connection, settings, few)
    job = jobs.create(connection, "register-scene", {}, few.id)
    with pytest.raises(TooMany, match="has 1 open jobs of 1 allowed"):
        quotas.require_free_job(connection, settings, few)
    jobs.dismiss(connection, job.id)
    quotas.require_free_job(connection, settings, few)


def test_a_token_whose_jobs_took_the_cpu_of_a_day_waits_until_some_is_given_back(connection, settings):
    one, other = (create_token(connection, name, ["register"]).token for name in ("one", "other"))
    day = settings.model_copy(update={"quota_cpu_seconds": 1000.0})
    for token in (one, other):
        job = jobs.create(connection, "register-scene", {}, token.id)
        assert attempts.claim_next(connection, "w", 30.0) is not None
    attempts.count_cpu(connection, one.id, 600.0, 1000.0)
    quotas.require_free_job(connection, day, one)
    attempts.count_cpu(connection, one.id, 500.0, 1000.0)
    jobs.dismiss(connection, job.id)
    with pytest.raises(TooMany, match=r"one have taken 1100 s of CPU of the 1000 s .* 14\d minutes"):
        quotas.require_free_job(connection, day, one)
    quotas.require_free_job(connection, day, other)
    run_sql(connection, "update job_turn set cpu_at = clock_timestamp() - interval '12 hours'")
    assert attempts.cpu_taken(connection, one.id, 1000.0) == pytest.approx(600.0, abs=1.0)
    quotas.require_free_job(connection, day, one)
    run_sql(connection, "update job_turn set cpu_at = clock_timestamp() + interval '1 year'")
    assert attempts.cpu_taken(connection, one.id, 1000.0) == pytest.approx(1100.0, abs=0.1), (
        "a clock went back"
    )


def test_a_token_uploads_no_more_bytes_than_its_quota(connection, settings):
    small = create_token(connection, "small", ["register"], storage_quota_bytes=1000).token
    assert quotas.require_room(connection, settings, small.id, "an image", 1000) == 1000
    scene_id = scenes.begin_upload(connection, small.id, "a", "a.tif", sigma_m=None)
    scenes.finish_upload(connection, scene_id, "scenes/a/a.tif", 900, "0" * 64)
    assert quotas.require_room(connection, settings, small.id, "an image") == 100
    with pytest.raises(TooLarge, match="900 of 1000 bytes are used"):
        quotas.require_room(connection, settings, small.id, "an image", 101)
    scenes.remove_scene(connection, scene_id)
    assert quotas.require_room(connection, settings, small.id, "an image") == 1000


def families(text: str) -> dict:
    return {family.name: family for family in text_string_to_metric_families(text)}


def test_metrics_report_requests_jobs_points_and_disk(client, connection, storage, bearer, tmp_path):
    made = make_block(tmp_path / "block", 7)
    serve_block(connection, storage, made.folder)
    jobs.create(connection, "register-scene", {})
    connection.commit()
    client.get("/healthz")
    client.get("/no/such/thing")
    client.request("ODD", "/healthz")
    metric_families = families(bearer("monitor").get("/metrics").text)
    value = {name: family.samples[0].value for name, family in metric_families.items() if family.samples}
    assert value["amers_points_published"] == 7
    assert value["amers_queue_length"] == 1
    assert value["amers_workers"] == 0
    assert value["amers_chip_bytes"] == sum(made.chips(row).nbytes for row in range(7))
    assert value["amers_oldest_waiting_job_seconds"] > 0
    assert 0 < value["amers_disk_free_bytes"] < value["amers_disk_total_bytes"]
    assert value["amers_database_bytes"] > 1_000_000
    (waiting,) = metric_families["amers_jobs"].samples
    assert waiting.labels == {"kind": "register-scene", "state": "accepted"}
    counts = {
        (sample.labels["method"], sample.labels["route"], sample.labels["status"]): sample.value
        for sample in metric_families["amers_request_duration_seconds"].samples
        if sample.name.endswith("_count")
    }
    assert counts["GET", "/healthz", "200"] == 1
    assert counts["GET", "none", "404"] == 1
    assert not any(method == "ODD" for method, _, _ in counts)


def test_the_status_has_the_queue_and_what_is_stored(connection, storage, bearer, tmp_path):
    made = make_block(tmp_path / "block", 7)
    serve_block(connection, storage, made.folder)
    jobs.create(connection, "register-scene", {})
    connection.commit()
    assert bearer("monitor").get("/status").status_code == 403
    status = bearer("admin").get("/status").json()
    assert (status["jobs_waiting"], status["jobs_running"], status["workers"]) == (1, 0, 0)
    assert status["oldest_waiting_s"] > 0
    assert status["points_served"] == 7
    assert status["chip_bytes"] == sum(made.chips(row).nbytes for row in range(7))
    assert status["damaged_files"] == 0


def test_points_that_nobody_gets_do_not_count_as_served(connection, storage, tmp_path):
    for version in ("1", "2"):
        made = make_block(tmp_path / version, 7, version=version)
        lifecycle.ingest_block(connection, storage, made.folder)
    assert metrics.read_gauges(connection).points == 0
    lifecycle.publish_block(connection, "calanques@1")
    assert metrics.read_gauges(connection).points == 7
    suspend_point(connection, 2**26, "under water")
    assert metrics.read_gauges(connection).points == 6
    lifecycle.withdraw_block(connection, "calanques@1")
    assert metrics.read_gauges(connection).points == 0


def test_the_oldest_job_that_waits_tells_for_how_long_jobs_wait(connection):
    assert metrics.read_gauges(connection).oldest_waiting_s == 0.0
    made = [jobs.create(connection, "register-scene", {}) for _ in range(3)]
    for job, age_s in zip(made, (100, 1000, 9000), strict=True):
        assert job is not None
        run_sql(
            connection,
            "update job set created_at = clock_timestamp() - make_interval(secs => %s) where id = %s",
            [age_s, job.id],
        )
    jobs.dismiss(connection, made[2].id)
    gauges = metrics.read_gauges(connection)
    assert gauges.queue == 2
    assert 1000 <= gauges.oldest_waiting_s < 1100


def test_pages_of_the_audit_trail_follow_each_other_without_repetition(connection):
    for number in range(5):
        create_token(connection, f"token {number}", ["read"])
    everything = [change.id for change in changes(connection)]
    pages, before = [], None
    while len(pages) < 9 and (page := list_changes(connection, 2, before, None, None)):
        pages += [change.id for change in page]
        before = pages[-1]
    assert pages == everything[::-1] == sorted(everything, reverse=True)
    assert len(pages) == 5


def test_who_keeps_most_comes_first_with_the_share_of_his_own_quota(connection, settings):
    kept = {"little": (10, 20), "much": (1000, 4000), "nothing allowed": (100, 0)}
    for name, (size_bytes, quota_bytes) in kept.items():
        token = create_token(connection, name, ["register"], storage_quota_bytes=quota_bytes).token
        scene = scenes.begin_upload(connection, token.id, "a.tif", "a.tif", sigma_m=None)
        scenes.finish_upload(connection, scene, f"scenes/{scene}/a.tif", size_bytes, "0" * 64)
    listed = [(row.name, row.share) for row in read_all_usage(connection, settings)]
    assert listed == [("much", 0.25), ("nothing allowed", None), ("little", 0.5)]


def test_chips_that_two_blocks_share_are_stored_once(connection, storage, bearer, tmp_path):
    administrator = bearer("admin")
    sizes = []
    for version in ("1", "2"):
        made = make_block(tmp_path / version, 7, version=version)
        lifecycle.ingest_block(connection, storage, made.folder)
        connection.commit()
        sizes.append(administrator.get("/status").json()["chip_bytes"])
    assert sizes[0] == sizes[1] > 0


def test_the_audit_trail_is_filtered_by_who_made_the_changes(client, bearer):
    administrator = bearer("admin")
    for name in ("Ada", "Bob"):
        body = {"name": name, "scopes": ["admin"]}
        secret = administrator.post("/tokens", json=body).json()["secret"]
        made = {"name": f"of {name}", "scopes": ["read"]}
        client.post("/tokens", json=made, headers={"Authorization": f"Bearer {secret}"})
    changes = administrator.get("/audit?actor=Ada").json()["changes"]
    assert [change["after"]["name"] for change in changes] == ["of Ada"]
    assert administrator.get("/audit?actor=nobody").json()["changes"] == []


def test_metrics_are_closed_until_a_setting_opens_them(client, settings, bearer):
    assert client.get("/metrics").status_code == 401
    assert bearer("read").get("/metrics").status_code == 403
    client.app.state.settings = settings.model_copy(update={"public_metrics": True})
    assert client.get("/metrics").status_code == 200


def test_a_request_id_that_is_none_is_replaced(client):
    for sent in ["with blank", "x" * 65, "é", "a/b"]:
        given = client.get("/healthz", headers={"X-Request-ID": sent.encode()}).headers["X-Request-ID"]
        assert UUID(given), sent


def test_an_unexpected_error_names_its_request(client):
    @client.app.get("/broken")
    def broken() -> None:
        raise KeyError("the inside")

    reply = client.get("/broken", headers={"X-Request-ID": "find-me"})
    assert (reply.status_code, reply.headers["X-Request-ID"]) == (500, "find-me")


def test_pages_of_other_sites_may_call_only_where_a_setting_names_them(settings):
    preflight_headers = {"Origin": "https://map.example", "Access-Control-Request-Method": "GET"}
    with TestClient(create_app(settings)) as closed:
        assert (
            "access-control-allow-origin"
            not in closed.options("/healthz", headers=preflight_headers).headers
        )
    chosen = settings.model_copy(update={"cors_origins": ("https://map.example",)})
    with TestClient(create_app(chosen)) as opened:
        reply = opened.options("/healthz", headers=preflight_headers)
        assert reply.headers["access-control-allow-origin"] == "https://map.example"
        other = opened.options(
            "/healthz", headers={**preflight_headers, "Origin": "https://evil.example"}
        )
        assert "access-control-allow-origin" not in other.headers


def record(message: str, **extra) -> logging.LogRecord:
    made = logging.makeLogRecord({"name": "amers", "levelname": "INFO", "msg": message, **extra})
    return made


def test_a_line_of_the_log_carries_request_job_and_caller():
    job_id, actor = UUID(int=1), UUID(int=2)
    with working_for(Origin(actor=actor, request_id="r-1", job_id=job_id)):
        line = json.loads(logs.Lines("json").format(record("done", status=200)))
        plain = logs.Lines("text").format(record("done", status=200, path="a b"))
    assert (line["request_id"], line["job_id"], line["actor"]) == ("r-1", str(job_id), str(actor))
    assert (line["message"], line["status"]) == ("done", 200)
    assert plain.endswith(f'done request_id=r-1 job_id={job_id} actor={actor} status=200 path="a b"')


def test_text_that_a_caller_sends_never_looks_like_a_line_of_the_log():
    line = logs.Lines("text").format(record("name\n2026-01-01 INFO forged"))
    assert "\n" not in line
