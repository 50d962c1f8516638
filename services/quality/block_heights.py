"""Heights of the points of a block against a terrain or surface model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from amers.services.quality.accuracy import (
    NormalisedError,
    Quantile,
    effective_number,
    normalised_error,
    sample_quantile,
    statistics,
)
from amers.services.quality.density import GroundMask
from amers.services.quality.normal_law import LINEAR_LE90
from amers.services.terrain import Terrain
from amers.services.types import Array, ControlPoints, IntArray

Compared = Literal["surface", "point"]
"""The height of the surface at a point, or that of the point, which is that of its chip's content."""

NORMAL_MAD = 1.4826
"""Standard deviation of a normal law over its median absolute deviation."""


@dataclass(frozen=True)
class HeightModel:
    """Heights that points are compared with.

    Attributes:
        terrain: heights of the ground, or of the surface; their sigma is independent from point to
            point.
        frame_sigma_m: of the error that all the heights share, such as that of their datum; 0 when
            unknown.
        excluded: ground where they are not to be trusted, such as filled voids and towns.
    """

    terrain: Terrain
    frame_sigma_m: float = 0.0
    excluded: GroundMask | None = None


@dataclass(frozen=True)
class HeightErrors:
    """Heights of m points of a block minus those of a height model.

    Attributes:
        row: (m,) of the points.
        lon_lat: (m, 2).
        error_m: (m,).
        variance_m2: (m,) stated for the errors: of the point, relative to the frame of its block, and of
            the model.
        compared: which of its two heights a point was compared by.
        unstated: points that do not state that height.
        excluded: points on excluded ground.
        outside: points where the model has no height.
    """

    row: IntArray
    lon_lat: Array
    error_m: Array
    variance_m2: Array
    compared: Compared
    unstated: int
    excluded: int
    outside: int


@dataclass(frozen=True)
class HeightAccuracy:
    """Accuracy of heights against a height model.

    Attributes:
        n: points.
        bias_m: mean error.
        median_m: median error.
        std_m: about the mean; null below two points.
        rmse_m: about zero.
        nmad_m: median absolute deviation from the median, times 1.4826: the standard deviation of a
            normal law that outliers do not move.
        le90_m: 90 % of the absolute errors.
    """

    n: int
    bias_m: float
    median_m: float
    std_m: float
    rmse_m: float
    nmad_m: float
    le90_m: Quantile


@dataclass(frozen=True)
class HeightCell:
    """The heights in a cell of one degree.

    Attributes:
        west, south: degrees.
        accuracy: of the heights in it.
    """

    west: float
    south: float
    accuracy: HeightAccuracy


@dataclass(frozen=True)
class HeightClass:
    """The heights on ground of one land cover.

    Attributes:
        name: of the land cover.
        accuracy: of the heights on it.
    """

    name: str
    accuracy: HeightAccuracy


@dataclass(frozen=True)
class HeightQuality:
    """The heights of a block against a height model.

    Attributes:
        against: name of the model.
        compared: "surface" where the block states heights of surfaces for comparison with elevation
            models, else "point".
        unstated: points without a height of their surface, which were left out.
        point_heights: the heights of all points themselves, for information; null where these were
            compared.
        excluded: points on excluded ground.
        outside: points where the model has no height.
        on_the_earth: all errors.
        relative: without the median error, which the points share as an error of their frame does.
        declared_le90_m: of the median point, relative to the frame, and of the model.
        normalised: the errors without their mean, in units of what is declared for them.
        typical_ratio: the same without the influence of outliers, as a ratio: their NMAD.
        normalised_frame: the median error in units of the declared frame of the block and of the model;
            n is 0 where the frame is not declared.
        cells: by cell of one degree.
        land_cover: by land cover; empty when it is not given.
    """

    against: str
    compared: Compared
    unstated: int
    point_heights: HeightAccuracy | None
    excluded: int
    outside: int
    on_the_earth: HeightAccuracy
    relative: HeightAccuracy
    declared_le90_m: float
    normalised: NormalisedError
    typical_ratio: float
    normalised_frame: NormalisedError
    cells: tuple[HeightCell, ...]
    land_cover: tuple[HeightClass, ...]


