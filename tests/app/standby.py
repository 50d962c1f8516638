"""Copies of the cluster of the tests that stream from it: standbys, which can be promoted."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psycopg
from psycopg.conninfo import make_conninfo

from amers.app.db.cluster.binaries import find_binaries, run_as, server_user
from amers.app.db.cluster.embedded import ROLE, SUPERUSER
from tests.service_process import until

PORT = 5432
"""Servers differ by the folders of their sockets."""
START_S = 60


@dataclass(frozen=True)
class Server:
    """A PostgreSQL server.

    Attributes:
        data: its data directory.
        sockets: the folder of its socket.
    """

    data: Path
    sockets: Path

    def dsn(self, name: str, role: str = ROLE) -> str:
        """The connection string of one of its databases."""
        return make_conninfo(host=str(self.sockets), port=PORT, user=role, dbname=name)

    def control(self, *words: str) -> None:
        """Run `pg_ctl` as the user of the server."""
        program = str(find_binaries().folder / "pg_ctl")
        done = run_as(
            server_user(self.data), [program, *words, "--pgdata", str(self.data), "--silent", "--wait"]
        )
        assert done.returncode == 0, done.stderr + done.stdout

    def position(self, function: str) -> str | None:
        """A position in the log of the server."""
        with psycopg.connect(self.dsn("postgres", SUPERUSER)) as connection:
            row = connection.execute(f"select {function}()::text".encode()).fetchone()
        assert row is not None
        return None if row[0] is None else str(row[0])

    def follows(self, primary: "Server") -> None:
        """Wait until this standby shows what the primary has committed."""
        wanted = primary.position("pg_current_wal_lsn")
        assert until(lambda: _reached(self.position("pg_last_wal_replay_lsn"), wanted))


def _reached(found: str | None, wanted: str | None) -> bool:
    def number(position: str | None) -> int:
        high, low = (position or "0/0").split("/")
        return (int(high, 16) << 32) + int(low, 16)

    return number(found) >= number(wanted)


@contextmanager
def standby(primary: Server, folder: Path) -> Iterator[Server]:
    """A standby that streams from a primary; it is stopped at the end."""
    user = server_user(primary.data)
    data, sockets = folder / "data", folder / "socket"
    for place in (folder, sockets):
        place.mkdir(mode=0o700)
        os.chown(place, user.uid, user.gid)
    hba = primary.data / "pg_hba.conf"
    if "replication" not in hba.read_text():
        hba.write_text(hba.read_text() + "local replication all peer map=amers\n")
        primary.control("reload")
    copy = [str(find_binaries().folder / "pg_basebackup"), "--pgdata", str(data)]
    copy += ["--write-recovery-conf", "--checkpoint=fast", "--no-sync"]
    copy += ["--dbname", primary.dsn("postgres", SUPERUSER)]
    done = run_as(user, copy)
    assert done.returncode == 0, done.stderr
    server = Server(data, sockets)
    options = f"-c unix_socket_directories='{sockets}'"
    server.control("start", "--log", str(folder / "log"), "--options", options)
    try:
        yield server
    finally:
        if (data / "postmaster.pid").exists():
            server.control("stop", "--mode", "immediate")
