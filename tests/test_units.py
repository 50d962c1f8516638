"""The units of systemd: every directive is known; they and the section *Upgrade* are followed."""

import gzip
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from uuid import uuid4

import httpx
import psycopg
import pytest

from amers.app.cli.serve import API_ENDING_S
from amers.app.cli.supervisor import Child
from amers.app.config import Settings
from amers.app.db import engine, revisions, stored_files
from amers.app.db.cluster import programs
from amers.app.usecases.tokens import create_token
from tests.app.operators_server import PASSWORD, OperatorsServer, running_server
from tests.confined import NOBODY, owned_folder, skip_unless_possible
from tests.run_folders import place_of_databases, run_folder
from tests.service_process import free_port
from tests.test_container_steps import psql
from tests.units import (
    CACHE,
    FOLDER,
    NAMES,
    STATE,
    Machine,
    directives,
    settings_folder,
    text_on_this_machine,
)

pytestmark = [pytest.mark.database, pytest.mark.long]

ROOT = Path(__file__).parent.parent
OPERATIONS = (ROOT / "docs" / "operations.md").read_text()
RELEASE = ROOT / "tests" / "golden" / "releases" / "0002.sql.gz"
SERVICES = [name for name in NAMES if name.endswith(".service")]
EXPOSURE = 25
"""In tenths, as `systemd-analyze security` rates a unit from 0 (confined) to 100."""
BACKUPS = "/var/backups/amers"


def commands(section: str) -> list[str]:
    """The lines of the code blocks of a section of the page of operations."""
    text = OPERATIONS.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    assert text, section
    blocks = re.findall(r"^ *```\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE)
    return [line.strip() for block in blocks for line in block.splitlines()]


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of all units with the programs of this machine."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is missing: no unit can be checked")
    folder = tmp_path_factory.mktemp("units")
    for name in NAMES:
        (folder / name.replace("@", "@1")).write_text(text_on_this_machine(name))
        (folder / name).write_text(text_on_this_machine(name))
    return folder


def test_every_directive_of_every_unit_is_known_to_systemd(units: Path):
    names = [name.replace("@", "@1") for name in NAMES]
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *(units / name for name in names)],
        capture_output=True,
        text=True,
        check=False,
    )
    said = [line for line in checked.stderr.splitlines() if str(units) in line or "amers" in line]
    assert (checked.returncode, said) == (0, []), checked.stderr


def test_a_wrong_directive_would_be_noticed(units: Path, tmp_path: Path):
    wrong = tmp_path / "wrong.service"
    wrong.write_text((units / "amers.service").read_text().replace("ProtectHome=", "ProtectHouse="))
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", wrong], capture_output=True, text=True, check=False
    )
    assert "ProtectHouse" in checked.stderr


@pytest.mark.parametrize("name", SERVICES)
def test_a_unit_is_confined(name: str, units: Path):
    unit = units / name.replace("@", "@1")
    rated = subprocess.run(
        ["systemd-analyze", "security", "--no-pager", "--offline=true", f"--threshold={EXPOSURE}", unit],
        capture_output=True,
        text=True,
        check=False,
    )
    assert rated.returncode == 0, rated.stdout[-2000:] + rated.stderr


def test_units_stop_as_serve_and_worker_stop():
    longest = max(API_ENDING_S, Child("", "").ending_s)
    for name in ("amers.service", "amers-worker@.service"):
        unit = directives(name)
        assert float(unit["TimeoutStopSec"][0]) > longest
        assert unit["KillMode"] == ["mixed"], "the processes below are stopped by the one above them"
    assert directives("amers.service")["SuccessExitStatus"] == [str(128 + signal.SIGTERM)]


@pytest.mark.parametrize("name", SERVICES)
def test_a_unit_sets_settings_that_exist_and_writes_where_the_page_says(name: str):
    known = {f"AMERS_{field.upper()}" for field in Settings.model_fields}
    text = (FOLDER / name).read_text() + (FOLDER / "amers.env").read_text()
    assert set(re.findall(r"\b(AMERS_\w+)=", text)) <= known
    unit = directives(name)
    assert (unit["StateDirectory"], unit["CacheDirectory"], unit["UMask"]) == (
        ["amers"],
        ["amers"],
        ["0027"],
    )


def test_the_page_installs_every_file_of_the_folder():
    lines = "\n".join(commands("Services of systemd"))
    assert {path.suffix for path in FOLDER.iterdir()} == {"", ".service", ".timer", ".env"}
    for words in ("systemd/*.service", "systemd/*.timer", "systemd/amers-backup ", "systemd/amers.env"):
        assert words in lines
    for line in commands("Services of systemd") + commands("Upgrade"):
        for name in (
            re.findall(r"\bamers[\w@.*-]*(?=\s|'|$)", line) if line.startswith("systemctl") else ()
        ):
            unit = name if "." in name else f"{name}.service"
            assert re.sub(r"@[\d*]", "@", unit) in NAMES, line


