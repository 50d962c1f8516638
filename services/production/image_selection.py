"""Image selection: the fewest recent, clear and varied images that show all ground often enough.

The input is what a catalogue states, no pixels. Ground is divided into cells; an image sees a cell
clearly when the cell's centre lies inside its footprint and outside of its mask. Every cell needs
`min_views` clear views by images below the first cloud limit. Where the catalogue has fewer, the next
limit applies, and so on: a cloudier image counts only there, and only outside of its mask.
`amers.services.production.multi_cover` solves the problem that results, and bounds it.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import shapely

from amers.services.errors import CoverageError, InputError
from amers.services.imagery.catalogue import ImageCatalogue, Shapes
from amers.services.production.ground_cells import (
    EARTH_RADIUS_M,
    GroundGrid,
    SeenCells,
    ground_grid,
    seen_cells,
)
from amers.services.production.multi_cover import (
    Classes,
    Counts,
    CoverProblem,
    LowerBound,
    greedy_cover,
    lower_bound,
    without_excess,
)
from amers.services.types import Array, BoolArray, IntArray, Progress, no_progress

CELLS_ACROSS = 12.0
"""Cells along the side of a square footprint of median area."""
NEAR_VERTICAL_DEG = 10.0
"""Images of a smaller incidence are views from above, whatever their azimuth."""
MOST_VIEWS = 200_000_000
"""Cells of all footprints together; the selection needs about 60 bytes for each."""
UNUSABLE = -1
_BOUND_STEPS = 3000
_LEAST_WEIGHT = 0.1
"""Added to the prices of cells, in mean prices: cells without a price count too."""
_AGE_PENALTY = 0.03
"""Per year before the newest image."""
_CLOUD_PENALTY = 0.5
"""Per unit of cloud cover; 100 percent are 1."""
_YEAR = np.timedelta64(365 * 24 + 6, "h")
_SAME_INSTANT = np.timedelta64(1000, "ms")
_SAME_GROUND = 0.9


@dataclass(frozen=True)
class SelectionOptions:
    """What is asked of a selection of images.

    Attributes:
        min_views: number of clear views that every place needs.
        cloud_limits_percent: cloud cover that images stay below: everywhere the first, where views are
            missing one after the other of the rest.
        max_snow_percent: largest snow cover of an image; images of unknown snow cover are taken.
        variety: what a view from a new season or direction is worth beyond another view.
        cell_m: side of a cell of the ground, metres; None: a twelfth of a footprint.
    """

    min_views: int = 6
    cloud_limits_percent: tuple[float, ...] = (15.0, 25.0, 40.0, 60.0, 80.0)
    max_snow_percent: float = 1.0
    variety: float = 0.1
    cell_m: float | None = None


@dataclass(frozen=True)
class ImageUse:
    """Numbers of images by what a selection makes of them; each image counts once, but for the last two.

    Attributes:
        catalogue: all images.
        duplicates: the same platform, second and ground as another image.
        snow: with more snow than allowed.
        cloud_unknown: neither cloud cover nor mask.
        too_cloudy: not below the last cloud limit.
        without_mask: not below the first cloud limit, and without a mask.
        usable: the rest.
        snow_unknown: of the usable ones, those that are taken as free of snow because nothing is stated.
        selected: chosen images.
    """

    catalogue: int
    duplicates: int
    snow: int
    cloud_unknown: int
    too_cloudy: int
    without_mask: int
    usable: int
    snow_unknown: int
    selected: int


@dataclass(frozen=True)
class CellViews:
    """The views of every cell of the ground.

    Attributes:
        grid: of the cells.
        cell: (c,) int64, numbers in the grid, rising.
        step: (c,) int64, position in `cloud_limits_percent` of the limit that holds in the cell.
        available: (c,) clear views that the usable images below this limit have.
        views: (c,) clear views that the chosen ones among them have; at least the smaller of `available`
            and `min_views`.
        seasons: (c,) of four that these views are from.
        directions: (c,) of five that these views are from: above, north, east, south, west.
    """

    grid: GroundGrid
    cell: IntArray
    step: IntArray
    available: Counts
    views: Counts
    seasons: IntArray
    directions: IntArray


@dataclass(frozen=True)
class ImageSelection:
    """The chosen images of a catalogue, and what they reach.

    Attributes:
        options: of the selection.
        image: (k,) int64, rows of the catalogue, rising.
        step: (k,) int64, position in `cloud_limits_percent` of the limit that the image needs.
        cells: views of the ground.
        bound: number of images that no selection falls below that gives the cells as many views.
        use: of the images.
    """

    options: SelectionOptions
    image: IntArray
    step: IntArray
    cells: CellViews
    bound: LowerBound
    use: ImageUse

    @property
    def above_bound(self) -> float:
        """Number of chosen images above the lower bound, as a share of the bound."""
        return len(self.image) / float(np.ceil(self.bound.images - 1e-6)) - 1.0

    @property
    def missing(self) -> IntArray:
        """(c,) views that each cell stays short of `min_views`."""
        return np.maximum(0, self.options.min_views - self.cells.views.astype(np.int64))


def select_images(
    catalogue: ImageCatalogue,
    options: SelectionOptions = SelectionOptions(),
    area: shapely.Geometry | None = None,
    progress: Progress = no_progress,
) -> ImageSelection:
    """The fewest recent, clear and varied images that show all ground often enough.

    Args:
        catalogue: of the images.
        options: what is asked.
        area: polygons on the ground that need views; None: where the catalogue has footprints.
        progress: receives the fraction done and a message.

    Raises:
        CoverageError: no footprint lies in the area, or no cell's centre in a footprint.
        InputError: the cells are too small for so much ground.
    """
    catalogue = with_cloud_from_masks(catalogue)
    duplicate = duplicates(catalogue)
    step = image_steps(catalogue, options)
    step[duplicate] = UNUSABLE
    progress(0.0, "ground in footprints")
    cell_m = options.cell_m or default_cell_m(catalogue)
    _refuse_small_cells(catalogue, cell_m)
    grid = ground_grid(cell_m)
    seen = seen_cells(catalogue.footprint, catalogue.mask, grid)
    cell = np.unique(seen.cell)
    if area is not None:
        inside = seen_cells(np.array([area], dtype=object), np.array([None], dtype=object), grid).cell
        if not np.isin(inside, cell, assume_unique=True).any():
            raise CoverageError(
                f"none of the {len(inside)} cells of the area lies in one of the {len(catalogue)} "
                "footprints; give an area that the catalogue covers"
            )
        cell = inside
    if not len(cell):
        raise CoverageError(
            f"no cell of {grid.row_deg:.3g} degrees has its centre in one of {len(catalogue)} "
            "footprints; state smaller cells (--cell-km)"
        )
    problem, cell_step, available = _cover_problem(catalogue, options, step, seen, cell)
    progress(0.2, "first selection")
    first = greedy_cover(problem, np.ones(len(cell)), options.variety)
    progress(0.25, "lower bound")
    bound = lower_bound(problem, int(first.sum()), _BOUND_STEPS)
    progress(0.9, "selection")
    weight = bound.price + _LEAST_WEIGHT * max(float(bound.price.mean()), 1e-12)
    order = np.lexsort((problem.preference, -step))
    covers = [
        without_excess(problem, cover, order)
        for cover in (greedy_cover(problem, weight, options.variety), first)
    ]
    chosen = min(covers, key=lambda cover: int(cover.sum()))
    seasons, directions = (count_classes(problem, chosen, way) for way in range(2))
    cells = CellViews(grid, cell, cell_step, available, problem.covers(chosen), seasons, directions)
    image = np.flatnonzero(chosen)
    use = _use(catalogue, options, step, duplicate, len(image))
    return ImageSelection(options, image, step[image], cells, bound, use)


def default_cell_m(catalogue: ImageCatalogue) -> float:
    """Side of a cell, metres: a twelfth of the side of a square of the footprints' median area."""
    return float(np.sqrt(np.median(_area_m2(catalogue)))) / CELLS_ACROSS


