"""The folder of a result holds the older result or the new one, whole, whenever a run is killed."""

import fcntl
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import pytest

from amers.app.errors import InputError
from amers.app.usecases.registration import result_folder
from amers.app.usecases.registration.result_folder import MANIFEST, older_result, replacing

OPERATIONS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.listdir", "os.scandir")
"""Audit events before Python touches the file system: a kill at each of them meets every state."""
LARGEST_NUMBER = 400
FILES = ("report.json", "report.txt", "residuals.gpkg", "refined_RPC.TXT")
"""Of a result, beside its model: what happens to one of them happens to any number."""


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill of a process loses nothing that it has written; only a power cut would."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def write_result(folder: Path, run: str, verdict: str = "good") -> None:
    """Write all files of a result, the content of each naming the run."""
    with replacing(folder) as new:
        for name in (*FILES, f"{run}_RPC.TXT"):
            (new / name).write_text(f"{name} of the {run} run\n" * 50)
        report = {"verdict": verdict, "scene": {"name": run}}
        (new / "report.json").write_text(json.dumps(report))


def run_in(folder: Path) -> str:
    """The run whose result a folder holds, after a check that it is whole and has nothing else."""
    manifest = json.loads((folder / MANIFEST).read_text())
    run: str = manifest["scene"]
    assert {path.name for path in folder.iterdir()} == {*FILES, f"{run}_RPC.TXT", MANIFEST}
    for path in folder.iterdir():
        if path.name != MANIFEST:
            assert sha256(path.read_bytes()).hexdigest() == manifest["files"][path.name]["sha256"]
        assert path.name in (MANIFEST, "report.json") or f"of the {run} run" in path.read_text()
    return run


def killed_at(number: int, work: Callable[[], None]) -> bool:
    """Do some work in a child that is killed before its operation of this number; whether it was."""
    child = os.fork()
    if child == 0:
        left = number

        def count(event: str, arguments: object) -> None:
            nonlocal left
            if event in OPERATIONS:
                left -= 1
                if left == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        try:
            work()
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


@pytest.mark.endurance
@pytest.mark.parametrize("exchanges", [True, False])
@pytest.mark.long
def test_a_result_is_whole_wherever_its_writer_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanges: bool
):
    if not exchanges:
        monkeypatch.setattr(result_folder, "_exchange", lambda one, other: False)
    folder = tmp_path / "out"
    write_result(folder, "older")
    seen = []
    for number in range(1, LARGEST_NUMBER):
        was_killed = killed_at(number, lambda: write_result(folder, "new"))
        if exchanges:
            seen.append(run_in(folder))
        # What the next run does first. Without an exchange it may have to put the older result back.
        older = older_result(folder)
        assert older is not None
        seen.append(run_in(folder))
        assert older.scene == seen[-1]
        assert list(tmp_path.iterdir()) == [folder]
        if not was_killed:
            break
        if seen[-1] == "new":
            write_result(folder, "older")
    assert not was_killed
    assert seen[-1] == "new"
    assert {"older", "new"} == set(seen[:-2])
    assert number > 2 * len(FILES)


@pytest.mark.long
def test_a_first_result_is_whole_or_absent_wherever_its_writer_is_killed(tmp_path: Path):
    folder = tmp_path / "deep" / "out"
    was_killed, number = True, 0
    while was_killed:
        number += 1
        was_killed = killed_at(number, lambda: write_result(folder, "new"))
        is_there = folder.exists()
        assert not is_there or run_in(folder) == "new"
        older = older_result(folder)
        assert (older is not None) == is_there
        assert [path.name for path in folder.parent.iterdir()] == (["out"] if is_there else [])
        if is_there and was_killed:
            folder.rename(tmp_path / f"made-{number}")
    assert is_there


