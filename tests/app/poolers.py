"""PgBouncer in front of the cluster of the tests."""

import os
import pwd
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from tests.service_process import free_port, until

PROGRAM = shutil.which("pgbouncer", path="/usr/sbin:/usr/bin:/usr/local/bin")
CONFIGURATION = """\
[databases]
* = host={host} port={port} user={user}
[pgbouncer]
listen_addr = 127.0.0.1
listen_port = {listen_port}
unix_socket_dir =
auth_type = any
pool_mode = {mode}
default_pool_size = {size}
max_client_conn = 200
logfile = {folder}/log
pidfile = {folder}/pid
{more}
"""


@contextmanager
def pooler(dsn: str, folder: Path, mode: str, *more: str, size: int = 40) -> Iterator[str]:
    """A connection string through a PgBouncer that runs as long as the context.

    Args:
        dsn: of the database behind it.
        folder: for its files; made here.
        mode: `session`, `transaction` or `statement`.
        more: further lines of its configuration.
        size: most connections to the database.
    """
    if PROGRAM is None:
        pytest.skip("pgbouncer is missing: `make proxies` installs it")
    folder.mkdir()
    server = conninfo_to_dict(dsn)
    listen_port = free_port()
    configuration = folder / "pgbouncer.ini"
    configuration.write_text(
        CONFIGURATION.format(
            host=server["host"],
            port=server["port"],
            user=server["user"],
            listen_port=listen_port,
            mode=mode,
            size=size,
            folder=folder,
            more="\n".join(more),
        )
    )
    # It refuses to run as root, and the cluster lets in its own user.
    owner = pwd.getpwuid(Path(str(server["host"])).stat().st_uid)
    identity = {}
    if os.geteuid() == 0:
        os.chown(folder, owner.pw_uid, owner.pw_gid)
        identity = {"user": owner.pw_uid, "group": owner.pw_gid, "extra_groups": []}
    process = subprocess.Popen(
        [PROGRAM, "-q", str(configuration)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        **identity,
    )
    address = make_conninfo(
        host="127.0.0.1", port=listen_port, user=server["user"], dbname=server["dbname"]
    )
    try:
        assert until(lambda: _answers(address)), (folder / "log").read_text()
        yield address
    finally:
        process.kill()
        process.wait()


def _answers(address: str) -> bool:
    try:
        psycopg.connect(address, connect_timeout=2).close()
    except psycopg.OperationalError:
        return False
    return True
