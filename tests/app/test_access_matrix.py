"""The access of every operation of the API description, tried with every kind of caller.

Operations, and who may use them, come from the OpenAPI document: an operation added tomorrow is tried
too. It is refused when it does not declare its access, or has a path parameter without a value here.
"""

from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import httpx
import pytest
from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute

from amers.app.api import openapi
from amers.app.api.access import FURTHER_SCOPES
from amers.app.api.credentials import BEARER
from amers.app.auth import INCLUDED, Scope
from amers.app.config import Settings
from amers.app.main import ROUTERS, create_app
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.flat_world import SIGMA_M, make_flat_world
from tests.app.hostile_installation import Installation, hostile_installation, told

pytestmark = pytest.mark.security

METHODS = ("get", "head", "options", "post", "put", "patch", "delete")
UNDESCRIBED = {
    "/api",
    "/connect",
    "/map",
    "/map/background.json",
    "/map/{name}",
    "/sign-in",
    "/sign-out",
}
"""Routes that are no part of the description: the description itself, and the pages for people."""
ASKS = {"OPTIONS"}
"""Methods of routes that are no part of it either: what a path can do."""
SCOPES: dict[str, tuple[Scope, ...]] = {
    "read": (Scope.READ,),
    "register": (Scope.REGISTER,),
    "monitor": (Scope.MONITOR,),
    "admin": (Scope.ADMIN,),
}
"""Callers with a valid token. All things that the requests name belong to the caller `other`."""
UNCOMPARED = ("audit", "probe.txt")
"""What everybody may change: `/readyz` writes a tiny file into the storage."""
INVALID = ("nobody", "wrong", "expired", "revoked")
MAYBE_WITHOUT_FILES = ("/results", "/files/", "/map/")
"""Parts of paths of files that the things of `other` do not have: the job has not run."""
OTHERS_SCENE_NAME = "harbour-2b9e.tif"
OWNED = {"scene_id": "others_scene", "upload_id": "others_upload", "job_id": "others_job"}
"""Path parameters that name what belongs to one owner."""
SHARED = {
    "point_id": "<point>",
    "feature_id": "1",
    "reference": "<staged>",
    "view": "1",
    "layer": "raw",
    "matrix_set": "WebMercatorQuad",
    "z": "0",
    "y": "0",
    "x": "0",
    "process_id": "register-scene",
    "token_id": str(UUID(int=1)),
    "name": "nothing",
    "item_id": "<others_scene>",
}
"""Values of the other path parameters."""


@dataclass(frozen=True)
class Operation:
    """An operation of the description.

    Attributes:
        security: as the description declares it; None: it does not.
        further: scopes that some inputs need in addition.
    """

    method: str
    path: str
    security: list[dict[str, list[str]]] | None
    further: tuple[str, ...]

    @property
    def is_public(self) -> bool:
        """Whether callers without a token may use it."""
        return {} in (self.security or [])

    @property
    def checks_tokens(self) -> bool:
        """Whether it looks at a token at all."""
        return any(BEARER in requirement for requirement in self.security or [])

    @property
    def is_owned(self) -> bool:
        """Whether it is about something that belongs to one owner."""
        return any(f"{{{name}}}" in self.path for name in OWNED) or self.path.startswith(
            ("/collections/scenes/items/{",)
        )

    def allows(self, role: str) -> bool:
        """Whether the declared scope is one that a caller has."""
        included = {scope for own in SCOPES[role] for scope in INCLUDED[own]}
        scopes = [set(needed) for item in self.security or [] for needed in item.values()]
        return self.is_public or any(needed <= set(map(str, included)) for needed in scopes)

    def url(self, store: Installation) -> str:
        """The path, filled with things of the caller `other`."""
        path = self.path
        for name, value in {**{key: f"<{thing}>" for key, thing in OWNED.items()}, **SHARED}.items():
            path = path.replace(f"{{{name}}}", value)
        if self.path.startswith("/collections/scenes/items/"):
            path = "/collections/scenes/items/<others_scene>"
        assert "{" not in path, f"{path}: give SHARED or OWNED a value for this parameter"
        return store.filled(path)


