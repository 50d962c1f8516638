"""What the files for containers say, done: by an engine where one runs, step by step where none does."""

import os
import re
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import httpx
import psycopg
import pytest

from amers.app.db import revisions
from tests.app.operators_server import (
    PASSWORD,
    SUPERUSER,
    SUPERUSERS_PASSWORD,
    OperatorsServer,
    running_server,
)
from tests.compose_file import compose, image_environment
from tests.confined import Confinement, owned_folder, path_of_amers, skip_unless_possible
from tests.run_folders import place_of_databases, run_folder
from tests.service_process import free_port, until

pytestmark = [pytest.mark.database, pytest.mark.long, pytest.mark.thorough]

ROOT = Path(__file__).parent.parent
DATABASE_FILES = ROOT / "examples" / "database"
ENGINES = ("docker", "podman", "buildah")


@dataclass(frozen=True)
class Containers:
    """The services of the compose file, each confined as it says.

    Attributes:
        server: stands in for `db`, prepared by the files that it mounts.
        data: behind the volume that the services share.
        secrets: the folder of the files of secrets.
        port: of the API, as the engine would publish it.
    """

    server: OperatorsServer
    data: Path
    secrets: Path
    port: int

    def command(self, name: str, words: list[str] | None = None) -> list[str]:
        """The words that run a service, or others in its place."""
        service = compose({"AMERS_TRUSTED_PROXIES": "172.18.0.1"})["services"][name]
        (volume,) = service["volumes"]
        (size,) = re.findall(r"size=(\w+)", service["tmpfs"][0])
        confinement = Confinement(
            writable={volume.partition(":")[2]: self.data},
            readable={"/run/secrets": self.secrets},
            tmp_size=size,
        )
        environment = {**image_environment(), **service["environment"], **self._instead_of_networks()}
        environment["PATH"] = path_of_amers()
        return confinement.command(words or service["command"], environment)

    def health(self, name: str) -> int:
        """The exit code of the check of a service's health."""
        kind, *words = compose({})["services"][name]["healthcheck"]["test"]
        assert kind == "CMD"
        here = [re.sub(r"(127\.0\.0\.1|api):8000", f"127.0.0.1:{self.port}", word) for word in words]
        return subprocess.run(self.command(name, here), capture_output=True, check=False).returncode

    @contextmanager
    def running(self, name: str, log: Path) -> Iterator["subprocess.Popen[bytes]"]:
        """A service, stopped as an engine stops it."""
        with log.open("ab") as output:
            process = subprocess.Popen(self.command(name), stdout=output, stderr=output)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=120)
            except subprocess.TimeoutExpired:
                process.kill()
                raise

    def _instead_of_networks(self) -> Mapping[str, str]:
        """The address of `db` is known to the driver, and the port is one that is free."""
        return {
            "PGHOSTADDR": "127.0.0.1",
            "PGPORT": str(self.server.port),
            "AMERS_PORT": str(self.port),
        }


