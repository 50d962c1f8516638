"""Which pairs of images are matched: neighbours, across passes, and far fewer than all."""

import numpy as np
import pytest

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.production.image_pairs import PARTNERS, image_pairs
from amers.services.sensors.ortho import OrthoModel
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Acquisition, Array, BoolArray, IntArray

GSD_M = 10.0
SIDE = 100


ACROSS = "EPSG:3832"
"""A map of the Pacific, which goes on beyond the meridian of 180 degrees."""


def strip(number: int, east_m: float, north_m: float = 0.0, crs: str = "EPSG:32631") -> Scene:
    """An image of one square kilometre on the map."""
    west_m, top_m = (3_338_000.0, 100_000.0) if crs == ACROSS else (500_000.0, 4_800_000.0)
    grid = MapGrid(
        crs,
        np.array([west_m + east_m, top_m - north_m]),
        np.array([[0.0, GSD_M], [-GSD_M, 0.0]]),
        (SIDE, SIDE),
    )
    pixels = np.zeros((SIDE, SIDE), dtype=np.float32)
    return Scene(ArrayImage(pixels), OrthoModel(grid), Acquisition(f"image_{number}"), 5.0)


def row_of(count: int, step_m: float) -> list[Scene]:
    return [strip(i, i * step_m) for i in range(count)]


def connected(pairs: IntArray, count: int) -> bool:
    group = np.arange(count)
    for one, other in pairs.tolist():
        group[group == group[one]] = group[other]
    return len(np.unique(group)) == 1


@pytest.mark.parametrize("crs", ["EPSG:32631", ACROSS])
def test_images_without_common_ground_are_no_pair(crs: str) -> None:
    scenes = [strip(number, number * 600.0, crs=crs) for number in range(5)]
    lon = [scene.model.locate(np.zeros((1, 2)), np.zeros(1))[0, 0] for scene in scenes]
    assert (np.ptp(lon) > 180.0) == (crs == ACROSS)
    np.testing.assert_array_equal(image_pairs(scenes, []), [[0, 1], [1, 2], [2, 3], [3, 4]])


def test_few_images_are_all_matched_with_each_other() -> None:
    assert len(image_pairs(row_of(6, 50.0), [])) == 15


def test_many_images_of_one_place_have_a_bounded_number_of_partners() -> None:
    count = 60
    pairs = image_pairs(row_of(count, 5.0), [])
    assert len(pairs) <= count * PARTNERS
    assert connected(pairs, count)


def passes_of(count: int, per_pass: int) -> list[BoolArray]:
    of_pass = np.arange(count) // per_pass
    return [of_pass == number for number in range(count // per_pass)]


def test_every_pass_is_tied_to_the_others() -> None:
    """Twelve images each of four passes, which all see the same place."""
    scenes = [strip(i, 20.0 * (i % 12)) for i in range(48)]
    passes = passes_of(48, 12)
    pairs = image_pairs(scenes, passes)
    for one in range(4):
        for other in range(one + 1, 4):
            across = passes[one][pairs[:, 0]] & passes[other][pairs[:, 1]]
            assert across.sum() >= 12, (one, other)


@pytest.mark.parametrize("count", [2, 30])
def test_pairs_do_not_depend_on_the_order_of_the_images(count: int) -> None:
    scenes = row_of(count, 37.0)
    order = np.random.default_rng(0).permutation(count)
    here = {tuple(sorted(pair)) for pair in image_pairs(scenes, []).tolist()}
    shuffled = image_pairs([scenes[i] for i in order], [])
    assert {tuple(sorted((int(order[i]), int(order[j])))) for i, j in shuffled.tolist()} == here


def test_of_images_of_one_place_those_from_one_side_are_partners() -> None:
    """Ten look from the east, ten from the west; of one side, none shows the very same place."""
    blank = ArrayImage(np.zeros((SIDE, SIDE), dtype=np.float32))
    scenes = []
    for number in range(20):
        target = np.array([3.0 + 0.0003 * (number % 10), 43.3, 0.0])
        direction = (30.0, 90.0 if number < 10 else 270.0)
        model = pushbroom_over(target, (SIDE, SIDE), GSD_M, direction, (-10.0, 10.0))
        scenes.append(Scene(blank, model, Acquisition(f"image_{number}"), 5.0))
    pairs = image_pairs(scenes, [])
    assert (pairs // 10 == pairs[:, :1] // 10).all()
    assert len(pairs) >= 10 * PARTNERS


def pairs_one_by_one(places_m: Array, passes: list[BoolArray]) -> set[tuple[int, int]]:
    """The same choice, image by image: the best of every pass, then the second best, up to eight."""
    chosen = set()
    for one, place in enumerate(places_m):
        apart = np.abs(places_m - place) / (GSD_M * SIDE)
        share = np.prod(np.maximum(1.0 - apart, 0.0), axis=1)
        partners = [k for k in np.argsort(-share).tolist() if share[k] >= 0.02 and k != one]
        of_pass = {k: next((n for n, mask in enumerate(passes) if mask[k]), -1 - k) for k in partners}
        rounds = [sum(of_pass[j] == of_pass[k] for j in partners[:i]) for i, k in enumerate(partners)]
        best = sorted(range(len(partners)), key=lambda i: (rounds[i], i))[:PARTNERS]
        chosen |= {(min(one, partners[i]), max(one, partners[i])) for i in best}
    return chosen


@pytest.mark.parametrize("seed", range(6))
def test_partners_are_the_best_of_every_pass_in_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 26
    places_m = rng.uniform(0.0, 1_500.0, (count, 2))
    of_pass = rng.integers(-1, 4, count)
    passes = [of_pass == number for number in range(4)]
    pairs = image_pairs([strip(i, *place) for i, place in enumerate(places_m.tolist())], passes)
    assert set(map(tuple, pairs.tolist())) == pairs_one_by_one(places_m, passes)
