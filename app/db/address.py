"""The address of a database of your own: checked before use, in errors without its password."""

import re
from pathlib import Path

import psycopg
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from amers.app.errors import InputError
from amers.app.outages import connection_failure

VARIABLE = "AMERS_DATABASE_URL"
PASSWORD_VARIABLE = "AMERS_DATABASE_PASSWORD_FILE"
EXPECTED = "postgresql://USER:PASSWORD@HOST:PORT/NAME"
SCHEMES = ("postgresql", "postgres")


URL = re.compile(
    r"postgres(?:ql)?://(?:(?P<user>[^:@/?#\s]*)(?::(?:[^@/?]|\?(?!\w+=))*)?@)?(?P<hosts>[^@/?#]*)"
    r"(?:/(?P<name>[^@/?#]*))?(?:\?[^@#]*)?"
)
"""An address that can be read in one way only: no part of a password can be taken for something else."""
HOST = r"(?:[\w.%-]*|\[[\w:.%]*\])(?::\d{1,5})?"
HOSTS = re.compile(f"{HOST}(?:,{HOST})*")
PAIR = re.compile(r"(?:^|\s)(\w+)\s*=")
UNREADABLE = (
    f"{VARIABLE}: it cannot be read as the address of a database: give {EXPECTED}, with "
    "characters such as @ / : % ? in the password written as %40 %2F %3A %25 %3F"
)


def check_address(url: str) -> None:
    """Check that an address of a database can be read, and in one way only; or `host=… dbname=…`.

    A password with a character that separates parts would become a host, a port or a name in part, and
    these are shown in messages. The message of the driver is not shown, which may quote the password.

    Raises:
        InputError: it cannot be read.
    """
    scheme, separator, _ = url.partition("://")
    if separator and scheme not in SCHEMES and "=" not in scheme:
        raise InputError(
            f"{VARIABLE}: {scheme[:40]!r} found in front of ://, {' or '.join(SCHEMES)} expected: give "
            f"{EXPECTED}"
        )
    try:
        conninfo_to_dict(url)
    except psycopg.Error:
        raise InputError(UNREADABLE) from None
    if not (_is_clear_url(url) if scheme in SCHEMES and separator else _are_clear_pairs(url)):
        raise InputError(UNREADABLE)


def with_password(url: str, file: Path | None) -> str:
    """The connection string with the password that a file has, as it is but for a line break at its end.

    Raises:
        InputError: the file cannot be read, is empty or has more than one line.
    """
    if file is None:
        return url
    try:
        password = file.read_text(encoding="utf-8").removesuffix("\n").removesuffix("\r")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise InputError(
            f"{PASSWORD_VARIABLE}: {file} cannot be read ({reason}): name a file that this user can "
            "read, with the password of the database's user"
        ) from None
    if not password or set(password) & set("\0\r\n"):
        raise InputError(
            f"{PASSWORD_VARIABLE}: {file} needs one line, the password of the database's user"
        )
    return make_conninfo(url, password=password)


def unreachable(error: psycopg.OperationalError, dsn: str) -> InputError:
    """The error for the user when no connection can be made: nothing of it is the driver's text."""
    parts = conninfo_to_dict(dsn)
    place = f"database {parts.get('dbname') or '(unnamed)'} on {parts.get('host') or 'this machine'}"
    return InputError(
        f"the {place} cannot be reached as user {parts.get('user') or '(unnamed)'} "
        f"({connection_failure(error)}): check {VARIABLE}, and that the server runs and lets this user "
        "in"
    )


def _is_clear_url(url: str) -> bool:
    read = URL.fullmatch(url)
    return read is not None and HOSTS.fullmatch(read["hosts"]) is not None


def _are_clear_pairs(text: str) -> bool:
    """Whether each name of `name=value …` is there once: a password can hold a blank and a name."""
    names = PAIR.findall(text)
    return len(names) == len(set(names))
