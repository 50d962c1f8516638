"""Aberration, light time and refraction agree with computations that do not use the model's formulas."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amers.services.geodesy import ecef_from_lon_lat_h, lon_lat_h_from_east_north_up
from amers.services.sensors.light_path import (
    EARTH_ROTATION_RAD_S,
    SPEED_OF_LIGHT_M_S,
    LightPath,
    zenith_path_excess_m,
)
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.simulation.orbit import pushbroom_over

SHAPE = (3000, 2000)
HEIGHTS_M = (-100.0, 4000.0)
ALL = LightPath(velocity_aberration=True, light_time=True, refraction=True)
a_millimetre_from_orbit_rad = 1e-3 / 700e3
a_millionth_of_a_pixel = 1e-6


def a_model(path: LightPath, incidence_deg: float = 25.0) -> PushbroomModel:
    """A simulated satellite over the Alps whose model applies some of the effects."""
    target = np.array([7.0, 45.9, 1500.0])
    model = pushbroom_over(target, SHAPE, 0.7, (incidence_deg, 100.0), HEIGHTS_M, jitter_px=0.3)
    return replace(model, light_path=path)


def positions(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in and around the image, at heights of the model."""
    rng = np.random.default_rng(8)
    return rng.uniform(-0.2, 1.2, (n, 2)) * SHAPE, rng.uniform(*HEIGHTS_M, n)


@pytest.mark.parametrize(
    "path", [LightPath(True), LightPath(light_time=True), LightPath(True, True), ALL]
)
def test_project_inverts_locate_and_has_the_stated_derivative(path: LightPath) -> None:
    model = a_model(path)
    image, height = positions(300)
    ground = model.locate(image, height)
    np.testing.assert_allclose(model.project(ground), image, atol=a_millionth_of_a_pixel)
    derivative = model.project_derivative(ground[:10])
    for i, point in enumerate(ground[:10]):
        moved = model.project(
            lon_lat_h_from_east_north_up(2.0 * np.vstack([np.eye(3), -np.eye(3)]), point)
        )
        np.testing.assert_allclose(
            derivative[i], ((moved[:3] - moved[3:]) / 4.0).T, rtol=1e-3, atol=1e-4
        )


def test_light_leaves_the_turning_ground_before_it_meets_the_moving_satellite() -> None:
    model = a_model(LightPath(velocity_aberration=True, light_time=True))
    image, height = positions(50)
    ground = ecef_from_lon_lat_h(model.locate(image, height))
    time = model.line_time(image[:, 0])[:, 0]
    satellite, ecef_velocity = model.orbit(time), model.orbit.derivative(time)
    spin = np.array([0.0, 0.0, EARTH_ROTATION_RAD_S])
    travel_s = np.zeros(len(ground))
    for _ in range(4):
        when_it_left = Rotation.from_rotvec(-travel_s[:, None] * spin).apply(ground)
        travel_s = np.linalg.norm(when_it_left - satellite, axis=1) / SPEED_OF_LIGHT_M_S
    seen = when_it_left - satellite
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    seen += (ecef_velocity + np.cross(spin, satellite)) / SPEED_OF_LIGHT_M_S
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    look = np.column_stack([model.look(image[:, 1]), np.ones(len(image))])
    look = Rotation.from_quat(model.attitude(time)).apply(look)
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    angle = np.linalg.norm(np.cross(seen, look), axis=1)
    assert angle.max() < a_millimetre_from_orbit_rad


def test_the_effects_have_their_known_size() -> None:
    centre, height = np.array([[1500.0, 1000.0]]), np.array([1500.0])
    plain = ecef_from_lon_lat_h(a_model(LightPath()).locate(centre, height))[0]

    def moved_m(path: LightPath) -> float:
        ground = ecef_from_lon_lat_h(a_model(path).locate(centre, height))[0]
        return float(np.linalg.norm(ground - plain))

    assert moved_m(LightPath(velocity_aberration=True)) == pytest.approx(19.0, abs=2.0)
    assert moved_m(LightPath(light_time=True)) == pytest.approx(0.85, abs=0.1)
    assert moved_m(LightPath(refraction=True)) == pytest.approx(1.1, abs=0.15)


@pytest.mark.parametrize(("zenith_deg", "ground_m"), [(10.0, 0.0), (30.0, 0.0), (45.0, 2500.0)])
def test_refraction_agrees_with_rays_traced_through_a_spherical_atmosphere(
    zenith_deg: float, ground_m: float
) -> None:
    radius, shells = 6371e3, np.linspace(ground_m, 100e3, 400_001)
    middle = (shells[1:] + shells[:-1]) / 2.0
    density = np.where(
        middle < 11e3,
        np.maximum(1.0 - 2.25577e-5 * middle, 0.1) ** 4.25588,
        0.2971 * np.exp(-(middle - 11e3) / 6341.6),
    )
    index = 1.0 + 2.77e-4 * density
    invariant = (radius + ground_m) * index[0] * np.sin(np.radians(zenith_deg))

    def turned_rad(refractive: np.ndarray | float, constant: float) -> float:
        sine = constant / (refractive * (radius + middle))
        return float((np.diff(shells) / (radius + middle) * sine / np.sqrt(1.0 - sine**2)).sum())

    bent, straight = turned_rad(index, invariant), turned_rad(1.0, invariant)
    displacement_m = (straight - bent) * (radius + ground_m)
    zenith = np.arcsin(invariant / (radius + ground_m))
    lift_m = zenith_path_excess_m(ground_m) / np.cos(zenith) ** 2
    assert lift_m * np.tan(zenith) == pytest.approx(displacement_m, rel=0.02)


def test_a_line_of_sight_with_refraction_passes_through_the_ground_at_its_height() -> None:
    model = a_model(ALL)
    image, _ = positions(50)
    height = np.full(50, sum(HEIGHTS_M) / 2.0)
    origin, direction = model.line_of_sight(image)
    offset = ecef_from_lon_lat_h(model.locate(image, height)) - origin
    assert np.linalg.norm(np.cross(offset, direction), axis=1).max() < 1e-4
