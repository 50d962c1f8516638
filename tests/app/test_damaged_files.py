"""Flipped bits and lost files in the storage: found by verification, export and use, and repaired."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from rasterio.transform import Affine
from typer.testing import CliRunner

from amers.app.cli.main import app as commands
from amers.app.config import Settings
from amers.app.db.engine import Connection, Database
from amers.app.main import create_app
from amers.app.storage import Storage, trash
from amers.app.usecases.installation import Installation
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.references import NewReference, add_reference
from amers.app.usecases.store_verification import Verification, verify_store
from amers.services.formats.chips.npy_files import read_chip_file
from tests.app.callers import Bearer
from tests.app.job_queue import claimed
from tests.app.s3_server import running_bucket
from tests.app.served import serve_block
from tests.factories import BOX, make_block
from tests.statements import run_sql
from tests.unproven import unproven_storage

pytestmark = pytest.mark.thorough

CHIPS = "/collections/points/chips"
EXPORT = {"inputs": {"bbox": list(BOX)}}
STORED = {"chips", "scene image", "side file", "upload archive", "result"}
"""Kinds of files in the storage."""
REFERENCES = {"reference image": "image.tif", "reference terrain": "terrain.tif"}
EVERY_KIND = STORED | set(REFERENCES)
FAST_MB_S = 1e6


@pytest.fixture
def references(tmp_path: Path) -> Path:
    """A folder with a reference image and a terrain of the same ground."""
    folder = tmp_path / "references"
    folder.mkdir()
    grid = Affine(10.0, 0, 5e5, 0, -10.0, 5e6)
    profile = {"driver": "GTiff", "width": 64, "height": 64, "count": 1, "dtype": "uint16"}
    for name, level in (("image.tif", 500), ("terrain.tif", 30)):
        with rasterio.open(folder / name, "w", crs="EPSG:32632", transform=grid, **profile) as file:
            file.write(np.full((64, 64), level, np.uint16), 1)
    return folder


@pytest.fixture(params=["folder", "bucket"])
def settings(
    request: pytest.FixtureRequest,
    dsn: str,
    tmp_path: Path,
    references: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Settings]:
    """Settings of an installation with its files in a folder or in a bucket."""
    basic = Settings(database_url=dsn, data_folder=tmp_path / "data", reference_folder=references)
    monkeypatch.setenv("AMERS_DATABASE_URL", dsn)
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(tmp_path / "data"))
    monkeypatch.setenv("AMERS_REFERENCE_FOLDER", str(references))
    if request.param == "folder":
        yield basic
        return
    with running_bucket(monkeypatch) as url:
        monkeypatch.setenv("AMERS_STORAGE_URL", url)
        yield basic.model_copy(update={"storage_url": url})


in_a_folder = pytest.mark.parametrize("settings", ["folder"], indirect=True)


@dataclass(frozen=True)
class Filled:
    """An installation with a file of every kind, and a caller who owns them.

    Attributes:
        keys: kind to the key of a file of it; of a reference, its path.
        chip_rows: id of a point to the rows of its chips.
        copies: a folder with whole copies of all files.
        job: address of the job that made the result.
    """

    installation: Installation
    client: TestClient
    caller: dict[str, str]
    monitor: dict[str, str]
    keys: dict[str, str]
    chip_rows: dict[int, range]
    copies: Path
    job: str

    @property
    def storage(self) -> Storage:
        return self.installation.storage

    def content(self, kind: str) -> bytes:
        if kind in REFERENCES:
            return self._reference(kind).read_bytes()
        with self.storage.open(self.keys[kind]) as file:
            return file.read()

    def replace(self, kind: str, content: bytes) -> None:
        """Change a file in its place, as a disk does: who has it open sees the change."""
        path = self._reference(kind) if kind in REFERENCES else self.storage.local(self.keys[kind])
        if path is not None:
            path.write_bytes(content)
        else:
            self.storage.put(self.keys[kind], [content])

    def flip(self, kind: str, at: int = -9) -> None:
        """Flip a bit of a file."""
        content = bytearray(self.content(kind))
        content[at] ^= 4
        self.replace(kind, bytes(content))

    def flip_chip(self, row: int) -> None:
        """Flip a bit of a chip."""
        first, size = read_chip_file(self.copies / self.keys["chips"], "").byte_range(row, 1)
        self.flip("chips", first + size // 2)

    def verify(self, copies: Path | None = None) -> Verification:
        return verify_store(self.installation, lambda fraction, key: None, FAST_MB_S, copies)

    def get(self, path: str) -> Any:
        return self.client.get(path, headers=self.caller)

    def run_export(self) -> dict[str, Any]:
        """A job that exports all points, after its only attempt."""
        reply = self.client.post("/processes/export-block/execution", json=EXPORT, headers=self.caller)
        job = claimed(self.installation.database, UUID(reply.json()["jobID"]))
        do_attempt(self.installation.database, self.installation.settings, job.id, job.attempt)
        return {"location": reply.headers["location"], **self.get(reply.headers["location"]).json()}

    def damaged_files(self) -> float:
        """The metric of damaged files."""
        lines = self.client.get("/metrics", headers=self.monitor).text.splitlines()
        return float(next(line for line in lines if line.startswith("amers_damaged_files ")).split()[1])

    def _reference(self, kind: str) -> Path:
        folder = self.installation.settings.reference_folder
        assert folder is not None
        return folder / self.keys[kind]


@pytest.fixture
def filled(
    settings: Settings, database: Database, connection: Connection, bearer: Bearer, tmp_path: Path
) -> Iterator[Filled]:
    """The installation, filled."""
    storage = unproven_storage(settings)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        serve_block(connection, storage, make_block(tmp_path / "block").folder)
        reference = NewReference("land", "image.tif", "terrain.tif", "ellipsoid")
        add_reference(connection, settings, reference)
        points = run_sql(connection, "select id, chip_row, chip_count from point").fetchall()
        chips_key = run_sql(connection, "select storage_key from chip_file").fetchone()["storage_key"]
        connection.commit()
        me = bearer("admin")
        image = b"II*\0" + bytes(range(256)) * 8
        scene = client.post("/scenes?name=scene.tif", content=image, headers=me).json()["id"]
        path = f"/scenes/{scene}/files/terrain.tif"
        assert client.put(path, content=image[::-1], headers=me).status_code == 200
        archive = client.put("/blocks/uploads/block.zip", content=b"PK" + image, headers=me)
        assert archive.status_code == 201, archive.text
        filled = Filled(
            Installation(database, storage, settings),
            client,
            me,
            bearer("monitor"),
            {"chips": chips_key, **REFERENCES},
            {p["id"]: range(p["chip_row"], p["chip_row"] + p["chip_count"]) for p in points},
            tmp_path / "copies",
            "",
        )
        job = filled.run_export()
        assert job["status"] == "successful", job
        filled.keys["scene image"] = f"scenes/{scene}/scene.tif"
        filled.keys["side file"] = f"scenes/{scene}/terrain.tif"
        filled.keys["upload archive"] = storage.keys("uploads")[0]
        filled.keys["result"] = storage.keys("results")[0]
        for kind in STORED:
            copy = tmp_path / "copies" / filled.keys[kind]
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(filled.content(kind))
        yield Filled(**{**vars(filled), "job": job["location"]})


def states(filled: Filled, verification: Verification) -> dict[str, str]:
    """State of each finding, by the kind of the file."""
    kinds = {key: kind for kind, key in filled.keys.items()}
    return {kinds[finding.key]: finding.state for finding in verification.findings}


def test_a_whole_storage_has_no_findings(filled: Filled):
    assert set(filled.keys) == EVERY_KIND
    verification = filled.verify()
    assert verification.findings == ()
    assert verification.n_files == len(EVERY_KIND)
    assert verification.n_recorded == 0


def test_a_flipped_bit_in_each_kind_of_file_is_found_and_repaired_from_copies(filled: Filled):
    whole = {kind: filled.content(kind) for kind in EVERY_KIND}
    for kind in EVERY_KIND:
        filled.flip(kind)

    verification = filled.verify()

    assert states(filled, verification) == dict.fromkeys(EVERY_KIND, "rotten")
    assert filled.damaged_files() == len(EVERY_KIND)
    repaired = filled.verify(filled.copies).findings
    assert {finding.key for finding in repaired if not finding.repaired} == set(REFERENCES.values())
    for kind in STORED:
        assert filled.content(kind) == whole[kind]
    for kind in REFERENCES:
        filled.replace(kind, whole[kind])
    assert filled.verify().findings == ()
    assert filled.damaged_files() == 0
    (discarded,) = trash.batches(filled.storage).values()
    assert set(discarded) == {filled.keys[kind] for kind in STORED}


def test_missing_files_are_found_and_put_back(filled: Filled):
    for kind in STORED:
        filled.storage.delete(filled.keys[kind])

    assert states(filled, filled.verify()) == dict.fromkeys(STORED, "missing")
    backup = filled.copies.parent / "backup"
    backup.mkdir()
    shutil.move(filled.copies, backup / "storage")
    assert all(finding.repaired for finding in filled.verify(backup).findings)
    assert filled.verify().findings == ()


def test_a_copy_that_is_rotten_itself_replaces_nothing(filled: Filled):
    filled.flip("side file")
    rotten = filled.content("side file")
    (filled.copies / filled.keys["side file"]).write_bytes(rotten[::-1])

    (finding,) = filled.verify(filled.copies).findings

    assert not finding.repaired
    assert "differs too" in finding.detail
    assert filled.content("side file") == rotten


@in_a_folder
def test_damaged_chips_are_named_by_their_rows_and_points(filled: Filled):
    (first, rows), (second, more_rows) = sorted(filled.chip_rows.items())[3:5]
    filled.flip_chip(rows[1])
    filled.flip_chip(more_rows[0])

    (finding,) = filled.verify().findings

    damaged = sorted((rows[1], more_rows[0]))
    assert f"rows {damaged[0]}, {damaged[1]}" in finding.detail
    assert (finding.n_points, finding.first_points) == (2, (first, second))


@in_a_folder
def test_a_damaged_header_or_end_of_a_file_of_chips_is_found(filled: Filled):
    whole = filled.content("chips")
    filled.flip("chips", 3)
    (finding,) = filled.verify().findings
    assert (finding.state, finding.n_points) == ("rotten", len(filled.chip_rows))
    filled.replace("chips", whole[:-1])
    (finding,) = filled.verify().findings
    assert (finding.state, finding.n_points) == ("rotten", 1)


@in_a_folder
def test_recorded_checksums_that_are_damaged_themselves_are_recorded_again(
    filled: Filled, connection: Connection
):
    statement = "update chip_file set chip_checksums = set_byte(chip_checksums, 5, 1)"
    run_sql(connection, statement)
    connection.commit()

    (finding,) = filled.verify().findings

    assert (finding.kind, finding.repaired) == ("chips", True)
    assert filled.verify().findings == ()


@in_a_folder
def test_files_of_an_earlier_version_get_checksums_at_the_first_verification(
    filled: Filled, connection: Connection
):
    run_sql(connection, "update chip_file set chip_checksums = null")
    run_sql(connection, "delete from result_file")
    run_sql(connection, "update upload set sha256 = null")
    run_sql(connection, "update reference_image set checksums = null")
    connection.commit()

    first = filled.verify()

    assert (first.findings, first.n_recorded) == ((), 2 + len(REFERENCES) + 1)
    for kind in EVERY_KIND:
        filled.flip(kind)
    assert states(filled, filled.verify()) == dict.fromkeys(EVERY_KIND, "rotten")


@in_a_folder
def test_files_that_no_row_names_are_reported_and_files_being_written_are_not(
    filled: Filled, connection: Connection
):
    beside = f"{filled.keys['side file'].rsplit('/', 1)[0]}/left.tif"
    for key in (f"chips/{'0' * 64}.npy", beside):
        filled.storage.put(key, [b"left behind"])
    row = run_sql(
        connection,
        """insert into scene (id, name, state, file_name)
           values (gen_random_uuid(), 'a', 'uploading', 'a.tif') returning id""",
    ).fetchone()
    connection.commit()
    filled.storage.put(f"scenes/{row['id']}/a.tif", [b"arriving"])

    findings = filled.verify().findings

    assert [(finding.key, finding.state) for finding in findings] == [
        (beside, "unknown"),
        (f"chips/{'0' * 64}.npy", "unknown"),
    ]


@in_a_folder
def test_the_command_shows_the_findings_and_ends_with_one(filled: Filled, tmp_path: Path):
    def run(*words: str) -> Any:
        return CliRunner().invoke(commands, ["store", "verify", *words], catch_exceptions=False)

    assert run("--json").exit_code == 0
    filled.flip_chip(0)
    result = run("--json", "--rate", "1000")
    assert result.exit_code == 1
    (finding,) = json.loads(result.stdout)["findings"]
    assert (finding["key"], finding["state"]) == (filled.keys["chips"], "rotten")
    assert filled.keys["chips"] in run().stdout
    repaired = run("--repair", str(filled.copies), "--json")
    assert repaired.exit_code == 0
    assert [one["repaired"] for one in json.loads(repaired.stdout)["findings"]] == [True]
    assert run().exit_code == 0


def test_an_export_never_launders_damage(filled: Filled):
    filled.flip_chip(17)

    job = filled.run_export()

    assert job["status"] == "failed"
    problem = json.dumps(job)
    assert filled.keys["chips"] in problem
    assert "rows 17" in problem
    assert filled.damaged_files() == 1


@in_a_folder
def test_an_export_by_command_never_launders_damage(filled: Filled, tmp_path: Path):
    filled.flip_chip(17)
    box = ",".join(map(str, BOX))
    result = CliRunner().invoke(
        commands, ["block", "export", "--bbox", box, "-o", str(tmp_path / "exported")]
    )
    assert result.exit_code != 0
    assert "rows 17" in str(result.exception)
    assert not (tmp_path / "exported").exists()


def test_damaged_chips_are_not_served_and_alarm_the_operator(
    filled: Filled, caplog: pytest.LogCaptureFixture
):
    (damaged, rows), (whole, _) = sorted(filled.chip_rows.items())[:2]
    item = f"/collections/points/items/{damaged}/chips"
    assert filled.get(f"{item}/1").status_code == 200
    filled.flip_chip(rows[1])

    for path in (f"{item}/1", item, f"{CHIPS}?ids={damaged}"):
        reply = filled.get(path)
        assert (reply.status_code, reply.json()["error"]) == (500, "DamagedFile"), path
    assert filled.get(f"{item}/0").status_code == 200
    assert filled.get(f"{CHIPS}?ids={whole}").status_code == 200
    alarms = [record for record in caplog.records if filled.keys["chips"] in record.getMessage()]
    assert {record.levelname for record in alarms} == {"ERROR"}
    assert filled.damaged_files() == 1
    assert filled.verify(filled.copies).is_whole
    assert filled.get(f"{item}/1").status_code == 200
    assert filled.damaged_files() == 0


@in_a_folder
def test_an_archive_of_chips_ends_where_damage_begins_and_alarms_the_operator(
    filled: Filled, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("amers.services.formats.chips.stacks.CHIPS_PER_PIECE", 16)
    filled.flip_chip(max(rows[-1] for rows in filled.chip_rows.values()))
    ids = ",".join(map(str, filled.chip_rows))
    whole_bytes = 101 * 101 * 2 * sum(map(len, filled.chip_rows.values()))

    reply = filled.get(f"{CHIPS}?ids={ids}")

    assert 0 < len(reply.content) < whole_bytes
    assert filled.damaged_files() == 1


@in_a_folder
def test_a_verification_reads_no_faster_than_its_rate(filled: Filled, monkeypatch: pytest.MonkeyPatch):
    waits: list[float] = []
    monkeypatch.setattr("amers.app.usecases.store_verification.time.sleep", waits.append)
    a_thousandth_of_a_megabyte_per_s = 0.001
    verification = verify_store(
        filled.installation, lambda fraction, key: None, a_thousandth_of_a_megabyte_per_s
    )
    due_s = verification.size_bytes / 1000.0
    assert due_s > 1000.0
    assert waits[-1] == pytest.approx(due_s, rel=0.1)


def test_a_missing_file_is_an_error_of_the_service_until_its_owner_removes_it(filled: Filled):
    scene = "/".join(filled.keys["scene image"].split("/")[:2])
    result = f"{filled.job}/results/block.zip"
    for kind, path in (("result", result), ("side file", f"/{scene}/files/terrain.tif")):
        assert filled.get(path).status_code == 200
        filled.storage.delete(filled.keys[kind])
        reply = filled.get(path)
        assert (reply.status_code, reply.json()["error"]) == (500, "DamagedFile")
    assert filled.damaged_files() == 2
    assert filled.client.delete(f"/{scene}", headers=filled.caller).status_code in (200, 204)
    assert filled.get(f"/{scene}/files/terrain.tif").status_code == 404
    assert {finding.kind for finding in filled.verify().findings} == {"result"}
    assert filled.damaged_files() == 1


@in_a_folder
def test_a_job_on_a_damaged_scene_names_the_damage_and_does_not_blame_the_sender(filled: Filled):
    scene = filled.keys["scene image"].split("/")[1]
    filled.flip("scene image")
    inputs = {"inputs": {"scene": scene}}
    reply = filled.client.post("/processes/register-scene/execution", json=inputs, headers=filled.caller)
    job = claimed(filled.installation.database, UUID(reply.json()["jobID"]))

    do_attempt(filled.installation.database, filled.installation.settings, job.id, job.attempt)

    ended = filled.get(reply.headers["location"]).json()
    assert ended["status"] == "failed"
    assert filled.keys["scene image"] in json.dumps(ended)
    assert "DamagedFile" in json.dumps(ended)
    assert filled.damaged_files() == 1
