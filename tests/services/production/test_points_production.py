"""Points of another base get chips where images show them, with the errors that these chips have."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import InputError, NotEnoughPoints
from amers.services.geodesy import east_north_up
from amers.services.imagery.scene import Scene
from amers.services.production.points_production import (
    MISSING,
    NO_HEIGHT,
    NOT_CONFIRMED,
    NOT_SALIENT,
    OUTSIDE,
    SAME_PLACE,
    KnownPointOptions,
    KnownPoints,
    produce_known_points,
)
from amers.services.registration.on_points import register_scene
from amers.services.simulation.view import SimulatedView, simulate_view, true_ground
from amers.services.types import UNKNOWN_FRAME, Array, Frame, GroundPoints
from tests.services.production.test_ortho_production import GSD_M, SIDE, land, ortho
from tests.services.production.test_several_orthos import LOCAL_PX, date, errors_m, named
from tests.services.simulated import SHAPE, MemoryChips, plan, world
from tests.services.textures import as_pixels, moved

SIGMA_UP_M = 4.0
IMAGE_SIGMA_M = 3.0
KNOWN_FRAME = Frame.from_sigmas(0.4, 0.7)
MOVED_PX = (1.3, -2.6)


def ground(lon_lat_h: Array, sigma_m: tuple[float, float, float] = (0.5, 0.5, 1.0)) -> GroundPoints:
    names = np.array([f"P{number}" for number in range(len(lon_lat_h))])
    return GroundPoints(names, lon_lat_h, np.tile(sigma_m, (len(lon_lat_h), 1)))


def places(count: int, margin_px: int = 60, height_m: float = 120.0) -> Array:
    """Places on the land, on a regular grid that the image shows with their chips."""
    side = np.linspace(margin_px, SIDE - 1 - margin_px, count)
    line_sample = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    return ortho(land()).model.locate(line_sample, np.full(len(line_sample), height_m))


@cache
def view(seed: int = 3) -> SimulatedView:
    """A steep view, off by two metres."""
    of_world = plan("steep", incidence_deg=28.0, azimuth_deg=70.0)
    return simulate_view(world(), of_world, np.random.default_rng(seed), (1.6, -1.2))


def off_m(found: KnownPoints) -> Array:
    """Points minus the ground in the middle of their chips (n, 3): east, north, up."""
    scene = view().as_scene(IMAGE_SIGMA_M)
    shown = true_ground(view(), world(), scene.model.project(found.points.lon_lat_h))
    return np.array(
        [
            east_north_up(point[None, :], content)[0]
            for point, content in zip(found.points.lon_lat_h, shown, strict=True)
        ]
    )


@cache
def with_wrong_heights() -> KnownPoints:
    side = np.linspace(90.0, SHAPE[0] - 91.0, 9)
    line_sample = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    true = true_ground(view(), world(), line_sample)
    wrong_m = SIGMA_UP_M * np.random.default_rng(5).standard_normal(len(true))
    file = ground(true + wrong_m[:, None] * [0.0, 0.0, 1.0], (0.01, 0.01, SIGMA_UP_M))
    options = KnownPointOptions(fine_gsd_m=1.0, coarse_gsd_m=4.0)
    return produce_known_points(file, [view().as_scene(IMAGE_SIGMA_M)], KNOWN_FRAME, options)


@pytest.mark.long
def test_the_error_of_a_height_acts_along_the_line_of_sight() -> None:
    found = with_wrong_heights()
    assert len(found.points) > 40
    error_m = off_m(found)
    error_m -= np.median(error_m, axis=0) * [1.0, 1.0, 0.0]
    covariance = found.points.covariance_m2
    # The horizontal errors follow those of the heights, as the covariance says ...
    slope = covariance[:, :2, 2] / covariance[:, 2, 2, None]
    rest_m = error_m[:, :2] - slope * error_m[:, 2:]
    rest_m -= np.median(rest_m, axis=0)
    horizontal_m = float(np.sqrt((error_m[:, :2] ** 2).sum(axis=1).mean()))
    left_m = float(np.sqrt(np.median((rest_m**2).sum(axis=1))))
    print(f"horizontal errors {horizontal_m:.2f} m, {left_m:.2f} m beyond those of the heights")
    assert horizontal_m > 1.5
    assert left_m < 0.3
    # ... and the stated sigmas are those of the errors.
    up = error_m[:, 2] / np.sqrt(covariance[:, 2, 2])
    assert 0.7 < np.sqrt((up**2).mean()) < 1.5


def test_the_frame_is_that_of_the_base_and_of_the_image() -> None:
    frame = with_wrong_heights().points.frames[0]
    assert frame.sigma_m == pytest.approx(np.hypot(0.4, IMAGE_SIGMA_M))
    assert frame.sigma_up_m == pytest.approx(0.7)
    unknown = produce_known_points(ground(places(4)), [ortho(land())], UNKNOWN_FRAME)
    assert np.isnan(unknown.points.frames[0].covariance_m2).all()


def test_sigmas_are_those_of_the_file_and_of_the_image() -> None:
    found = produce_known_points(ground(places(4), (2.0, 1.0, 5.0)), [ortho(land())], KNOWN_FRAME)
    sigma_m = np.sqrt(np.diagonal(found.points.covariance_m2, 0, 1, 2))
    np.testing.assert_allclose(sigma_m[:, 0], np.hypot(2.0, 3.0), rtol=1e-3)  # 0.3 px of 10 m
    np.testing.assert_allclose(sigma_m[:, 1], np.hypot(1.0, 3.0), rtol=1e-3)
    np.testing.assert_allclose(sigma_m[:, 2], 5.0)
    np.testing.assert_allclose(found.points.lon_lat_h, places(4)[found_rows(found)], atol=1e-12)


def found_rows(found: KnownPoints) -> list[int]:
    return [int(name[1:]) for name in found.source_id]


def test_every_point_that_is_left_out_is_counted_by_its_reason() -> None:
    pixels = land().copy()
    pixels[:130, :130] = 0.0  # flat
    image = as_pixels(pixels)
    image[-130:, -130:] = np.nan  # missing
    scene = named(ortho(land()), image, "torn")
    at = scene.model.locate
    cases = {
        NOT_SALIENT: at(np.array([[62.0, 62.0]]), np.zeros(1)),
        MISSING: at(np.array([[SIDE - 66.0, SIDE - 66.0]]), np.zeros(1)),
        OUTSIDE: at(np.array([[20.0, 400.0], [-500.0, 10.0]]), np.zeros(2)),
        NO_HEIGHT: at(np.array([[400.0, 400.0]]), np.full(1, np.nan)),
        SAME_PLACE: places(5)[12:13],
    }
    good = places(5, 200)
    cases[SAME_PLACE] = good[3:4]
    found = produce_known_points(ground(np.concatenate([good, *cases.values()])), [scene], UNKNOWN_FRAME)
    assert found.left_out == {reason: len(points) for reason, points in cases.items()}
    assert found.source_id.tolist() == [f"P{number}" for number in range(len(good))]


@pytest.mark.long
def test_a_displaced_scene_is_registered_on_the_points() -> None:
    found = produce_known_points(ground(places(8)), [ortho(land())], KNOWN_FRAME)
    scene = replace(ortho(moved(land(), *MOVED_PX)), sigma_m=30.0)
    chips = MemoryChips(np.concatenate([found.chips(row) for row in range(len(found.points))]))
    result = register_scene(scene, found.points, chips)
    middle = np.full((1, 2), (SIDE - 1) / 2.0)
    shift_px = (result.model.correction.apply(middle) - middle)[0]
    np.testing.assert_allclose(shift_px, MOVED_PX, atol=0.01)


@pytest.mark.long
def test_several_images_give_views_and_the_error_of_the_points() -> None:
    scenes = [date(0), date(1)]
    found = produce_known_points(ground(places(9), (0.01, 0.01, 1.0)), scenes, UNKNOWN_FRAME)
    sigma_m = np.sqrt(np.diagonal(found.points.covariance_m2, 0, 1, 2))[:, :2]
    normalised = errors_m(found, 0)[:, ::-1] / sigma_m  # type: ignore[arg-type]
    spread = float(np.sqrt((normalised**2).mean()))
    print(f"normalised errors {spread:.2f}, local sigma {found.local_sigma_m:.1f} m")
    assert 0.7 < spread < 1.5
    assert found.local_sigma_m == pytest.approx(LOCAL_PX * GSD_M, rel=0.35)
    assert set(found.left_out) <= {NOT_CONFIRMED}
    assert (np.diff(found.points.views.start) >= 2).all()


def halves() -> list[Scene]:
    """The land in two images that show no point in common."""
    west, east = as_pixels(land()), as_pixels(land())
    west[:, SIDE // 2 :] = np.nan
    east[:, : SIDE // 2] = np.nan
    return [named(ortho(land()), west, "west"), named(ortho(land()), east, "east")]


def test_images_without_common_points_keep_their_errors_in_the_points() -> None:
    found = produce_known_points(ground(places(8)), halves(), KNOWN_FRAME)
    assert found.points.frames[0].sigma_m == pytest.approx(0.4)
    sigma_m = np.sqrt(np.diagonal(found.points.covariance_m2, 0, 1, 2))
    np.testing.assert_allclose(sigma_m[:, 0], np.sqrt(0.5**2 + 3.0**2 + 15.0**2), rtol=1e-3)


def test_a_point_without_a_sigma_is_refused_with_the_way_to_state_it() -> None:
    file = ground(places(4))
    sigma_m = file.sigma_m.copy()
    sigma_m[5, 2] = np.nan
    with pytest.raises(InputError, match=r"1 of 16 points, such as P5, have no sigma up: .*--point"):
        produce_known_points(replace(file, sigma_m=sigma_m), [ortho(land())], UNKNOWN_FRAME)


def test_too_few_points_are_refused_with_the_counts() -> None:
    far = places(4)
    far[3:, 0] += 5.0
    with pytest.raises(NotEnoughPoints, match=r"3 usable .* of 16 points: 13 no image shows"):
        produce_known_points(ground(far), [ortho(land())], UNKNOWN_FRAME)


@pytest.mark.thorough
def test_points_stay_where_the_file_has_them_whatever_the_order_of_the_images() -> None:
    file = ground(places(6))
    for scenes in ([date(0, 0.0), date(1, 0.0)], [date(1, 0.0), date(0, 0.0)]):
        found = produce_known_points(file, scenes, UNKNOWN_FRAME)
        np.testing.assert_array_equal(found.points.lon_lat_h, file.lon_lat_h[found_rows(found)])
        assert found.gsds_m == (10.0, 40.0)
