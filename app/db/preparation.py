"""Preparation of a database of your own: checks before Amers makes its tables, with the statements.

A superuser prepares the database once. Amers makes PostGIS only where its role may.
"""

from dataclasses import dataclass
from typing import Any

import psycopg

from amers.app.errors import InputError

Connection = psycopg.Connection[tuple[Any, ...]]
OLDEST_SERVER = 15
STATE = """
select current_user::text as role, current_database()::text as database,
    quote_ident(current_user) as quoted_role, quote_ident(current_database()) as quoted_database,
    (select quote_ident(nspname) from pg_extension e join pg_namespace n on n.oid = e.extnamespace
     where extname = 'postgis') as postgis,
    to_regtype('geometry') is not null as is_found,
    quote_ident(coalesce(current_schema(), 'public')) as schema,
    coalesce(has_schema_privilege(current_schema(), 'create'), false) as may_create"""
SECTION = 'see "A database of your own" in docs/operations.md'


@dataclass(frozen=True)
class _State:
    role: str
    database: str
    quoted_role: str
    quoted_database: str
    postgis: str | None
    is_found: bool
    schema: str
    may_create: bool


def prepare(connection: Connection) -> str:
    """Make PostGIS in a database that does not have it, and see that tables can be made there.

    Returns:
        The schema that PostGIS is in, as an identifier of SQL.

    Raises:
        InputError: a superuser has to prepare something; the message has the statements.
    """
    version = connection.info.server_version // 10_000
    if version < OLDEST_SERVER:
        raise InputError(
            f"the server of the database is PostgreSQL {version}, and {OLDEST_SERVER} or later is "
            "needed: upgrade it, or name another one in AMERS_DATABASE_URL"
        )
    state = _read(connection)
    if state.postgis is None:
        _make_postgis(connection, state)
        state = _read(connection)
    role, database = state.quoted_role, state.quoted_database
    if not state.is_found:
        raise InputError(
            f"PostGIS is in schema {state.postgis} of database {state.database}, which the role "
            f"{state.role} may not use: let a superuser run `grant usage on schema {state.postgis} to "
            f"{role}`; {SECTION}"
        )
    if not state.may_create:
        raise InputError(
            f"the role {state.role} may not make tables in schema {state.schema} of database "
            f"{state.database}: let a superuser run `alter database {database} owner to {role}` or "
            f"`grant create on schema {state.schema} to {role}`; {SECTION}"
        )
    return str(state.postgis)


def _read(connection: Connection) -> _State:
    row = connection.execute(STATE).fetchone()
    assert row is not None
    return _State(*row)


def _make_postgis(connection: Connection, state: _State) -> None:
    try:
        with connection.transaction():
            connection.execute("create extension if not exists postgis")
    except psycopg.errors.InsufficientPrivilege:
        raise InputError(
            f"the database {state.database} has no PostGIS, and the role {state.role} may not make it: "
            f"let a superuser run `create extension postgis` in this database; {SECTION}"
        ) from None
    except (psycopg.errors.UndefinedFile, psycopg.errors.FeatureNotSupported) as error:
        raise InputError(
            f"the server of database {state.database} does not have PostGIS "
            f"({error.diag.message_primary}): install PostGIS 3 on the machine of the server"
        ) from None
