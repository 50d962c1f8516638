"""PostgreSQL's client programs, run on a database of any server."""

import os
import re
import shutil
import subprocess
from pathlib import Path

from psycopg.conninfo import conninfo_to_dict, make_conninfo

from amers.app.db.cluster.binaries import USUAL_FOLDERS
from amers.app.db.revisions import driver_connection
from amers.app.db.session import PATIENCE
from amers.app.errors import InputError

ADVICE = {
    "unsupported version": "a newer pg_dump wrote the archive: install the programs of its version",
    "statement timeout": "another command changes the tables; try again when it has ended",
}
"""What to do about errors that do not say it."""


def run_program(dsn: str, name: str, *arguments: str) -> str:
    """Run a client program on a database; returns what it prints.

    The password travels in the environment, which other users of the machine cannot see. There is no
    limit on the time, because databases have any size; a connection that is cut ends the program.

    Raises:
        InputError: there is no such program for this server, or it refuses; the message is its first.
    """
    address = {key: str(value) for key, value in (PATIENCE | conninfo_to_dict(dsn)).items()}
    if "sslpassword" in address:
        raise InputError(
            f"AMERS_DATABASE_URL has an sslpassword, which {name} would show to all users of the "
            "machine: use a key without a password, in a file that only this user can read"
        )
    password = address.pop("password", None)
    environment = os.environ | {"LC_ALL": "C"}
    if password is not None:
        environment["PGPASSWORD"] = password
    # It would ask on the terminal for a password, and wait.
    program = [str(_find_program(dsn, name)), "--no-password"]
    command = [*program, f"--dbname={make_conninfo(**address)}", *arguments]
    ended = _run(command, environment)
    if ended.returncode != 0:
        raise InputError(_reason(name, ended.stderr))
    return ended.stdout


def read_archive(dsn: str, *arguments: str) -> str:
    """What the pg_restore that fits the server of a database prints about an archive.

    Raises:
        InputError: there is none, or it cannot read the archive.
    """
    ended = _run([str(_find_program(dsn, "pg_restore")), *arguments], os.environ | {"LC_ALL": "C"})
    if ended.returncode != 0:
        raise InputError(_reason("pg_restore", ended.stderr))
    return ended.stdout


def _run(command: list[str], environment: dict[str, str]) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )


def _find_program(dsn: str, name: str) -> Path:
    """The program of the server's version, else of the next newer one: an older one is refused.

    A newer one may set parameters that the server does not know.
    """
    with driver_connection(dsn) as connection:
        server = connection.info.server_version // 10_000
    paths = [path for folder in USUAL_FOLDERS for path in Path("/").glob(f"{folder}/{name}")]
    if (on_path := shutil.which(name)) is not None:
        paths.append(Path(on_path))
    versions = {path: version for path in paths if (version := _version(path)) is not None}
    fitting = [path for path, version in versions.items() if version >= server]
    if fitting:
        return min(fitting, key=lambda path: versions[path])
    present = f"only version {max(versions.values())} of it is here" if versions else "it is not here"
    raise InputError(
        f"{name} of PostgreSQL {server} or later is needed, as the server of the database is {server}, "
        f"and {present}: install it (Debian, Ubuntu: apt-get install postgresql-client-{server})"
    )


def _version(path: Path) -> int | None:
    """The major version of a client program; None if it cannot be run."""
    try:
        printed = _run([str(path), "--version"], os.environ | {"LC_ALL": "C"}).stdout
    except OSError:
        return None
    version = re.search(r"\(PostgreSQL\) (\d+)", printed)
    return None if version is None else int(version[1])


def _reason(name: str, printed: str) -> str:
    """The first error that a program has printed, without the data and statements below it."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    errors = [line for line in lines if f"{name}: error:" in line] or lines or ["it says nothing"]
    reason = errors[0].removeprefix(f"{name}: error: ")
    advice = [advice for words, advice in ADVICE.items() if words in reason]
    return ": ".join([name, reason, *advice])
