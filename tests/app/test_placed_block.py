"""`amers block frame`: a block on control that came later; nothing of it is measured again."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from amers.app.errors import InputError
from amers.app.usecases.blocks.frame import place_block
from amers.app.usecases.control_files import ControlFiles
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.new_block import BlockIdentity
from amers.services.adjustment.intersection import intersect
from amers.services.formats.block.check import check_block
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.geodesy import move_metres
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array, Observations
from tests.command_line import amers_here
from tests.services.production.simulated_control import CHI2_3
from tests.services.simulated import BLOCK_SIGMA_M, OPTIONS, block_views, world
from tests.services.ties import difference_m

pytestmark = [pytest.mark.long, pytest.mark.thorough]

STATED = PointStatements(StatedByCaller("ellipsoid"), (0.1, 0.2), (0.1, 0.2), 0.2)


def survey(path: Path, count: int, seed: int, wrong: int = 0) -> Path:
    """Points of the world with the errors stated, marked by the corners of pixels; some 9 m off."""
    rng = np.random.default_rng(seed)
    first, second, _ = (view.geometry for view in block_views())
    pixels = rng.uniform(150.0, 550.0, (count, 2))
    ground = first.true_model.locate(pixels, np.full(count, np.mean(world().height_range_m)))
    stated = move_metres(ground, rng.normal(0.0, (0.1, 0.1, 0.2), (count, 3)))
    stated[:wrong, 2] += 9.0
    lines = ["# pixel-origin=corner", "id,lon,lat,height_m,image,line,sample"]
    for geometry in (first, second):
        marks = geometry.true_model.project(ground) + rng.normal(0.5, 0.2, (count, 2))
        for k, (at, mark) in enumerate(zip(stated.tolist(), marks.tolist(), strict=True)):
            values = [f"P{k}", *map(repr, at), geometry.acquisition.image_id, *map(repr, mark)]
            lines.append(",".join(values))
    path.write_text("\n".join(lines) + "\n")
    return path


@dataclass(frozen=True)
class Made:
    """A block without control, and its images."""

    folder: Path
    images: tuple[Path, ...]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("made")
    for view in block_views():
        path = folder / f"{view.geometry.acquisition.image_id}.tif"
        write_raster(path, view.pixels, view.geometry.delivered)
    images = tuple(sorted(folder.glob("*.tif")))
    given = ProductionImages(images, sigma_m=BLOCK_SIGMA_M)
    run_image_production(given, folder / "block", BlockIdentity("made"), OPTIONS)
    return Made(folder / "block", images)


def models(block: Path) -> list[RpcModel]:
    names = [view.geometry.acquisition.image_id for view in block_views()]
    return [parse_rpc_text((block / "models" / f"{name}_RPC.TXT").read_text()) for name in names]


def frame_error_m(block: Path) -> Array:
    """Mean error (3,) on the Earth of the points of a block: where its models show them, truly."""
    ground, found = read_block(block).points.lon_lat_h, models(block)
    seen = np.stack([model.project(ground) for model in found], axis=1)
    observations = Observations(
        np.repeat(np.arange(len(ground)), len(found)),
        np.tile(np.arange(len(found)), len(ground)),
        seen.reshape(-1, 2),
        np.full(len(ground) * len(found), 0.1),
    )
    true = [view.geometry.true_model for view in block_views()]
    return difference_m(ground, intersect(true, observations, len(ground)).lon_lat_h).mean(axis=0)


def test_a_block_follows_control_and_its_points_and_chips_stay(made: Made, tmp_path: Path) -> None:
    control = ControlFiles((survey(tmp_path / "survey.csv", 8, 3, wrong=2),), STATED)
    check = ControlFiles((survey(tmp_path / "check.csv", 6, 9),), STATED)
    moved = tmp_path / "moved"
    placed = place_block(made.folder, made.images, control, moved, check=check)

    before, after = read_block(made.folder), check_block(moved)
    frame = after.points.frames[0]
    assert frame.sigma_m < 0.5 < before.points.frames[0].sigma_m
    error_m = frame_error_m(moved)
    assert error_m @ np.linalg.solve(frame.covariance_m2, error_m) < CHI2_3
    assert np.linalg.norm(error_m) < 0.3 * np.linalg.norm(frame_error_m(made.folder))

    left_out = [n for n, used in zip(placed.control, placed.fit.active, strict=True) if not used]
    assert left_out == ["survey.csv:P0", "survey.csv:P1"]
    assert after.document.metadata.provenance.options["placed"]["left_out"] == left_out
    assert after.document.metadata.version == "2"
    figures = {figure.name: figure for figure in after.document.metadata.accuracy}
    assert "6 control points of survey.csv" in figures["frame_sigma_m"].against
    assert figures["check_ce90_m"].count == 6
    assert figures["check_ce90_m"].value < 1.0
    assert placed.normalised is not None
    assert placed.normalised.lower < placed.normalised.mean_square < placed.normalised.upper

    assert len(after.points) == len(before.points)
    old = np.lexsort(before.points.covariance_m2[:, 0, 0][None])
    new = np.lexsort(after.points.covariance_m2[:, 0, 0][None])
    step_m = difference_m(after.points.lon_lat_h[new], before.points.lon_lat_h[old])
    assert step_m == pytest.approx(np.tile(placed.fit.translation_m, (len(old), 1)), abs=1e-3)
    for one, other in zip(models(made.folder), models(moved), strict=True):
        shown = one.project(before.points.lon_lat_h[old])
        assert other.project(after.points.lon_lat_h[new]) == pytest.approx(shown, abs=1e-3)
    with FolderChips(made.folder) as chips, FolderChips(moved) as again:
        for a, b in zip(old[:10].tolist(), new[:10].tolist(), strict=True):
            first, second = (
                source.read(
                    points.chip_files[points.chip_file[row]],
                    int(points.chip_row[row]),
                    int(np.diff(points.views.start)[row]),
                )
                for source, points, row in ((chips, before.points, a), (again, after.points, b))
            )
            assert np.array_equal(first, second)


def test_the_command_says_what_it_has_done(made: Made, tmp_path: Path) -> None:
    words = ["block", "frame", made.folder, "-o", tmp_path / "moved", "--json"]
    words += [word for image in made.images for word in ("--images", image)]
    words += ["--control", survey(tmp_path / "survey.csv", 6, 3), "--control-vertical", "ellipsoid"]
    words += ["--control-sigma-m", "0.1,0.2", "--control-frame-sigma-m", "0.1,0.2"]
    done = amers_here(words, dict(os.environ))
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["control_points_used"] == 6
    assert said["frame_sigma_m"][0] < 0.5 < said["frame_sigma_before_m"][0]
    assert said["on_the_earth"]["ce90_m"] < 1.5


def test_an_image_of_another_block_and_missing_control_are_refused(made: Made, tmp_path: Path) -> None:
    other = tmp_path / "other.tif"
    other.write_bytes(made.images[0].read_bytes())
    control = ControlFiles((survey(tmp_path / "survey.csv", 6, 3),), STATED)
    with pytest.raises(InputError, match=r"other\.tif: other is no image of the block"):
        place_block(made.folder, [other], control, tmp_path / "moved")
    words = ["block", "frame", made.folder, "-o", tmp_path / "moved", "--images", made.images[0]]
    done = amers_here(words, dict(os.environ))
    assert done.returncode == 2
    assert "add --control" in done.stderr
    assert not (tmp_path / "moved").exists()
