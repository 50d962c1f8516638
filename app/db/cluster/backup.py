"""Backup and restore of the database, by PostgreSQL's own programs.

An archive holds what Amers owns: tables, functions and rows of its schema, usually `public`. What
belongs to a superuser stays with the server: PostGIS with its tables, other extensions, schemas of
others, roles and grants. So a role without further rights restores what it has backed up, archives of
former versions too.
"""

import logging
import re
import tempfile
from pathlib import Path

from amers.app.db.cluster.programs import read_archive, run_program
from amers.app.db.preparation import prepare
from amers.app.db.revisions import driver_connection
from amers.app.errors import Conflict, InputError

POSTGIS_ALONE = "--extension=postgis"
"""No extension of others is read, whose tables may be closed to this role."""
LOCK_WAIT = "60s"
PLAIN = ("--no-owner", "--no-privileges")
NOT_OURS = ("--no-comments", "--no-publications", "--no-subscriptions", "--no-security-labels")
WHOLE = ("--single-transaction", "--exit-on-error", "--no-tablespaces")
OF_THE_SERVER = re.compile(r"\d+; \d+ \d+ (SCHEMA - public|EXTENSION|COMMENT|DEFAULT ACL|ACL) ")
TABLE = re.compile(r"\d+; \d+ \d+ TABLE (?!DATA )(.*)")
TABLE_DATA = re.compile(r"\d+; \d+ \d+ TABLE DATA (.*)")
REFERENCE_SYSTEMS = re.compile(r"\d+; \d+ \d+ TABLE DATA (.+) spatial_ref_sys ")
OWN_TABLES = """select relname from pg_class
    where relnamespace = to_regnamespace(quote_ident(current_schema()))
    and relkind in ('r', 'p', 'v', 'm', 'f') and not exists (select from pg_depend
        where classid = 'pg_class'::regclass and objid = pg_class.oid and deptype = 'e')
    order by relname"""
SHOWN_TABLES = 3

log = logging.getLogger(__name__)


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
        options = ["--format=custom", *PLAIN, POSTGIS_ALONE, f"--lock-wait-timeout={LOCK_WAIT}"]
        options.append(f"--schema={_own_schema(dsn)}")
        options += [] if snapshot is None else [f"--snapshot={snapshot}"]
        run_program(dsn, "pg_dump", *options, f"--file={unfinished}")
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)


def restore(dsn: str, file: Path) -> None:
    """Read an archive into a database without tables, wholly or not at all.

    Reference systems that were added to those of PostGIS belong to its owner: they are logged.

    Raises:
        Conflict: the database has tables.
        InputError: the file is not an archive, the database is not prepared, or pg_restore refuses.
    """
    entries = check_restorable(dsn, file)
    with tempfile.NamedTemporaryFile("w", prefix="amers-", suffix=".list") as chosen:
        chosen.write("\n".join(_of_amers(entries)))
        chosen.flush()
        options = (*WHOLE, *PLAIN, *NOT_OURS, f"--use-list={chosen.name}")
        try:
            run_program(dsn, "pg_restore", *options, str(file))
        except InputError as error:
            raise InputError(f"{error}; nothing was restored into the database") from error
    missing = _missing_reference_systems(dsn, file, entries)
    if missing:
        log.warning(
            "the archive has reference systems that the PostGIS of this database lacks (SRID %s): Amers "
            "uses none of them, and only the owner of PostGIS can add them",
            ", ".join(map(str, missing)),
        )


def check_restorable(dsn: str, file: Path) -> list[str]:
    """The entries of an archive that can be restored into a database, before anything is written.

    Raises:
        Conflict: the database has tables.
        InputError: the file is not an archive, or the database is not prepared for it.
    """
    if not file.is_file():
        raise InputError(f"no file {file}")
    with driver_connection(dsn) as connection:
        tables = [str(name) for (name,) in connection.execute(OWN_TABLES)]
        found = prepare(connection) if not tables else None
    if tables:
        shown = ", ".join(tables[:SHOWN_TABLES]) + (", …" if len(tables) > SHOWN_TABLES else "")
        raise Conflict(
            f"the database has tables already ({shown}): restore into an empty one (another "
            "AMERS_DATA_FOLDER or AMERS_DATABASE_URL)"
        )
    entries = read_archive(dsn, "--list", str(file)).splitlines()
    expected = _postgis_of(entries)
    if expected not in (None, found):
        raise InputError(
            f"the archive was made with PostGIS in schema {expected}, the database has it in schema "
            f"{found}: let a superuser run `drop extension postgis; create schema if not exists "
            f"{expected}; create extension postgis schema {expected}` in it, then restore again"
        )
    return entries


def has_tables(dsn: str) -> bool:
    """Whether a database has tables of Amers."""
    with driver_connection(dsn) as connection:
        row = connection.execute("select to_regclass('alembic_version')").fetchone()
    return row != (None,)


def _own_schema(dsn: str) -> str:
    """The schema of the tables, as an identifier of SQL."""
    with driver_connection(dsn) as connection:
        row = connection.execute("select quote_ident(current_schema())").fetchone()
    assert row is not None
    return str(row[0])


def _of_amers(entries: list[str]) -> list[str]:
    """The entries of an archive without those of the server, and without rows of tables of extensions.

    A table of an extension is made by the extension: the archive has its rows, but not the table.
    """
    tables = {found[1] for entry in entries if (found := TABLE.match(entry))}
    return [
        entry
        for entry in entries
        if not OF_THE_SERVER.match(entry)
        and not ((rows := TABLE_DATA.match(entry)) and rows[1] not in tables)
    ]


def _postgis_of(entries: list[str]) -> str | None:
    """The schema in which the PostGIS of an archive was; None if the archive does not state it."""
    return next((found[1] for entry in entries if (found := REFERENCE_SYSTEMS.match(entry))), None)


def _missing_reference_systems(dsn: str, file: Path, entries: list[str]) -> list[int]:
    """SRIDs of the reference systems in an archive that the PostGIS of a database does not have."""
    if _postgis_of(entries) is None:
        return []
    options = ("--data-only", "--table=spatial_ref_sys", "--file=-")
    rows = read_archive(dsn, *options, str(file)).splitlines()
    added = [int(row.split("\t")[0]) for row in rows if re.match(r"\d+\t", row)]
    with driver_connection(dsn) as connection:
        found = connection.execute("select srid from spatial_ref_sys where srid = any(%s)", [added])
        present = {srid for (srid,) in found}
    return sorted(set(added) - present)
