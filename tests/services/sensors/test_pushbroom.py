"""The rigorous pushbroom: project, locate and line of sight agree, and are NaN outside its range."""

import numpy as np
import pytest

from amers.services.geodesy import (
    ecef_from_lon_lat_h,
    lon_lat_h_from_east_north_up,
    lon_lat_h_from_ecef,
)
from amers.services.imagery.scene import view_direction
from amers.services.imagery.source import image_gsd_m
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.simulation.orbit import pushbroom_over

TARGET = np.array([5.4, 43.6, 250.0])
SHAPE = (1200, 900)
a_millionth_of_a_pixel = 1e-6
a_micrometre = 1e-6
a_hundredth_of_a_degree = 0.01


def a_model(incidence_deg: float, azimuth_deg: float, lon: float = 5.4) -> PushbroomModel:
    """A pushbroom with jitter, seen from a given direction."""
    target = np.array([lon, *TARGET[1:]])
    return pushbroom_over(
        target,
        SHAPE,
        0.5,
        (incidence_deg, azimuth_deg),
        (100.0, 900.0),
        jitter_px=0.5,
        rng=np.random.default_rng(4),
    )


def image_and_heights(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in and around the image, at heights of the model."""
    rng = np.random.default_rng(11)
    return rng.uniform(-0.3, 1.3, (n, 2)) * SHAPE, rng.uniform(100.0, 900.0, n)


@pytest.mark.parametrize(("incidence", "azimuth"), [(0.0, 0.0), (15.0, 95.0), (30.0, 250.0)])
def test_project_inverts_locate(incidence: float, azimuth: float) -> None:
    model = a_model(incidence, azimuth)
    image, height = image_and_heights(500)
    ground = model.locate(image, height)
    np.testing.assert_allclose(ground[:, 2], height, atol=a_micrometre)
    np.testing.assert_allclose(model.project(ground), image, atol=a_millionth_of_a_pixel)


def test_project_inverts_locate_across_the_antimeridian() -> None:
    model = a_model(20.0, 80.0, lon=180.0)
    image, height = image_and_heights(300)
    ground = model.locate(image, height)
    assert ground[:, 0].min() < -179.9
    assert ground[:, 0].max() > 179.9
    np.testing.assert_allclose(model.project(ground), image, atol=a_millionth_of_a_pixel)


def test_the_line_of_sight_passes_through_everything_located_on_it() -> None:
    model = a_model(25.0, 130.0)
    image, height = image_and_heights(200)
    origin, direction = model.line_of_sight(image)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-12)
    offset = ecef_from_lon_lat_h(model.locate(image, height)) - origin
    distance = np.linalg.norm(np.cross(offset, direction), axis=1)
    assert distance.max() < 10.0 * a_micrometre


def test_the_line_of_sight_starts_on_the_orbit() -> None:
    origin, _ = a_model(25.0, 130.0).line_of_sight(np.array([[600.0, 450.0]]))
    assert 680e3 < lon_lat_h_from_ecef(origin)[0, 2] < 720e3


def test_the_derivative_agrees_with_differences_of_project() -> None:
    model = a_model(25.0, 130.0)
    ground = model.locate(*image_and_heights(20))
    derivative = model.project_derivative(ground)
    step_m = 2.0
    for i, point in enumerate(ground):
        enu = step_m * np.vstack([np.eye(3), -np.eye(3)])
        moved = model.project(lon_lat_h_from_east_north_up(enu, point))
        numeric = ((moved[:3] - moved[3:]) / (2.0 * step_m)).T
        np.testing.assert_allclose(derivative[i], numeric, atol=1e-6)


@pytest.mark.parametrize(("incidence", "azimuth"), [(8.0, 10.0), (25.0, 100.0), (25.0, 300.0)])
def test_the_target_is_at_the_image_centre_in_the_given_direction(
    incidence: float, azimuth: float
) -> None:
    model = pushbroom_over(TARGET, SHAPE, 0.7, (incidence, azimuth), (100.0, 900.0))
    centre = (np.array([SHAPE]) - 1.0) / 2.0
    np.testing.assert_allclose(model.project(TARGET[None, :]), centre, atol=0.001)
    seen_incidence, seen_azimuth = view_direction(model, centre, TARGET[None, :])
    assert seen_incidence[0] == pytest.approx(incidence, abs=a_hundredth_of_a_degree)
    assert seen_azimuth[0] == pytest.approx(azimuth, abs=a_hundredth_of_a_degree)
    assert image_gsd_m(model, TARGET) == pytest.approx(0.7, rel=0.001)


def test_north_is_up_and_east_to_the_right_so_that_images_are_not_mirrored() -> None:
    model = a_model(0.0, 0.0)
    derivative = model.project_derivative(TARGET[None, :])[0]
    assert derivative[0, 1] < 0.0 < derivative[1, 0]


def test_positions_far_outside_the_image_are_nan() -> None:
    model = a_model(20.0, 100.0)
    far = lon_lat_h_from_east_north_up(
        np.array([[5e3, 0.0, 0.0], [0.0, 5e3, 0.0], [0.0, 0.0, -12.7e6]]), TARGET
    )
    assert np.isnan(model.project(far)).all()
    assert np.isnan(model.project_derivative(far)).all()
    beyond = np.array([[-0.6 * SHAPE[0], 0.0], [0.0, 1.6 * SHAPE[1]]])
    assert np.isnan(model.locate(beyond, np.array([200.0, 200.0]))).all()


def test_a_line_of_sight_that_misses_a_height_is_not_located() -> None:
    model = a_model(20.0, 100.0)
    assert np.isnan(model.locate(np.array([[5.0, 5.0]]), np.array([-6.3e6]))).all()
