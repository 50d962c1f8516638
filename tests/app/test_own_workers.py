"""Workers on a database with foreign settings, behind a pooler, and read-only for a while."""

from pathlib import Path
from uuid import uuid4

import psycopg
import pytest
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict
from pydantic import SecretStr

from amers.app.db.cluster.embedded import SUPERUSER, Cluster
from tests.app.flat_world import make_flat_world
from tests.app.installation import Installation
from tests.app.poolers import pooler
from tests.app.worker_processes import wait_until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

FOREIGN = {"TimeZone": "Asia/Kathmandu", "DateStyle": "SQL, DMY", "search_path": "nowhere"}
FOREIGN |= {"statement_timeout": "150", "standard_conforming_strings": "off"}


def test_a_worker_behind_a_pooler_does_jobs_and_outlives_a_read_only_database(
    cluster: Cluster, installation: Installation, tmp_path: Path, open_folder: Path
):
    world = make_flat_world(tmp_path / "world", size=800)
    ask, dsn, log = installation.registering(world), installation.dsn, installation.log
    name = sql.Identifier(str(conninfo_to_dict(dsn)["dbname"]))
    with (
        psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as operator,
        pooler(dsn, open_folder / uuid4().hex[:8], "session", "server_reset_query = ") as address,
    ):

        def alter(setting: str, value: str) -> None:
            statement = sql.SQL("alter database {} set {} = {}")
            operator.execute(statement.format(name, sql.Identifier(setting), value))

        for setting, value in FOREIGN.items():
            alter(setting, value)
        with installation.worker(database_url=SecretStr(address), lease_seconds=3.0) as worker:
            done = installation.ended(ask(1))
            assert done["status"] == "successful", (done, log.read_text())
            alter("default_transaction_read_only", "on")
            operator.execute(
                "select pg_terminate_backend(pid) from pg_stat_activity where datname = %s",
                [name.as_string().strip('"')],
            )
            wait_until(lambda: "read-only" in log.read_text(), "the worker says that it cannot write")
            alter("default_transaction_read_only", "off")
            operator.execute(
                "select pg_terminate_backend(pid) from pg_stat_activity where datname = %s",
                [name.as_string().strip('"')],
            )
            again = installation.ended(ask(1))
            assert again["status"] == "successful", (again, log.read_text())
            assert worker.poll() is None
        assert "Traceback" not in log.read_text()
