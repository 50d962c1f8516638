"""Backup and restore of the database, by PostgreSQL's own programs."""

import shutil
import subprocess
from pathlib import Path

import psycopg
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from app.db.cluster.binaries import find_binaries
from app.errors import Conflict, InputError


def dump(dsn: str, file: Path, snapshot: str | None = None) -> None:
    """Write the database into an archive: one moment of it, while others go on.

    Args:
        dsn: of the database.
        file: to write.
        snapshot: the moment, exported by a transaction; None for the present one.

    Raises:
        Conflict: the file exists.
        InputError: the file cannot be written, or pg_dump refuses.
    """
    if file.exists():
        raise Conflict(f"{file} exists")
    unfinished = file.with_name(f".{file.name}.unfinished")
    try:
        options = ["--format=custom", "--no-owner", "--no-privileges"]
        options += [] if snapshot is None else [f"--snapshot={snapshot}"]
        _run(dsn, "pg_dump", *options, f"--file={unfinished}")
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)


def restore(dsn: str, file: Path) -> None:
    """Read an archive into a database without tables, wholly or not at all.

    Raises:
        Conflict: the database has tables of Amers.
        InputError: the file is not an archive, or pg_restore refuses.
    """
    if not file.is_file():
        raise InputError(f"no file {file}")
    if has_tables(dsn):
        raise Conflict(
            "the database has tables already: restore into an empty one (another AMERS_DATA_FOLDER)"
        )
    # Who may read is granted anew: the roles of the cluster that the archive came from may be gone.
    whole = ("--single-transaction", "--exit-on-error", "--no-owner", "--no-privileges")
    # Only the owner of PostGIS, a superuser, may restore its comment; Amers has no comments.
    _run(dsn, "pg_restore", *whole, "--no-comments", str(file))


def has_tables(dsn: str) -> bool:
    """Whether a database has tables of Amers."""
    with psycopg.connect(dsn) as connection:
        row = connection.execute("select to_regclass('alembic_version')").fetchone()
    return row != (None,)


def _program(dsn: str, name: str) -> Path:
    """A program that is not older than the server: beside the server's own, or the one on the path."""
    with psycopg.connect(dsn) as connection:
        version = connection.info.server_version // 10_000
    try:
        own = find_binaries(version).folder / name
    except InputError:
        own = Path("/nonexistent")
    found = own if own.is_file() else shutil.which(name)
    if found is None:
        raise InputError(f"{name} was not found: install the client programs of PostgreSQL {version}")
    return Path(found)


def _run(dsn: str, name: str, *arguments: str) -> None:
    """The password travels in the environment, which other users of the machine cannot see."""
    address = conninfo_to_dict(dsn)
    password = str(address.pop("password", ""))
    bare_dsn = make_conninfo(**{key: str(value) for key, value in address.items()})
    command = [str(_program(dsn, name)), f"--dbname={bare_dsn}", *arguments]
    environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C", "PGPASSWORD": password}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise InputError(f"{name}: {done.stderr.strip()}")
