"""What belongs to a block that is not published is served in no way; once it is published, it is."""

from collections.abc import Callable, Iterable

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
OF_ALL = (
    f"{POINTS}?bbox=5,43,6,44",
    f"{POINTS}?bbox=5,43,6,44&f=csv",
    f"{CHIPS}?bbox=5,43,6,44",
    HISTORY,
    f"{HISTORY}?filter=state='suspended'",
    "/collections/points/tiles/WebMercatorQuad/8/93/131",
    "/collections/density/items",
    "/collections/blocks/items",
)


@pytest.fixture
def staged(connection, storage, tmp_path) -> dict[str, str]:
    """Ids of points of a staged block beside a published one: one to be served, one suspended."""
    for count, name in ((12, "shown"), (9, "staged")):
        folder = make_block(tmp_path / name, count=count, seed=count, name=name).folder
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


@pytest.mark.parametrize("role", [READ, ADMIN])
def test_a_point_is_served_by_its_id_while_its_block_is_published(
    staged, published, client, bearer, role
):
    headers = bearer(role)

    def statuses() -> dict[str, int]:
        found = {way: client.get(way, headers=headers).status_code for way in paths(staged, OF_A_POINT)}
        body = {"ids": [int(staged["served"])]}
        return {**found, "post": client.post(CHIPS, json=body, headers=headers).status_code}

    hidden = statuses()
    assert set(hidden.values()) == {404}, hidden
    published(True)
    shown = statuses()
    assert set(shown.values()) == {200}, shown
    published(False)
    assert statuses() == hidden


def test_what_is_told_of_all_points_changes_with_a_publication_alone(staged, published, client, bearer):
    """A staged block leaves no trace in what is listed, counted, drawn or archived, a withdrawn one none
    that stays."""
    headers = bearer(READ)

    def told(way: str) -> object:
        reply = client.get(way, headers=headers)
        assert reply.status_code == 200, reply.text
        if "json" not in reply.headers["content-type"]:
            return reply.content
        return {name: value for name, value in reply.json().items() if name != "timeStamp"}

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


def test_nothing_that_a_token_opens_may_stay_in_a_cache_that_people_share(
    staged, published, client, bearer
):
    published(True)
    for way in paths(staged, [*OF_A_POINT[:-1], *OF_ALL]):
        assert client.get(way).status_code == 401
        reply = client.get(way, headers=bearer(READ))
        assert reply.status_code == 200
        directives = {one.strip() for one in reply.headers["cache-control"].split(",")}
        assert directives & {"no-store", "private"}, way
        assert not any(one.startswith(("public", "s-maxage")) for one in directives), way
