"""A renewed version of a block: which points stay, with their own kinds, and what its document says."""

from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from amers.app.db.renewal import StoredSearches
from amers.app.errors import ComputationError, Conflict, InputError
from amers.app.usecases.blocks import renewal, renewing_scenes
from amers.app.usecases.blocks.renewal import Base, next_version, renew_block, stage_renewal
from amers.app.usecases.blocks.renewing_scenes import GoodScene, SceneOnBlock, register_on_block
from amers.app.usecases.registration.register import SceneFiles
from amers.services.imagery.scene import Scene
from amers.services.production.renewed_views import RenewedViews, SeeingScene
from amers.services.quality.qualification import QualificationOptions
from amers.services.quality.vanished import Searches, VanishedPoints
from amers.services.registration.options import RegistrationOptions
from amers.services.types import Acquisition, no_progress
from tests.factories import control_points, metadata

COUNT = 9
VANISHED = (6, 2)
"""Rows of the points that are gone, the more certain one first."""
IDS = tuple(UUID(int=number) for number in (11, 12))
DAYS = (datetime(2025, 3, 4, 23, tzinfo=UTC), datetime(2026, 7, 8, 1, tzinfo=UTC))
SEARCHED = ((0, 1, 2, 4, 5, 6, 7), (1, 2, 3, 6, 8))
FOUND = ((1, 1, 1, 1, 0, 0, 1), (1, 0, 1, 0, 1))
SEEN = ([0, 1, 4, 7], [1, 3, 8])
"""Rows of the points that stay and that the scenes have found."""


def base() -> Base:
    points = control_points(COUNT, np.random.default_rng(3))
    return Base(
        block=SimpleNamespace(id="valley", version="3", number=17),  # type: ignore[arg-type]
        version="4",
        metadata=metadata("valley", "3"),
        points=replace(points, id=points.id + 100),
        suspended=np.array([104, 209]),
        typology=tuple(f"kind {row}" for row in range(COUNT)),
    )


def scenes() -> list[SceneOnBlock]:
    return [
        SceneOnBlock(
            name=f"scene {number}",
            registration=IDS[number],
            scene=SimpleNamespace(acquisition=SimpleNamespace(image_id=f"image {number}")),  # type: ignore[arg-type]
            taken_at=DAYS[number],
            searched=np.array(SEARCHED[number]),
            found=np.array(FOUND[number], dtype=np.bool_),
        )
        for number in range(2)
    ]


