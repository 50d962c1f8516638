"""A block of a continent judged: its density on textured ground, and later images registered on it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely

from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import metres_per_degree, move_metres
from amers.services.matching.predict import in_image
from amers.services.quality.density import density_cells, share_reaching
from amers.services.registration.options import RegistrationOptions
from amers.services.simulation.archive import ArchiveView
from amers.services.simulation.conditions import clouds_over
from amers.services.simulation.detectors import PERFECT
from amers.services.simulation.distortion import Distortion
from amers.services.simulation.land import WATER
from amers.services.simulation.world import World
from amers.services.types import Array, BoolArray, ChipSource, ControlPoints
from benchmarks._continent import Continent
from benchmarks._outcome import Outcome, registered
from benchmarks._point_errors import BlockErrors
from benchmarks._scenes import Prepared

CORRECT_M = 3.0
"""Largest horizontal error of a measure that shows its point."""
_CLEAR_OPACITY = 0.2
_CHIP_REACH_M = 100.0
POINTS_PER_KM2 = 0.5
_PATCH_M = 100.0
_LEAST_CONTRAST = 0.08
_LEAST_TEXTURED = 0.5
OPTIONS = RegistrationOptions(max_points=0)


@dataclass(frozen=True)
class LaterScene:
    """A later image registered on a block of n points.

    Attributes:
        name: of the image.
        outcome: of the registration, against the truth.
        shown: (n,) whether the image shows the point, whole and without clouds.
        found: (n,) whether it was matched where it truly is.
    """

    name: str
    outcome: Outcome
    shown: BoolArray
    found: BoolArray


def register_later(
    continent: Continent,
    points: ControlPoints,
    chips: ChipSource,
    true_lon_lat_h: Array,
    frame_error_m: Array,
    *,
    say: Callable[[str], object] = lambda words: None,
) -> list[LaterScene]:
    """The later images of a continent, each registered on a block.

    Args:
        continent: with its later images.
        points, chips: of the block.
        true_lon_lat_h: (n, 3) of the points; where NaN, the error of the frame stands in.
        frame_error_m: (3,) east, north, up, of the block.
        say: receives every outcome.
    """
    true = np.where(
        np.isfinite(true_lon_lat_h),
        true_lon_lat_h,
        move_metres(points.lon_lat_h, np.tile(-frame_error_m, (len(points), 1))),
    )
    results = []
    for name, view in continent.later.items():
        scene = read_scene(continent.folder / "later" / f"{name}.tif")
        prepared = Prepared(
            scene,
            points,
            continent.world_of(view),
            continent.geometry(view),
            PERFECT,
            _only_frame(frame_error_m),
            Distortion(scene.image.shape),
        )
        outcome, registration = registered(prepared, chips, OPTIONS)
        line_sample = prepared.geometry.true_model.project(true)
        found = np.zeros(len(points), dtype=bool)
        if registration is not None:
            measures = registration.measures
            rows = np.searchsorted(points.id, measures.point_id)
            off_px = np.linalg.norm(measures.line_sample - line_sample[rows], axis=1)
            found[rows] = measures.matched & (off_px * view.plan.gsd_m < CORRECT_M)
        results.append(LaterScene(name, outcome, _shown(view, line_sample), found))
        say(f"{name}: {outcome.verdict} {outcome.reason}")
    return results


def never_found(scenes: list[LaterScene]) -> float:
    """Share of the points that no image matches, of those that one image shows or more."""
    shown = np.any([scene.shown for scene in scenes], axis=0)
    found = np.any([scene.found for scene in scenes], axis=0)
    return float((shown & ~found).sum() / max(1, shown.sum()))


def _shown(view: ArchiveView, line_sample: Array) -> BoolArray:
    """Which points (n,) an image shows whole and without clouds."""
    reach_px = _CHIP_REACH_M / view.plan.gsd_m
    inside = in_image(line_sample, view.plan.shape, -reach_px - max(view.border_px))
    rng = np.random.default_rng([view.seed, 0])
    clouds = clouds_over(view.plan.shape, view.conditions.cloud_cover, rng)
    if clouds is None:
        return np.asarray(inside)
    clear = inside.copy()
    for row in np.flatnonzero(inside):
        around = np.linspace(-reach_px, reach_px, 9)
        line, sample = line_sample[row]
        clear[row] = clouds.opacity(line + around, sample + around).max() < _CLEAR_OPACITY
    return np.asarray(clear)


def _only_frame(frame_error_m: Array) -> BlockErrors:
    """A block that is off by its frame and not distorted."""
    return BlockErrors(frame_error_m[None, :], np.zeros((2, 3)), np.array([1.0, 0.0]), np.zeros(2), 1.0)


@dataclass(frozen=True)
class DensityVerdict:
    """How densely a block covers the area of an archive.

    Attributes:
        points_per_km2: in the area.
        cells: number of cells of 2 km2 that are textured.
        reached: share of them with a point or more.
        degree_cells_reached: share of the cells of 0.1 degree, by area, with a point for 2 km2 or more.
    """

    points_per_km2: float
    cells: int
    reached: float
    degree_cells_reached: float


def judge_density(continent: Continent, points: ControlPoints) -> DensityVerdict:
    """The density of a block in the area of the archive."""
    lon_lat = points.lon_lat_h[:, :2]
    area = np.array(shapely.get_coordinates(continent.area)[:-1])
    inside = shapely.contains_xy(continent.area, lon_lat)
    side_m = 1_000.0 / np.sqrt(POINTS_PER_KM2)
    count, corner = counts(continent, lon_lat[inside], side_m)
    textured = textured_cells(continent.world, corner, side_m)
    cells = density_cells(lon_lat[inside], area)
    return DensityVerdict(
        points_per_km2=float(inside.sum() / (continent.size.area_m * 1e-3) ** 2),
        cells=int(textured.sum()),
        reached=float((count[textured] > 0).mean()),
        degree_cells_reached=share_reaching(cells, POINTS_PER_KM2),
    )


def counts(continent: Continent, lon_lat: Array, side_m: float) -> tuple[Array, Array]:
    """Numbers of points in the whole cells of an area, and their south-west corners (k, 2), degrees."""
    west_south = np.array(continent.area.bounds[:2])
    side = side_m / np.array(metres_per_degree(float(west_south[1]), 300.0))
    n = int(continent.size.area_m / side_m)
    cell = np.floor((lon_lat - west_south) / side).astype(np.int64)
    whole = ((cell >= 0) & (cell < n)).all(axis=1)
    count = np.bincount(cell[whole, 0] * n + cell[whole, 1], minlength=n * n)
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2)
    return count, west_south + grid * side


def textured_cells(world: World, corner: Array, side_m: float) -> BoolArray:
    """Which cells (k,) have texture in half of their patches of 100 m or more."""
    patch = round(_PATCH_M / world.posting_m)
    n = int(side_m / world.posting_m) // patch
    out = np.empty(len(corner), dtype=bool)
    rows, columns = world.albedo.shape
    for number, (column, row) in enumerate(np.rint(world.column_row(corner)).astype(int)):
        cells = np.ix_(
            np.arange(row - n * patch, row) % rows, np.arange(column, column + n * patch) % columns
        )
        albedo = world.albedo[cells].reshape(n, patch, n, patch)
        dry = (world.parcel[cells] != WATER).reshape(n, patch, n, patch).mean(axis=(1, 3)) > 0.5
        contrast = albedo.std(axis=(1, 3)) / albedo.mean(axis=(1, 3))
        out[number] = (dry & (contrast > _LEAST_CONTRAST)).mean() >= _LEAST_TEXTURED
    return out
