"""Points of one real pair are control to another: its frame follows, and wrong ones leave by name."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import east_north_up, move_metres
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import Window
from amers.services.types import Array, Frame, Observations
from tests.journeys.ties import independent_tracks
from tests.services.adjustment.grounds import ground_of
from tests.services.ties import difference_m

pytestmark = pytest.mark.real_data

tie_sigma_px = 0.3
slope = 1e-4
names = ("img_01", "img_02", "img_03")
handful = 12
point_sigma_m = 0.3
blunder_m = 12.0
FRAME = Frame.from_sigmas(1.0, 1.5)
trials = 8


@dataclass(frozen=True)
class Triplet:
    """Three images and details that all of them show."""

    images: list[ImageParameters]
    tracks: Observations

    def pair(self, *numbers: int) -> tuple[list[ImageParameters], Observations]:
        """Two of the images, and the same details in them."""
        seen = self.tracks.take(np.isin(self.tracks.image, numbers))
        return [self.images[k] for k in numbers], replace(
            seen, image=np.searchsorted(numbers, seen.image)
        )


def parameters(scene: Scene) -> ImageParameters:
    shape, shift_px = scene.image.shape, scene.sigma_m / scene_gsd_m(scene)
    name = scene.acquisition.image_id
    return image_parameters(
        name, scene.model, shape, shift_px=shift_px, slope_px=slope * max(shape) / 2.0
    )


@pytest.fixture(scope="module")
def triplet(real_data: Path) -> Triplet:
    scenes = [read_scene(real_data / "phr_calanques_triplet" / f"{name}.tif") for name in names]
    tracks = independent_tracks([s.image.read(Window(0, 0, *s.image.shape)) for s in scenes])
    measured = replace(tracks, sigma_px=np.full(len(tracks), tie_sigma_px))
    return Triplet([parameters(scene) for scene in scenes], measured)


@pytest.fixture(scope="module")
def base(triplet: Triplet) -> BlockAdjustment:
    """The pair that the control is taken from: its frame is the truth here."""
    return adjust_block(*triplet.pair(0, 1))


def spread(base: BlockAdjustment) -> Array:
    """Rows of a handful of its points, far from each other and not outside three standard deviations."""
    found = np.flatnonzero(np.isfinite(base.lon_lat_h[:, 0]))
    place = east_north_up(base.lon_lat_h[found], base.lon_lat_h[found[0]])[:, :2]
    chosen = [0]
    while len(chosen) < handful:
        distance = np.linalg.norm(place[:, None] - place[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return np.sort(found[chosen])


def control(
    base: BlockAdjustment, rng: np.random.Generator, wrong: int = 0
) -> tuple[ControlGround, Array]:
    """Perturbed points of the base, some wrong besides, and the error of their frame (3,)."""
    rows = spread(base)
    frame_error_m = rng.multivariate_normal(np.zeros(3), FRAME.covariance_m2)
    error_m = rng.normal(0.0, point_sigma_m, (handful, 3)) + frame_error_m
    error_m[:wrong] += rng.choice([-blunder_m, blunder_m], (wrong, 3))
    own_m2 = base.point_covariance_m2[rows] + np.eye(3) * point_sigma_m**2
    known = move_metres(base.lon_lat_h[rows], error_m)
    return ground_of(rows, known, own_m2, FRAME, name="point "), frame_error_m


def frame_error_m(block: BlockAdjustment, base: BlockAdjustment, without: Array) -> Array:
    """Median distance (3,) of points that were no control from the same details of the base."""
    others = np.setdiff1d(np.arange(len(base.lon_lat_h)), without)
    return np.asarray(
        np.nanmedian(difference_m(block.lon_lat_h[others], base.lon_lat_h[others]), axis=0)
    )


@pytest.mark.long
def test_the_frame_of_another_pair_follows_its_control(triplet: Triplet, base: BlockAdjustment) -> None:
    images, observations = triplet.pair(1, 2)
    free = adjust_block(images, observations)
    # That of Pléiades by the documents beside the images: 8.5 m CE90.
    assert free.frames[0].sigma_m > 3.0 * FRAME.sigma_m
    squares = []
    for trial in range(trials):
        known, injected_m = control(base, np.random.default_rng([8, trial]))
        block = adjust_block(images, observations, control=known)
        error_m = frame_error_m(block, base, known.point)
        covariance = block.frames[0].covariance_m2
        assert known.point.size == block.control_active.sum()
        assert np.linalg.norm(error_m - injected_m) < 3.0 * point_sigma_m
        assert block.frames[0].sigma_m < 1.2 * FRAME.sigma_m
        squares.append(error_m @ np.linalg.solve(covariance, error_m))
    assert chi2.ppf(0.001, 3 * trials) < np.sum(squares) < chi2.ppf(0.999, 3 * trials)


@pytest.mark.thorough
def test_wrong_points_among_real_control_leave_by_name(triplet: Triplet, base: BlockAdjustment) -> None:
    images, observations = triplet.pair(1, 2)
    for trial in range(trials):
        known, injected_m = control(base, np.random.default_rng([9, trial]), wrong=2)
        block = adjust_block(images, observations, control=known)
        out = [name for name, stays in zip(known.names, block.control_active, strict=True) if not stays]
        assert out == ["point 1", "point 2"]
        error_m = frame_error_m(block, base, known.point)
        assert np.linalg.norm(error_m - injected_m) < 3.0 * point_sigma_m
