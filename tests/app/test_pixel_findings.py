"""What is wrong with the pixels of a scene reaches the terminal, `--json`, the report and its page."""

import json
import os
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import Affine

from amers.services.types import FloatImage
from tests.command_line import amers_here
from tests.services.imagery.textures import repeated, texture

WORDS = "lines 90 to 94 repeat lines 85 to 89: what follows may lie 5 px from its place"


def written(path: Path, pixels: FloatImage) -> Path:
    """An image on a map, without a sensor model."""
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=pixels.shape[1],
        height=pixels.shape[0],
        count=1,
        dtype="uint16",
        crs="EPSG:32632",
        transform=Affine(10, 0, 5e5, 0, -10, 5e6),
    ) as file:
        file.write(pixels.astype(np.uint16), 1)
    return path


def test_repeated_lines_of_a_scene_that_cannot_be_registered_are_told_everywhere(tmp_path: Path) -> None:
    pixels = texture("fractal", 1, (200, 240))
    scene = written(tmp_path / "scene.tif", repeated(pixels, 90, 5))
    reference = written(tmp_path / "reference.tif", np.full_like(pixels, 7.0))
    folder = tmp_path / "out"
    command = ["scene", "register", scene, "--reference", reference, "--sigma-m", "5", "-o", folder]
    people = amers_here(command, os.environ)
    assert people.returncode != 0
    assert f"scene.tif: {WORDS}" in people.stderr
    (finding,) = json.loads((folder / "report.json").read_text())["scene"]["pixel_findings"]
    assert (finding["kind"], finding["line"], finding["lines"]) == ("repeated lines", 90, 5)
    assert (finding["words"], finding["amount_px"]) == (WORDS, 5.0)
    assert "What the pixels show" in (folder / "report.html").read_text()
    assert WORDS in (folder / "report.txt").read_text().replace("\n", " ")
    for_programs = amers_here([*command, "--json"], os.environ)
    assert json.loads(for_programs.stdout)["pixel_findings"] == [finding]
    assert WORDS not in for_programs.stderr


def test_a_clean_scene_has_no_findings(tmp_path: Path) -> None:
    scene = written(tmp_path / "scene.tif", texture("fractal", 2, (200, 240)))
    reference = written(tmp_path / "reference.tif", np.full((200, 240), 7.0, np.float32))
    folder = tmp_path / "out"
    amers_here(
        ["scene", "register", scene, "--reference", reference, "--sigma-m", "5", "-o", folder],
        os.environ,
    )
    assert json.loads((folder / "report.json").read_text())["scene"]["pixel_findings"] == []
    assert "What the pixels show" not in (folder / "report.html").read_text()