def _area_m2(catalogue: ImageCatalogue) -> Array:
    """Area (n,) of the footprints, to a few percent."""
    bounds = shapely.bounds(catalogue.footprint)
    latitude = np.radians((bounds[:, 1] + bounds[:, 3]) / 2.0)
    radian = EARTH_RADIUS_M * np.radians(1.0)
    return np.asarray(radian**2 * shapely.area(catalogue.footprint) * np.cos(latitude))


def _refuse_small_cells(catalogue: ImageCatalogue, cell_m: float) -> None:
    views = float(_area_m2(catalogue).sum()) / cell_m**2
    if views > MOST_VIEWS:
        raise InputError(
            f"cells of {cell_m / 1000.0:.3g} km make {views:,.0f} views of {len(catalogue)} images, "
            f"{MOST_VIEWS:,} at most expected; state larger cells (--cell-km)"
        )


def image_steps(catalogue: ImageCatalogue, options: SelectionOptions) -> IntArray:
    """Position (n,) in the cloud limits of the first that an image stays below; -1 when unusable.

    Images of unknown cloud cover are not used, and those without a mask only below the first limit.
    """
    cloud = catalogue.cloud_percent
    limits = options.cloud_limits_percent
    step = np.searchsorted(limits, cloud, side="right").astype(np.int64)
    unusable = np.isnan(cloud) | (step == len(limits)) | ((step > 0) & ~catalogue.has_mask)
    step[unusable | (catalogue.snow_percent > options.max_snow_percent)] = UNUSABLE
    return step


