"""A colour crop, four times coarser, registered on points made from two panchromatic views."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.block.check import check_block
from amers.services.formats.block.reader import FolderChips
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import Window
from amers.services.production.image_production import ProductionOptions
from amers.services.registration.on_points import register_scene
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, FloatImage

pytestmark = [pytest.mark.real_data, pytest.mark.thorough]

RATIO = 4
SPOILED_PX = np.array([6.0, -9.0])
SIGMA_M = 15.0
WINDOW_PX = 40
"""Half the side of compared windows: 20 pixels of the colour crop."""
three_tenths_of_a_pixel = 0.3
same_moment_px = 0.02


def rpc_text_of_geom(geom: str) -> str:
    """An OSSIM keyword list as RPC text; the numbers are the same."""
    entries = dict(line.split(":", 1) for line in geom.splitlines() if ":" in line)
    parts = ("line", "samp", "lat", "long", "height")
    rows = [f"{part}_{kind}: {entries[f'{part}_{kind}']}" for part in parts for kind in ("off", "scale")]
    rows += [
        f"{name}_coeff_{k + 1}: {entries[f'{name}_coeff_{k:02d}']}"
        for name in ("line_num", "line_den", "samp_num", "samp_den")
        for k in range(20)
    ]
    return "\n".join(rows).upper() + "\n"


@pytest.fixture(scope="module")
def folder(real_data: Path) -> Path:
    return real_data / "phr_ventoux_pair"


@pytest.fixture(scope="module")
def block(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("colour") / "ventoux"
    images = [folder / "left_image.tif", folder / "right_image.tif"]
    options = ProductionOptions(fine_gsd_m=0.5, coarse_gsd_m=1.0, surface_pairs=0)
    run_image_production(ProductionImages(tuple(images)), made, BlockIdentity("ventoux"), options)
    return made


@pytest.fixture(scope="module")
def colour(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    model = tmp_path_factory.mktemp("colour") / "lowres_color_image_RPC.TXT"
    model.write_text(rpc_text_of_geom((folder / "lowres_color_image.geom").read_text()))
    return read_scene(folder / "lowres_color_image.tif", model, sigma_m=SIGMA_M)


@pytest.fixture(scope="module")
def ties(folder: Path, colour: Scene) -> tuple[Array, Array]:
    """Places of the left view matched in the colour crop, window against window, without a model."""
    left = read_scene(folder / "left_image.tif")
    fine = cv2.GaussianBlur(left.image.read(Window(0, 0, *left.image.shape)), (0, 0), RATIO / 2.0)
    coarse = colour.image.read(Window(0, 0, *colour.image.shape))
    size = RATIO * coarse.shape[1], RATIO * coarse.shape[0]
    large = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    in_left, in_large = [], []
    for line in range(WINDOW_PX, fine.shape[0] - WINDOW_PX, 16):
        for sample in range(WINDOW_PX, fine.shape[1] - WINDOW_PX, 16):
            window = np.s_[line - WINDOW_PX : line + WINDOW_PX + 1]
            piece = fine[window, sample - WINDOW_PX : sample + WINDOW_PX + 1]
            scores = cv2.matchTemplate(large, piece, cv2.TM_CCOEFF_NORMED)
            row, col = np.unravel_index(scores.argmax(), scores.shape)
            if scores.max() < 0.8 or not (0 < row < len(scores) - 1 and 0 < col < len(scores[0]) - 1):
                continue
            tops = [_top(scores[row - 1 : row + 2, col]), _top(scores[row, col - 1 : col + 2])]
            in_left.append((line, sample))
            in_large.append(np.array([row, col]) + tops + WINDOW_PX)
    return (np.array(in_large) + 0.5) / RATIO - 0.5, np.array(in_left, dtype=np.float64)


def _top(scores: FloatImage) -> float:
    before, at, after = (float(score) for score in scores)
    return (before - after) / (2.0 * (before - 2.0 * at + after))


def differences_px(
    colour: SensorModel, left: SensorModel, ties: tuple[Array, Array], height_m: float
) -> Array:
    """Matched minus predicted positions (n, 2) of the left view's details in the colour crop."""
    ground = left.locate(ties[1], np.full(len(ties[1]), height_m))
    return ties[0] - colour.project(ground)


def test_a_colour_crop_is_registered_to_a_third_of_its_pixel(
    block: Path, colour: Scene, ties: tuple[Array, Array]
) -> None:
    points = check_block(block).points
    left = parse_rpc_text((block / "models" / "left_image_RPC.TXT").read_text())
    height_m = float(np.median(points.lon_lat_h[:, 2]))
    delivered = colour.model
    wrong = replace(delivered, image_offset=delivered.image_offset + SPOILED_PX)  # type: ignore[type-var]
    registration = register_scene(replace(colour, model=wrong), points, FolderChips(block))

    # The points lie where the two views overlap; beyond them the model is an extrapolation.
    seen = left.project(points.lon_lat_h)
    among = ((ties[1] >= seen.min(axis=0)) & (ties[1] <= seen.max(axis=0))).all(axis=1)
    delivered_px, registered_px = (
        np.hypot(*differences_px(model, left, ties, height_m).T)
        for model in (delivered, registration.model)
    )
    std_px = np.sqrt(np.trace(registration.adjustment.covariance_at(ties[0]), axis1=1, axis2=2) / 2.0)
    print(
        f"{among.sum()} ties among {registration.qualification.point_counts.active} points: "
        f"{np.median(delivered_px[among]):.3f} px as delivered, "
        f"{np.median(registered_px[among]):.3f} px registered; {(~among).sum()} ties beyond: "
        f"{np.median(registered_px[~among]):.3f} px, expected {np.median(std_px[~among]):.3f} px; "
        f"pixels of {scene_gsd_m(colour):.2f} m, {registration.qualification.verdict}"
    )
    assert among.sum() > 50
    assert np.median(registered_px[among]) < three_tenths_of_a_pixel
    assert np.quantile(registered_px[among], 0.9) < three_tenths_of_a_pixel
    assert np.median(registered_px[~among]) < 3.0 * np.median(std_px[~among])
    assert registration.qualification.verdict in ("good", "usable")
    assert registration.search_stages[-1].chip_gsd_m == 0.5  # Few points have chips of 1 m.

    # Both images were taken at the same moment, so the height of the ground hardly matters.
    higher = differences_px(registration.model, left, ties, height_m + 1.0)
    assert (
        np.hypot(*(higher - differences_px(registration.model, left, ties, height_m)).T).max()
        < same_moment_px
    )
