"""What belongs to a block that is not published is served in no way; once it is published, it is."""

from collections.abc import Callable, Iterable

import httpx
import pytest

from amers.app.db.blocks import ID_BITS
from amers.app.usecases import history
from amers.app.usecases.blocks import lifecycle
from tests.factories import make_block

pytestmark = pytest.mark.security

READ, ADMIN = "read", "admin"
POINTS, CHIPS, HISTORY = (
    f"/collections/{name}" for name in ("points/items", "points/chips", "point-history/items")
)
OF_A_POINT = (
    f"{POINTS}/<served>",
    f"{POINTS}/<served>?f=html",
    f"{POINTS}/<served>/chips",
    f"{POINTS}/<served>/chips?f=png",
    f"{POINTS}/<served>/chips/0",
    f"{POINTS}/<served>/chips/0?f=tif",
    f"{CHIPS}?ids=<served>",
    f"{CHIPS}?ids=<served>&f=tif",
    f"{HISTORY}/<suspended>",
)
TELLING = ("points", "density", "point-history", "blocks")
OF_ALL = (
    f"{POINTS}?bbox=5,43,6,44",
    f"{POINTS}?bbox=5,43,6,44&f=csv",
    f"{CHIPS}?bbox=5,43,6,44",
    HISTORY,
    f"{HISTORY}?filter=state='suspended'",
    "/collections/points/tiles/WebMercatorQuad/8/93/131",
    "/collections/density/items",
    "/collections/blocks/items",
    *(f"/collections/{name}" for name in TELLING),
)


@pytest.fixture
def staged(connection, storage, tmp_path) -> dict[str, str]:
    """Ids of points of a staged block beside a published one: one to be served, one suspended."""
    for count, name, west in ((12, "shown", 5.2), (9, "staged", 5.3)):
        box = (west, 43.2, west + 0.1, 43.3)
        folder = make_block(tmp_path / name, count=count, seed=count, name=name, box=box).folder
        number = lifecycle.ingest_block(connection, storage, folder).block.number
        first = number << ID_BITS
        history.suspend_point(connection, first + 1, "a house was built")
    lifecycle.publish_block(connection, "shown")
    connection.commit()
    return {"served": str(first), "suspended": str(first + 1)}


@pytest.fixture
def published(connection) -> Callable[[bool], None]:
    """Publishes the staged block, or withdraws it."""

    def publish(wanted: bool) -> None:
        (lifecycle.publish_block if wanted else lifecycle.withdraw_block)(connection, "staged")
        connection.commit()

    return publish


def paths(staged: dict[str, str], ways: Iterable[str]) -> list[str]:
    """Paths with the ids of the staged points in their places."""
    for name, value in staged.items():
        ways = [way.replace(f"<{name}>", value) for way in ways]
    return list(ways)


def content(reply: httpx.Response) -> object:
    """What a reply has, but for when it was given."""
    assert reply.status_code == 200, reply.text
    if "json" not in reply.headers["content-type"]:
        return reply.content
    return {name: value for name, value in reply.json().items() if name != "timeStamp"}


@pytest.mark.parametrize("role", [READ, ADMIN])
def test_a_point_is_served_by_its_id_while_its_block_is_published(staged, published, bearer, role):
    caller = bearer(role)

    def statuses() -> dict[str, int]:
        found = {way: caller.get(way).status_code for way in paths(staged, OF_A_POINT)}
        body = {"ids": [int(staged["served"])]}
        return {**found, "post": caller.post(CHIPS, json=body).status_code}

    hidden = statuses()
    assert set(hidden.values()) == {404}, hidden
    published(True)
    shown = statuses()
    assert set(shown.values()) == {200}, shown
    published(False)
    assert statuses() == hidden


def test_what_is_told_of_all_points_changes_with_a_publication_alone(staged, published, client, bearer):
    """A staged block leaves no trace in what is listed, counted, drawn or archived, a withdrawn one none
    that stays; to administrators neither, but for the blocks themselves."""

    def told(way: str) -> object:
        asking = [bearer(READ)] if "/blocks" in way else [bearer(READ), bearer(ADMIN)]
        first, *others = [content(client.get(way, headers=caller)) for caller in asking]
        assert all(other == first for other in others), way
        return first

    before = {way: told(way) for way in OF_ALL}
    published(True)
    assert not [way for way in OF_ALL if told(way) == before[way]]
    published(False)
    assert not [way for way in OF_ALL if told(way) != before[way]]


def test_histories_on_the_command_line_are_those_of_published_blocks(staged, published, connection):
    def suspended() -> set[int]:
        return {one.id for one in history.list_histories(connection, "suspended")}

    hidden = int(staged["suspended"])
    assert len(suspended()) == 1
    assert hidden not in suspended()
    published(True)
    assert hidden in suspended()