@dataclass
class Systemd:
    """Does what `systemctl` would do with the units, without systemd.

    Attributes:
        machine: on which they run.
        log: what they say.
        running: started services by name.
        stack: ends them all.
    """

    machine: Machine
    log: Path
    stack: ExitStack
    running: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)

    def systemctl(self, verb: str, *names: str) -> int:
        """Start or stop units; returns the exit code."""
        for name in names:
            unit = name if "." in name else f"{name}.service"
            if unit.endswith(".timer"):
                continue
            code = self._start(unit) if verb == "start" else self._stop(unit)
            if code:
                return code
        return 0

    def _start(self, unit: str) -> int:
        template = re.sub(r"@\w+", "@", unit)
        with self.log.open("ab") as output:
            process = subprocess.Popen(self.machine.command(template), stdout=output, stderr=output)
        if directives(template)["Type"] == ["oneshot"]:
            return process.wait(timeout=300)
        self.running[unit] = process
        self.stack.callback(self._stop, unit)
        return 0

    def _stop(self, unit: str) -> int:
        for name in [name for name in self.running if name == unit or unit.endswith("@*.service")]:
            process = self.running.pop(name)
            process.send_signal(signal.SIGTERM)
            code = process.wait(timeout=120)
            success = directives(re.sub(r"@\w+", "@", name))["SuccessExitStatus"]
            assert str(code) in ["0", *success], self.log.read_text()
        return 0


@pytest.fixture
def server() -> Iterator[OperatorsServer]:
    with run_folder(place_of_databases()) as folder, running_server(folder) as server:
        yield server


@contextmanager
def systemd(server: OperatorsServer, open_folder: Path, tmp_path: Path) -> Iterator[Systemd]:
    """A machine on which the page of operations was followed up to the schema of the database."""
    skip_unless_possible()
    place = open_folder / uuid4().hex[:8]
    place.mkdir(mode=0o755)
    settings = settings_folder(place / "etc", PASSWORD)
    password = place / "password"
    password.write_text(PASSWORD)
    password.chmod(0o644)
    made = psql(server, "make_database.sql", f"--set=password_file={password}")
    assert made.returncode == 0, made.stderr
    folders = {name: owned_folder(place / name.strip("/")) for name in (STATE, CACHE, BACKUPS)}
    ports = {"PGPORT": str(server.port), "AMERS_PORT": str(free_port())}
    with ExitStack() as stack:
        yield Systemd(Machine(folders, settings, ports), tmp_path / "log", stack)


