"""The address of a database of your own: checked before use, in errors without its password."""

import psycopg
from psycopg.conninfo import conninfo_to_dict

from app.errors import InputError

VARIABLE = "AMERS_DATABASE_URL"
EXPECTED = "postgresql://USER:PASSWORD@HOST:PORT/NAME"
SCHEMES = ("postgresql", "postgres")


def check_address(url: str) -> None:
    """Check that the driver can read the address of a database; it may also be `host=… dbname=…`.

    The message of the driver is not shown: it may quote a part of the password.

    Raises:
        InputError: it cannot be read.
    """
    scheme, separator, _ = url.partition("://")
    if separator and scheme not in SCHEMES:
        raise InputError(
            f"{VARIABLE}: {scheme[:40]!r} found in front of ://, {' or '.join(SCHEMES)} expected: give "
            f"{EXPECTED}"
        )
    try:
        conninfo_to_dict(url)
    except psycopg.Error:
        raise InputError(
            f"{VARIABLE}: it cannot be read as the address of a database: give {EXPECTED}, with "
            "characters such as @ / : % in the password written as %40 %2F %3A %25"
        ) from None


def unreachable(error: psycopg.OperationalError, dsn: str) -> InputError:
    """The error for the user when no connection can be made."""
    parts = conninfo_to_dict(dsn)
    reason = " ".join(str(error).split())
    if password := str(parts.get("password") or ""):
        reason = reason.replace(password, "***")
    place = f"database {parts.get('dbname') or '(unnamed)'} on {parts.get('host') or 'this machine'}"
    return InputError(
        f"the {place} cannot be reached as user {parts.get('user') or '(unnamed)'} ({reason}): check "
        f"{VARIABLE}, and that the server runs and lets this user in"
    )
