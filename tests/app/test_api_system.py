"""The landing page, health checks, access by scopes, and replies to errors."""

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from amers.app.api import error_responses
from amers.app.api.deps import Admin, DatabaseDep, PointsReader, Reader, Registrar
from amers.app.api.try_out import TRY_OUTS
from amers.app.db import engine
from amers.app.errors import (
    AmersError,
    ComputationError,
    Conflict,
    InputError,
    NotAllowed,
    NotFound,
    TooLarge,
)
from amers.app.main import create_app
from amers.app.usecases.tokens import create_token, list_tokens
from amers.services.errors import NotEnoughPoints
from tests.statements import run_in, run_sql

SCOPES = {"read": Reader, "register": Registrar, "admin": Admin}


@pytest.fixture
def app(settings):
    """The application with endpoints of the tests beside its own."""
    app = create_app(settings)
    for name, caller in SCOPES.items():
        app.add_api_route(f"/scope/{name}", endpoint_for(caller))
    app.add_api_route("/scope/points", endpoint_for(PointsReader))

    @app.get("/number/{number}")
    def number(number: int, database: DatabaseDep) -> int:
        with database.reading() as connection:
            return run_sql(connection, "select %s / nullif(%s, 0) as it", [10, number]).fetchone()["it"]

    @app.post("/echo")
    def echo(body: dict) -> dict:
        return body

    @app.post("/token/{name}")
    def keep(name: str, database: DatabaseDep) -> str:
        with database.transaction() as connection:
            create_token(connection, name, ["read"])
            if name == "spoiled":
                raise Conflict("spoiled")
        return name

    @app.get("/slow")
    def slow(database: DatabaseDep) -> None:
        with database.reading() as connection:
            run_sql(connection, "select pg_sleep(20)")

    return app


def endpoint_for(caller: type) -> object:
    def show_caller(caller: caller) -> str:
        return caller.name if caller else "anybody"

    return show_caller


@pytest.fixture
def client(app):
    with TestClient(app, raise_server_exceptions=False) as client:
        yield client


def refused(reply, status: int) -> dict:
    """The problem details of a reply, checked against RFC 9457."""
    assert reply.status_code == status, reply.text
    assert reply.headers["content-type"] == error_responses.PROBLEM_JSON
    problem = reply.json()
    assert problem["status"] == status
    assert problem["type"] == "about:blank"
    assert problem["title"]
    assert problem["detail"]
    return problem


def test_every_link_of_the_landing_page_works(client, bearer):
    page, caller = client.get("/").json(), bearer("register")
    for link in page["links"]:
        assert caller.get(link["href"]).status_code == 200, link


def test_a_ready_service_has_a_database_that_answers(client):
    assert client.get("/healthz").json() == {"status": "alive"}
    reply = client.get("/readyz")
    assert (reply.status_code, reply.json()["parts"]["database"]) == (200, {"status": "ok"})


def test_connections_that_the_database_has_closed_are_replaced_before_use(client, dsn):
    ours = "datname = current_database() and usename = current_user and pid <> pg_backend_pid()"
    run_in(
        engine.connect(dsn),
        f"select pg_terminate_backend(pid, 10000) from pg_stat_activity where {ours}",
    )
    for _ in range(5):
        assert client.get("/conformance").status_code == client.get("/readyz").status_code == 200


def test_the_description_of_the_api_is_openapi_3_1(client):
    assert client.get("/api").json()["openapi"].startswith("3.1")


def test_the_page_of_the_api_has_all_operations_with_their_parameters(client):
    document = client.get("/api").json()
    page = client.get("/api?f=html").text
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            start = page.index(f"<code>{method.upper()} {path}</code>")
            part = page[start : page.index("</details>", start)]
            for parameter in operation["parameters"]:
                assert f"<code>{parameter['name']}</code>" in part, (path, parameter["name"])
    items = page.partition("GET /collections/points/items</code>")[2].partition("</details>")[0]
    assert "a token with scope read" in items
    assert "at least 1; at most" in items, "the bounds of limit"