def with_cloud_from_masks(catalogue: ImageCatalogue) -> ImageCatalogue:
    """The images with the share of the footprint that the mask hides, where no cloud cover is stated."""
    cloud = catalogue.cloud_percent.copy()
    for i in np.flatnonzero(np.isnan(cloud) & catalogue.has_mask):
        hidden = shapely.union_all(shapely.get_parts(catalogue.mask[i]))
        inside = shapely.intersection(catalogue.footprint[i], hidden)
        cloud[i] = 100.0 * shapely.area(inside) / shapely.area(catalogue.footprint[i])
    return replace(catalogue, cloud_percent=cloud)


def duplicates(catalogue: ImageCatalogue) -> BoolArray:
    """Whether (n,) an earlier image of the catalogue has the same platform, second and ground."""
    order = np.lexsort((np.arange(len(catalogue)), catalogue.acquired, catalogue.platform.astype(str)))
    duplicate = np.zeros(len(catalogue), dtype=np.bool_)
    begin = 0
    for end, i in enumerate(order):
        while (
            catalogue.platform[order[begin]] != catalogue.platform[i]
            or catalogue.acquired[i] - catalogue.acquired[order[begin]] > _SAME_INSTANT
        ):
            begin += 1
        for j in order[begin:end]:
            if catalogue.platform[i] and not duplicate[j] and _same_ground(catalogue.footprint, i, j):
                duplicate[max(i, j)] = True
    return duplicate


def _same_ground(footprint: Shapes, i: int, j: int) -> bool:
    shared = shapely.area(shapely.intersection(footprint[i], footprint[j]))
    return bool(shared > _SAME_GROUND * min(shapely.area(footprint[i]), shapely.area(footprint[j])))


