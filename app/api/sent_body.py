"""The bodies of uploads, whose senders are asked for their right to send while they do."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

from fastapi import Request

from amers.app.api.body import body_chunks
from amers.app.auth import require_still_valid
from amers.app.db.engine import Database
from amers.app.db.tokens import Token
from amers.app.outages import outage_of

CHECK_S = 5.0
"""Time after which a token is looked up again: an upload may take hours."""

log = logging.getLogger(__name__)


def sent_chunks(request: Request, database: Database, caller: Token) -> Iterator[bytes]:
    """The body, chunk by chunk, for an endpoint in a thread, while the token of the caller is valid.

    The token is looked up every few seconds, and once more when all has arrived.

    Raises:
        NotAllowed: the token was revoked, or has expired.
        ClientDisconnect, HTTPException: as for `body_chunks`.
    """
    checked = time.monotonic()
    for chunk in body_chunks(request):
        yield chunk
        if time.monotonic() - checked >= CHECK_S:
            with _later_in_an_outage():
                require_still_valid(database, caller)
            checked = time.monotonic()
    require_still_valid(database, caller)


@contextmanager
def _later_in_an_outage() -> Iterator[None]:
    """Let an upload go on while the database is away: the last look at the token decides."""
    try:
        yield
    except Exception as error:
        outage = outage_of(error)
        if outage is None:
            raise
        log.warning("the token of an upload is looked up later: %s", outage.reason)