def test_a_failed_run_leaves_the_older_result(tmp_path: Path):
    write_result(tmp_path / "out", "older", verdict="usable")
    with suppress(RuntimeError), replacing(tmp_path / "out") as new:
        (new / "report.json").write_text("half")
        raise RuntimeError
    assert run_in(tmp_path / "out") == "older"
    older = older_result(tmp_path / "out")
    assert older is not None
    assert (older.scene, older.verdict) == ("older", "usable")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def put_a_file(folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")


def put_a_folder(folder: Path) -> None:
    (folder / "other-scene").mkdir()
    (folder / "other-scene" / "report.json").write_text("{}")


def edit_a_file(folder: Path) -> None:
    (folder / "refined_RPC.TXT").write_text("LINE_OFF: 1")


def replace_a_file_by_a_link(folder: Path) -> None:
    (folder / "report.txt").rename(folder.parent / "report.txt")
    (folder / "report.txt").symlink_to(folder.parent / "report.txt")


def lose_the_manifest(folder: Path) -> None:
    (folder / MANIFEST).unlink()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (put_a_file, "notes.txt"),
        (put_a_folder, "other-scene"),
        (edit_a_file, "refined_RPC.TXT changed"),
        (replace_a_file_by_a_link, "report.txt changed"),
        (lose_the_manifest, "no manifest.json that identifies"),
    ],
)
def test_files_that_amers_did_not_write_are_neither_deleted_nor_overwritten(
    tmp_path: Path, change: Callable[[Path], None], says: str
):
    folder = tmp_path / "out"
    write_result(folder, "older")
    change(folder)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=says):
        older_result(folder)
    with pytest.raises(InputError, match=says):
        write_result(folder, "new")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_file_put_beside_the_older_result_during_the_work_is_kept(tmp_path: Path):
    folder = tmp_path / "out"
    write_result(folder, "older")

    def work() -> None:
        with replacing(folder) as new:
            (new / "report.json").write_text('{"verdict": "good", "scene": {"name": "new"}}')
            put_a_file(folder)

    with pytest.raises(InputError, match=r"notes\.txt"):
        work()
    assert (folder / "notes.txt").read_text() == "mine"
    (folder / "notes.txt").unlink()
    assert run_in(folder) == "older"


def test_a_geopackage_that_a_viewer_has_touched_is_replaced(tmp_path: Path):
    write_result(tmp_path / "out", "older")
    with (tmp_path / "out" / "residuals.gpkg").open("a") as file:
        file.write("a change counter")
    write_result(tmp_path / "out", "new")
    assert run_in(tmp_path / "out") == "new"


def test_a_link_to_a_folder_keeps_leading_to_the_result(tmp_path: Path):
    write_result(tmp_path / "disk" / "out", "older")
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "out")
    write_result(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert run_in(tmp_path / "disk" / "out") == "new"


def test_two_runs_do_not_write_into_one_folder(tmp_path: Path):
    with replacing(tmp_path / "out") as new:
        with pytest.raises(InputError, match="another command writes"):
            older_result(tmp_path / "out")
        (new / "report.json").write_text('{"verdict": "good", "scene": {"name": "new"}}')
    assert older_result(tmp_path / "out") is not None


def test_a_work_folder_of_somebody_else_is_left_alone(tmp_path: Path):
    (tmp_path / ".out.amers-work" / "new").mkdir(parents=True)
    put_a_file(tmp_path / ".out.amers-work" / "new")
    with pytest.raises(InputError, match=r"\.out\.amers-work: contains files that Amers did not write"):
        write_result(tmp_path / "out", "new")
    assert (tmp_path / ".out.amers-work" / "new" / "notes.txt").exists()


def test_a_file_system_without_locks_is_used_without_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refuse)
    write_result(tmp_path / "out", "older")
    write_result(tmp_path / "out", "new")
    assert run_in(tmp_path / "out") == "new"


def test_a_file_system_that_numbers_a_file_anew_each_time_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(os.path, "samestat", lambda one, other: False)
    with pytest.raises(InputError, match="another number each time"):
        write_result(tmp_path / "out", "new")


def test_folders_that_cannot_be_replaced_are_refused_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(InputError, match=r"name (another|a) folder.*-o"):
            older_result(folder)
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    for folder in (Path(), Path(".."), tmp_path / "here"):
        with pytest.raises(InputError, match=r"working folder.*-o .*registered"):
            older_result(folder)
    with pytest.raises(InputError, match="root of a volume"):
        older_result(Path("/proc"))


def test_a_folder_without_permission_is_refused_before_the_work(tmp_path: Path):
    (tmp_path / "locked").mkdir(mode=0o555)
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from amers.app.usecases.registration.result_folder import older_result\n"
        "if os.getuid() == 0:\n"
        "    os.setgid(65534), os.setuid(65534)\n"
        "older_result(Path(sys.argv[1]))\n"
    )
    for parent in (tmp_path, *tmp_path.parents[:2]):
        parent.chmod(0o755)
    command = [sys.executable, "-c", code, str(tmp_path / "locked" / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert "cannot be written (Permission denied" in ended.stderr
    assert "-o" in ended.stderr
