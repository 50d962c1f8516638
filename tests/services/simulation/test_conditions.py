"""Each condition changes the image by the stated amount."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.imagery.source import Window
from amers.services.simulation.conditions import CLEAR, CLOUD_LIGHT, Conditions, clouds_over
from amers.services.simulation.light import day_of, radiance
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from amers.services.simulation.world import World, make_world

SHAPE = (300, 340)
a_twentieth = 0.05
SUMMER = datetime(2024, 6, 12, 10, 40, tzinfo=UTC)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(np.random.default_rng(3), size_m=400.0, posting_m=1.0)


@pytest.fixture(scope="module")
def geometry(world: World) -> ViewGeometry:
    lon, lat = world.centre_lon_lat.tolist()
    return plan_geometry(world, ViewPlan("view", (lon, lat), SHAPE, 1.0), np.random.default_rng(0))


def image(world: World, geometry: ViewGeometry, conditions: Conditions = CLEAR) -> np.ndarray:
    return TiledView(world, geometry, 5, conditions).read(Window(0, 0, *SHAPE))


def silent(geometry: ViewGeometry) -> ViewGeometry:
    radiometry = replace(geometry.plan.radiometry, noise_floor=0.0, noise_per_signal=0.0)
    return replace(geometry, plan=replace(geometry.plan, radiometry=radiometry))


@pytest.mark.parametrize("cover", [0.1, 0.4, 0.7])
def test_clouds_cover_the_given_share_of_the_image(cover: float) -> None:
    clouds = clouds_over(SHAPE, cover, np.random.default_rng(1))
    assert clouds is not None
    opacity = clouds.opacity(np.arange(SHAPE[0], dtype=float), np.arange(SHAPE[1], dtype=float))
    assert np.mean(opacity > 0.5) == pytest.approx(cover, abs=a_twentieth)


def test_zero_cloud_cover_gives_no_clouds() -> None:
    assert clouds_over(SHAPE, 0.0, np.random.default_rng(1)) is None


def test_a_thick_cloud_hides_the_ground_completely(world: World, geometry: ViewGeometry) -> None:
    under = Conditions(cloud_cover=0.5)
    clouds = clouds_over(SHAPE, 0.5, np.random.default_rng([5, 0]))
    assert clouds is not None
    opacity = clouds.opacity(np.arange(SHAPE[0], dtype=float), np.arange(SHAPE[1], dtype=float))
    clear, cloudy = image(world, geometry), image(world, geometry, under)
    thick, open_sky = opacity > 0.99, opacity < 0.01
    assert abs(np.corrcoef(clear[thick], cloudy[thick])[0, 1]) < 3.0 * a_twentieth
    assert np.corrcoef(clear[open_sky], cloudy[open_sky])[0, 1] > 0.5
    radiometry = geometry.plan.radiometry
    expected = radiometry.haze + radiometry.gain * CLOUD_LIGHT
    assert np.median(cloudy[thick]) == pytest.approx(expected, rel=3.0 * a_twentieth)


def test_haze_removes_the_given_share_of_the_contrast(world: World, geometry: ViewGeometry) -> None:
    clear = image(world, silent(geometry))
    hazy = image(world, silent(geometry), Conditions(haze=0.6))
    assert hazy.std() / clear.std() == pytest.approx(0.4, abs=0.01)
    assert hazy.min() > clear.min()


def test_inverted_contrast_is_the_opposite(world: World, geometry: ViewGeometry) -> None:
    clear, opposite = image(world, geometry), image(world, geometry, Conditions(inverted=True))
    assert np.corrcoef(clear.ravel(), opposite.ravel())[0, 1] < -0.9


def test_noise_has_the_given_standard_deviation(world: World, geometry: ViewGeometry) -> None:
    noisy = image(world, geometry, Conditions(noise=80.0)) - image(world, silent(geometry))
    assert noisy.std() == pytest.approx(80.0, rel=a_twentieth)


def test_a_season_changes_vegetation_and_not_roofs(world: World) -> None:
    sun = 50.0, 150.0
    rows, columns = world.albedo.shape
    now, later = (
        radiance(world, day_of(world, SUMMER.date(), *sun, season), (0, 0), (rows, columns))
        for season in (0.0, 1.0)
    )
    built = np.isfinite(world.roof_m)
    np.testing.assert_array_equal(now[built], later[built])
    assert np.corrcoef(now[~built], later[~built])[0, 1] < 0.8


def test_a_share_outside_0_to_1_is_refused() -> None:
    with pytest.raises(InputError, match=r"cloud_cover: 1.2 given, 0 to 1 expected"):
        Conditions(cloud_cover=1.2)
