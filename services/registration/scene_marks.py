"""Ground points that a person marked in a scene: alone, or in addition to the points of a search."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.registration.search import Search, adjust_search
from amers.services.statements import Statements
from amers.services.types import (
    UNKNOWN_FRAME,
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    Frame,
    IntArray,
    Measures,
    SurfaceHeights,
    Views,
)


@dataclass(frozen=True)
class SceneMarks:
    """n points of known ground that a person marked in the image of a scene.

    Attributes:
        names: of the marks.
        lon_lat_h: (n, 3).
        line_sample: (n, 2).
        sigma_m: (n, 3) of the ground: east, north, up.
        sigma_px: (n,) of the picks, each coordinate.
        frame: error on the Earth that all of them share.
        statements: of their files.
        number: (n,) int64, identities of the marks as control points, below 0, where several scenes show
            the same ground; None for -1, -2 and so on.
    """

    names: tuple[str, ...]
    lon_lat_h: Array
    line_sample: Array
    sigma_m: Array
    sigma_px: Array
    frame: Frame
    statements: Statements = ()
    number: IntArray | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def covariance_m2(self) -> Array:
        """(n, 3, 3) of the ground: east, north, up."""
        return np.asarray(self.sigma_m[:, None, :] ** 2 * np.eye(3))

    @property
    def numbers(self) -> IntArray:
        """Identities (n,) of the marks as control points, which no base has."""
        return -np.arange(1, len(self) + 1) if self.number is None else self.number

    def take(self, rows: IntArray | BoolArray) -> "SceneMarks":
        """Some of the marks."""
        columns = {
            name: getattr(self, name)[rows]
            for name in ("lon_lat_h", "line_sample", "sigma_m", "sigma_px")
        }
        names = tuple(np.array(self.names, dtype=np.str_)[rows].tolist())
        return replace(self, names=names, number=self.numbers[rows], **columns)

    @property
    def points(self) -> ControlPoints:
        """The marks as control points without chips."""
        n, none = len(self), np.zeros(0)
        no_rows = none.astype(np.int64)
        zeros = np.zeros(n, dtype=np.int64)
        return ControlPoints(
            id=self.numbers,
            lon_lat_h=self.lon_lat_h,
            covariance_m2=self.covariance_m2,
            block=zeros,
            frames=(self.frame,),
            saliency=np.ones(n),
            health=np.ones(n),
            views=Views(np.zeros(n + 1, dtype=np.int64), none, no_rows, none, none, none, ()),
            chip_file=zeros,
            chip_row=zeros,
            chip_files=(),
        )


NO_MARKS = SceneMarks(
    (), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), UNKNOWN_FRAME
)


class NoChips:
    """The chips of marks: there are none."""

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """No chips (0, 101, 101)."""
        return np.zeros((0, 101, 101), dtype=np.uint16)


def without_marks(measures: Measures) -> Measures:
    """The measures of a registration but for those of marks."""
    return measures.take(measures.point_id >= 0)


def with_marks(points: ControlPoints, marks: SceneMarks) -> ControlPoints:
    """Control points, and behind them marks as points of a block of their own, without views."""
    added = marks.points
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(points, name), getattr(added, name)])
        for name in ("id", "lon_lat_h", "covariance_m2", "saliency", "health", "chip_file", "chip_row")
    }
    surface = points.surface
    if surface is not None:
        unknown = np.full(len(marks), np.nan)
        surface = SurfaceHeights(
            np.concatenate([surface.height_m, unknown]), np.concatenate([surface.sigma_m, unknown])
        )
    start = np.concatenate([points.views.start, np.full(len(marks), points.views.start[-1])])
    return replace(
        points,
        **columns,
        block=np.concatenate([points.block, np.full(len(marks), len(points.frames))]),
        frames=(*points.frames, marks.frame),
        views=replace(points.views, start=start),
        surface=surface,
    )


def adjust_with_marks(
    scene: Scene,
    points: ControlPoints,
    search: Search,
    marks: SceneMarks,
    options: AdjustmentOptions,
) -> tuple[ControlPoints, Search, SceneAdjustment]:
    """The points of a registration with marks behind them, the last search with these, its adjustment.

    Args:
        scene: as delivered.
        points: all points that the scene may show.
        search: the last one.
        marks: in the scene.
        options: of the adjustment.
    """
    search = searched_with_marks(search, len(points), marks)
    adjustment = adjust_search(scene, search, options, ground_may_move=True)
    return with_marks(points, marks), search, adjustment


def searched_with_marks(search: Search, count: int, marks: SceneMarks) -> Search:
    """A search with marks as points that were found; they stand behind all `count` points."""
    n, matches = len(marks), search.matches
    matches = replace(
        matches,
        line_sample=np.concatenate([matches.line_sample, marks.line_sample]),
        displacement_m=np.concatenate([matches.displacement_m, np.full((n, 2), np.nan)]),
        sigma_px=np.concatenate([matches.sigma_px, marks.sigma_px]),
        score=np.concatenate([matches.score, np.full(n, np.nan)]),
        views=np.concatenate([matches.views, np.zeros(n, dtype=np.int64)]),
        reason=np.concatenate([matches.reason, np.full(n, "")]),
        by_gradient=np.concatenate([matches.by_gradient, np.zeros(n, dtype=np.bool_)]),
    )
    return replace(
        search,
        points=with_marks(search.points, marks),
        rows=np.concatenate([search.rows, count + np.arange(n)]),
        matches=matches,
        inliers=np.concatenate([search.inliers, np.ones(n, dtype=np.bool_)]),
    )
