"""Outages: the part of the infrastructure that has failed, from the error of the database or the disk.

An outage is nobody's input and no bug: a database that is read-only, full, starting or gone. One table
says for each kind what a reply, a command and the log state, with which status, and whether the same may
succeed later. A new kind is a new row.

Nothing of the address of the database is ever quoted: what libpq says when it cannot connect may repeat
a part of the password. The server's own words about a statement are quoted where they name what is
missing.

Source: PostgreSQL documentation, appendix A, error codes.
"""

import errno
import re
from dataclasses import dataclass, replace
from typing import Literal

from amers.app.errors import AmersError, StorageOutage
from amers.services.errors import causes


@dataclass(frozen=True)
class Outage:
    """One kind of failure of the infrastructure.

    Attributes:
        part: what has failed.
        reason: what is wrong, and what to do where somebody has to do something; half a sentence.
        status: of the HTTP reply.
        again: whether the same may succeed later without anybody's change.
        quotes: whether the server's own words follow the reason: they name what is missing.
    """

    part: Literal["database", "storage"]
    reason: str
    status: int = 503
    again: bool = True
    quotes: bool = False


def _database(reason: str, *, status: int = 503, again: bool = True, quotes: bool = False) -> Outage:
    return Outage("database", reason, status, again, quotes)


READ_ONLY = _database(
    "the database is read-only: it is a standby, or the settings of the database or of its role allow "
    "no writes. Requests that read still work; nothing can be stored"
)
NO_ANSWER = _database("the database does not answer")
LIMIT = _database("the request took the database too long and was stopped; ask for less", again=False)
DISK_FULL = _database(
    "the disk of the database is full: nothing was stored; the operator has to free space",
    status=507,
)
RIGHTS = _database(
    "the role of the database may not do this; its owner has to grant it", again=False, quotes=True
)
MISSING = _database(
    "PostGIS or a table that Amers needs is missing in the database, or has moved since the service "
    "started; run `amers db status`",
    again=False,
    quotes=True,
)
POOLER = _database(
    "the pooler in front of the database gives one session to several connections in turn: set "
    "pool_mode=session for this database there, or let AMERS_DATABASE_URL name the server itself",
    again=False,
)
DAMAGED = _database("the database has damaged data; its log has the details", again=False)