def height_errors(
    points: ControlPoints, model: HeightModel, compared: Compared | None = None
) -> HeightErrors:
    """Heights of points minus those of a height model.

    A point has two heights. Its own is that of the content of its chip, which registration searches. The
    height of the surface at the centre of the chip is a statement for elevation models. A horizontal
    error of a point moves it along the slope of the model.

    Args:
        points: of a block.
        model: heights.
        compared: which height; by default that of the surface if any point states it, else that of the
            point.
    """
    surface = points.surface
    if compared is None:
        has_surface = surface is not None and bool(np.isfinite(surface.height_m).any())
        compared = "surface" if has_surface else "point"
    lon_lat = points.lon_lat_h[:, :2]
    height_m, variance_m2 = points.lon_lat_h[:, 2], points.covariance_m2[:, 2, 2]
    if compared == "surface":
        unknown = np.full(len(points), np.nan)
        height_m = unknown if surface is None else surface.height_m
        variance_m2 = unknown if surface is None else surface.sigma_m**2
    stated = np.isfinite(height_m)
    covered = np.zeros(len(points), dtype=np.bool_)
    if model.excluded is not None:
        covered = model.excluded(lon_lat)
    error_m = height_m - model.terrain.height_m(lon_lat)
    known = np.isfinite(error_m)
    rows = np.flatnonzero(known & ~covered)
    slope = np.nan_to_num(model.terrain.slope(lon_lat[rows]))
    covariance = points.covariance_m2[rows]
    along_slope = np.einsum("ni,nij,nj->n", slope, covariance[:, :2, :2], slope)
    if compared == "point":
        # The height of a surface is a measure of its own; that of a point goes with its position.
        along_slope -= 2.0 * np.einsum("ni,ni->n", slope, covariance[:, :2, 2])
    return HeightErrors(
        row=rows,
        lon_lat=lon_lat[rows],
        error_m=error_m[rows],
        variance_m2=variance_m2[rows] + along_slope + model.terrain.sigma_m(lon_lat[rows]) ** 2,
        compared=compared,
        unstated=int((~stated).sum()),
        excluded=int((covered & stated).sum()),
        outside=int((~known & stated & ~covered).sum()),
    )


def height_quality(
    errors: HeightErrors,
    points: ControlPoints,
    model: HeightModel,
    against: str,
    land_cover: Sequence[str] | None = None,
) -> HeightQuality:
    """The heights of a block against a height model: found, and declared against found.

    Args:
        errors: of the points of the block.
        points: of the block; all have the first frame.
        model: that they were compared with.
        against: name of the model.
        land_cover: name of the land cover at each error; None when it is not given.
    """
    error_m = errors.error_m
    degree = np.floor(errors.lon_lat).astype(np.int64)
    cells, cell = np.unique(degree, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    median_m = float(np.median(error_m)) if len(error_m) else float("nan")
    n = len(error_m)
    # A mean out of n errors takes a part of each: n - 1 are free.
    freed = (error_m - error_m.mean()) * np.sqrt(n / (n - 1.0)) if n > 1 else error_m[:0]
    scaled = freed / np.sqrt(errors.variance_m2[: len(freed)])
    declared_m = np.sqrt(errors.variance_m2)
    frame_m2 = points.frames[0].covariance_m2[2:, 2:] + model.frame_sigma_m**2
    names = np.array([] if land_cover is None else list(land_cover), dtype=np.str_)
    return HeightQuality(
        against=against,
        compared=errors.compared,
        unstated=errors.unstated,
        point_heights=None
        if errors.compared == "point"
        else height_accuracy(height_errors(points, model, "point").error_m),
        excluded=errors.excluded,
        outside=errors.outside,
        on_the_earth=height_accuracy(error_m, cell),
        relative=height_accuracy(error_m - median_m, cell),
        declared_le90_m=LINEAR_LE90 * float(np.median(declared_m)) if n else float("nan"),
        normalised=normalised_error(freed[:, None], errors.variance_m2[: len(freed), None, None]),
        typical_ratio=nmad(scaled),
        normalised_frame=normalised_error(np.array([[median_m]]), frame_m2[None]),
        cells=tuple(
            HeightCell(float(west), float(south), height_accuracy(error_m[cell == k]))
            for k, (west, south) in enumerate(cells.tolist())
        ),
        land_cover=tuple(
            HeightClass(str(name), height_accuracy(error_m[names == name])) for name in np.unique(names)
        ),
    )


def height_accuracy(error_m: Array, group: IntArray | None = None) -> HeightAccuracy:
    """Accuracy of heights with errors (n,); errors of one group (n,) share a part of theirs."""
    figures = statistics(error_m)
    effective = None if group is None else effective_number(error_m[:, None], group)
    return HeightAccuracy(
        n=figures.n,
        bias_m=figures.mean,
        median_m=float(np.median(error_m)) if len(error_m) else float("nan"),
        std_m=figures.std,
        rmse_m=figures.rms,
        nmad_m=nmad(error_m),
        le90_m=sample_quantile(np.abs(error_m), effective),
    )


def nmad(values: Array) -> float:
    """Median absolute deviation of (n,) values from their median, times 1.4826; NaN without values."""
    if not len(values):
        return float("nan")
    return NORMAL_MAD * float(np.median(np.abs(values - np.median(values))))
