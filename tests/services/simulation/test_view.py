"""Simulated images agree with their true geometry."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.errors import InputError
from amers.services.imagery.source import render_chip
from amers.services.sensors.correction import CorrectedModel
from amers.services.simulation.land import NO_ROOF
from amers.services.simulation.light import SKY_LIGHT, radiance_of_day, smooth_radiance
from amers.services.simulation.render import Radiometry, ray_setup, render
from amers.services.simulation.view import (
    SimulatedView,
    ViewPlan,
    plan_geometry,
    render_view,
    simulate_block,
    simulate_view,
    true_ground,
    true_line_sample,
)
from amers.services.simulation.world import World, make_world

two_hundredths_of_a_pixel = 0.02
a_hundredth_of_a_pixel = 0.01
half_the_spacing_of_rays_px = 0.25
a_millimetre = 1e-3
SILENT = Radiometry(noise_floor=0.0, noise_per_signal=0.0)
SUMMER = datetime(2024, 6, 12, 10, 40, tzinfo=UTC)
SPRING = datetime(2024, 4, 3, 10, 40, tzinfo=UTC)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(np.random.default_rng(1), size_m=800.0)


def plan(world: World, **changes: object) -> ViewPlan:
    lon, lat = (float(v) for v in world.centre_lon_lat)
    base = ViewPlan("view", (lon, lat), (700, 700), incidence_deg=15.0, azimuth_deg=100.0)
    return replace(base, **changes)  # type: ignore[arg-type]


def centroid(chip: np.ndarray) -> np.ndarray:
    """Centre of a bright Gaussian relative to its chip, by a parabola fitted to its logarithm."""
    r = len(chip) // 2
    line, sample = np.mgrid[-r : r + 1, -r : r + 1]
    light = chip - np.median(np.concatenate([chip[0], chip[-1], chip[:, 0], chip[:, -1]]))
    bright = light > 0.3 * light.max()
    y, x, weight = line[bright], sample[bright], light[bright]
    design = np.column_stack([np.ones(len(y)), y, x, y * y, x * y, x * x])
    k = np.linalg.lstsq(design * weight[:, None], np.log(weight) * weight, rcond=None)[0]
    return np.linalg.solve([[2.0 * k[3], k[4]], [k[4], 2.0 * k[5]]], -k[1:3])


@pytest.mark.parametrize(
    ("incidence", "azimuth", "gsd"), [(0.0, 10.0, 0.5), (25.0, 100.0, 0.5), (25.0, 220.0, 0.8)]
)
def test_marks_on_the_ground_are_seen_where_the_true_model_says(
    incidence: float, azimuth: float, gsd: float
) -> None:
    world = make_world(np.random.default_rng(3), 400.0, relief_m=30.0)
    n = len(world.terrain_m)
    rng = np.random.default_rng(5)
    node = np.arange(60.0, n - 60.0, 60.0)
    marks = np.stack(np.meshgrid(node, node), axis=-1).reshape(-1, 2)
    marks += rng.uniform(-5.0, 5.0, marks.shape)
    axis = np.arange(n)
    albedo = np.full((n, n), 0.1)
    for x, y in marks:
        albedo += 0.4 * np.outer(np.exp(-((axis - y) ** 2) / 32.0), np.exp(-((axis - x) ** 2) / 32.0))
    bare = replace(world, roof_m=np.full_like(world.roof_m, NO_ROOF))
    views = plan(
        bare, shape=(300, 300), gsd_m=gsd, incidence_deg=incidence, azimuth_deg=azimuth, jitter_px=0.3
    )
    model = plan_geometry(bare, views, rng).true_model
    light = albedo.astype(np.float32)
    smooth = smooth_radiance(light, bare.roof_m, gsd / bare.posting_m)
    setup = ray_setup(bare, incidence, 60.0, 150.0)
    strips = render(bare, model, (300, 300), smooth, setup, radiometry=SILENT, rng=rng)
    pixels = np.concatenate([strip for _, strip in strips]).astype(np.float64)
    lon_lat = bare.lon_lat(marks)
    expected = model.project(np.column_stack([lon_lat, bare.height_m(lon_lat)]))
    expected = expected[((expected > 20.0) & (expected < 280.0)).all(axis=1)]
    assert len(expected) > 10
    r = round(6.0 / gsd)
    first = np.round(expected).astype(int)
    seen = np.array([centroid(pixels[i - r : i + r + 1, j - r : j + r + 1]) + [i, j] for i, j in first])
    error_px = seen - expected
    assert np.abs(np.median(error_px, axis=0)).max() < two_hundredths_of_a_pixel / 4.0
    assert np.abs(error_px).max() < two_hundredths_of_a_pixel


def test_the_true_ground_lies_on_the_surface_and_on_the_line_of_sight(world: World) -> None:
    view = simulate_view(world, plan(world, shape=(64, 64)), np.random.default_rng(0))
    model = plan_geometry(world, plan(world), np.random.default_rng(0)).true_model
    view = replace(view, geometry=replace(view.geometry, true_model=model))
    image = np.random.default_rng(4).uniform(0.0, 699.0, (4000, 2))
    ground = true_ground(view, world, image)
    np.testing.assert_allclose(true_line_sample(view, ground), image, atol=1e-6)
    terrain = world.height_m(ground[:, :2])
    surface = world.surface_m(ground[:, :2])
    on_terrain = np.abs(ground[:, 2] - terrain) < a_millimetre
    on_roof = np.abs(ground[:, 2] - surface) < a_millimetre
    on_wall = ~on_terrain & ~on_roof
    assert on_terrain.mean() > 0.7
    assert (on_roof & ~on_terrain).mean() > 0.005
    assert (ground[on_wall, 2] > terrain[on_wall] - a_millimetre).all()
    assert on_wall.mean() < 0.1


def a_tower(world: World) -> World:
    """The world with a single tower, 20 m square and 30 m high, on flat bare ground."""
    n = len(world.terrain_m)
    roof = np.full_like(world.roof_m, NO_ROOF)
    middle = slice(n // 2 - 20, n // 2 + 20)
    roof[middle, middle] = 230.0
    return replace(
        world,
        roof_m=roof,
        terrain_m=np.full_like(world.terrain_m, 200.0),
        parcel=np.zeros_like(world.parcel),
    )


def test_a_tower_hides_the_ground_behind_it_and_leans_away_from_the_sensor(world: World) -> None:
    towered = a_tower(world)
    n = len(world.terrain_m)
    leaning = plan(towered, shape=(200, 200), incidence_deg=25.0, azimuth_deg=90.0)
    view = simulate_view(towered, leaning, np.random.default_rng(0))
    hidden_m = 30.0 * np.tan(np.radians(25.0))
    for behind_m, is_hidden in ((1.0, True), (hidden_m - 1.0, True), (hidden_m + 1.0, False)):
        spot = towered.lon_lat(np.array([[n / 2 - 20.5 - behind_m / 0.5, n / 2]]))
        point = np.array([[*spot[0], 200.0]])
        seen = true_ground(view, towered, true_line_sample(view, point))
        assert (seen[0, 2] > 200.5) == is_hidden, behind_m
    front = towered.lon_lat(np.array([[n / 2 + 19.5 + 1.0, n / 2]]))
    point = np.array([[*front[0], 200.0]])
    seen = true_ground(view, towered, true_line_sample(view, point))
    np.testing.assert_allclose(seen, point, atol=a_millimetre)


def test_a_roof_is_seen_where_the_true_model_puts_its_edges(world: World) -> None:
    towered = replace(a_tower(world), albedo=np.full_like(world.albedo, 0.1))
    n = len(world.terrain_m)
    towered.albedo[towered.roof_m > NO_ROOF] = 0.6
    straight = plan(towered, shape=(200, 200), incidence_deg=25.0, azimuth_deg=90.0, radiometry=SILENT)
    view = simulate_view(towered, straight, np.random.default_rng(0))
    corners = towered.lon_lat(n / 2 - 0.5 + 20.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    image = true_line_sample(view, np.column_stack([corners, np.full(4, 230.0)]))
    x, y = image[:, 1], image[:, 0]
    area_px = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    halfway = 0.5 * (float(view.pixels.max()) + float(np.median(view.pixels)))
    bright = view.pixels > halfway
    assert bright.sum() == pytest.approx(area_px, rel=0.01)
    line_sample = np.argwhere(bright).mean(axis=0)
    np.testing.assert_allclose(line_sample, image.mean(axis=0), atol=half_the_spacing_of_rays_px)


def zncc(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def correlations(world: World, first: SimulatedView, second: SimulatedView) -> np.ndarray:
    """Correlation of two views around points of open ground, projected by their true models."""
    image = np.stack(np.meshgrid(*[np.arange(80.0, 640.0, 70.0)] * 2), axis=-1).reshape(-1, 2)
    ground = true_ground(first, world, image)
    ground = ground[np.abs(ground[:, 2] - world.height_m(ground[:, :2])) < a_millimetre]
    scores = []
    for point in ground:
        chips = [
            render_chip(view.image, view.geometry.true_model, point, 0.5, 51) for view in (first, second)
        ]
        if np.isfinite(chips).all():
            scores.append(zncc(*chips))
    assert len(scores) > 40
    return np.array(scores)


@pytest.mark.long
def test_two_views_of_one_day_correlate(world: World) -> None:
    rng = np.random.default_rng(0)
    first = simulate_view(world, plan(world), rng)
    second = simulate_view(world, plan(world, incidence_deg=12.0, azimuth_deg=280.0), rng)
    assert np.median(correlations(world, first, second)) > 0.85


@pytest.mark.thorough
def test_views_of_different_days_correlate_less_but_mostly_well(world: World) -> None:
    rng = np.random.default_rng(0)
    first = simulate_view(world, plan(world, acquired_at=SUMMER), rng)
    same = simulate_view(world, plan(world, acquired_at=SUMMER, azimuth_deg=200.0), rng)
    other = simulate_view(world, plan(world, acquired_at=SPRING, azimuth_deg=200.0), rng)
    within, across = correlations(world, first, same), correlations(world, first, other)
    assert np.median(across) < np.median(within)
    assert np.mean(across > 0.5) > 0.7


def test_the_delivered_model_has_exactly_the_given_error(world: World) -> None:
    error_px = np.array([[0.0, 2.0, -1.0], [0.0, 0.5, 1.5]])
    geometry = plan_geometry(world, plan(world), np.random.default_rng(0), (30.0, -40.0), error_px)
    rng = np.random.default_rng(2)
    image = rng.uniform(0.0, 699.0, (500, 2))
    ground = geometry.true_model.locate(image, rng.uniform(*world.height_range_m, 500))
    wrong = CorrectedModel(geometry.true_model, geometry.error).project(ground)
    fit_error_px = np.linalg.norm(geometry.delivered.project(ground) - wrong, axis=1)
    assert fit_error_px.max() < 2.0 * a_hundredth_of_a_pixel
    np.testing.assert_allclose(geometry.error.parameters[:, 1:], error_px[:, 1:])
    moved = np.hypot(*geometry.error.parameters[:, 0])
    assert moved == pytest.approx(50.0 / 0.5, rel=0.1)


def test_the_rpc_fits_the_true_model(world: World) -> None:
    geometry = plan_geometry(world, plan(world), np.random.default_rng(0))
    image = np.random.default_rng(2).uniform(0.0, 699.0, (500, 2))
    ground = geometry.true_model.locate(image, np.full(500, 190.0))
    error_px = np.linalg.norm(geometry.rpc.project(ground) - image, axis=1)
    assert error_px.max() < a_hundredth_of_a_pixel


@pytest.mark.long
def test_the_same_seed_gives_the_same_images(world: World) -> None:
    first, again = (
        simulate_block(world, np.random.default_rng(7), n_views=2, shape=(150, 150)) for _ in range(2)
    )
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.pixels, b.pixels)
        np.testing.assert_array_equal(a.geometry.delivered.line_num, b.geometry.delivered.line_num)


def test_strips_make_up_the_image_and_none_of_it_is_nodata(world: World) -> None:
    geometry = plan_geometry(world, plan(world), np.random.default_rng(0))
    strips = list(render_view(world, geometry, np.random.default_rng(0)))
    assert [line for line, _ in strips] == [0, 256, 512]
    pixels = np.concatenate([strip for _, strip in strips])
    assert pixels.shape == (700, 700)
    assert pixels.min() > 0
    assert pixels.max() <= 4095
    assert np.mean(pixels == 4095) < 0.001


def test_shadows_fall_away_from_the_sun(world: World) -> None:
    towered = replace(a_tower(world), albedo=np.full_like(world.albedo, 0.3))
    radiance = radiance_of_day(towered, SUMMER.date(), 45.0, 180.0)
    n = len(radiance)
    assert radiance[n // 2 - 20 - 40, n // 2] < 0.5 * radiance[n // 2 + 20 + 40, n // 2]
    assert radiance[n // 2 - 20 - 70, n // 2] == radiance[n // 2 + 20 + 40, n // 2]


@pytest.mark.parametrize("towards", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_slopes_reflect_what_falls_on_them(world: World, towards: tuple[float, float]) -> None:
    """In proportion to the cosine between sun and normal, beside the light of the sky."""
    small = np.s_[:60, :60]
    east, north = np.meshgrid(np.arange(60.0), -np.arange(60.0))
    rise = 0.3 * world.posting_m * (towards[0] * east + towards[1] * north)
    bare = replace(
        world,
        terrain_m=(200.0 + rise).astype(np.float32),
        roof_m=np.full((60, 60), NO_ROOF, dtype=np.float32),
        albedo=np.full((60, 60), 0.5, dtype=np.float32),
        parcel=np.zeros_like(world.parcel[small]),
    )
    light = radiance_of_day(bare, SUMMER.date(), 40.0, 200.0)[10:-10, 10:-10]
    elevation, azimuth = np.radians([40.0, 200.0])
    sun = np.array([np.sin(azimuth), np.cos(azimuth), np.tan(elevation)]) * np.cos(elevation)
    normal = np.cross([1.0, 0.0, 0.3 * towards[0]], [0.0, 1.0, 0.3 * towards[1]])
    share = sun @ normal / np.linalg.norm(normal) / sun[2]
    np.testing.assert_allclose(light, 0.5 * (SKY_LIGHT + (1.0 - SKY_LIGHT) * share), rtol=1e-3)


def test_terrain_that_would_occlude_itself_is_refused(world: World) -> None:
    steep = replace(world, terrain_m=world.terrain_m * np.float32(20.0))
    with pytest.raises(InputError, match="slopes up to"):
        simulate_view(steep, plan(steep, incidence_deg=40.0), np.random.default_rng(0))
