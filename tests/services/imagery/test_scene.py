"""Centre, ground sampling, footprint and view directions of a scene."""

from dataclasses import replace

import numpy as np
import pytest
from shapely.geometry import MultiPoint, Polygon

from amers.services.imagery.scene import (
    Scene,
    scene_centre,
    scene_footprint,
    scene_gsd_m,
    view_direction,
)
from amers.services.imagery.source import ArrayImage
from amers.services.simulation.view import ViewGeometry, plan_geometry
from amers.services.simulation.world import World, make_world
from amers.services.types import Array
from tests.services.simulated import plan, world

a_metre_deg = 1.0 / 111_000.0
a_tenth_of_a_degree = 0.1
one_percent = 0.01


def scene_of(geometry: ViewGeometry) -> Scene:
    pixels = np.zeros(geometry.plan.shape, dtype=np.float32)
    return Scene(ArrayImage(pixels), geometry.delivered, geometry.acquisition, 5.0)


def flown(incidence: float = 20.0, azimuth: float = 120.0, where: World | None = None) -> ViewGeometry:
    ground = world() if where is None else where
    lon, lat = (float(v) for v in ground.centre_lon_lat)
    requested = plan(lon_lat=(lon, lat), shape=(500, 900), incidence_deg=incidence, azimuth_deg=azimuth)
    return plan_geometry(ground, requested, np.random.default_rng(0))


def turned(degrees: Array) -> Array:
    """Differences of angles, -180 to 180."""
    return np.asarray((degrees + 180.0) % 360.0 - 180.0)


def test_the_centre_projects_to_the_middle_of_the_image() -> None:
    scene = scene_of(flown())
    centre = scene_centre(scene)
    np.testing.assert_allclose(scene.model.project(centre[None, :])[0], [249.5, 449.5], atol=1e-4)
    assert centre[2] == pytest.approx(np.mean(scene.model.height_range_m))


@pytest.mark.parametrize("gsd_m", [0.5, 1.0])
def test_the_ground_sampling_is_that_of_the_planned_view(gsd_m: float) -> None:
    geometry = plan_geometry(world(), plan(gsd_m=gsd_m), np.random.default_rng(0))
    assert scene_gsd_m(scene_of(geometry)) == pytest.approx(gsd_m, rel=one_percent)


@pytest.mark.parametrize(("incidence", "azimuth"), [(5.0, 0.0), (20.0, 120.0), (30.0, 275.0)])
def test_directions_are_those_of_the_planned_view(incidence: float, azimuth: float) -> None:
    geometry = flown(incidence, azimuth)
    image = np.array([[249.5, 449.5]])
    ground = geometry.true_model.locate(image, world().height_m(np.array([geometry.plan.lon_lat])))
    for model in (geometry.true_model, geometry.rpc):
        directions = view_direction(model, image, ground)
        assert directions[0][0] == pytest.approx(incidence, abs=a_tenth_of_a_degree)
        assert np.abs(turned(directions[1] - azimuth)).max() < a_tenth_of_a_degree / np.sin(
            np.radians(incidence)
        )


def test_directions_of_the_rpc_are_those_of_the_sensor_in_the_whole_image() -> None:
    geometry = flown()
    image = np.random.default_rng(0).uniform([0, 0], [499, 899], (50, 2))
    ground = geometry.true_model.locate(image, np.full(50, 180.0))
    true = view_direction(geometry.true_model, image, ground)
    rpc = view_direction(geometry.rpc, image, ground)
    np.testing.assert_allclose(rpc[0], true[0], atol=a_tenth_of_a_degree)
    np.testing.assert_allclose(turned(rpc[1] - true[1]), 0.0, atol=2.0 * a_tenth_of_a_degree)


def test_the_footprint_contains_all_the_ground_that_the_image_can_show() -> None:
    scene = scene_of(flown(30.0))
    outline = Polygon(scene_footprint(scene))
    assert outline.is_valid
    assert outline.exterior.is_ccw
    rng = np.random.default_rng(0)
    image = rng.uniform([-0.5, -0.5], [499.5, 899.5], (500, 2))
    ground = scene.model.locate(image, rng.uniform(*scene.model.height_range_m, 500))
    grown = outline.buffer(a_metre_deg)
    assert grown.covers(MultiPoint(ground[:, :2]))


def test_the_footprint_is_no_larger_than_the_ground_that_the_image_can_show() -> None:
    scene = scene_of(flown(30.0))
    corners = np.array([[-0.5, -0.5], [-0.5, 899.5], [499.5, 899.5], [499.5, -0.5]])
    ends = [scene.model.locate(corners, np.full(4, h))[:, :2] for h in scene.model.height_range_m]
    hull = MultiPoint(np.concatenate(ends)).convex_hull
    outline = Polygon(scene_footprint(scene))
    assert outline.area == pytest.approx(hull.area, rel=1e-3)
    assert hull.buffer(a_metre_deg).covers(outline)


def test_a_footprint_across_the_antimeridian_is_in_one_piece() -> None:
    west = make_world(
        np.random.default_rng(3), size_m=1000.0, posting_m=2.0, centre_lon_lat=(180.0, -17.0)
    )
    scene = scene_of(flown(where=west))
    outline = scene_footprint(scene)
    assert np.ptp(outline[:, 0]) < 0.02
    assert (outline[:, 0] > 180.0).any() != (outline[:, 0] < -180.0).any()
    here = scene_of(flown(where=replace(west, origin_lon_lat=west.origin_lon_lat - [80.0, 0.0])))
    area = Polygon(outline).area
    assert area == pytest.approx(Polygon(scene_footprint(here)).area, rel=one_percent)
