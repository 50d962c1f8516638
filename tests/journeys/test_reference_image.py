"""Sentinel-2 scenes of another day on a reference ortho-image: dense matching on real pixels."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from amers.services.formats.images.raster import map_grid_of, open_raster
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource, Window
from amers.services.matching.reference_image import Reference
from amers.services.registration.on_points import Registration
from amers.services.registration.on_reference import register_on_reference
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array, FloatImage

pytestmark = [pytest.mark.real_data, pytest.mark.thorough]

SHIFT_EAST_M, SHIFT_NORTH_M = 6.4, 18.3
"""Shift of the May scene against the June scene, from SIFT features over both."""
SHIFT_ALLOWED_M = 1.0
LARGEST_LOCAL_SHIFT_PX = 0.7
MEDIAN_ALLOWED_PX = 0.05
TYPICAL_ALLOWED_PX = 0.3
"""Difference of two measurements with windows of 31 and 41 pixels, in a field of varying shifts."""


def ortho(path: Path) -> tuple[ImageSource, OrthoModel]:
    image = open_raster(path)
    grid = map_grid_of(image)
    assert grid is not None
    return image, OrthoModel(grid)


def registered(reference: Path, scene: Path, sigma_m: float) -> tuple[Registration, OrthoModel]:
    image, model = ortho(reference)
    held = Reference(image, model, None, sigma_m=1.0, common_sigma_m=0.5)
    scene_image, scene_model = ortho(scene)
    registration = register_on_reference(
        Scene(scene_image, scene_model, Acquisition(scene.stem), sigma_m), held
    )
    return registration, scene_model


def test_the_may_scene_of_berlin_is_found_eighteen_metres_north_and_its_clouds_are_left_out(
    real_data: Path,
) -> None:
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    registration, model = registered(june, may, sigma_m=30.0)
    centre = (np.array([[3152.0, 2074.0]]) - 1.0) / 2.0
    shift_xy = model.grid.step_xy @ (registration.model.correction.apply(centre) - centre)[0]
    assert shift_xy[0] == pytest.approx(SHIFT_EAST_M, abs=SHIFT_ALLOWED_M)
    assert shift_xy[1] == pytest.approx(SHIFT_NORTH_M, abs=SHIFT_ALLOWED_M)
    assert registration.qualification.verdict == "good"
    not_found = np.isin(registration.measures.reason, ["low_score", "nodata"])
    assert 0.2 < not_found.mean() < 0.7


def plain_displacement(left: FloatImage, right: FloatImage, line_sample: Array) -> Array:
    """Displacements (n, 2) of windows between two images, by plain correlation; NaN at edges."""
    displacements = np.full((len(line_sample), 2), np.nan)
    for i, (line, sample) in enumerate(np.round(line_sample).astype(int)):
        piece = left[line - 15 : line + 16, sample - 15 : sample + 16]
        around = right[line - 19 : line + 20, sample - 19 : sample + 20]
        if piece.shape != (31, 31) or around.shape != (39, 39):
            continue
        scores = cv2.matchTemplate(around, piece, cv2.TM_CCOEFF_NORMED)
        row, col = np.unravel_index(scores.argmax(), scores.shape)
        if 0 < row < 8 and 0 < col < 8:
            tops = [_top(scores[row - 1 : row + 2, col]), _top(scores[row, col - 1 : col + 2])]
            displacements[i] = np.array([row, col]) - 4 + tops
    return displacements


def _top(scores: FloatImage) -> float:
    before, at, after = (float(score) for score in scores)
    return (before - after) / (2.0 * (before - 2.0 * at + after))


@pytest.mark.endurance
def test_the_local_shifts_of_maricopa_are_measured_as_pixel_against_pixel_shows_them(
    real_data: Path,
) -> None:
    folder = real_data / "s2_maricopa_pair"
    registration, _ = registered(folder / "left.tif", folder / "right.tif", sigma_m=20.0)
    left, right = (
        image.read(Window(0, 0, *image.shape))
        for image, _ in (ortho(folder / "left.tif"), ortho(folder / "right.tif"))
    )
    measures = registration.measures
    plain = plain_displacement(left, right, measures.predicted)
    difference = (measures.line_sample - measures.predicted - plain)[measures.matched]
    difference = difference[np.isfinite(difference).all(axis=1)]
    assert len(difference) > 500
    assert np.abs(np.median(difference, axis=0)).max() < MEDIAN_ALLOWED_PX
    assert np.median(np.abs(difference), axis=0).max() < TYPICAL_ALLOWED_PX
    # Neither a shift nor a smooth displacement follows fields that moved separately: it is refused.
    assert np.abs(registration.adjustment.correction.parameters[:, 0]).max() < LARGEST_LOCAL_SHIFT_PX
    assert registration.qualification.verdict == "failed"