@pytest.mark.thorough
def test_the_store_of_an_earlier_release_is_upgraded_as_the_page_says_and_served(
    server: OperatorsServer, open_folder: Path, tmp_path: Path
):
    """The former program is not here: the archive of its backup is made as it made it.

    The golden store comes without its files; others stand in, which the verification finds.
    """
    dsn = server.dsn("amers", "amers")
    with systemd(server, open_folder, tmp_path) as machine:
        load_release(dsn)
        folders, port = machine.machine.folders, machine.machine.variables["AMERS_PORT"]
        names = stand_in_files(server, folders[STATE] / "storage")
        assert revisions.status(dsn).found == "0002"
        done = []
        for line in commands("Upgrade"):
            words = shlex.split(line)
            done.append(words[0])
            if words == ["systemctl", "start", "amers-backup"]:
                programs.run_program(
                    dsn,
                    "pg_dump",
                    *("--format=custom", "--no-owner", "--no-privileges"),
                    f"--file={tmp_path / 'former.dump'}",
                )
            elif words[0] == "systemctl":
                assert machine.systemctl(*words[1:]) == 0, machine.log.read_text()
            elif words[0] == "curl":
                here = [word.replace(":8000", f":{port}") for word in words]
                reply = subprocess.run(here, capture_output=True, text=True, check=False)
                assert reply.returncode == 0, reply.stderr + machine.log.read_text()
                assert json.loads(reply.stdout)["parts"]["schema"]["status"] == "ok"
            elif words[0] == "systemd-run":
                verified = run_in_unit(machine.machine, words)
                assert verified.returncode in (0, 1), verified.stderr
                findings = json.loads(verified.stdout)["findings"]
                stored = [row for row in findings if row["kind"] != "reference"]
                assert {row["key"] for row in stored} <= names
                assert {row["state"] for row in stored} == {"rotten"}
            else:
                assert words[0] in ("git", "/opt/amers/bin/pip"), line
        assert done.count("systemctl") >= 4
        assert {"curl", "systemd-run"} <= set(done)
        assert_points(dsn, port)
        # Back: what the former version has backed up is whole, for any version.
        again = server.make_database()
        environment = machine.machine.environment("amers-upgrade.service")
        environment |= {
            "AMERS_DATABASE_URL": again,
            "AMERS_DATABASE_PASSWORD_FILE": f"{tmp_path}/password",
        }
        (tmp_path / "password").write_text(PASSWORD)
        restored = subprocess.run(
            ["amers", "db", "restore", str(tmp_path / "former.dump")],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert restored.returncode == 0, restored.stderr
        count = "select count(*) from point"
        assert server.rows(again, count) == server.rows(dsn, count)


def load_release(dsn: str) -> None:
    """Fill a database of an ordinary role with the store of a release."""
    statements = gzip.decompress(RELEASE.read_bytes()).decode()
    own = "\n".join(
        line for line in statements.splitlines() if not line.startswith("COMMENT ON EXTENSION")
    )
    with psycopg.connect(dsn) as connection:
        connection.execute(own.encode())


def stand_in_files(server: OperatorsServer, storage: Path) -> set[str]:
    """Put files in place of those that the rows of the release name; returns their keys."""
    copy = server.make_database()
    load_release(copy)
    revisions.upgrade(copy)
    with engine.connect(copy) as connection:
        keys = {file.storage_key for file in stored_files.read_named_files(connection)}
    for key in keys:
        (storage / key).parent.mkdir(parents=True, exist_ok=True)
        (storage / key).write_bytes(b"stands in")
    for path in [storage, *storage.rglob("*")]:
        os.chown(path, NOBODY, NOBODY)
    return keys


def run_in_unit(machine: Machine, words: list[str]) -> "subprocess.CompletedProcess[str]":
    """Do what `systemd-run` does with its options and a command."""
    assert "--property=EnvironmentFile=/etc/amers/amers.env" in words
    command = words[next(n for n, word in enumerate(words) if word.startswith("/opt/amers/bin/")) :]
    name = "amers-upgrade.service"
    own = dict(
        word.removeprefix("--setenv=").split("=", 1) for word in words if word.startswith("--setenv=")
    )
    assert own == {"AMERS_DATA_FOLDER": STATE}
    here = [Path(command[0]).name, *command[1:], "--json"]
    return machine.confinement(name).run(here, machine.environment(name))


def assert_points(dsn: str, port: str) -> None:
    with engine.connect(dsn) as connection:
        secret = create_token(connection, "reader", ["read"]).secret
    page = httpx.get(
        f"http://127.0.0.1:{port}/collections/points/items?limit=100",
        headers={"Authorization": f"Bearer {secret}"},
        timeout=30,
    )
    assert len(page.json()["features"]) == 11, page.text


@pytest.mark.thorough
def test_the_nightly_backup_verifies_and_keeps_the_newest(
    server: OperatorsServer, open_folder: Path, tmp_path: Path
):
    with systemd(server, open_folder, tmp_path) as machine:
        assert machine.systemctl("start", "amers-upgrade") == 0, machine.log.read_text()
        backups = machine.machine.folders[BACKUPS]
        older = [f"2020-01-{day:02}T020000Z" for day in range(1, 20)]
        for name in [*older, "of somebody"]:
            (backups / name).mkdir()
        assert machine.systemctl("start", "amers-backup") == 0, machine.log.read_text()
        kept = sorted(path.name for path in backups.iterdir())
        assert kept[:13] == older[-13:]
        assert kept[14:] == ["of somebody"]
        assert (backups / kept[13] / "manifest.json").is_file()
        assert oct((backups / kept[13]).stat().st_mode & 0o777) == "0o700"


STEPS = ("backup", "verify-backup")


@pytest.mark.parametrize(
    ("codes", "code", "is_pruned"),
    [((0, 0), 0, True), ((1, 0), 1, True), ((2, 0), 2, False), ((0, 2), 2, False), ((1, 2), 2, False)],
)
def test_the_exit_code_of_a_nightly_backup_tells_what_went_wrong(
    codes: tuple[int, int], code: int, is_pruned: bool, tmp_path: Path
):
    """Damaged files are told though the backup is whole; nothing is removed without a verified one."""
    made = '[ "$2" = backup ] && mkdir "$3" && touch "$3/manifest.json"\n' if codes[0] < 2 else ""
    cases = "\n".join(f"{step}) exit {code} ;;" for step, code in zip(STEPS, codes, strict=True))
    amers = tmp_path / "bin" / "amers"
    amers.parent.mkdir()
    amers.write_text(f'#!/bin/sh\n{made}case "$2" in\n{cases}\nesac\n')
    amers.chmod(0o755)
    backups = tmp_path / "backups"
    (backups / "2020-01-01T020000Z").mkdir(parents=True)
    done = subprocess.run(
        [FOLDER / "amers-backup", backups, "1"],
        env={"PATH": f"{amers.parent}:/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    assert (backups / "2020-01-01T020000Z").exists() is not is_pruned
