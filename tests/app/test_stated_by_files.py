"""What files state reaches the terminal, `--json` and the report, also of a registration that failed."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from tests.command_line import amers_here
from tests.geotiffs import write_geotiff

ASSUMED = "cut.tif: bands: "


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A flat ortho-image of four bands on a map: it can be read, and not be registered."""
    path = tmp_path / "cut.tif"
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=64,
        height=64,
        count=4,
        dtype="uint16",
        crs="EPSG:32632",
        transform=Affine(10, 0, 5e5, 0, -10, 5e6),
    ) as file:
        pixels = np.random.default_rng(1).integers(100, 900, (64, 64)).astype(np.uint16)
        file.write(np.stack([pixels] * 4))
    return path


@pytest.fixture
def reference(tmp_path: Path) -> Path:
    """An ortho-image of the same ground without any detail."""
    path = tmp_path / "reference.tif"
    place = Affine(10, 0, 5e5, 0, -10, 5e6)
    write_geotiff(path, np.full((64, 64), 7, dtype=np.uint8), crs="EPSG:32632", transform=place)
    return path


def test_a_failed_registration_says_what_was_assumed_of_its_files(
    scene: Path, reference: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    command = ["scene", "register", scene, "--reference", reference, "--sigma-m", "5", "-o", folder]
    people = amers_here(command, os.environ)
    assert people.returncode != 0
    assert ASSUMED in people.stderr
    report = json.loads((folder / "report.json").read_text())
    uses = [one["use"] for one in report["run"]["statements"] if one["subject"] == "bands"]
    assert uses == ["assumed"]
    assert "What the files state" in (folder / "report.html").read_text()
    for_programs = amers_here([*command, "--json"], os.environ)
    stated = json.loads(for_programs.stdout)["statements"]
    assert any(one["subject"] == "bands" and one["file"] == "cut.tif" for one in stated)
    assert ASSUMED not in for_programs.stderr
