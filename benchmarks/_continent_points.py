"""Where the content of the chips of a block truly lies, and the true errors of its points.

A point is what its chips show in their centres. Each chip is searched in the image that it was cut from,
which gives a true line of sight, whatever the block says of its models. The height where the lines of
sight show the same content is found by matching the same images rendered without noise, clouds and
season, under one sun and with true models: the surface below the centre would not do, as a chip is found
where the whole of it agrees.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from functools import cached_property

import numpy as np

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import metres_per_degree_at, move_metres, sun_direction
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource, render_chip
from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.matching.multi_image import refine_on_chips
from amers.services.quality.accuracy import accuracy, normalised_error
from amers.services.quality.normal_law import LINEAR_LE90, normal_ce90
from amers.services.simulation.archive import ArchiveView
from amers.services.simulation.render import Radiometry
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewGeometry
from amers.services.simulation.world import World, part_of_world
from amers.services.types import (
    Array,
    ChipArray,
    ChipSource,
    ControlPoints,
    Frame,
    IntArray,
    Observations,
)
from benchmarks._continent import Continent

_CELL_M = 1_500.0
_MARGIN_M = 700.0
_SEARCH_PX = 16
_SAME_PIXELS = CorrelationOptions(min_score=0.9, max_second=0.97, max_sigma_px=2.0)
_SILENT = Radiometry(noise_floor=0.0, noise_per_signal=0.0)
_OUTLIER = 5.0


@dataclass(frozen=True)
class TruePlaces:
    """Where the content of the chips of n points truly lies.

    Attributes:
        lon_lat_h: (n, 3) mean of the views; NaN where chips or height were not found.
        apart_m: (n,) horizontal root mean square of the views' places about their mean.
    """

    lon_lat_h: Array
    apart_m: Array


@dataclass(frozen=True)
class PointVerdict:
    """True errors of points against what their block declares; metres.

    Attributes:
        points, judged: of the block, and those whose true place is known.
        ce90_m, le90_m: true, on the Earth.
        declared_ce90_m, declared_le90_m: on the Earth, median of the points.
        relative_ce90_m, relative_le90_m: true, without the error of the frame.
        declared_relative_ce90_m, declared_relative_le90_m: median of the points.
        frame_error_m: (3,) east, north, up, common to all points.
        frame_normalised: mean square of it over the declared frame; NaN where that is unknown.
        normalised, relative_normalised: mean square of the errors over what is declared.
        views_apart_m: median distance between what the views of a point show.
    """

    points: int
    judged: int
    ce90_m: float
    le90_m: float
    declared_ce90_m: float
    declared_le90_m: float
    relative_ce90_m: float
    relative_le90_m: float
    declared_relative_ce90_m: float
    declared_relative_le90_m: float
    frame_error_m: tuple[float, float, float]
    frame_normalised: float
    normalised: float
    relative_normalised: float
    views_apart_m: float


def judge_points(points: ControlPoints, places: TruePlaces) -> PointVerdict:
    """The true errors of the points of one block against what it declares."""
    error_m = errors_m(points, places)
    known = np.isfinite(error_m).all(axis=1)
    error_m, own = error_m[known], points.covariance_m2[known]
    frame = points.frames[0]
    common_m = common_error_m(error_m, own, frame)
    on_earth, relative = accuracy(error_m), accuracy(error_m - common_m)
    declared = own + frame.covariance_m2
    return PointVerdict(
        points=len(points),
        judged=int(known.sum()),
        ce90_m=on_earth.ce90_m.value,
        le90_m=_le90_m(error_m),
        declared_ce90_m=float(np.median(normal_ce90(declared[:, :2, :2]))),
        declared_le90_m=_declared_le90_m(declared),
        relative_ce90_m=relative.ce90_m.value,
        relative_le90_m=_le90_m(error_m - common_m),
        declared_relative_ce90_m=float(np.median(normal_ce90(own[:, :2, :2]))),
        declared_relative_le90_m=_declared_le90_m(own),
        frame_error_m=(float(common_m[0]), float(common_m[1]), float(common_m[2])),
        frame_normalised=normalised_error(common_m[None, :], frame.covariance_m2[None]).mean_square,
        normalised=normalised_error(error_m, declared).mean_square,
        relative_normalised=normalised_error(error_m - common_m, own).mean_square,
        views_apart_m=float(np.nanmedian(places.apart_m)),
    )


def errors_m(points: ControlPoints, places: TruePlaces) -> Array:
    """Errors (n, 3) east, north, up of points against their true places, metres; NaN where unknown."""
    per_degree = metres_per_degree_at(points.lon_lat_h)
    difference = points.lon_lat_h - places.lon_lat_h
    return np.column_stack([difference[:, :2] * per_degree, difference[:, 2]])


def common_error_m(error_m: Array, covariance_m2: Array, frame: Frame) -> Array:
    """The error (3,) that all points share, most likely by their covariances and that of their frame.

    Points that lie far from the others are left out.
    """
    from_median = np.abs(error_m - np.median(error_m, axis=0))
    spread = 1.4826 * np.median(from_median, axis=0) + 1e-6
    near = (from_median < _OUTLIER * spread).all(axis=1)
    weight = np.linalg.inv(covariance_m2[near])
    normal, right = weight.sum(axis=0), (weight @ error_m[near][:, :, None]).sum(axis=0)[:, 0]
    if np.isfinite(frame.covariance_m2).all():
        normal = normal + np.linalg.pinv(frame.covariance_m2)
    return np.asarray(np.linalg.solve(normal, right))


def true_places(
    continent: Continent,
    points: ControlPoints,
    chips: ChipSource,
    rows: IntArray | None = None,
    say: Callable[[str], object] = lambda words: None,
) -> TruePlaces:
    """Where the content of the finest chips of points truly lies.

    Args:
        continent: what the images show.
        points: of a block whose images are of the continent.
        chips: of the points.
        rows: of the points that are looked at; by default all.
        say: receives what is done.
    """
    rows = np.arange(len(points)) if rows is None else rows
    found = TruePlaces(np.full((len(points), 3), np.nan), np.full(len(points), np.nan))
    block = _Block(continent, points, chips)
    cells = _cells(points, rows)
    for number, cell in enumerate(cells):
        _look_at(block, cell, found)
        say(f"true places: {number + 1} of {len(cells)} parts")
    return found


@dataclass(frozen=True)
class _Block:
    """A block of a continent, and the truth about its images."""

    continent: Continent
    points: ControlPoints
    chips: ChipSource

    @cached_property
    def day(self) -> date:
        """The middle day of its images."""
        taken = [image.acquired_at for image in self.points.views.images]
        days = sorted(moment.date() for moment in taken if moment is not None)
        return days[len(days) // 2]

    @cached_property
    def world(self) -> World:
        """The world on that day."""
        return self.continent.world_on(self.day)

    @cached_property
    def geometries(self) -> list[ViewGeometry]:
        """The geometries of its images."""
        return [self.continent.geometry(view) for view in self._views]

    @cached_property
    def pixels(self) -> list[ImageSource]:
        """The pixels that chips were cut from: of files, or of the older images, which have none."""
        folder = self.continent.folder / "archive" / "images"
        paths = [folder / f"{view.name}.tif" for view in self._views]
        return [
            read_scene(path).image if path.exists() else self.continent.image(view)
            for path, view in zip(paths, self._views, strict=True)
        ]

    @property
    def _views(self) -> list[ArchiveView]:
        known = {**self.continent.older, **self.continent.views}
        return [known[image.image_id] for image in self.points.views.images]

    def sights(self, rows: IntArray) -> Observations:
        """Where in their images the finest chips of points truly lie; `point` counts the rows."""
        points, seen = self.points, []
        for number, row in enumerate(rows.tolist()):
            first, last = points.views.start[row : row + 2]
            gsd_m = float(points.views.gsd_m[first])
            count = int((points.views.gsd_m[first:last] == gsd_m).sum())
            file = points.chip_files[points.chip_file[row]]
            for k, chip in enumerate(self.chips.read(file, int(points.chip_row[row]), count)):
                image = int(points.views.image[first + k])
                position = self._found(chip, image, points.lon_lat_h[row], gsd_m)
                if position is not None:
                    seen.append((number, image, position))
        return Observations(
            np.array([number for number, _, _ in seen], dtype=np.int64),
            np.array([image for _, image, _ in seen], dtype=np.int64),
            np.array([position for _, _, position in seen]).reshape(-1, 2),
            np.ones(len(seen)),
        )

    def _found(self, stored: ChipArray, image: int, ground: Array, gsd_m: float) -> Array | None:
        """Position (2,) of the centre of a chip in its image; None where it is not found."""
        model = self.geometries[image].true_model
        chip = np.where(stored == 0, np.nan, stored).astype(np.float32)
        patch = render_chip(self.pixels[image], model, ground, gsd_m, len(chip) + 2 * _SEARCH_PX)
        peak = find_chip(patch, chip, _SAME_PIXELS)
        if peak.reason != FOUND:
            return None
        moved_m = np.array([[peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m, 0.0]])
        return model.project(move_metres(ground[None, :], moved_m))[0]


def _look_at(block: _Block, rows: IntArray, found: TruePlaces) -> None:
    """Fill in the true places of neighbouring points."""
    observed = block.sights(rows)
    models = [geometry.true_model for geometry in block.geometries]
    start = intersect(models, observed, len(rows)).lon_lat_h
    usable = np.flatnonzero(np.isfinite(start).all(axis=1))
    if len(usable) == 0:
        return
    part = part_of_world(block.world, start[usable, :2], _MARGIN_M)
    scenes = [
        _under_one_sun(part, block.geometries[image], block.day) for image in np.unique(observed.image)
    ]
    gsd_m = float(block.points.views.gsd_m.min())
    measured = refine_on_chips(scenes, start[usable], gsd_m).observations
    heights_m = intersect([scene.model for scene in scenes], measured, len(usable)).lon_lat_h[:, 2]
    for number, height_m in zip(usable.tolist(), heights_m.tolist(), strict=True):
        if math.isnan(height_m):
            continue
        mine = observed.take(observed.point == number)
        places = np.concatenate(
            [
                models[image].locate(position[None, :], np.array([height_m]))
                for image, position in zip(mine.image.tolist(), mine.line_sample, strict=True)
            ]
        )
        found.lon_lat_h[rows[number]] = places.mean(axis=0)
        apart_m = (places - places.mean(axis=0))[:, :2] * metres_per_degree_at(places)
        found.apart_m[rows[number]] = np.sqrt((apart_m**2).sum(axis=1).mean())


def _under_one_sun(part: World, geometry: ViewGeometry, day: date) -> Scene:
    """What an image would show on a day at noon, without noise, with its true model."""
    noon = datetime.combine(day, datetime.min.time(), geometry.plan.acquired_at.tzinfo)
    noon += timedelta(hours=11)
    sun = sun_direction(part.centre_lon_lat, noon)
    acquisition = replace(geometry.acquisition, sun_elevation_deg=sun[0], sun_azimuth_deg=sun[1])
    plan = replace(geometry.plan, acquired_at=noon, radiometry=_SILENT)
    same = replace(geometry, plan=plan, acquisition=acquisition)
    return Scene(TiledView(part, same, 0), geometry.true_model, acquisition, 0.0)


def _cells(points: ControlPoints, rows: IntArray) -> list[IntArray]:
    """The rows in groups of neighbours."""
    per_degree = metres_per_degree_at(points.lon_lat_h[rows[:1]])[0]
    cell = np.floor(points.lon_lat_h[rows, :2] * per_degree / _CELL_M).astype(np.int64)
    group = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    return [rows[group == number] for number in range(int(group.max()) + 1)]


def _le90_m(error_m: Array) -> float:
    le90_m = accuracy(error_m).le90_m
    return math.nan if le90_m is None else le90_m.value


def _declared_le90_m(covariance_m2: Array) -> float:
    return float(np.median(LINEAR_LE90 * np.sqrt(covariance_m2[:, 2, 2])))
