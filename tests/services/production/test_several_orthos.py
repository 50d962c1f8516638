"""Several ortho-images of one place: the views of one point, and the errors that they show."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely
from scipy.ndimage import map_coordinates

from amers.services.errors import InputError, NotEnoughPoints
from amers.services.geodesy import east_north_up, ecef_from_lon_lat_h
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.joined_points import TilePoints, joined_points, still_found
from amers.services.production.ortho_production import (
    OrthoPointOptions,
    OrthoPoints,
    produce_ortho_points,
    shifts_of_scenes,
)
from amers.services.registration.on_points import register_scene
from amers.services.types import Array, Frame
from tests.services.production.test_ortho_production import FLAT, GSD_M, SIDE, chips_of, land, ortho
from tests.services.textures import as_pixels, texture

pytestmark = [pytest.mark.long, pytest.mark.thorough]

OPTIONS = OrthoPointOptions(points=100)
LOCAL_PX = 0.8
"""Standard deviation of the position of a detail relative to the rest of its image."""
SHIFTS_PX = np.array([[0.0, 0.0], [1.3, -2.6], [-0.7, 0.4]])
a_tenth_of_a_pixel = 0.1


def local_errors(seed: int) -> Array:
    """Smooth displacements (2, SIDE, SIDE) of the lines and samples of an image, pixels."""
    rng = np.random.default_rng(seed)
    return LOCAL_PX * np.stack([texture(rng, SIDE, 40.0) for _ in range(2)])


def date(number: int, local: float = 1.0, noise: float = 0.05, shift_px: Array | None = None) -> Scene:
    """An image of the land with its own shift, local errors, noise and contrast."""
    shift = SHIFTS_PX[number % 3] if shift_px is None else shift_px
    off = local * local_errors(100 + number) + shift[:, None, None]
    place = np.stack(np.mgrid[:SIDE, :SIDE]) - off
    shown = map_coordinates(land(), place, order=3, mode="grid-wrap")
    rng = np.random.default_rng(200 + number)
    pixels = as_pixels((0.7 + 0.2 * number % 0.5) * shown + noise * rng.standard_normal(shown.shape))
    return named(ortho(np.zeros((SIDE, SIDE))), pixels, f"date-{number}")


def named(scene: Scene, pixels: np.ndarray, name: str) -> Scene:
    taken = replace(scene.acquisition, image_id=name)
    return replace(scene, image=ArrayImage(pixels), acquisition=taken, sigma_m=15.0)


@cache
def made(count: int = 2, first: int = 0) -> OrthoPoints:
    return produce_ortho_points([date(first + k) for k in range(count)], FLAT, OPTIONS)


def errors_m(found: OrthoPoints, number: int) -> Array:
    """Errors (n, 2) north, east of the points, relative to the frame of their image."""
    at = ortho(land()).model.project(found.points.lon_lat_h)
    off = np.stack([map_coordinates(axis, at.T, order=1) for axis in local_errors(100 + number)], axis=1)
    return (off - off.mean(axis=0)) * GSD_M * [-1.0, 1.0]


@pytest.mark.parametrize("count", [2, 3])
def test_the_disagreement_of_the_images_is_the_error_of_the_points(count: int) -> None:
    normalised, stated_m = [], []
    for first in (0, 3, 6):
        found = made(count, first)
        sigma_m = np.sqrt(np.diagonal(found.points.covariance_m2, 0, 1, 2))[:, :2]
        normalised.append((errors_m(found, first)[:, ::-1] / sigma_m).ravel())
        stated_m.append(found.local_sigma_m)
    spread = float(np.sqrt((np.concatenate(normalised) ** 2).mean()))
    print(f"{count} images: normalised errors {spread:.2f}, local sigmas {np.round(stated_m, 1)} m")
    assert 0.7 < spread < 1.5
    np.testing.assert_allclose(stated_m, LOCAL_PX * GSD_M, rtol=0.35)


def test_images_that_agree_do_not_make_points_better_than_one_image_is_taken_for() -> None:
    found = produce_ortho_points([date(0, 0.0), date(1, 0.0)], FLAT, OPTIONS)
    sigma_m = np.sqrt(np.diagonal(found.points.covariance_m2, 0, 1, 2))[:, :2]
    np.testing.assert_allclose(sigma_m, 0.3 * GSD_M, rtol=1e-3)
    assert found.local_sigma_m < 0.1 * GSD_M


def test_every_image_is_brought_onto_the_first_one() -> None:
    found = produce_ortho_points([date(k, 0.0) for k in range(3)], FLAT, OPTIONS)
    expected_m = (SHIFTS_PX - SHIFTS_PX[0])[:, ::-1] * [GSD_M, -GSD_M]
    np.testing.assert_allclose(found.shift_m, expected_m, atol=a_tenth_of_a_pixel * GSD_M)
    # Their chips show the same detail, whatever the shift of the image.
    n_views = np.diff(found.points.views.start)
    assert (n_views >= 3).mean() > 0.9
    for row in np.flatnonzero(n_views >= 3)[:10]:
        chips = found.chips(row)[:3].astype(np.float64)
        alike = np.corrcoef([chip[5:-5, 5:-5].ravel() for chip in chips])
        assert alike.min() > 0.97


def test_images_that_disagree_by_more_than_they_state_raise_the_sigma_of_the_frame() -> None:
    agreeing = made().points.frames[0]
    assert agreeing.sigma_m == pytest.approx(
        15.0 * max(1.0, made().shift_m[1] @ made().shift_m[1] / 900) ** 0.5
    )
    far = date(1, 0.0, shift_px=np.array([0.0, 9.0]))
    found = produce_ortho_points([date(0, 0.0), far], FLAT, OPTIONS)
    assert np.linalg.norm(found.shift_m[1]) == pytest.approx(90.0, abs=1.0)
    # 90 m between two images that err alike: 90 / sqrt(2) of each, and again a coordinate.
    assert found.points.frames[0].sigma_m == pytest.approx(45.0, rel=0.02)


def clouded() -> Scene:
    scene = date(1, 0.0)
    pixels = np.array(scene.image.pixels)  # type: ignore[attr-defined]
    cloud = texture(np.random.default_rng(9), SIDE, 12.0)
    pixels[:, : SIDE // 2] = as_pixels(cloud)[:, : SIDE // 2]
    return replace(scene, image=ArrayImage(pixels))


def test_points_under_a_cloud_of_another_date_are_kept_only_on_request() -> None:
    scenes = [date(0, 0.0), clouded()]
    found = produce_ortho_points(scenes, FLAT, OPTIONS)
    seen = ortho(land()).model.project(found.points.lon_lat_h)
    assert seen[:, 1].min() > SIDE / 2 - 20
    every = produce_ortho_points(scenes, FLAT, replace(OPTIONS, min_views=1))
    assert len(every.points) > 1.5 * len(found.points)


def test_a_third_date_is_registered_on_points_of_two() -> None:
    scene = replace(date(2, 0.0), sigma_m=30.0)
    found = produce_ortho_points([date(0, 0.0), date(1, 0.0)], FLAT, OPTIONS)
    result = register_scene(scene, found.points, chips_of(found))
    middle = np.full((1, 2), (SIDE - 1) / 2.0)
    shift_px = (result.model.correction.apply(middle) - middle)[0]
    np.testing.assert_allclose(shift_px, SHIFTS_PX[2] - SHIFTS_PX[0], atol=a_tenth_of_a_pixel)


def test_an_image_of_other_ground_is_refused_by_name() -> None:
    other = as_pixels(texture(np.random.default_rng(77), SIDE, 1.5))
    strange = named(ortho(land()), other, "elsewhere")
    with pytest.raises(NotEnoughPoints, match=r"lie in elsewhere, and \d+ of them agree.*--sigma-m"):
        produce_ortho_points([date(0), strange], FLAT, OPTIONS)


def test_two_images_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match="must have different names, found date-0, date-0"):
        produce_ortho_points([date(0), date(0)], FLAT, OPTIONS)


def other_land() -> Scene:
    rng = np.random.default_rng(9)
    return named(ortho(np.zeros((SIDE, SIDE))), as_pixels(texture(rng, SIDE, 3.0)), "elsewhere")


def test_an_image_in_which_nothing_is_found_stops_the_work_or_gives_no_views() -> None:
    scenes = [date(0), other_land(), date(1)]
    with pytest.raises((NotEnoughPoints, InputError), match="elsewhere"):
        produce_ortho_points(scenes, FLAT, OPTIONS)
    met: list[Exception] = []
    found = produce_ortho_points(scenes, FLAT, OPTIONS, not_found=met.append)
    assert met
    assert all("elsewhere" in str(error) for error in met)
    assert set(found.points.views.image.tolist()) == {0, 2}
    np.testing.assert_array_equal(found.shift_m[2], made().shift_m[1])
    shift_m = shifts_of_scenes(scenes, FLAT, OPTIONS)
    np.testing.assert_array_equal(np.isfinite(shift_m[:, 0]), [True, False, True])
    np.testing.assert_allclose(shift_m[2], made().shift_m[1], atol=a_tenth_of_a_pixel * GSD_M)


def test_only_squares_that_need_a_point_are_searched() -> None:
    everywhere = made().points.lon_lat_h
    middle = np.median(everywhere[:, 0])
    west = produce_ortho_points(
        [date(0), date(1)], FLAT, OPTIONS, wanted=lambda lon_lat: lon_lat[:, 0] < middle
    )
    assert 0.4 < len(west.points) / len(everywhere) < 0.6
    step_deg = np.ptp(everywhere[:, 0]) / 10.0
    assert west.points.lon_lat_h[:, 0].max() < middle + step_deg


def test_points_of_two_productions_are_joined_far_from_each_other_in_one_frame() -> None:
    first, second = made(), made(2, 1)
    whole = shapely.box(*np.concatenate([first.outline.min(axis=0), first.outline.max(axis=0)]))
    rows = [np.arange(len(one.points)) for one in (first, second)]
    move_m = np.array([30.0, -20.0])
    tiles = [
        TilePoints(first, rows[0], whole.buffer(0.01), move_m),
        TilePoints(second, rows[1], whole.buffer(0.01), move_m),
    ]
    frame = Frame.from_sigmas(4.0, 2.0)
    points, chips = joined_points(tiles, FLAT, frame, 20.0 * GSD_M)
    assert points.frames == (frame,)
    n = len(first.points)
    assert len(points) > n
    moved_m = east_north_up(points.lon_lat_h[:1], first.points.lon_lat_h[0])[0, :2]
    np.testing.assert_allclose(moved_m, move_m, atol=0.1)
    ecef = ecef_from_lon_lat_h(points.lon_lat_h)
    apart_m = np.linalg.norm(ecef[n:, None] - ecef[None, :n], axis=2).min(axis=1)
    assert apart_m.min() >= 20.0 * GSD_M
    names = [image.image_id for image in points.views.images]
    assert len(set(names)) == len(names) == 3, "the date that both have is one image"
    np.testing.assert_array_equal(chips(0), first.chips(0))
    views = points.views
    assert len(chips(len(points) - 1)) == views.start[-1] - views.start[-2]


def test_a_point_that_two_latest_images_contradict_has_vanished() -> None:
    found = made()
    latest = [other_land(), replace(other_land(), acquisition=replace(date(5).acquisition))]
    assert len(still_found(found, latest[:1])) == len(found.points), "one may be a cloud's shadow"
    assert len(still_found(found, latest)) == 0
    assert len(still_found(found, [*latest, date(1)])) == len(found.points), "one of them shows it"
