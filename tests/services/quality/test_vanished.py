"""Points that have vanished are told from those that a cloud, a season or bad luck has hidden."""

import numpy as np
import pytest

from amers.services.geodesy import lon_lat_h_from_east_north_up
from amers.services.quality.vanished import FALSE_SHARE, Searches, VanishedPoints, vanished_points
from amers.services.types import Array, BoolArray

ORIGIN = np.array([179.999, 43.2, 100.0])
"""The points lie on both sides of the antimeridian."""
SIDE_M = 10_000.0


def ground(rng: np.random.Generator, count: int) -> Array:
    enu = np.column_stack([rng.uniform(0.0, SIDE_M, (count, 2)), np.zeros(count)])
    lon_lat_h = lon_lat_h_from_east_north_up(enu, ORIGIN)
    lon_lat_h[:, 0] = (lon_lat_h[:, 0] + 180.0) % 360.0 - 180.0
    return lon_lat_h


def searched(found: BoolArray, days: list[str]) -> Searches:
    """Every scene searches every point; (scenes, points) found."""
    scene, point = np.indices(found.shape)
    dates = np.array(days, dtype="datetime64[D]")
    return Searches(scene.ravel(), point.ravel(), found.ravel(), dates)


def monthly(count: int) -> list[str]:
    return (np.datetime64("2021-01-15") + 91 * np.arange(count)).astype(str).tolist()


def by_point(vanished: VanishedPoints) -> set[int]:
    return set(vanished.point.tolist())


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_points_that_no_later_scene_finds_have_vanished(rng: np.random.Generator) -> None:
    found = rng.random((12, 300)) < 0.85
    found[5:, :6] = False
    found[4, :6] = True
    vanished = vanished_points(ground(rng, 300), searched(found, monthly(12)))
    assert set(range(6)) <= by_point(vanished)
    rows = [vanished.point.tolist().index(point) for point in range(6)]
    assert (vanished.missed[rows] == 7).all()
    assert (vanished.last_found[rows] == np.datetime64(monthly(12)[4])).all()
    assert (vanished.probability[rows] < 1e-3).all()


@pytest.mark.parametrize("first", [False, True])
def test_of_two_scenes_of_one_day_that_which_finds_a_point_counts_as_the_last(
    rng: np.random.Generator, first: bool
) -> None:
    found = rng.random((12, 300)) < 0.95
    found[4:, 7] = False
    found[4 if first else 5, 7] = True
    days = monthly(12)
    days[5] = days[4]
    vanished = vanished_points(ground(rng, 300), searched(found, days))
    assert vanished.missed[vanished.point == 7].tolist() == [6]


def test_a_point_that_no_scene_has_ever_found_is_one_of_them(rng: np.random.Generator) -> None:
    found = rng.random((8, 200)) < 0.9
    found[:, 3] = False
    vanished = vanished_points(ground(rng, 200), searched(found, monthly(8)))
    assert 3 in by_point(vanished)
    assert np.isnat(vanished.last_found[vanished.point == 3]).all()


@pytest.mark.long
def test_at_most_one_in_twenty_is_still_there(rng: np.random.Generator) -> None:
    """Points differ in how often they are found, which their history before has shown."""
    wrong, called = 0, 0
    for _ in range(40):
        own = rng.beta(12.0, 1.5, 400)
        found = rng.random((16, 400)) < own
        found[9:, :20] = False
        vanished = by_point(vanished_points(ground(rng, 400), searched(found, monthly(16))))
        wrong += len(vanished - set(range(20)))
        called += len(vanished)
    assert called > 0.9 * 40 * 20
    assert wrong <= FALSE_SHARE * called


def test_a_cloud_that_nobody_has_masked_hides_no_point_for_good(rng: np.random.Generator) -> None:
    lon_lat_h = ground(rng, 300)
    found = rng.random((8, 300)) < 0.95
    under_cloud = lon_lat_h[:, 1] < np.quantile(lon_lat_h[:, 1], 0.3)
    found[4:][:, under_cloud] = False
    assert len(vanished_points(lon_lat_h, searched(found, monthly(8)))) == 0


def test_many_scenes_of_one_season_are_one_try(rng: np.random.Generator) -> None:
    winter = ["2023-01-02", "2023-01-09", "2023-01-20", "2023-02-03", "2023-02-17", "2023-03-08"]
    found = rng.random((10, 200)) < 0.95
    found[4:, 7] = False
    lon_lat_h = ground(rng, 200)
    assert 7 not in by_point(vanished_points(lon_lat_h, searched(found, monthly(4) + winter)))
    assert 7 in by_point(vanished_points(lon_lat_h, searched(found, monthly(10))))


def test_what_counts_is_when_scenes_were_taken(rng: np.random.Generator) -> None:
    """A scene of an archive that is registered last says nothing about today."""
    found = rng.random((10, 200)) < 0.95
    found[:5, 7] = False
    found[5:, 7] = True
    days = monthly(10)
    lon_lat_h = ground(rng, 200)
    assert 7 not in by_point(vanished_points(lon_lat_h, searched(found, days)))
    assert 7 in by_point(vanished_points(lon_lat_h, searched(found, days[5:] + days[:5])))


def test_a_point_that_was_always_hard_to_find_needs_more_scenes(rng: np.random.Generator) -> None:
    found = rng.random((24, 200)) < 0.95
    found[:, [1, 2]] = True
    found[:20:2, 1] = False
    found[20:, [1, 2]] = False
    vanished = by_point(vanished_points(ground(rng, 200), searched(found, monthly(24))))
    assert 2 in vanished
    assert 1 not in vanished


def test_the_probability_is_that_of_one_miss_a_quarter_beside_others(rng: np.random.Generator) -> None:
    """Of fifteen points, all others are neighbours; of the scenes of a quarter, the strongest counts."""
    before = ["2021-02-01", "2021-05-01", "2021-08-01", "2021-11-01"]
    quarter = ["01-10", "03-20"], ["04-10", "06-20"]
    since = [f"{year}-{day}" for year in (2022, 2023, 2024) for days in quarter for day in days]
    found = rng.random((16, 15)) < 0.8
    found[:, 0] = [True, False, False, True] + 12 * [False]
    vanished = vanished_points(ground(rng, 15), searched(found, before + since))
    share = (found[:, 1:].sum(axis=1) + 1.0) / (14 + 2.0)
    health = min((2.0 + 5.0) / (share[:4].sum() + 5.0), 1.0)
    missed = [1.0 - health * max(share[i], share[i + 1]) for i in range(4, 16, 2)]
    assert vanished.probability[vanished.point == 0] == pytest.approx([np.prod(missed)])


def test_without_searches_nothing_has_vanished() -> None:
    none = Searches(*(np.empty(0, np.int64),) * 2, np.empty(0, bool), np.empty(0, "datetime64[D]"))
    assert len(vanished_points(np.empty((0, 3)), none)) == 0
    assert len(vanished_points(ORIGIN[None, :], none)) == 0
    one = Searches(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1, bool), none.days)
    one = Searches(one.scene, one.point, one.found, np.array(["2024-01-01"], "datetime64[D]"))
    assert len(vanished_points(ORIGIN[None, :], one)) == 0
