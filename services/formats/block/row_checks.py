"""Checks of the rows of the two tables of an Amers block."""

from collections.abc import Sequence

import numpy as np
import shapely

from amers.services.formats.block.document import BlockDocument
from amers.services.formats.block.document_json import BLOCK_JSON
from amers.services.formats.block.problems import ProblemReport
from amers.services.formats.block.tables import POINTS_PARQUET, VIEWS_PARQUET, PointRows, ViewRows
from amers.services.types import Array, BoolArray, IntArray

LOWEST_M, HIGHEST_M = -500.0, 9000.0
SMALLEST_SIGMA_M, LARGEST_SIGMA_M = 1e-6, 1e6
OUTLINE_MARGIN_DEG = 1e-9


def check_points(report: ProblemReport, points: PointRows, document: BlockDocument) -> None:
    """Add to a report the problems of the points: ids, positions, covariances, counts and dates."""
    n = len(points.id)
    if n != document.counts.points:
        report.add(
            BLOCK_JSON,
            "amers:counts.points",
            str(document.counts.points),
            f"{n}, rows of {POINTS_PARQUET}",
        )
    if n == 0:
        report.add(POINTS_PARQUET, "", "no points", "at least one")
    ids = (POINTS_PARQUET, "id")
    outside = (points.id < 0) | (points.id >= n)
    report.rows(ids, outside, points.id, f"0 to {n - 1}")
    report.rows(ids, ~outside & _repeated(points.id), points.id, "an id that occurs once")
    _check_positions(report, points.lon_lat_h, document.metadata.extent)
    _check_covariances(report, points)
    report.rows(
        (POINTS_PARQUET, "saliency"),
        ~((points.saliency >= 0.0) & (points.saliency <= 1.0)),
        points.saliency,
        "0 to 1",
    )
    report.rows((POINTS_PARQUET, "chip_count"), points.chip_count < 1, points.chip_count, "1 or more")
    least = document.metadata.specification.min_views
    report.rows(
        (POINTS_PARQUET, "n_views"),
        points.n_views < least,
        points.n_views,
        f"{least} or more, the specification's min_views",
    )
    dated = ~(np.isnat(points.first_view) | np.isnat(points.last_view))
    report.rows(
        (POINTS_PARQUET, "first_view"),
        dated & (points.first_view > points.last_view),
        points.first_view,
        "a date not after last_view",
    )


def _check_positions(report: ProblemReport, lon_lat_h: Array, outline: Array) -> None:
    limits = (("lon", -180.0, 180.0), ("lat", -90.0, 90.0), ("height", LOWEST_M, HIGHEST_M))
    on_earth = np.ones(len(lon_lat_h), dtype=np.bool_)
    for column, (name, low, high) in enumerate(limits):
        values = lon_lat_h[:, column]
        inside = (values >= low) & (values <= high)
        report.rows((POINTS_PARQUET, f"geometry {name}"), ~inside, values, f"{low:g} to {high:g}")
        on_earth &= inside
    lon, lat = lon_lat_h[on_earth, 0], lon_lat_h[on_earth, 1]
    declared = shapely.Polygon(outline).buffer(OUTLINE_MARGIN_DEG, join_style="mitre")
    shapely.prepare(declared)
    within = np.zeros(len(lon), dtype=np.bool_)
    for turn in (-360.0, 0.0, 360.0):
        within |= shapely.intersects_xy(declared, lon + turn, lat)
    outside = np.zeros(len(lon_lat_h), dtype=np.bool_)
    outside[on_earth] = ~within
    report.rows(
        (POINTS_PARQUET, "geometry"), outside, lon_lat_h, "a position inside the outline of the block"
    )


def _check_covariances(report: ProblemReport, points: PointRows) -> None:
    in_range = (points.sigma_m >= SMALLEST_SIGMA_M) & (points.sigma_m <= LARGEST_SIGMA_M)
    expected = f"{SMALLEST_SIGMA_M:g} to {LARGEST_SIGMA_M:g} metres"
    for column, name in enumerate(("sigma_east_m", "sigma_north_m", "sigma_up_m")):
        values = points.sigma_m[:, column]
        report.rows((POINTS_PARQUET, name), ~in_range[:, column], values, expected)
    if points.surface is not None:
        height_m, sigma_m = points.surface.height_m, points.surface.sigma_m
        unknown = np.isnan(height_m) & np.isnan(sigma_m)
        stated = np.isfinite(height_m) & (sigma_m >= SMALLEST_SIGMA_M) & (sigma_m <= LARGEST_SIGMA_M)
        report.rows(
            (POINTS_PARQUET, "surface_sigma_m"),
            ~(unknown | stated),
            sigma_m,
            f"{expected} with a finite surface_height_m, or null in both",
        )
    possible = np.abs(points.correlation) <= 1.0
    for column, name in enumerate(("corr_east_north", "corr_east_up", "corr_north_up")):
        values = points.correlation[:, column]
        report.rows((POINTS_PARQUET, name), ~possible[:, column], values, "-1 to 1")
    en, eu, nu = points.correlation.T
    determinant = 1.0 - en**2 - eu**2 - nu**2 + 2.0 * en * eu * nu
    report.rows(
        (POINTS_PARQUET, "corr_*"),
        possible.all(axis=1) & ~(determinant > 0.0),
        points.correlation,
        "correlations of a positive definite covariance",
    )