@pytest.mark.parametrize("path", ["/?f=html", "/api?f=html"])
def test_every_form_of_a_page_sends_a_request_that_the_service_answers(client, bearer, path):
    """As a browser sends it: all fields of the form in the query, without a script."""
    reply = client.get(path)
    assert "<script" not in reply.text
    assert "form-action 'self'" in reply.headers["content-security-policy"]
    assert reply.text.count('<form method="get"') == len(TRY_OUTS)
    for form in TRY_OUTS:
        assert f"{client.base_url}/{form.path}" in reply.text
        choices = {field.name: [value for value, _ in field.choices] for field in form.fields}
        asked = {field.name: field.value for field in form.fields}
        for kind in choices["f"]:
            tried = bearer("read").get(f"/{form.path}", params=asked | {"f": kind})
            assert tried.status_code == 200, (form.id, kind, tried.text)


def test_an_endpoint_refuses_callers_without_a_token(client):
    for path in ["/scope/read", "/scope/register", "/scope/admin", "/scope/points"]:
        reply = client.get(path)
        refused(reply, 401)
        assert reply.headers["www-authenticate"].startswith("Bearer"), path


@pytest.mark.parametrize("header", ["Bearer wrong", "Bearer ", "Basic dTpw", "nonsense", "Bearer \x00"])
@pytest.mark.parametrize("path", ["/scope/read", "/scope/points"])
def test_an_invalid_token_is_refused_and_never_treated_as_no_token(client, settings, path, header):
    public = TestClient(client.app)
    client.app.state.settings = settings.model_copy(update={"public_points": True})
    refused(public.get(path, headers={"Authorization": header}), 401)


@pytest.mark.parametrize(
    ("scope", "opened"),
    [
        ("read", {"read", "points"}),
        ("register", {"read", "register", "points"}),
        ("admin", {*SCOPES, "points"}),
    ],
)
def test_a_token_opens_the_endpoints_of_its_scope(bearer, scope, opened):
    caller = bearer(scope)
    for name in (*SCOPES, "points"):
        reply = caller.get(f"/scope/{name}")
        if name in opened:
            assert reply.json() == f"a token to {scope}"
        else:
            assert "scope" in refused(reply, 403)["detail"]


def test_points_are_open_without_a_token_only_if_the_setting_allows_it(client, settings):
    refused(client.get("/scope/points"), 401)
    client.app.state.settings = settings.model_copy(update={"public_points": True})
    assert client.get("/scope/points").json() == "anybody"
    refused(client.get("/scope/read"), 401)


def test_a_part_of_a_path_that_names_nothing_is_named(client):
    problem = refused(client.get("/number/seven"), 404)
    assert problem["errors"][0]["field"] == "path.number"
    assert "no number 'seven'" in problem["detail"]


def test_an_unknown_path_is_a_problem_too(client):
    refused(client.get("/nothing/here"), 404)
    refused(client.delete("/healthz"), 405)


def test_a_body_that_is_not_json_is_refused(client):
    refused(client.post("/echo", content=b"{", headers={"Content-Type": "application/json"}), 422)


def test_the_reply_to_an_unexpected_error_reveals_nothing(client):
    @client.app.get("/broken")
    def broken() -> None:
        raise KeyError("the inside")

    problem = refused(client.get("/broken"), 500)
    assert "inside" not in str(problem)


def test_a_request_that_takes_the_database_too_long_is_stopped(app, settings, dsn):
    quick = create_app(settings.model_copy(update={"read_timeout_seconds": 0.1}))
    quick.router.routes.extend(route for route in app.routes if getattr(route, "path", "") == "/slow")
    with TestClient(quick, raise_server_exceptions=False) as client:
        assert "too long" in refused(client.get("/slow"), 503)["detail"]


def test_a_request_is_stored_completely_or_not_at_all(client, connection):
    assert client.post("/token/whole").status_code == 200
    assert [token.name for token in list_tokens(connection)] == ["whole"]
    refused(client.post("/token/spoiled"), 409)
    assert [token.name for token in list_tokens(connection)] == ["whole"]


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (InputError("x"), 422),
        (NotEnoughPoints(found=3, needed=6), 409),
        (ComputationError("x"), 409),
        (Conflict("x"), 409),
        (NotFound("x"), 404),
        (TooLarge("x"), 413),
        (NotAllowed("x", authenticated=False), 401),
        (NotAllowed("x", authenticated=True), 403),
        (AmersError("x"), 500),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_every_error_has_its_status(error, status):
    app = FastAPI()
    error_responses.install(app)

    @app.get("/")
    def fail() -> None:
        raise error

    problem = refused(TestClient(app).get("/"), status)
    assert problem["detail"] == str(error)
    assert problem["error"] == type(error).__name__