def operations(document: dict[str, Any]) -> list[Operation]:
    """All operations of a description."""
    return [
        Operation(
            method,
            path,
            operation.get("security"),
            tuple(operation.get(FURTHER_SCOPES, ())),
        )
        for path, described in document["paths"].items()
        for method, operation in described.items()
        if method in METHODS
    ]


DOCUMENT = create_app(Settings(data_folder=Path("unused"))).openapi()
OPERATIONS = operations(DOCUMENT)
IDS = [f"{item.method.upper()} {item.path}" for item in OPERATIONS]


@pytest.fixture(scope="module")
def store(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    """An installation whose scenes, uploads and jobs belong to one owner, `other`."""
    folder = tmp_path_factory.mktemp("access")
    world = make_flat_world(folder / "world", size=600, points=12)
    with fresh_database(cluster, TEMPLATE) as dsn, hostile_installation(dsn, folder, world) as store:
        scene = store.client.post(
            f"/scenes?name={OTHERS_SCENE_NAME}&sigma_m={SIGMA_M}",
            content=world.tagged.read_bytes(),
            headers=store.headers["other"],
        )
        store.names["others_scene"] = scene.json()["id"]
        store.headers["wrong"] = {"Authorization": f"Bearer {store.names['secret_but_one']}"}
        yield store


def send(store: Installation, operation: Operation, role: str) -> httpx.Response:
    """The reply to a request of a caller, complete but for what access does not depend on."""
    more: dict[str, Any] = {}
    headers = dict(store.headers[role])
    if operation.path.startswith("/uploads"):
        headers |= {"Tus-Resumable": "1.0.0", "Upload-Length": "10", "Upload-Offset": "0"}
        headers |= {"Upload-Metadata": "filename YS50aWY="}
    if operation.method in ("post", "put", "patch"):
        if operation.method == "patch" and operation.path.startswith("/uploads"):
            headers["Content-Type"] = "application/offset+octet-stream"
            more["content"] = b"II*\0"
        else:
            more["json"] = {}
    return store.client.request(operation.method, operation.url(store), headers=headers, **more)


def discloses(store: Installation, operation: Operation, reply: httpx.Response) -> list[str]:
    """What a reply shows of the things of others that the request itself did not name."""
    request = operation.url(store)
    things = [store.names[thing] for thing in OWNED.values()] + [OTHERS_SCENE_NAME]
    return [thing for thing in things if thing in told(reply) and thing not in request]


def test_every_operation_declares_who_may_use_it():
    assert [name for name, item in zip(IDS, OPERATIONS, strict=True) if item.security is None] == []
    described = {item.path for item in OPERATIONS}
    for router in ROUTERS:
        for route in router.routes:
            assert isinstance(route, APIRoute)
            if not route.include_in_schema:
                assert route.path in UNDESCRIBED or route.methods == ASKS, route.path
    assert len(described) > 50


def test_an_operation_without_a_declaration_is_noticed():
    router = APIRouter()

    @router.get("/new")
    def new() -> None:
        """An operation whose author forgot its access."""

    app = FastAPI()
    openapi.install(app, (router,), Settings(data_folder=Path("unused")))
    app.include_router(router)
    (operation,) = (item for item in operations(app.openapi()) if item.path == "/new")
    assert operation.security is None


OF_OPENAPI = {
    *("tags", "summary", "description", "externalDocs", "operationId", "parameters", "requestBody"),
    *("responses", "callbacks", "deprecated", "security", "servers"),
}
"""Members of an operation. Source: OpenAPI 3.1.0, section 4.8.10."""


def test_what_the_description_adds_to_openapi_is_an_extension_that_names_scopes():
    described = [item for path in DOCUMENT["paths"].values() for item in path.values()]
    added = {member for item in described for member in item} - OF_OPENAPI
    assert added
    assert all(member.startswith("x-") for member in added)
    further = {scope for item in OPERATIONS for scope in item.further}
    assert {str(Scope.ADMIN)} <= further <= {str(scope) for scope in Scope}


def test_public_settings_are_part_of_the_declaration():
    settings = Settings(data_folder=Path("unused"), public_points=True, public_metrics=True)
    public = {item.path for item in operations(create_app(settings).openapi()) if item.is_public}
    closed = {item.path for item in OPERATIONS if item.is_public}
    assert public - closed >= {"/metrics", "/collections/points/items", "/collections"}
    assert not any(path.startswith("/collections/scenes") for path in public)


@pytest.mark.parametrize("operation", OPERATIONS, ids=IDS)
def test_refused_callers_learn_and_change_nothing(store: Installation, operation: Operation):
    before = store.digest(UNCOMPARED)
    replies = {role: send(store, operation, role) for role in INVALID}
    for role, reply in replies.items():
        if operation.checks_tokens and not (role == "nobody" and operation.is_public):
            assert reply.status_code == 401, (role, reply.text[:300])
            assert reply.headers["www-authenticate"].startswith("Bearer")
        else:
            assert reply.status_code not in (401, 403), (role, reply.text[:300])
    for role in SCOPES:
        if operation.checks_tokens and not operation.allows(role):
            replies[role] = send(store, operation, role)
            assert replies[role].status_code == 403, (role, replies[role].text[:300])
        elif role != "admin" and operation.is_owned:
            replies[role] = send(store, operation, role)
            assert replies[role].status_code == 404, (role, replies[role].text[:300])
    assert store.digest(UNCOMPARED) == before
    for role, reply in replies.items():
        assert reply.status_code < 500, (role, reply.text[:300])
        assert discloses(store, operation, reply) == [], role


@pytest.fixture(scope="module")
def deleted() -> set[str]:
    """Paths of operations whose things an administrator has deleted."""
    return set()


@pytest.mark.parametrize(
    "operation",
    sorted(OPERATIONS, key=lambda item: METHODS.index(item.method)),
    ids=lambda item: f"{item.method.upper()} {item.path}",
)
def test_allowed_callers_are_let_in_and_see_nothing_of_others(
    store: Installation, deleted: set[str], operation: Operation
):
    """The administrator comes last for each method, deletions last of all: they are carried out.

    In an order that is drawn, what was deleted before is not there.
    """
    for role in SCOPES:
        if not operation.checks_tokens or not operation.allows(role):
            continue
        reply = send(store, operation, role)
        assert reply.status_code < 500, (role, reply.text[:300])
        assert reply.status_code != 401, role
        needs_more = role != "admin" and operation.further
        assert needs_more or reply.status_code != 403, (role, reply.text[:300])
        if role == "admin":
            if operation.method == "delete" and reply.is_success:
                deleted.add(operation.path)
            is_there = (
                operation.method in ("get", "head")
                and operation.is_owned
                and not operation.path.startswith(tuple(deleted))
            )
            assert (
                not is_there
                or reply.status_code != 404
                or any(files in operation.path for files in MAYBE_WITHOUT_FILES)
            ), reply.text[:300]
        else:
            assert discloses(store, operation, reply) == [], role


def test_the_token_as_password_of_basic_is_taken_wherever_bearer_is(store: Installation):
    """By a caller whose scope few operations allow, so that nothing changes."""
    secret = store.headers["monitor"]["Authorization"].split()[1]
    password = b64encode(f"anybody:{secret}".encode()).decode()
    store.headers["monitor by basic"] = {"Authorization": f"Basic {password}"}
    for name, operation in zip(IDS, OPERATIONS, strict=True):
        if operation.checks_tokens:
            by_bearer, by_basic = (
                send(store, operation, role) for role in ("monitor", "monitor by basic")
            )
            assert by_basic.status_code == by_bearer.status_code != 401, name


@pytest.mark.parametrize("thing", OWNED.values())
def test_the_reply_about_the_thing_of_another_is_that_about_no_thing(store: Installation, thing: str):
    folder = {"others_scene": "scenes", "others_upload": "uploads", "others_job": "jobs"}[thing]
    replies = [
        store.client.get(f"/{folder}/{one}", headers=store.headers["register"])
        for one in (store.names[thing], str(uuid4()))
    ]
    his, none = (reply.text.replace(str(reply.request.url).rsplit("/", 1)[1], "ID") for reply in replies)
    assert (replies[0].status_code, his) == (404, none)