def _repeated(values: IntArray) -> BoolArray:
    """Whether each value (n,) occurs more than once."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return counts[inverse] > 1


def check_order(report: ProblemReport, points: PointRows, views: ViewRows) -> None:
    """Add to a report the views that are not in the order of the points and of their chips."""
    count = np.maximum(points.chip_count, 0)
    owner = np.repeat(points.id, count)
    if len(owner) != len(views.point_id):
        report.add(
            VIEWS_PARQUET, "", f"{len(views.point_id)} rows", f"{len(owner)}, the sum of chip_count"
        )
        return
    report.rows(
        (VIEWS_PARQUET, "point_id"),
        owner != views.point_id,
        views.point_id,
        "the ids of the points in their order",
    )
    first = np.cumsum(count) - count
    within = np.arange(len(owner)) - np.repeat(first, count)
    report.rows((VIEWS_PARQUET, "view"), within != views.view, views.view, "0, 1, 2 … within each point")


def check_views(
    report: ProblemReport, points: PointRows, views: ViewRows, document: BlockDocument
) -> None:
    """Add to a report the problems of the views: images, ground samplings and chips.

    `check_order` must have found no problem.
    """
    if len(views.view) != document.counts.views:
        report.add(
            BLOCK_JSON,
            "amers:counts.views",
            str(document.counts.views),
            f"{len(views.view)}, rows of {VIEWS_PARQUET}",
        )
    names = [image.image_id for image in document.images]
    if len(names) != document.counts.images or len(set(names)) != len(names):
        report.add(
            BLOCK_JSON,
            "amers:images",
            f"{len(names)} images",
            f"{document.counts.images} images with different names",
        )
    listed = np.array([name in set(names) for name in views.image_ids], dtype=np.bool_)
    image_id = np.array(views.image_ids, dtype=object)[views.image]
    report.rows(
        (VIEWS_PARQUET, "image_id"),
        ~listed[views.image],
        image_id,
        f"an image of amers:images in {BLOCK_JSON}",
    )
    _check_samplings(report, views, document.metadata.specification.gsds_m)
    _check_chips(report, points, views)


def _check_samplings(report: ProblemReport, views: ViewRows, gsds_m: Sequence[float]) -> None:
    report.rows(
        (VIEWS_PARQUET, "gsd_m"),
        ~np.isclose(views.gsd_m[:, None], np.array(gsds_m)[None, :], rtol=1e-6, atol=0.0).any(axis=1),
        views.gsd_m,
        "one of " + ", ".join(f"{gsd:g}" for gsd in gsds_m),
    )
    coarser = np.diff(views.gsd_m, prepend=-np.inf) < 0.0
    report.rows(
        (VIEWS_PARQUET, "gsd_m"),
        coarser & (views.view > 0),
        views.gsd_m,
        "the finest first within each point",
    )


def _check_chips(report: ProblemReport, points: PointRows, views: ViewRows) -> None:
    owner = np.repeat(np.arange(len(points.id)), points.chip_count)
    report.rows(
        (VIEWS_PARQUET, "chip_row"),
        views.chip_row != points.chip_row[owner] + views.view,
        views.chip_row,
        f"chip_row of the point in {POINTS_PARQUET} + view",
    )
    own_file = np.array(points.chip_files, dtype=object)[points.chip_file][owner]
    file = np.array(views.chip_files, dtype=object)[views.chip_file]
    report.rows(
        (VIEWS_PARQUET, "chip_file"),
        file != own_file,
        file,
        f"the chip_file of the point in {POINTS_PARQUET}",
    )
    pairs = np.unique(np.column_stack([owner, views.image]), axis=0)
    image_counts = np.bincount(pairs[:, 0], minlength=len(points.id))
    report.rows(
        (POINTS_PARQUET, "n_views"),
        points.n_views != image_counts,
        points.n_views,
        "the number of distinct images among its views",
    )
