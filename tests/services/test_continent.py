"""A simulated continent as files: readable as an archive, with the errors that its truth states."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import shapely

from amers.services.errors import InputError
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.stac.catalogue import read_catalogue
from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window, render_chip
from amers.services.sensors.base import SensorModel
from amers.services.simulation.archive import (
    CONTINENT,
    IMAGE_SIGMA_M,
    JITTER_PX,
    PASS_SIGMA_M,
    ArchiveView,
    archive_views,
    later_views,
)
from amers.services.simulation.conditions import clouds_over
from amers.services.types import Array
from benchmarks._continent import Continent, open_continent
from benchmarks.continent import make

pytestmark = [pytest.mark.long, pytest.mark.endurance]

SEEDS = range(60)
a_tenth_of_a_pixel = 0.1
fits_an_rpc_px = 0.02


@pytest.fixture(scope="module")
def catalogue(small_continent: Continent) -> ImageCatalogue:
    read = read_catalogue(str(small_continent.folder / "archive"))
    assert (read.bad, read.problems, read.other_masks) == (0, (), 0)
    return read.images


def scene_of(continent: Continent, name: str) -> Scene:
    return read_scene(continent.folder / "archive" / "images" / f"{name}.tif")


def grid_of(view: ArchiveView, count: int = 15) -> Array:
    axes = [np.linspace(0.0, size - 1.0, count) for size in view.plan.shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def test_the_catalogue_states_every_image_and_its_pass(
    small_continent: Continent, catalogue: ImageCatalogue
) -> None:
    assert sorted(catalogue.id) == sorted(small_continent.views)
    for row, name in enumerate(catalogue.id):
        view, scene = small_continent.views[name], scene_of(small_continent, name)
        assert (catalogue.platform[row], catalogue.orbit[row]) == (view.platform, view.orbit)
        assert scene.acquisition.acquired_at is not None
        stated = np.datetime64(scene.acquisition.acquired_at.replace(tzinfo=None))
        assert abs(stated - catalogue.acquired[row]) < np.timedelta64(2, "ms")
        assert scene.acquisition.sensor == view.platform
        np.testing.assert_allclose(
            catalogue.incidence_deg[row], scene.acquisition.incidence_deg, atol=0.3
        )
        turned = (catalogue.azimuth_deg[row] - scene.acquisition.azimuth_deg + 180.0) % 360.0 - 180.0
        assert abs(turned) < 3.0
        assert scene.sigma_m == pytest.approx(np.hypot(PASS_SIGMA_M, IMAGE_SIGMA_M))
    assert len({(p, o) for p, o in zip(catalogue.platform, catalogue.orbit, strict=True)}) == 3


def test_an_image_shows_the_ground_that_the_truth_states_within_the_errors_of_its_model(
    small_continent: Continent,
) -> None:
    for name, view in small_continent.views.items():
        line_sample = grid_of(view)
        ground = small_continent.ground(view, line_sample)
        true_model = small_continent.geometry(view).true_model
        np.testing.assert_allclose(true_model.project(ground), line_sample, atol=1e-3)
        model = scene_of(small_continent, name).model
        error_px = model.project(ground) - line_sample
        design = np.column_stack([np.ones(len(line_sample)), line_sample])
        fitted = design @ np.linalg.lstsq(design, error_px, rcond=None)[0]
        beyond_affine = np.abs(error_px - fitted).max()
        assert 0.3 * JITTER_PX < beyond_affine < 2.5 * JITTER_PX + fits_an_rpc_px
        at_centre_m = to_ground(model, ground, error_px).mean(axis=0)
        np.testing.assert_allclose(at_centre_m, view.error_m, atol=0.5)


def to_ground(model: SensorModel, ground: Array, error_px: Array) -> Array:
    """Errors on the ground (n, 2), east and north, of errors in the image (n, 2)."""
    derivative = model.project_derivative(ground)[:, :, :2]
    return np.asarray(np.linalg.solve(derivative, error_px[:, :, None])[:, :, 0])


def test_location_errors_are_shared_by_a_pass_as_stated() -> None:
    shared, alone = [], []
    for seed in SEEDS:
        views = archive_views(CONTINENT, seed)
        assert len(views) == 40
        assert len({view.orbit for view in views}) == 6
        shared += list({view.orbit: view.pass_error_m for view in views}.values())
        alone += [np.subtract(view.error_m, view.pass_error_m) for view in views]
    # Standard deviations of 720 and 4,800 normal numbers.
    assert np.std(shared) == pytest.approx(PASS_SIGMA_M, rel=0.1)
    assert np.std(alone) == pytest.approx(IMAGE_SIGMA_M, rel=0.04)


def test_the_full_archive_covers_its_area_from_several_passes() -> None:
    views = archive_views(CONTINENT, 1)
    years = {view.day.year for view in views}
    assert max(years) - min(years) == 3
    assert np.ptp([view.plan.incidence_deg for view in views]) > 15.0
    later = later_views(CONTINENT, 1)
    assert len(later) == 20
    assert min(view.day for view in later) > max(view.day for view in views)
    errors_m = [np.hypot(*view.error_m) for view in later]
    assert 10.0 < max(errors_m) < 20.0


def test_masks_outline_the_clouds(small_continent: Continent, catalogue: ImageCatalogue) -> None:
    row = int(np.argmax(catalogue.cloud_percent))
    assert catalogue.cloud_percent[row] > 5.0
    view, scene = small_continent.views[catalogue.id[row]], scene_of(small_continent, catalogue.id[row])
    pixels = scene.image.read(Window(0, 0, *scene.image.shape))
    line_sample = np.rint(grid_of(view, 80))
    height_m = np.full(len(line_sample), sum(scene.model.height_range_m) / 2.0)
    at = shapely.points(scene.model.locate(line_sample, height_m)[:, :2])
    masked = shapely.contains(catalogue.mask[row], at)
    brightness = pixels[tuple(line_sample.astype(int).T)]
    assert np.nanmedian(brightness[masked]) > 1.6 * np.nanmedian(brightness[~masked])
    clouds = clouds_over(
        view.plan.shape, view.conditions.cloud_cover, np.random.default_rng([view.seed, 0])
    )
    assert clouds is not None
    whole = clouds.opacity(*(np.arange(0.0, size) for size in view.plan.shape))
    opacity = whole[tuple(line_sample.astype(int).T)]
    seen = np.isfinite(brightness)
    assert masked[seen & (opacity > 0.9)].mean() > 0.97
    assert (opacity[masked] > 0.1).mean() > 0.7
    assert 100.0 * masked[seen].mean() == pytest.approx(catalogue.cloud_percent[row], abs=2.0)


def test_few_pixels_are_saturated_and_borders_have_no_data(small_continent: Continent) -> None:
    for name, view in small_continent.views.items():
        image = scene_of(small_continent, name).image
        pixels = image.read(Window(0, 0, *image.shape))
        assert 0.0 < np.isinf(pixels).mean() < 0.01 + view.conditions.cloud_cover
        assert np.isnan(pixels[0]).sum() == 2 * view.border_px[0]
        finite = pixels[np.isfinite(pixels)]
        assert finite.min() >= 1.0
        assert finite.max() < 4095.0


def test_dates_differ_more_than_images_of_one_day(small_continent: Continent) -> None:
    by_orbit: dict[int, list[str]] = {}
    for name, view in small_continent.views.items():
        by_orbit.setdefault(view.orbit, []).append(name)
    first, other = list(by_orbit.values())[:2]
    same_day = agreement(small_continent, first[0], first[1])
    other_day = agreement(small_continent, first[0], other[0])
    assert 0.3 < other_day < same_day - 0.02


def agreement(continent: Continent, one: str, other: str) -> float:
    """Median correlation of chips of two images at places that both show."""
    world = continent.world
    step = np.linspace(-0.18, 0.18, 5)
    offset = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    lon_lat = world.centre_lon_lat + offset * len(world.albedo) * world.step_deg
    scores = []
    for point in np.column_stack([lon_lat, world.height_m(lon_lat)]):
        chips = []
        for name in (one, other):
            view = continent.views[name]
            scene = scene_of(continent, name)
            chips.append(render_chip(scene.image, continent.geometry(view).rpc, point, 2.5, 61).ravel())
        valid = np.isfinite(chips).all(axis=0)
        if valid.mean() > 0.9:
            scores.append(np.corrcoef(chips[0][valid], chips[1][valid])[0, 1])
    return float(np.median(scores))


def test_what_is_there_is_kept_and_what_is_missing_is_made_again(
    small_continent: Continent, tmp_path: Path
) -> None:
    folder = shutil.copytree(small_continent.folder, tmp_path / "continent")
    paths = sorted((folder / "archive" / "images").glob("*.tif"))
    missing, kept = paths[0], paths[1]
    pixels, time = missing.read_bytes(), kept.stat().st_mtime_ns
    missing.unlink()
    make(folder, "small", small_continent.seed)
    assert missing.read_bytes() == pixels
    assert kept.stat().st_mtime_ns == time


def test_a_folder_with_another_continent_is_refused(small_continent: Continent) -> None:
    with pytest.raises(InputError, match="another size or seed"):
        make(small_continent.folder, "small", small_continent.seed + 1)


def test_a_folder_without_a_continent_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no continent found"):
        open_continent(tmp_path)


def test_nothing_of_the_truth_is_in_the_files_of_the_archive(small_continent: Continent) -> None:
    stated = (small_continent.folder / "archive" / "items.ndjson").read_text()
    item = json.loads(stated.splitlines()[0])
    assert set(item["assets"]) <= {"image", "clouds"}
    assert "truth" not in stated
