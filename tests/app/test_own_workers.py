"""Workers on a database with foreign settings, behind a pooler, and read-only for a while."""

from collections.abc import Callable
from pathlib import Path
from uuid import uuid4

import psycopg
import pytest
from fastapi.testclient import TestClient
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict
from pydantic import SecretStr

from amers.app.config import Settings
from amers.app.db.cluster.embedded import SUPERUSER, Cluster
from amers.app.storage import Storage
from tests.app.flat_world import make_flat_world
from tests.app.poolers import pooler
from tests.app.worker_processes import ended, running_worker, scene_to_register, wait_until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

FOREIGN = {"TimeZone": "Asia/Kathmandu", "DateStyle": "SQL, DMY", "search_path": "nowhere"}
FOREIGN |= {"statement_timeout": "150", "standard_conforming_strings": "off"}


def test_a_worker_behind_a_pooler_does_jobs_and_outlives_a_read_only_database(
    cluster: Cluster,
    settings: Settings,
    client: TestClient,
    bearer: Callable[[str], dict[str, str]],
    storage: Storage,
    dsn: str,
    tmp_path: Path,
    open_folder: Path,
):
    world = make_flat_world(tmp_path / "world", size=800)
    me = bearer("register")
    ask = scene_to_register(client, me, storage, dsn, world)
    name = sql.Identifier(str(conninfo_to_dict(dsn)["dbname"]))
    log = tmp_path / "worker.log"
    with (
        psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as operator,
        pooler(dsn, open_folder / uuid4().hex[:8], "session", "server_reset_query = ") as address,
    ):

        def alter(setting: str, value: str) -> None:
            statement = sql.SQL("alter database {} set {} = {}")
            operator.execute(statement.format(name, sql.Identifier(setting), value))

        for setting, value in FOREIGN.items():
            alter(setting, value)
        pooled = settings.model_copy(update={"database_url": SecretStr(address), "lease_seconds": 3.0})
        with running_worker(pooled, log) as worker:
            done = ended(client, ask(1), me)
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
            again = ended(client, ask(1), me)
            assert again["status"] == "successful", (again, log.read_text())
            assert worker.poll() is None
        assert "Traceback" not in log.read_text()
