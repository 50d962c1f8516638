"""`amers production run` with points marked in the images: the block states what places it."""

from pathlib import Path

import numpy as np
import pytest

from amers.app.errors import InputError
from amers.app.usecases.control_files import ControlFiles
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.block.reader import read_document
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.images.raster import write_raster
from tests.services.simulated import BLOCK_SIGMA_M, OPTIONS, block_views, world

pytestmark = pytest.mark.long


def survey(folder: Path) -> Path:
    """Six true points of the world, marked in two views by the corners of their pixels."""
    first, second, _ = (view.geometry for view in block_views())
    pixels = np.random.default_rng(3).uniform(150.0, 550.0, (6, 2))
    ground = first.true_model.locate(pixels, np.full(6, np.mean(world().height_range_m)))
    lines = ["# pixel-origin=corner", "id,lon,lat,height_m,image,line,sample"]
    for geometry in (first, second):
        marks = geometry.true_model.project(ground) + 0.5
        for k, (at, mark) in enumerate(zip(ground.tolist(), marks.tolist(), strict=True)):
            values = [f"P{k}", *map(repr, at), geometry.acquisition.image_id, *map(repr, mark)]
            lines.append(",".join(values))
    path = folder / "survey.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def images_with(control: ControlFiles, folder: Path) -> ProductionImages:
    for view in block_views():
        path = folder / f"{view.geometry.acquisition.image_id}.tif"
        write_raster(path, view.pixels, view.geometry.delivered)
    return ProductionImages(tuple(sorted(folder.glob("*.tif"))), sigma_m=BLOCK_SIGMA_M, control=control)


def test_a_block_states_the_points_that_place_it(tmp_path: Path) -> None:
    stated = PointStatements(StatedByCaller("ellipsoid"), (0.1, 0.2), (0.1, 0.2), 0.2)
    control = ControlFiles((survey(tmp_path),), stated)
    images = images_with(control, tmp_path)
    made = run_image_production(images, tmp_path / "block", BlockIdentity("made"), OPTIONS)
    metadata = read_document(tmp_path / "block").metadata
    assert made.adjustment.control_active.all()
    assert set(made.control.names) == {f"survey.csv:P{k}" for k in range(6)}
    absolute = next(figure for figure in metadata.accuracy if figure.kind == "absolute")
    assert absolute.value < 0.5
    assert "6 control points of survey.csv" in absolute.against


def test_a_file_that_states_no_frame_is_refused_before_any_work(tmp_path: Path) -> None:
    control = ControlFiles((survey(tmp_path),), PointStatements(StatedByCaller("ellipsoid"), (0.1, 0.2)))
    with pytest.raises(InputError, match="--control-frame-sigma-m"):
        run_image_production(
            images_with(control, tmp_path), tmp_path / "block", BlockIdentity("made"), OPTIONS
        )
    assert not (tmp_path / "block").exists()
    assert not (tmp_path / "block.work").exists()
