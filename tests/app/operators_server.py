"""A PostgreSQL server as operators have one: by TCP, with passwords, its superuser never Amers."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import psycopg
from psycopg import sql
from psycopg.conninfo import make_conninfo

from amers.app.db.cluster.binaries import ServerUser, find_binaries, run_as, server_user
from tests.service_process import free_port

SUPERUSER = "postgres"
SUPERUSERS_PASSWORD = "only the operator knows this"
PASSWORD = "p@ss w:o/r%d'\"\\#$1"
"""Of the ordinary roles: characters that addresses, shells and files treat in their own ways."""
START_S = 60
CONFIGURATION = """
listen_addresses = '127.0.0.1'
port = {port}
unix_socket_directories = ''
fsync = off
full_page_writes = off
shared_buffers = 64MB
"""


@dataclass(frozen=True)
class OperatorsServer:
    """A running server.

    Attributes:
        port: on 127.0.0.1.
        data: PostgreSQL's data directory, with its log.
    """

    port: int
    data: Path

    def dsn(self, name: str, role: str, password: str | None = PASSWORD) -> str:
        """The connection string of a role."""
        return make_conninfo(host="127.0.0.1", port=self.port, dbname=name, user=role, password=password)

    def run(self, database: str, *statements: str, **names: str) -> None:
        """Run statements as the superuser; `{name}` in them is quoted as an identifier."""
        dsn = self.dsn(database, SUPERUSER, SUPERUSERS_PASSWORD)
        with psycopg.connect(dsn, autocommit=True) as connection:
            for statement in statements:
                quoted = {key: sql.Identifier(value) for key, value in names.items()}
                connection.execute(sql.SQL(statement).format(**quoted))  # type: ignore[arg-type]

    def make_database(self, postgis: str | None = "public", powers: str = "") -> str:
        """The connection string of a new database of a new ordinary role, PostGIS made by the superuser.

        Args:
            postgis: schema that gets PostGIS; None: the database has none.
            powers: further words about the role, such as `createrole`.
        """
        name, role = f"store {uuid4().hex[:6]}", f"keeper-{uuid4().hex[:6]}"
        with psycopg.connect(self.dsn("postgres", SUPERUSER, SUPERUSERS_PASSWORD)) as connection:
            literal = sql.Literal(PASSWORD)
            connection.execute(
                sql.SQL("create role {} login password {} {}").format(
                    sql.Identifier(role),
                    literal,
                    sql.SQL(powers),  # type: ignore[arg-type]
                )
            )
        self.run("postgres", "create database {name} owner {role}", name=name, role=role)
        if postgis is not None:
            self.run(
                name,
                "create schema if not exists {schema}",
                "create extension postgis schema {schema}",
                "grant usage on schema {schema} to public",
                schema=postgis,
            )
        return self.dsn(name, role)

    def rows(self, dsn: str, statement: str) -> list[tuple[Any, ...]]:
        """What a role gets for a statement."""
        with psycopg.connect(dsn) as connection:
            return connection.execute(statement.encode()).fetchall()


@contextmanager
def running_server(folder: Path) -> Iterator[OperatorsServer]:
    """A server of this test alone, below a folder that the server's user can pass."""
    binaries, user, data = find_binaries(), server_user(folder / "server"), folder / "server"
    data.mkdir(mode=0o700)
    server = OperatorsServer(free_port(), data)
    password = folder / "password"
    try:
        os.chown(data, user.uid, user.gid)
        _write(password, SUPERUSERS_PASSWORD, user)
        options = ["--pgdata", str(data), "--username", SUPERUSER, "--pwfile", str(password)]
        options += ["--auth", "scram-sha-256", "--encoding", "UTF8", "--locale", "C", "--no-sync"]
        made = run_as(user, [str(binaries.folder / "initdb"), *options])
        assert made.returncode == 0, made.stderr
        with (data / "postgresql.conf").open("a") as configuration:
            configuration.write(CONFIGURATION.format(port=server.port))
        control = [str(binaries.folder / "pg_ctl"), "--pgdata", str(data), "--wait", "--silent"]
        start = ["start", "--timeout", str(START_S), "--log", str(data / "log")]
        started = run_as(user, [*control, *start])
        assert started.returncode == 0, (data / "log").read_text()
        try:
            yield server
        finally:
            run_as(user, [*control, "stop", "--mode", "immediate"])
    finally:
        shutil.rmtree(data, ignore_errors=True)
        password.unlink(missing_ok=True)


def _write(path: Path, text: str, user: ServerUser) -> None:
    path.write_text(text)
    path.chmod(0o600)
    os.chown(path, user.uid, user.gid)