def view_classes(catalogue: ImageCatalogue) -> Classes:
    """Season and direction (n, 2) of each image, one bit each; 0 where the angles are unknown.

    Seasons are those of the calendar: December to February and so on. Directions are above (incidence
    below 10 degrees) and the quarters of the compass from which the sensor looks.
    """
    month = catalogue.acquired.astype("datetime64[M]").astype(np.int64) % 12
    season = (month + 1) % 12 // 3
    azimuth = catalogue.azimuth_deg
    quarter = np.where(np.isnan(azimuth), 0.0, (azimuth + 45.0) % 360.0 // 90.0).astype(np.int64)
    above = catalogue.incidence_deg < NEAR_VERTICAL_DEG
    direction = np.where(above, 1, 2 << quarter)
    unknown = np.isnan(catalogue.incidence_deg) | (np.isnan(azimuth) & ~above)
    return np.column_stack([1 << season, np.where(unknown, 0, direction)]).astype(np.uint8)


def count_classes(problem: CoverProblem, chosen: BoolArray, way: int) -> IntArray:
    """Number of classes (c,) that the chosen images of every cell are of, in one way of variety."""
    owner = np.repeat(np.arange(len(chosen)), np.diff(problem.start))
    taken = chosen[owner]
    seen = np.zeros(len(problem.need), dtype=np.uint8)
    np.bitwise_or.at(seen, problem.cell[taken], problem.classes[owner[taken], way])
    return np.unpackbits(seen[:, None], axis=1).sum(axis=1).astype(np.int64)


def _cover_problem(
    catalogue: ImageCatalogue,
    options: SelectionOptions,
    step: IntArray,
    seen: SeenCells,
    cell: IntArray,
) -> tuple[CoverProblem, IntArray, Counts]:
    """The problem of covering cells, the step of every cell, and its available views."""
    owner = np.repeat(np.arange(len(catalogue), dtype=np.int32), np.diff(seen.start))
    usable = seen.clear & (step[owner] != UNUSABLE)
    owner, place = owner[usable], np.searchsorted(cell, seen.cell[usable]).astype(np.int32)
    inside = cell[np.minimum(place, len(cell) - 1)] == seen.cell[usable]
    owner, place = owner[inside], place[inside]
    cell_step, available = _cell_steps(step[owner], place, len(cell), options)
    counts = step[owner] <= cell_step[place]
    owner, place = owner[counts], place[counts]
    age = (catalogue.acquired.max() - catalogue.acquired) / _YEAR
    cloud = np.nan_to_num(catalogue.cloud_percent, nan=100.0) / 100.0
    problem = CoverProblem(
        start=np.searchsorted(owner, np.arange(len(catalogue) + 1)).astype(np.int64),
        cell=place,
        need=np.minimum(available, options.min_views).astype(np.int16),
        classes=view_classes(catalogue),
        preference=1.0 / (1.0 + _AGE_PENALTY * age + _CLOUD_PENALTY * cloud),
    )
    return problem, cell_step, available


def _cell_steps(
    view_step: IntArray, place: npt.NDArray[np.int32], count: int, options: SelectionOptions
) -> tuple[IntArray, Counts]:
    """The first step (count,) at which each cell has enough views, else the last; its views there."""
    cell_step = np.full(count, len(options.cloud_limits_percent) - 1, dtype=np.int64)
    available = np.zeros(count, dtype=np.int64)
    is_open = np.ones(count, dtype=np.bool_)
    for step in range(len(options.cloud_limits_percent)):
        more = np.bincount(place[view_step == step], minlength=count)
        available[is_open] += more[is_open]
        cell_step[is_open & (available >= options.min_views)] = step
        is_open &= available < options.min_views
    return cell_step, np.minimum(available, np.iinfo(np.int16).max).astype(np.int16)


def _use(
    catalogue: ImageCatalogue,
    options: SelectionOptions,
    step: IntArray,
    duplicate: BoolArray,
    selected: int,
) -> ImageUse:
    """What became of the images: an unusable one is counted under the first reason."""
    cloud, limits = catalogue.cloud_percent, options.cloud_limits_percent
    reasons = {
        "duplicates": duplicate,
        "snow": catalogue.snow_percent > options.max_snow_percent,
        "cloud_unknown": np.isnan(cloud),
        "too_cloudy": cloud >= limits[-1],
        "without_mask": (cloud >= limits[0]) & ~catalogue.has_mask,
    }
    left = np.ones(len(catalogue), dtype=np.bool_)
    counts = {}
    for name, refused in reasons.items():
        counts[name] = int((left & refused).sum())
        left &= ~refused
    return ImageUse(
        catalogue=len(catalogue),
        usable=int((step != UNUSABLE).sum()),
        snow_unknown=int((left & np.isnan(catalogue.snow_percent)).sum()),
        selected=selected,
        **counts,
    )