def psql(server: OperatorsServer, file: str, *options: str) -> "subprocess.CompletedProcess[str]":
    """Run a file of statements as the superuser, as the image of the database does."""
    return subprocess.run(
        ["psql", "--no-psqlrc", "--set=ON_ERROR_STOP=1", *options, f"--file={DATABASE_FILES / file}"]
        + [f"--dbname=host=127.0.0.1 port={server.port} user={SUPERUSER} dbname=postgres"],
        env={**os.environ, "PGPASSWORD": SUPERUSERS_PASSWORD},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def server() -> Iterator[OperatorsServer]:
    if shutil.which("psql") is None:
        pytest.skip("psql is missing: nothing can do what the image of the database does")
    with run_folder(place_of_databases()) as folder, running_server(folder) as server:
        yield server


@pytest.fixture
def secrets(open_folder: Path) -> Path:
    """The folder of a password with every kind of character, which any user in a container can read."""
    folder = open_folder / uuid4().hex[:8]
    folder.mkdir(mode=0o755)
    (folder / "database_password").write_text(f"{PASSWORD}\n")
    return folder


def test_the_database_is_made_for_an_ordinary_role_and_its_superuser_is_closed(
    server: OperatorsServer, secrets: Path
):
    file = f"--set=password_file={secrets / 'database_password'}"
    made = psql(server, "make_database.sql", file)
    assert made.returncode == 0, made.stderr
    dsn = server.dsn("amers", "amers")
    ((*powers,),) = server.rows(
        dsn,
        "select rolsuper, rolcreaterole, rolcreatedb, rolreplication, rolbypassrls from pg_roles"
        " where rolname = current_user",
    )
    assert powers == [False] * 5
    assert server.rows(
        dsn, "select postgis_lib_version() ~ '^3', pg_has_role('amers_reader', 'member')"
    ) == [(True, True)]
    other = psql(
        server,
        "make_database.sql",
        file,
        "--set=role=second one",
        "--set=database=second store",
        "--set=postgis_schema=gis",
    )
    assert other.returncode == 0, other.stderr
    second = server.dsn("second store", "second one")
    assert server.rows(second, "select to_regtype('gis.geometry')::text") == [("gis.geometry",)]
    revisions.upgrade(second)
    log = (server.data / "log").read_text()
    assert PASSWORD not in log
    assert "password" not in log

    closed = psql(server, "superuser_by_socket_only.sql")
    assert closed.returncode == 0, closed.stderr
    for password in (SUPERUSERS_PASSWORD, PASSWORD, ""):
        with pytest.raises(psycopg.OperationalError):
            psycopg.connect(server.dsn("postgres", SUPERUSER, password))


@pytest.mark.parametrize("content", ["", None])
def test_a_missing_password_makes_no_role(content: str | None, server: OperatorsServer, secrets: Path):
    file = secrets / "other"
    if content is not None:
        file.write_text(content)
    refused = psql(server, "make_database.sql", f"--set=password_file={file}")
    assert refused.returncode == 3
    assert "cannot be read or is empty" in refused.stderr
    superuser = server.dsn("postgres", SUPERUSER, SUPERUSERS_PASSWORD)
    assert server.rows(superuser, "select count(*) from pg_roles where rolname = 'amers'") == [(0,)]


def test_the_services_run_confined_as_the_compose_file_says(
    server: OperatorsServer, secrets: Path, open_folder: Path, tmp_path: Path
):
    skip_unless_possible()
    file = f"--set=password_file={secrets / 'database_password'}"
    assert psql(server, "make_database.sql", file).returncode == 0
    data = owned_folder(open_folder / uuid4().hex[:8])
    containers = Containers(server, data, secrets, free_port())
    upgraded = subprocess.run(
        containers.command("upgrade"), capture_output=True, text=True, timeout=120, check=False
    )
    assert upgraded.returncode == 0, upgraded.stderr
    log = tmp_path / "log"
    with containers.running("api", log) as api:
        assert until(lambda: containers.health("api") == 0 or api.poll() is not None), log.read_text()
        assert api.poll() is None, log.read_text()
        assert containers.health("worker") == 1, "nobody works"
        made = subprocess.run(
            containers.command(
                "api", ["amers", "token", "create", "first", "--scope", "register", "--json"]
            ),
            capture_output=True,
            text=True,
            check=False,
        )
        assert made.returncode == 0, made.stderr
        with containers.running("worker", log) as worker:
            assert until(lambda: containers.health("worker") == 0), log.read_text()
        assert worker.returncode == 0, log.read_text()
        image = b"II*\0" + bytes(1000)
        secret = re.search(r'"secret": "([^"]+)"', made.stdout)
        assert secret is not None
        sent = httpx.post(
            f"http://127.0.0.1:{containers.port}/scenes?name=a.tif",
            content=image,
            headers={"Authorization": f"Bearer {secret[1]}"},
        )
        assert sent.status_code == 201, sent.text
        assert any((data / "storage" / "scenes").rglob("a.tif"))
    assert api.returncode == 128 + signal.SIGTERM, log.read_text()
    assert PASSWORD not in log.read_text()


def test_a_confined_service_can_write_into_its_volume_and_its_tmp_alone(
    secrets: Path, open_folder: Path
):
    skip_unless_possible()
    data = owned_folder(open_folder / uuid4().hex[:8])
    confinement = Confinement({"/var/lib/amers": data}, {"/run/secrets": secrets}, "1m")
    places = ["/x", "/run/secrets/x", f"{ROOT}/x", "/usr/x", "/etc/x", "/var/x"]
    for place in places:
        tried = confinement.run(["touch", place], {"PATH": path_of_amers()})
        assert "Read-only file system" in tried.stderr, place
    assert confinement.run(["touch", "/var/lib/amers/x"], {}).returncode == 0
    full = confinement.run(["dd", "if=/dev/zero", "of=/tmp/x", "bs=1M", "count=2"], {})
    assert "No space left" in full.stderr
    assert not [place for place in places if Path(place).exists()]


@pytest.mark.endurance
def test_the_package_is_installed_from_files_with_known_hashes_as_in_the_image(tmp_path: Path):
    """The steps of the stage `build` of the Dockerfile, in an empty folder."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    stage = text.partition(" AS build")[2].partition("\nFROM ")[0]
    for source, target in re.findall(r"^COPY (?!--from)(.*) (\S+)$", stage, re.MULTILINE):
        for name in source.split():
            there = ROOT / name
            if there.is_dir():
                shutil.copytree(there, tmp_path / target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(there, tmp_path / name)
    steps = re.findall(r"^RUN (?:--mount=\S+ )?(.*)$", stage, re.MULTILINE)
    assert len(steps) == 3
    place = tmp_path / "opt"
    for step in steps:
        here = step.replace("/opt/amers", str(place)).replace(
            "python -m venv", f"{sys.executable} -m venv"
        )
        done = subprocess.run(
            ["sh", "-c", here], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
    told = subprocess.run(
        [place / "bin" / "amers", "--version"], cwd="/", capture_output=True, text=True, check=False
    )
    assert told.returncode == 0, told.stderr
    assert stat.S_ISREG((place / "bin" / "amers").stat().st_mode)


def engine() -> str:
    """A container engine that runs on this machine."""
    for name in ENGINES:
        if (
            shutil.which(name)
            and subprocess.run([name, "info"], capture_output=True, check=False).returncode == 0
        ):
            return name
    pytest.skip(f"no container engine runs here ({', '.join(ENGINES)}): its steps are tested one by one")


@pytest.mark.endurance
def test_an_image_is_built_and_its_command_runs_read_only():
    program = engine()
    tag = f"amers-test-{uuid4().hex[:8]}"
    built = subprocess.run(
        [program, "build", "--tag", tag, str(ROOT)], capture_output=True, text=True, check=False
    )
    if built.returncode != 0 and re.search(r"pull|registry|resolve|manifest", built.stderr):
        pytest.skip(f"the base images cannot be fetched here: {built.stderr.strip().splitlines()[-1]}")
    assert built.returncode == 0, built.stderr
    try:
        options = ["--rm", "--read-only", "--tmpfs=/tmp", "--cap-drop=ALL"]
        told = subprocess.run(
            [program, "run", *options, tag, "amers", "--version"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert told.returncode == 0, told.stderr
    finally:
        subprocess.run([program, "rmi", "--force", tag], capture_output=True, check=False)