BY_STATE: dict[str, Outage] = {
    "25006": READ_ONLY,
    "57014": LIMIT,
    "25P03": _database("the database ended a session that had waited in a transaction"),
    "25P04": _database("the database ended a transaction that took too long"),
    "57P01": _database("the database ended the session: it stops, or an administrator ended it"),
    "57P02": _database("the database ended the session, because one of its processes crashed"),
    "57P03": _database("the database does not accept connections yet: it starts, stops or recovers"),
    "57P04": _database("the database was dropped", again=False),
    "57P05": _database("the database ended a session that was idle"),
    "53100": DISK_FULL,
    "53200": _database("the server of the database is out of memory"),
    "53300": _database("the database has no more connections to give"),
    "40001": _database(
        "the database stopped a statement that conflicted with another one, or with its recovery"
    ),
    "40P01": _database("the database stopped one of two transactions that waited for each other"),
    "55P03": _database("another transaction kept a lock for longer than this request may wait"),
    "42501": RIGHTS,
    "42P01": MISSING,
    "42883": MISSING,
    "42704": MISSING,
    "3F000": MISSING,
    "26000": POOLER,
    "42P05": POOLER,
    "XX001": DAMAGED,
    "XX002": DAMAGED,
}
"""By SQLSTATE."""
BY_CLASS: dict[str, Outage] = {
    "08": NO_ANSWER,
    "28": _database(
        "the database does not let this role in; check its password and rights", again=False
    ),
    "40": _database("the database rolled the transaction back"),
    "53": _database("the server of the database lacks resources"),
    "57": _database("an administrator of the database intervened"),
    "58": _database("the server of the database cannot use its disk"),
}
"""By the first two characters of a SQLSTATE that has no row of its own."""
BY_WORDS: tuple[tuple[str, Outage], ...] = (
    ("no connection was free", _database("all connections of this process to the database are in use")),
    ("transaction blocks not allowed", POOLER),
    ("no password supplied", _database("no password is given, and one is needed", again=False)),
    ("authentication failed", _database("password authentication failed", again=False)),
    ("pg_hba", _database("pg_hba.conf of the server does not let this role in from here", again=False)),
    ("(role|user) .* does not exist|no such user", _database("there is no such role", again=False)),
    ("permission denied for database", _database("the role may not connect to it", again=False)),
    ("database .* does not exist|no such database", _database("there is no such database", again=False)),
    ("too many (clients|connections)|connection slots|no more connections", BY_STATE["53300"]),
    ("is starting up|is shutting down|recovery mode|not yet accepting", BY_STATE["57P03"]),
    ("session is read-only|is in hot standby", _database("no server that takes writes answers")),
    ("session is not read-only|not in hot standby", _database("no server of the wanted kind answers")),
    (
        "unsupported startup parameter",
        _database("a pooler refuses the settings of a session", again=False),
    ),
    ("closed", _database("the connection to the database was lost")),
    (
        "could not translate host name|Name or service|name resolution",
        _database("its host is not known"),
    ),
    ("Connection refused|No such file or directory", _database("refused: nothing listens there")),
    ("timeout expired|timed out|query_wait_timeout", _database("the database did not answer in time")),
    ("certificate|SSL|TLS", _database("no encrypted connection can be agreed on", again=False)),
)
"""By the words of an error without SQLSTATE: of the driver, when a connection begins or ends."""
NO_ROOM = Outage(
    "storage", "a disk of the service is full; no part of this was stored: try again later", status=507
)
BY_ERRNO: dict[int, Outage] = {
    errno.ENOSPC: NO_ROOM,
    errno.EDQUOT: NO_ROOM,
    errno.EFBIG: NO_ROOM,
    errno.EROFS: Outage("storage", "a disk of the service is mounted read-only: nothing can be stored"),
    errno.EACCES: Outage("storage", "the service has no rights to a file or folder of its own"),
    errno.EPERM: Outage("storage", "the service may not do this to a file or folder of its own"),
    errno.EIO: Outage("storage", "a disk of the service reports errors of input and output"),
    errno.EUCLEAN: Outage("storage", "the file system of a disk of the service is damaged"),
    errno.ESTALE: Outage(
        "storage", "a network disk of the service is stale: it has to be mounted again"
    ),
    **dict.fromkeys(
        (errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EHOSTDOWN),
        Outage("storage", "a disk of the service is gone"),
    ),
}
"""Of the files, by the number of an error of the operating system."""


def outage_of(error: BaseException) -> Outage | None:
    """The outage that an error, or one behind it, tells of; None for any other error.

    An error of Amers has its own message, whatever is behind it.
    """
    for cause in causes(error):
        if isinstance(cause, AmersError):
            return None
        if (found := _outage(cause)) is not None:
            return found
    return None


def connection_failure(error: BaseException) -> str:
    """Why no connection to the database could be made, in words of Amers: no part of its address."""
    found = _outage(error)
    return (found or NO_ANSWER).reason


def _outage(error: BaseException) -> Outage | None:
    if isinstance(error, StorageOutage):
        return Outage("storage", error.reason)
    if _is_of_driver(error):
        return _of_database(error)
    if isinstance(error, OSError) and error.errno is not None:
        return BY_ERRNO.get(error.errno)
    return None


def _of_database(error: BaseException) -> Outage | None:
    state = getattr(error, "sqlstate", None)
    if state is None:
        # Without a SQLSTATE the driver itself speaks: of a connection, or of a value it cannot send.
        if not _is(error, "OperationalError") and not _is_closed(error):
            return None
        words = str(error)
        if _is(error, "UnusableSession"):
            return _database(words, again=False)
        fitting = (row for pattern, row in BY_WORDS if re.search(pattern, words, re.IGNORECASE))
        return next(fitting, NO_ANSWER)
    found = BY_STATE.get(state) or BY_CLASS.get(state[:2])
    if found is not None and found.quotes:
        return replace(found, reason=f"{found.reason} ({_first_line(error)})")
    return found


def _is_of_driver(error: BaseException) -> bool:
    """Whether psycopg raised an error; it is not imported for commands that do without it."""
    return any(kind.__module__.partition(".")[0] == "psycopg" for kind in type(error).__mro__)


def _is(error: BaseException, name: str) -> bool:
    return any(kind.__name__ == name for kind in type(error).__mro__)


def _is_closed(error: BaseException) -> bool:
    """Whether a connection was used that the server, or its loss, had closed."""
    return _is(error, "InterfaceError") and "closed" in str(error)


def _first_line(error: BaseException) -> str:
    primary = getattr(getattr(error, "diag", None), "message_primary", None)
    return str(primary or error).partition("\n")[0]