class Renewal:
    """A renewal of which the science and the store are given.

    Attributes:
        searches: from which the vanished points were told.
        seeing: the scenes that give views, with the rows of the kept points that they saw.
        written: what the new folder was written from.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.base, self.searches, self.groups = base(), Searches(*[np.empty(0)] * 4), list[Any]()
        self.seeing: Sequence[SeeingScene] = ()
        self.short, self.gained = 0, (np.array([0, 2]), np.array([2]))
        self.written: tuple[Any, ...] = ()
        self.named: dict[str, Any] = {}
        stored = Searches(
            np.array([0, 1, 1]),
            np.array([6, 2, 6]),
            np.array([True, True, False]),
            np.array(["2024-01-01", "2024-06-01"], dtype="datetime64[D]"),
        )
        for name, fake in {
            "open_chips": lambda *_: SimpleNamespace(close=lambda: None),
            "register_on_block": lambda *_: scenes(),
            "renewal.find_searches": self.find_searches(stored),
            "vanished_points": self.vanished_points,
            "with_new_views": self.with_new_views,
            "short_ground": lambda *_: SimpleNamespace(spacing_m=1500.0),
            "shown_twice": lambda *_: self.short,
            "overlapping_scenes": lambda _: self.groups,
            "points_where_short": self.points_where_short,
            "with_new_points": lambda renewed, _: renewed,
            "write_block": self.write_block,
        }.items():
            monkeypatch.setattr(f"{renewal.__name__}.{name}", fake)

    def find_searches(self, stored: Searches) -> Any:
        def find(_: object, block: str, left_out: list[UUID]) -> object:
            assert (block, left_out) == ("valley", list(IDS))
            return SimpleNamespace(of_points=lambda _: stored)

        return find

    def vanished_points(self, lon_lat_h: Any, searches: Searches) -> VanishedPoints:
        np.testing.assert_array_equal(lon_lat_h, self.base.points.lon_lat_h)
        self.searches = searches
        last = np.array(["NaT", "2024-06-01"], dtype="datetime64[D]")
        return VanishedPoints(np.array(VANISHED), np.array([5, 3]), last, np.array([0.00012345, 0.0456]))

    def with_new_views(self, points: Any, _: object, seeing: Sequence[SeeingScene]) -> RenewedViews:
        self.seeing = seeing
        views = points.views
        more = replace(views, start=views.start + np.arange(len(points) + 1), gsd_m=np.zeros(7 * 7))
        return RenewedViews(replace(points, views=more), lambda _: np.zeros(0), self.gained)

    def points_where_short(self, group: Any, points: Any, ground: Any, views: int, _: object) -> Any:
        assert (len(points), ground.spacing_m, views) == (7, 1500.0, 2)
        if len(group) > 1:
            raise ComputationError("too few")
        number = int(group[0].acquisition.image_id[-1])
        return SimpleNamespace(points=[0] * (2 + number))

    def write_block(self, *given: Any, **named: Any) -> None:
        self.written, self.named = given, named

    def run(self, folder: Path) -> dict[str, Any]:
        database: Any = SimpleNamespace(reading=nullcontext)
        storage: Any = None
        given: list[Any] = [SimpleNamespace(registration=one) for one in IDS]
        return renew_block(database, storage, self.base, given, folder)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Renewal:
    return Renewal(monkeypatch)


def test_points_that_vanished_leave_and_the_others_keep_their_kinds(
    made: Renewal, tmp_path: Path
) -> None:
    made.run(tmp_path)
    folder, document, points, _, models = made.written
    kept = [row for row in range(COUNT) if row not in VANISHED]
    assert (folder, models) == (tmp_path, {})
    assert points.id.tolist() == [100 + row for row in kept]
    assert made.named["typology"] == [f"kind {row}" for row in kept]
    assert (document.id, document.version, document.frame) == ("valley", "4", base().metadata.frame)
    assert document.provenance.sources == ("valley@3", "image 0", "image 1")


def test_a_scene_gives_views_to_those_of_the_kept_points_that_it_found(
    made: Renewal, tmp_path: Path
) -> None:
    made.run(tmp_path)
    kept = np.delete(np.arange(COUNT), VANISHED)
    for scene, rows, number in zip(made.seeing, SEEN, range(2), strict=True):
        assert scene.scene.acquisition.image_id == f"image {number}"
        found = np.array(SEARCHED[number])[np.array(FOUND[number]) > 0]
        assert kept[scene.seen].tolist() == [row for row in found.tolist() if row not in VANISHED]
        assert kept[scene.seen].tolist() == rows


def test_the_searches_of_the_renewal_follow_those_of_the_store(made: Renewal, tmp_path: Path) -> None:
    made.run(tmp_path)
    found = made.searches
    assert found.days.astype(str).tolist() == ["2024-01-01", "2024-06-01", "2025-03-04", "2026-07-08"]
    rows = list(zip(found.scene.tolist(), found.point.tolist(), found.found.tolist(), strict=True))
    assert rows[:3] == [(0, 6, True), (1, 2, True), (1, 6, False)]
    assert rows[3:] == [
        (2 + number, point, bool(is_found))
        for number in range(2)
        for point, is_found in zip(SEARCHED[number], FOUND[number], strict=True)
    ]


def test_the_document_tells_each_scene_and_each_vanished_point(made: Renewal, tmp_path: Path) -> None:
    document = made.run(tmp_path)
    assert document["renews"] == "valley@3"
    assert document["scenes"] == [
        {
            "name": f"scene {number}",
            "image": f"image {number}",
            "taken_at": DAYS[number].isoformat(),
            "registration": str(IDS[number]),
            "points_seen": sum(FOUND[number]),
            "points_with_new_views": (2, 1)[number],
        }
        for number in range(2)
    ]
    assert (document["new_views"], document["points_with_new_views"]) == (7, 2)
    assert document["suspended_points_left_out"] == [104, 209]
    assert document["proposed_withdrawals"] == [
        {
            "point": 100 + row,
            "lon_lat_h": made.base.points.lon_lat_h[row].tolist(),
            "scenes_that_missed_it": missed,
            "last_found": day,
            "probability_if_still_there": probability,
        }
        for row, missed, day, probability in zip(
            VANISHED, (5, 3), (None, "2024-06-01"), (0.00012, 0.046), strict=True
        )
    ]
    none = "none of the squares of 1,500 m without a point is shown by two scenes"
    assert (document["new_points"], document["new_points_note"]) == (0, none)


def test_of_several_groups_of_scenes_one_without_points_is_told_and_the_others_count(
    made: Renewal, tmp_path: Path
) -> None:
    made.short = 5
    first, second = (one.scene for one in scenes())
    made.groups = [[first], [first, second], [second]]
    document = made.run(tmp_path)
    assert document["new_points"] == 5
    words = "5 of the squares of 1,500 m without a point are shown by two scenes"
    assert document["new_points_note"] == f"{words}; image 0, image 1 give no point: too few"
    assert made.named["typology"][-6:] == ["kind 8", *[None] * 5]


def test_a_scene_that_gives_no_view_and_a_block_without_points_are_refused(
    made: Renewal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made.gained = (np.array([0]), np.array([], dtype=np.int64))
    with pytest.raises(InputError, match=r"scene 1: gives no point a view"):
        made.run(tmp_path)
    none = VanishedPoints(np.arange(COUNT), *[np.zeros(COUNT)] * 3)
    monkeypatch.setattr(renewal, "vanished_points", lambda *_: none)
    with pytest.raises(InputError, match=f"block valley: all {COUNT} points have vanished"):
        made.run(tmp_path)
    assert made.written == ()


@pytest.mark.parametrize(
    ("existing", "given", "expected"),
    [
        (["3"], "", "4"),
        (["3", "10", "9", "draft"], "", "11"),
        (["3"], "autumn", "autumn"),
        (["3", "autumn"], "autumn", Conflict),
        (["3", "4"], "4", Conflict),
    ],
)
def test_the_next_version_is_the_next_whole_number_or_the_one_given(
    existing: list[str],
    given: str,
    expected: str | type[Exception],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = [SimpleNamespace(version=version) for version in existing]
    monkeypatch.setattr(renewal.blocks, "find_blocks", lambda *_: found)
    connection: Any = None
    if isinstance(expected, str):
        assert next_version(connection, base().block, given) == expected
        return
    with pytest.raises(expected):
        next_version(connection, base().block, given)


@pytest.mark.parametrize("states", [("published",), ("withdrawn", "published")])
def test_a_renewal_is_staged_with_the_priority_of_the_version_that_is_still_published(
    states: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = [
        SimpleNamespace(state=state, number=18 - len(states) + k, priority=5 + k)
        for k, state in enumerate(states)
    ]
    staged: list[tuple[Any, ...]] = []
    monkeypatch.setattr(renewal.blocks, "find_blocks", lambda *_: versions)
    monkeypatch.setattr(renewal.lifecycle, "ingest_block", lambda *given: staged.append(given))
    nothing: Any = None
    stage_renewal(nothing, nothing, base(), Path("new"), no_progress)
    assert staged == [(None, None, Path("new"), no_progress, 4 + len(states))]
    for other in (
        [SimpleNamespace(state="published", number=16, priority=0)],
        [SimpleNamespace(state="withdrawn", number=17, priority=0)],
    ):
        monkeypatch.setattr(renewal.blocks, "find_blocks", lambda *_, found=other: found)
        with pytest.raises(Conflict, match="valley@3 is no longer published"):
            stage_renewal(nothing, nothing, base(), Path("new"), no_progress)


@pytest.mark.parametrize("known_day", [True, False])
def test_a_scene_is_registered_on_all_points_whatever_was_asked_of_it_before(
    monkeypatch: pytest.MonkeyPatch, *, known_day: bool
) -> None:
    """Points that a cloud hides were not tried, nor those beyond the image."""
    asked: list[RegistrationOptions] = []
    points = replace(control_points(5, np.random.default_rng(2)), id=np.arange(5) * 10)

    def register(scene: Any, on: Any, _: object, options: Any, *, progress: Any) -> Any:
        assert on is points
        asked.append(options)
        number = int(scene.acquisition.image_id[-1])
        measures = SimpleNamespace(
            point_id=np.array([0, 20, 30, 40]),
            active=np.array([number == 0, False, True, True]),
            reason=np.array(["", "cloud", "", "nodata"]),
        )
        qualification = SimpleNamespace(verdict="good")
        return SimpleNamespace(
            measures=measures, qualification=qualification, model=f"model {number}", adjustment=number
        )

    def read(image: Path, *_: object, **__: object) -> Scene:
        acquired = DAYS[0] if known_day else None
        pixels: Any = SimpleNamespace(shape=(3, 4), close=lambda: None)
        model: Any = None
        return Scene(pixels, model, Acquisition(image.name, acquired_at=acquired), 1.0)

    monkeypatch.setattr(renewing_scenes, "read_scene", read)
    monkeypatch.setattr(renewing_scenes, "register_scene", register)
    monkeypatch.setattr(renewing_scenes, "registered_scene", lambda scene, *made: (scene, *made))
    before = RegistrationOptions(
        max_points=7, seed=5, qualification=QualificationOptions(max_ce90_on_earth_m=0.1)
    )
    given = [
        GoodScene(f"scene {k}", SceneFiles(Path(f"image {k}")), IDS[k], DAYS[1], before)
        for k in range(2)
    ]
    with ExitStack() as stack:
        found = register_on_block(points, None, given, stack, no_progress)  # type: ignore[arg-type]
        with pytest.raises(InputError, match="scene 1: the block has views of an image image 1 already"):
            register_on_block(points, None, [given[1]] * 2, stack, no_progress)  # type: ignore[arg-type]
    assert asked[:2] == [replace(before, max_points=0, qualification=QualificationOptions())] * 2
    for number, one in enumerate(found):
        assert (one.name, one.registration) == (f"scene {number}", IDS[number])
        assert one.taken_at == DAYS[0 if known_day else 1]
        assert one.scene[1:] == (f"model {number}", number)  # type: ignore[index]
        assert one.searched.tolist() == [0, 3]
        assert one.found.tolist() == [number == 0, True]


def test_searches_tell_of_the_points_at_exactly_their_places() -> None:
    """A point that an older version had elsewhere tells of none."""
    places = np.array([[5.0, 43.0, 100.0], [5.1, 43.0, 100.0], [5.0, 43.0, 101.0]])
    stored = StoredSearches(
        scene=np.array([0, 0, 1, 1]),
        lon_lat_h=places[[2, 0, 1, 0]],
        found=np.array([False, True, False, True]),
        days=np.array(["2024-04-10", "2024-07-20"], dtype="datetime64[D]"),
    )
    own = stored.of_points(places[:2])
    assert (own.scene.tolist(), own.point.tolist()) == ([0, 1, 1], [0, 1, 0])
    assert own.found.tolist() == [True, False, True]
    assert own.days is stored.days
