"""How far images of one place disagree, against what they state, and which points they confirm."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.production import view_agreement
from amers.services.production.view_agreement import AgreedViews, agreed_views
from amers.services.types import Acquisition, Array, Observations
from tests.services.conftest import FlatModel
from tests.services.production.displaced_details import GSD_M, TILE_PX, drawn_details, map_moved

BLANK = ArrayImage(np.zeros((10, 10), dtype=np.float32))


def agreed(sigmas_m: tuple[float, ...], shift_m: Array) -> AgreedViews:
    """Images that state these sigmas and lie off by these shifts; of five points they show some."""
    scenes = [Scene(BLANK, FlatModel(), Acquisition("image"), sigma_m) for sigma_m in sigmas_m]
    point, image = np.array([0, 0, 0, 1, 1, 2, 4]), np.array([0, 1, 2, 0, 1, 1, 2])
    views = Observations(point, image, np.zeros((7, 2)), np.full(7, np.nan))
    tied = np.ones(len(scenes), dtype=bool)
    reference, shown_by = np.array([0, 0, 1, -1, 2]), np.array([3, 3, 3, 0, 1])
    return AgreedViews(scenes, views, reference, shown_by, shift_m, tied, np.nan)


def test_images_that_are_off_as_they_state_disagree_as_stated() -> None:
    """The first image is off as well: shifts are those of both. Drawn a hundred times as large."""
    rng, sigmas_m = np.random.default_rng(3), (2.0, 6.0)
    off_m = rng.normal(size=(4000, 2, 2)) * np.array(sigmas_m)[:, None]
    shifts_m = 100.0 * (off_m[:, 1] - off_m[:, 0])
    ratios = [agreed(sigmas_m, np.stack([np.zeros(2), one])).disagreement for one in shifts_m]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(100.0, rel=0.03)


def test_the_image_that_disagrees_most_counts_and_agreement_makes_nothing_better() -> None:
    shift_m = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, -40.0]])
    assert agreed((2.0, 2.0, 2.0), shift_m).disagreement == pytest.approx(10.0)
    assert agreed((2.0, 2.0, 2.0), shift_m / 100.0).disagreement == 1.0


def test_points_are_confirmed_by_enough_images_or_by_all_that_show_them() -> None:
    views = agreed((2.0, 2.0, 2.0), np.zeros((3, 2)))
    np.testing.assert_array_equal(views.confirmed(3), [True, False, False, False, True])
    np.testing.assert_array_equal(views.confirmed(2), [True, True, False, False, True])
    np.testing.assert_array_equal(views.confirmed(1, 0.5), [True, True, False, False, True])
    np.testing.assert_array_equal(views.confirmed(1, 1.0), [True, False, False, False, True])
    taken = views.take(np.array([1, 4]))
    np.testing.assert_array_equal(taken.point, [0, 0, 1])
    np.testing.assert_array_equal(taken.image, [0, 1, 2])
    assert replace(views, reference=np.full(5, -1)).confirmed(1).sum() == 0


DETAILS = 6
LOCAL_M = 2.0
LAY_OFF_M = np.array([[0.0, 0.0], [6.0, -9.0], [-12.0, 20.0]])


def test_images_are_brought_onto_the_first_of_them_and_are_as_wrong_as_they_were_drawn() -> None:
    """Two images disagree by the errors of both."""
    rng, details = np.random.default_rng(7), drawn_details(DETAILS)
    off_m = rng.normal(0.0, LOCAL_M, (3, DETAILS**2, 2)) + LAY_OFF_M[:, None]
    images = [details.scene(f"image {k}", off_m[k], 20.0) for k in range(3)]
    views = agreed_views(images, details.lon_lat_h, GSD_M)
    assert views.local_sigma_m == pytest.approx(LOCAL_M, rel=0.25)
    expected_m = np.median(off_m - off_m[0], axis=1)
    np.testing.assert_allclose(views.shift_m, expected_m, atol=0.5 * LOCAL_M)
    for k, scene in enumerate(views.scenes):
        shown = scene.model.project(details.lon_lat_h) - details.model.project(details.lon_lat_h)
        seen_m = (shown * [-GSD_M, GSD_M])[:, ::-1]
        np.testing.assert_allclose(seen_m, np.tile(views.shift_m[k], (DETAILS**2, 1)), atol=0.02)
    assert views.tied.all()


def test_details_far_from_where_the_others_lie_are_no_views_of_their_points() -> None:
    """Four of 36 are off by 10 m; they neither move the image nor make its details worse."""
    details = drawn_details(DETAILS)
    off_m = np.zeros((2, DETAILS**2, 2))
    off_m[1] = np.random.default_rng(3).normal(0.0, 0.3, (DETAILS**2, 2))
    wrong = np.array([3, 14, 22, 30])
    off_m[1, wrong] = [6.0, -8.0]
    images = [details.scene(f"image {k}", off_m[k], 5.0) for k in range(2)]
    views = agreed_views(images, details.lon_lat_h, GSD_M)
    found_in_both = np.bincount(views.views.point, minlength=DETAILS**2) == 2
    assert not found_in_both[wrong].any()
    assert found_in_both.sum() > 0.9 * (DETAILS**2 - 4)
    assert not views.confirmed(2)[wrong].any()
    assert np.abs(views.shift_m).max() < 0.3
    assert views.local_sigma_m == pytest.approx(0.3 / np.sqrt(2.0), rel=0.35)


def test_an_image_is_searched_as_far_as_both_are_off() -> None:
    """Within three standard deviations of 45 and of 30 m together, and no farther."""
    details, still = drawn_details(DETAILS), np.zeros((DETAILS**2, 2))

    images = [details.scene("first", still, 45.0), details.scene("second", still, 30.0)]

    def shift_m(off_m: float) -> Array:
        images[1] = replace(images[1], model=map_moved(details.model, np.array([off_m, 0.0])))
        return agreed_views(images, details.lon_lat_h, GSD_M).shift_m[1]

    np.testing.assert_allclose(shift_m(156.0), [156.0, 0.0], atol=0.2)
    with pytest.raises(NotEnoughPoints, match="lies farther off than its accuracy states"):
        shift_m(250.0)


def part(scene: Scene, rows: int) -> Scene:
    """A scene of some rows of details."""
    pixels = scene.image.read(Window(0, 0, rows * TILE_PX, DETAILS * TILE_PX))
    return replace(scene, image=ArrayImage(pixels))


def test_each_image_counts_by_its_details() -> None:
    """The one that shows a third of them is much worse."""
    details, rng = drawn_details(DETAILS), np.random.default_rng(8)
    off_m = rng.normal(0.0, 1.0, (3, DETAILS**2, 2)) * np.array([0.0, 0.6, 3.0])[:, None, None]
    images = [details.scene(f"image {k}", off_m[k], 20.0) for k in range(3)]
    images[2] = part(images[2], 2)
    views = agreed_views(images, details.lon_lat_h, GSD_M)
    count = np.bincount(views.views.image)
    assert count[1] > 30
    assert 8 <= count[2] <= 12
    expected_m = np.sqrt((count[1:] * [0.6**2, 3.0**2] / 2.0).sum() / count[1:].sum())
    assert views.local_sigma_m == pytest.approx(expected_m, rel=0.15)


def test_few_details_show_no_shift_and_no_errors() -> None:
    """Five lie in another image, which stays where it is; sixteen that are found tell no sigma."""
    details = drawn_details(4)
    images = [details.scene(f"image {k}", np.full((16, 2), 4.0 * k), 20.0) for k in range(2)]
    few = agreed_views(images, details.lon_lat_h[:5], GSD_M)
    np.testing.assert_array_equal(few.tied, [True, False])
    assert not few.shift_m.any()
    assert not few.views.image.any()
    more = agreed_views(images, details.lon_lat_h, GSD_M)
    np.testing.assert_allclose(more.shift_m[1], 4.0, atol=0.1)
    assert np.isnan(more.local_sigma_m)


def test_an_image_that_misses_a_quarter_of_a_chip_does_not_show_its_point() -> None:
    """Another one, that shows it, defines its detail."""
    details, still = drawn_details(3), np.zeros((9, 2))
    images = [details.scene(f"image {k}", still, 5.0) for k in range(2)]
    pixels = images[0].image.read(Window(0, 0, *details.shape))
    pixels[TILE_PX : TILE_PX + 40, TILE_PX : 2 * TILE_PX] = np.nan
    images[0] = replace(images[0], image=ArrayImage(pixels))
    views = agreed_views(images, details.lon_lat_h, GSD_M)
    np.testing.assert_array_equal(views.reference, np.where(np.arange(9) == 4, 1, 0))
    np.testing.assert_array_equal(views.shown_by, np.where(np.arange(9) == 4, 1, 2))


def test_ground_beside_all_images_has_no_reference_and_no_views() -> None:
    details, still = drawn_details(3), np.zeros((9, 2))
    images = [details.scene(f"image {k}", still, 5.0) for k in range(2)]
    far = details.lon_lat_h[:2] + [0.5, 0.0, 0.0]
    views = agreed_views(images, np.concatenate([far[:1], details.lon_lat_h, far[1:]]), GSD_M)
    np.testing.assert_array_equal(views.reference, [-1, *[0] * 9, -1])
    np.testing.assert_array_equal(views.shown_by, [0, *[2] * 9, 0])
    assert set(views.views.point.tolist()) == set(range(1, 10))
    assert not views.confirmed(1)[[0, -1]].any()


def test_tasks_of_any_number_of_points_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of a task are numbered from its first point: those after it are of others."""
    details, rng = drawn_details(DETAILS), np.random.default_rng(5)
    off_m = rng.normal(0.0, 1.0, (2, DETAILS**2, 2))
    images = [details.scene(f"image {k}", off_m[k], 5.0) for k in range(2)]
    whole = agreed_views(images, details.lon_lat_h, GSD_M)
    monkeypatch.setattr(view_agreement, "_OF_TASK", 7)
    parts = agreed_views(images, details.lon_lat_h, GSD_M)
    for name in ("point", "image", "line_sample"):
        np.testing.assert_array_equal(getattr(parts.views, name), getattr(whole.views, name))
    np.testing.assert_array_equal(parts.shift_m, whole.shift_m)
    assert parts.local_sigma_m == whole.local_sigma_m
