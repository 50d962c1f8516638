"""One address that opens the map page of a service on this machine, signed in."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from uuid import uuid4

from amers.app.auth import Scope
from amers.app.db import engine
from amers.app.db.jobs import jobs
from amers.app.db.jobs.jobs import JobFilter
from amers.app.errors import NotFound
from amers.app.usecases.tokens import create_token, revoke_token

_DAYS = 1
"""How long the token is valid where its end is not reached, after a power cut."""


@contextmanager
def signed_in_address(database_url: str, service_url: str) -> Iterator[str]:
    """The address of the map page with a token of its own, which ends with the context.

    The token allows everything and stands behind the sign `#`: a browser keeps that part to itself, and
    the page takes it only on this machine. The page opens at the scene that was registered last.

    Args:
        database_url: of the private database of this machine.
        service_url: such as `http://127.0.0.1:8000`.
    """
    name = f"amers serve {uuid4().hex[:8]}"
    with engine.connect(database_url) as connection:
        made = create_token(connection, name, [Scope.ADMIN], _DAYS)
        wanted = JobFilter(kinds=("register-scene",), states=("successful",))
        newest = jobs.newest(connection, None, wanted, 1)
    place = f"/job/{newest[0].id}/map" if newest else "/points"
    try:
        yield f"{service_url}/map#token={made.secret}&at={place}"
    finally:
        with engine.connect(database_url) as connection, suppress(NotFound):
            revoke_token(connection, str(made.token.id))
