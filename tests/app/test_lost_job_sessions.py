"""A session that the database ends, at whatever statement of a job or of its worker, costs one attempt.

`make test-thorough` draws statements of each kind of job, `make test-endurance` tries them all.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

import psycopg
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.app.db.jobs.jobs import Job
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.jobs import PROCESSES
from amers.app.usecases.tokens import create_token
from amers.app.worker.attempt import Attempts
from amers.app.worker.sweep import sweep_jobs
from amers.app.worker.warm_process import WarmProcess, WarmServer
from tests.app.conftest import EMPTY_TEMPLATE
from tests.app.flat_world import CENTRE, SIGMA_M
from tests.app.job_queue import state_of
from tests.app.ledger import job_runner
from tests.app.moved_lines import jittered, registration, stored_registration
from tests.app.session_relay import Ending, Relay, relayed
from tests.app.store_commands import Installations, Place, fill, settings_of
from tests.app.surface_world import write_pair
from tests.app.test_lost_sessions import drawn, limited, new_database
from tests.app.test_orthorectification import write_inputs
from tests.app.test_vectors import drawn as drawn_vectors
from tests.open_archive import CENTRE as OPEN_CENTRE
from tests.open_archive import make_archive
from tests.statements import run_in

pytestmark = [pytest.mark.long, pytest.mark.thorough]

LONGEST_S = 240
MOST_ATTEMPTS = 4
"""Attempts that one lost session may cost, with those of a job that was given back."""
LEASE_S = 30.0
BASE_BOX = [OPEN_CENTRE[0] - 0.01, OPEN_CENTRE[1] - 0.01, OPEN_CENTRE[0] + 0.01, OPEN_CENTRE[1] + 0.01]


@dataclass(frozen=True)
class ElsewhereServer:
    """Starts processes of a server on another installation than its own.

    Attributes:
        server: of the warm processes.
        environment: with the place of the installation.
    """

    server: WarmServer
    environment: Mapping[str, str]

    def start(
        self, function: str, arguments: Sequence[str], environment: Mapping[str, str]
    ) -> WarmProcess:
        return self.server.start(function, arguments, {**environment, **self.environment})


@pytest.fixture(scope="module")
def server() -> Iterator[WarmServer]:
    """A server of warm processes for all tests."""
    with WarmServer({}) as server:
        yield server


@pytest.fixture(scope="module")
def with_jobs(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Installations:
    """Copies of one installation where a job of each kind waits."""
    made = tmp_path_factory.mktemp("jobs")
    installations = Installations(cluster, made, new_database(cluster), EMPTY_TEMPLATE)
    dsn = cluster.dsn(installations.filled)
    fill(dsn, made, points=100, size=1200)
    make_archive(made / "open", dates=3)
    queue_jobs(dsn, made)
    return installations


def files_of(place: Place) -> dict[str, str]:
    """Settings by which jobs find files on the server."""
    catalogue = place.made / "open" / "items.json"
    return {"AMERS_INGEST_FOLDER": str(place.made), "AMERS_CATALOGUES": str(catalogue)}


def queue_jobs(dsn: str, made: Path) -> None:
    """Let a job of each kind wait."""
    settings = settings_of(dsn, made)
    with TestClient(create_app(settings)) as client, engine.pooled(dsn, settings) as database:
        with engine.connect(dsn) as connection:
            secret = create_token(connection, "surveyor", ["admin", "register"]).secret
        me = {"Authorization": f"Bearer {secret}"}

        def upload(path: Path) -> str:
            target = f"/scenes?name={path.name}&sigma_m={SIGMA_M}"
            return str(client.post(target, content=path.read_bytes(), headers=me).json()["id"])

        flat, east, south = (
            upload(made / name) for name in ("world/tagged.tif", "joint/east.tif", "joint/south.tif")
        )
        image, dem = write_inputs(made)
        raw = upload(image)
        pair = [upload(path) for path in write_pair(made)]
        pixels = drawn_vectors(made / "pixels.geojson", "LINESTRING (100.5 -50.5, 300.5 -250.5)")
        ground = drawn_vectors(made / "ground.geojson", "POINT (5.25 43.25)")
        for path in (dem, pixels, ground):
            laid = client.put(f"/scenes/{raw}/files/{path.name}", content=path.read_bytes(), headers=me)
            assert laid.status_code == 200, laid.text
        run = job_runner(client, database, settings, me)
        moved = stored_registration(
            dsn, Storage(settings.data_folder / "storage"), raw, registration(made / "moved", jittered())
        )
        done = run("register-scene", scene=flat, options={"max_points": 0})
        assert done["status"] == "successful", done
        box = [*(CENTRE - 0.1), *(CENTRE + 0.1)]
        on_ground = {"scene": raw, "dem": "dem.tif", "vertical": "ellipsoid"}
        inputs: dict[str, dict[str, object]] = {
            "register-scene": {"scene": flat},
            "register-scenes": {"scenes": [east, south]},
            "view-scene": {"scene": raw},
            "read-model": {"scene": raw},
            "map-scene": {"scene": flat, "registration": done["jobID"]},
            "orthorectify": on_ground,
            "straighten-scene": {"scene": raw, "registration": moved},
            "make-mosaic": {"scenes": pair, "gsd_m": 2.0, "height_m": 150.0},
            "make-surface": {"scenes": pair, "gsd_m": 2.0, "heights_m": [140.0, 180.0]},
            "correct-vectors": {**on_ground, "vectors": pixels.name, "sigma_m": SIGMA_M},
            "project-vectors": {**on_ground, "vectors": ground.name},
            "ingest-block": {"path": "new"},
            "export-block": {"bbox": box},
            "assess-block": {"block": "flat"},
            "renew-block": {"block": "flat", "jobs": [done["jobID"]]},
            "make-base": {"id": "open", "bbox": BASE_BOX, "dates": 2, "geoid": "open/geoid.gtx"},
        }
        assert inputs.keys() == PROCESSES.keys(), "a new kind of job needs inputs here"
        for kind, values in inputs.items():
            reply = client.post(f"/processes/{kind}/execution", json={"inputs": values}, headers=me)
            assert reply.status_code == 201, reply.text


@contextmanager
def waiting_job(
    installations: Installations, folder: Path, kind: str
) -> Iterator[tuple[Place, Relay, UUID]]:
    """An installation behind a relay, where a job of a kind is the next one."""
    with installations.new(folder, "") as place, relayed(place.dsn) as relay:
        with psycopg.connect(place.dsn) as connection:
            row = connection.execute(
                "update job set priority = 100 where kind = %s and state = 'accepted' returning id",
                [kind],
            ).fetchone()
        assert row is not None
        yield Place(place.folder, place.made, relay.dsn), relay, row[0]


def do_job(server: WarmServer, place: Place, direct_dsn: str, job_id: UUID) -> Job:
    """Do attempts as one worker does, until the job has ended; time passes between them."""
    settings = settings_of(place.dsn, place.made, place.folder / "data")
    environment = {name: place.environment[name] for name in place.environment if "AMERS" in name}
    elsewhere = ElsewhereServer(server, environment | files_of(place))
    with engine.pooled(direct_dsn, settings) as direct:
        for _ in range(MOST_ATTEMPTS):
            with limited(LONGEST_S):
                attempt_once(settings, place.dsn, elsewhere)
            job = state_of(direct, job_id)
            if job.state not in ("accepted", "running"):
                return job
            run_in(
                direct.transaction(),
                "update job set not_before = null, lease_until = case state when 'running'"
                " then now() - interval '1 second' end where id = %s",
                [job_id],
            )
            sweep_jobs(direct, LEASE_S)
    return job


def attempt_once(settings: Settings, dsn: str, server: ElsewhereServer) -> None:
    """One ticket of the queue; the queue logs what it raises, and goes on."""
    try:
        with engine.pooled(dsn, settings) as database:
            Attempts(database, server, settings, "w", lambda: False).do_next_job()  # type: ignore[arg-type]
    except psycopg.Error:
        return


def check_done(job: Job, installation: Place) -> None:
    """A job is done once, whatever it took."""
    assert job.state == "successful", (job.state, job.message, job.error)
    with psycopg.connect(installation.dsn) as connection:
        row = connection.execute(
            "select count(*) from registration where job_id = %s", [job.id]
        ).fetchone()
    assert row is not None
    assert row[0] == {"register-scene": 1, "register-scenes": 2}.get(job.kind, 0)


def statements_of(installations: Installations, folder: Path, server: WarmServer, kind: str) -> int:
    """The number of statements of a job, and of its worker for it, when nothing happens."""
    with waiting_job(installations, folder, kind) as (place, relay, job_id):
        relay.arm()
        job = do_job(server, place, relay.direct, job_id)
        n_statements = relay.count
        check_done(job, place)
        assert job.attempt == 1
        return n_statements


def lose(
    installations: Installations,
    folder: Path,
    server: WarmServer,
    kind: str,
    number: int,
    ending: Ending,
) -> None:
    """Do a job whose session, or that of its worker, ends at a statement."""
    with waiting_job(installations, folder, kind) as (place, relay, job_id):
        relay.arm(number, ending)
        job = do_job(server, place, relay.direct, job_id)
        relay.arm()
        check_done(job, place)
        assert job.failures <= 1, "one lost session is one failure at most"


@pytest.mark.parametrize("kind", sorted(PROCESSES))
def test_a_session_lost_at_drawn_statements_costs_a_job_one_attempt_at_most(
    with_jobs: Installations, server: WarmServer, tmp_path: Path, kind: str
):
    n_statements = statements_of(with_jobs, tmp_path, server, kind)
    for ending in (Ending.TERMINATED, Ending.UNANSWERED):
        for number in drawn(kind, ending, n_statements, 1):
            lose(with_jobs, tmp_path, server, kind, number, ending)


@pytest.mark.endurance
@pytest.mark.parametrize("ending", list(Ending))
@pytest.mark.parametrize("kind", sorted(PROCESSES))
def test_a_session_lost_at_any_statement_costs_a_job_one_attempt_at_most(
    with_jobs: Installations, server: WarmServer, tmp_path: Path, kind: str, ending: Ending
):
    n_statements = statements_of(with_jobs, tmp_path, server, kind)
    assert n_statements > 0
    for number in range(1, n_statements + 1):
        lose(with_jobs, tmp_path, server, kind, number, ending)
