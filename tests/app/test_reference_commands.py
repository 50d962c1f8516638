"""`amers reference`: reference images on the command line."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from amers.app.cli.main import main
from amers.app.config import Settings
from tests.app.test_references import GSD_M, SIZE, write


@dataclass(frozen=True)
class Said:
    """The exit code and the output of a command."""

    returncode: int
    stdout: str
    stderr: str


Amers = Callable[..., Said]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of references, and one beside it."""
    flat = np.full((SIZE, SIZE), 300.0, np.float32)
    for path in ("allowed/land.tif", "allowed/heights.tif", "beside/land.tif"):
        write(tmp_path / path, flat)
    (tmp_path / "allowed" / "land.json").write_text("{}")
    return tmp_path / "allowed"


@pytest.fixture
def amers(
    settings: Settings,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Amers:
    """Runs `amers reference` on the installation of the test, in this process."""
    assert settings.database_url is not None
    monkeypatch.setenv("AMERS_DATABASE_URL", settings.database_url.get_secret_value())
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))
    monkeypatch.setenv("AMERS_REFERENCE_FOLDER", str(folder))

    def run(*words: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["amers", "reference", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        output = capsys.readouterr()
        return Said(int(end.value.code or 0), output.out, output.err)

    return run


def listed(amers: Amers) -> list[dict[str, object]]:
    result = amers("list", "--json")
    assert result.returncode == 0, result.stderr
    output: list[dict[str, object]] = json.loads(result.stdout)
    return output


def test_a_reference_is_added_listed_and_removed(amers: Amers, folder: Path):
    heights = ("--dem", "heights.tif", "--vertical", "ellipsoid", "--sigma-m", 2.5)
    heights += ("--sigma-up-m", 4.0)
    result = amers("add", "land.tif", "--name", "Ventoux", *heights, "--json")
    assert result.returncode == 0, result.stderr
    added = json.loads(result.stdout)
    assert (added["name"], added["image"], added["dem"]) == ("Ventoux", "land.tif", "heights.tif")
    assert (added["vertical"], added["sigma_m"], added["sigma_up_m"]) == ("ellipsoid", 2.5, 4.0)
    the_scale_of_the_map = 1e-3
    assert added["gsd_m"] == pytest.approx(GSD_M, rel=the_scale_of_the_map)
    assert amers("add", "land.tif", "--name", "Alps").returncode == 0
    assert [one["name"] for one in listed(amers)] == ["Alps", "Ventoux"]
    assert "Ventoux" in amers("list").stdout
    again = amers("add", "land.tif", "--name", "Ventoux")
    assert (again.returncode, "there is a reference" in again.stderr) == (2, True)
    result = amers("remove", "Ventoux")
    assert (result.returncode, result.stdout.strip()) == (0, "removed Ventoux")
    assert [one["name"] for one in listed(amers)] == ["Alps"]
    assert (folder / "land.tif").exists(), "its files stay in their folder"
    gone = amers("remove", "Ventoux")
    assert (gone.returncode, "no reference Ventoux" in gone.stderr) == (2, True)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("../beside/land.tif", "--name", "x"), "not a file below the folder"),
        (("none.tif", "--name", "x"), "not a file below the folder"),
        (("land.tif", "--name", " "), "1 to 120 characters"),
        (("land.tif", "--name", "x", "--dem", "heights.tif"), "heights.tif"),
        (("land.json", "--name", "x"), "a catalogue leads to files elsewhere"),
        (
            ("land.tif", "--name", "x", "--vertical", "ellipsoid"),
            "given without dem, whose heights they describe",
        ),
        (("land.tif", "--name", "x", "--dem", "../beside/land.tif"), "not a file below the folder"),
    ],
)
def test_an_unusable_reference_is_refused_in_one_line(
    amers: Amers, words: tuple[str, ...], message: str
):
    result = amers("add", *words)
    assert (result.returncode, message in result.stderr) == (2, True), result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert listed(amers) == []


def test_without_a_folder_of_references_the_setting_is_named(
    amers: Amers, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("AMERS_REFERENCE_FOLDER")
    result = amers("add", "land.tif", "--name", "x")
    assert result.returncode == 2
    assert "AMERS_REFERENCE_FOLDER" in result.stderr
