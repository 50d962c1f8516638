"""An ortho-image and an elevation model place a block: each what it knows, within what is declared."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.imagery.source import ArrayImage
from amers.services.production.control import Control
from amers.services.production.height_control import ControlHeights
from amers.services.production.image_production import Production
from amers.services.production.ortho_control import ControlOrtho
from amers.services.sensors.ortho import OrthoModel
from amers.services.terrain import Terrain
from amers.services.types import BoolArray, Frame
from tests.services.production.simulated_control import CHI2_3, frame_error_m, free, placed, views
from tests.services.quality.test_site_images import vertical_ortho
from tests.services.registration.test_on_reference import grid, positions
from tests.services.simulated import world

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SEEDS = (12, 21, 22)
ORTHO_SIGMA_M = 0.5
DEM_SIGMA_M = 1.0
DEM_FRAME_M = (2.0, 0.7)
POSTING_M = 10.0


@cache
def reference():
    return vertical_ortho().reference


def ortho(seed: int, damaged: bool = False) -> ControlOrtho:
    """A vertical ortho-image whose map is off as it declares; of a damaged one a quarter is 4 m off."""
    east_m, north_m = np.random.default_rng([seed, 7]).normal(0.0, ORTHO_SIGMA_M, 2)
    exact = reference()
    off = replace(exact.model.grid, origin_xy=exact.model.grid.origin_xy + [east_m, north_m])
    image = exact.image
    if damaged:
        pixels = image.pixels.copy()
        half = len(pixels) // 2
        pixels[:half, :half] = np.roll(pixels[:half, :half], 4, axis=1)
        image = ArrayImage(pixels)
    frame = Frame.from_sigmas(ORTHO_SIGMA_M, np.nan)
    moved = replace(exact, image=image, model=OrthoModel(off), sigma_m=0.3, frame=frame)
    return ControlOrtho("ortho.tif", moved)


def heights(seed: int, bias_m: float = 0.0, wrong: BoolArray | None = None) -> ControlHeights:
    """The terrain without its buildings, with noise of every height and an error of all."""
    rng = np.random.default_rng([seed, 8])
    nodes = grid(POSTING_M)
    at = nodes.lon_lat(positions(nodes).astype(float))
    height_m = world().height_m(at).reshape(nodes.shape)
    height_m += rng.normal(0.0, DEM_SIGMA_M, nodes.shape) + rng.normal(0.0, DEM_FRAME_M[1]) + bias_m
    off = replace(nodes, origin_xy=nodes.origin_xy + rng.normal(0.0, DEM_FRAME_M[0], 2))
    if wrong is not None:
        height_m[wrong] += 40.0
    terrain = Terrain(off, ArrayImage(height_m.astype(np.float32)), sigmas=DEM_SIGMA_M)
    return ControlHeights("dem.tif", terrain, Frame.from_sigmas(*DEM_FRAME_M))


@cache
def placed_by(seed: int, kinds: str) -> Production:
    control = Control(
        orthos=(ortho(seed),) if "ortho" in kinds else (),
        heights=(heights(seed),) if "dem" in kinds else (),
    )
    return placed(seed, control)


def squares(kinds: str) -> list[float]:
    """Squares of the errors of the frames in units of what is declared, of three coordinates."""
    out = []
    for seed in SEEDS:
        made = placed_by(seed, kinds)
        error_m, frame_m2 = frame_error_m(made, views(seed)), made.points.frames[0].covariance_m2
        without = free(seed).points.frames[0]
        sigma_m, used = np.sqrt(np.diag(frame_m2)), made.adjustment.control_active
        print(
            f"{kinds} {seed}: {error_m.round(2)} m of {sigma_m.round(2)}, {used.sum()} of {len(used)}, "
            f"without {without.sigma_m:.1f}, {without.sigma_up_m:.1f}"
        )
        out.append(float(error_m @ np.linalg.solve(frame_m2, error_m)))
    return out


@pytest.mark.parametrize("kinds", ["ortho", "dem", "ortho and dem"])
def test_the_frame_is_within_what_is_declared(kinds: str) -> None:
    found = squares(kinds)
    # Chi-squared of nine coordinates: 5 % lie below 0.37, 5 % above 1.88.
    assert max(found) < CHI2_3
    assert 0.2 < np.mean(found) / 3.0 < 1.9
    for seed in SEEDS:
        assert placed_by(seed, kinds).adjustment.control_active.mean() > 0.8


@pytest.mark.parametrize("seed", SEEDS)
def test_each_kind_of_control_tells_what_it_knows_alone(seed: int) -> None:
    without = free(seed).points.frames[0]
    by_ortho, by_heights, by_both = (
        placed_by(seed, kinds).points.frames[0] for kinds in ("ortho", "dem", "ortho and dem")
    )
    assert by_ortho.sigma_m < 0.7
    assert by_ortho.sigma_up_m > 0.3 * without.sigma_up_m
    assert by_heights.sigma_up_m < 1.2
    assert by_heights.sigma_m == pytest.approx(without.sigma_m, rel=0.1)
    assert by_both.sigma_m < 0.7
    assert by_both.sigma_up_m < 1.0


def test_a_damaged_part_of_an_ortho_image_is_left_out_by_place() -> None:
    control = Control(orthos=(ortho(21, damaged=True),))
    made = placed(21, control)
    used, known = made.adjustment.control_active, made.control
    at = known.lon_lat_h[:, :2]
    lines = reference().model.project(known.lon_lat_h)
    inner = (lines < np.array(reference().image.shape) / 2.0 - 60.0).all(axis=1)
    print(f"{(~used).sum()} of {len(used)} left out, {inner.sum()} lie in the damaged part, {at.shape}")
    assert inner.sum() > 3
    assert used[inner].mean() < 0.2
    error_m, frame_m2 = frame_error_m(made, views(21)), made.points.frames[0].covariance_m2
    assert error_m @ np.linalg.solve(frame_m2, error_m) < CHI2_3


def test_an_ortho_image_of_another_place_is_refused_with_its_name() -> None:
    exact = ortho(12)
    away = exact.reference.model.grid
    far = replace(away, origin_xy=away.origin_xy + 300.0)
    elsewhere = replace(exact, reference=replace(exact.reference, model=OrthoModel(far)))
    with pytest.raises(NotEnoughPoints, match=r"ortho\.tif: it shows other ground"):
        placed(12, Control(orthos=(elsewhere,)))


def test_wrong_heights_are_left_out() -> None:
    nodes = grid(POSTING_M)
    wrong = np.zeros(nodes.shape, dtype=np.bool_)
    wrong[25:45, 25:45] = True
    made = placed(22, Control(heights=(heights(22, wrong=wrong),)))
    used, known = made.adjustment.control_active, made.control
    line_sample = nodes.line_sample(known.lon_lat_h[:, :2])
    inside = ((line_sample > 26) & (line_sample < 43)).all(axis=1)
    print(f"{(~used).sum()} of {len(used)} left out, {inside.sum()} lie on wrong heights")
    assert inside.sum() > 2
    assert not used[inside].any()
    error_m, frame_m2 = frame_error_m(made, views(22)), made.points.frames[0].covariance_m2
    assert error_m @ np.linalg.solve(frame_m2, error_m) < CHI2_3


def test_heights_of_other_ground_are_refused_with_their_name() -> None:
    own = heights(12)
    away = replace(own.terrain.grid, origin_xy=own.terrain.grid.origin_xy + 5000.0)
    elsewhere = replace(own, terrain=replace(own.terrain, grid=away))
    with pytest.raises(NotEnoughPoints, match=r"dem\.tif: \d+ tried, 0 where it has heights"):
        placed(12, Control(heights=(elsewhere,)))
