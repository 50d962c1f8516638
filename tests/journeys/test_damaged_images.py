"""Real images with damaged pixels, through their files: production, registration and dense matching."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy.spatial import cKDTree

from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import east_north_up
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.matching.reference_image import Reference
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.on_reference import register_on_reference
from amers.services.types import ControlPoints
from tests.services.simulated import MemoryChips

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

five_percent = 0.05
the_same_point_m = 1.0
SATURATED_SHARE = 300e-6
OPTIONS = ProductionOptions(fine_gsd_m=0.5, coarse_gsd_m=2.0, surface_pairs=0)


def damaged_copy(source: Path, target: Path, bits: int, share: float, seed: int) -> Path:
    """A copy of an image at a number of bits, with a share of its pixels at the largest value."""
    with rasterio.open(source) as file:
        pixels, rpcs = np.rint(file.read()).astype(np.uint16), file.rpcs
        place = {"crs": file.crs, "transform": file.transform}
    assert pixels.max() < 2**bits - 1
    pixels[np.random.default_rng(seed).random(pixels.shape) < share] = 2**bits - 1
    count, height, width = pixels.shape
    profile = {"count": count, "height": height, "width": width, "dtype": "uint16", "NBITS": bits}
    with rasterio.open(target, "w", driver="GTiff", **profile, **place) as file:
        file.write(pixels)
        if rpcs is not None:
            file.rpcs = rpcs
    return target


@pytest.fixture(scope="module")
def calanques(real_data: Path, tmp_path_factory: pytest.TempPathFactory):
    """The triplet by share of saturated pixels: three paths at 12 bits."""

    @cache
    def triplet(share: float) -> list[Path]:
        folder = tmp_path_factory.mktemp("calanques")
        names = [f"img_0{number}.tif" for number in (1, 2, 3)]
        source = real_data / "phr_calanques_triplet"
        return [
            damaged_copy(source / name, folder / name, 12, share, seed)
            for seed, name in enumerate(names)
        ]

    return triplet


@pytest.fixture(scope="module")
def produced(calanques):
    @cache
    def block(share: float) -> Production:
        return produce_points([read_scene(path) for path in calanques(share)[:2]], OPTIONS)

    return block


def as_control(made: Production) -> tuple[ControlPoints, MemoryChips]:
    chips = np.concatenate([made.chips(row) for row in range(len(made.points))])
    return made.points, MemoryChips(chips)


def assert_alike(damaged: Registration, clean: Registration) -> None:
    """Same verdict; number of points and declared CE90 within five percent."""
    assert damaged.qualification.verdict == clean.qualification.verdict
    count = clean.measures.active.sum()
    assert abs(damaged.measures.active.sum() - count) <= five_percent * count
    assert ce90_px(damaged) == pytest.approx(ce90_px(clean), rel=five_percent)


def ce90_px(registration: Registration) -> list[float]:
    criteria = registration.qualification.criteria
    return [c.value for c in criteria if c.name == "predicted_ce90_px"]


@pytest.mark.endurance
def test_a_pair_with_saturated_pixels_gives_as_many_points_of_the_same_precision(produced) -> None:
    clean, damaged = produced(0.0), produced(SATURATED_SHARE)
    assert abs(len(damaged.points) - len(clean.points)) <= five_percent * len(clean.points)
    # Sigmas are spread over a factor of four: of other points, the median is another one.
    place_m = east_north_up(clean.points.lon_lat_h, clean.points.lon_lat_h[0])
    again_m = east_north_up(damaged.points.lon_lat_h, clean.points.lon_lat_h[0])
    distance_m, nearest = cKDTree(place_m[:, :2]).query(again_m[:, :2])
    both = distance_m < the_same_point_m
    assert both.mean() > 0.8
    before_m, after_m = (
        np.sqrt(np.diagonal(points.covariance_m2, 0, 1, 2))
        for points in (clean.points.take(nearest[both]), damaged.points.take(np.flatnonzero(both)))
    )
    np.testing.assert_allclose(
        np.median(after_m, axis=0), np.median(before_m, axis=0), rtol=five_percent
    )
    assert as_control(damaged)[1].chips.all()


def test_a_scene_with_saturated_pixels_is_registered_as_without(calanques, produced) -> None:
    control = as_control(produced(0.0))
    clean, damaged = (
        register_scene(read_scene(calanques(share)[2], sigma_m=20.0), *control)
        for share in (0.0, SATURATED_SHARE)
    )
    assert_alike(damaged, clean)


def test_points_and_scene_with_saturated_pixels_register_as_many_points_as_without(
    calanques, produced
) -> None:
    clean, damaged = (
        register_scene(read_scene(calanques(share)[2], sigma_m=20.0), *as_control(produced(share)))
        for share in (0.0, SATURATED_SHARE)
    )
    assert damaged.qualification.verdict == clean.qualification.verdict
    count = clean.measures.active.sum()
    assert abs(damaged.measures.active.sum() - count) <= five_percent * count
    # Other points were chosen: productions of the clean pair with noise of 1 grey value spread as much.
    assert ce90_px(damaged) == pytest.approx(ce90_px(clean), rel=2.0 * five_percent)


def test_a_scene_with_saturated_pixels_is_registered_on_a_reference_as_without(
    real_data: Path, tmp_path: Path
) -> None:
    folder = real_data / "s2a_berlin_pair"
    (june,) = folder.glob("ref_*.tif")
    (may,) = folder.glob("tgt_*.tif")
    registrations = []
    for share in (SATURATED_SHARE, 0.0):
        paths = [
            damaged_copy(path, tmp_path / path.name, 14, share, seed)
            for seed, path in enumerate((june, may))
        ]
        held, scene = (cropped(read_scene(path, sigma_m=30.0)) for path in paths)
        reference = Reference(held.image, held.model, None, sigma_m=1.0, common_sigma_m=0.5)
        registrations.append(register_on_reference(scene, reference))
    assert_alike(*registrations)


def cropped(scene: Scene) -> Scene:
    """The scene in memory."""
    pixels = scene.image.read(Window(0, 0, *scene.image.shape))
    return Scene(ArrayImage(pixels), scene.model, scene.acquisition, scene.sigma_m)
