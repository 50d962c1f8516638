"""Quality figures of a block from its own points: density, views, stated precision."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from amers.services.quality.accuracy_statement import AccuracyStatement, median_accuracy
from amers.services.quality.density import DensityCells, density_cells, share_reaching
from amers.services.types import Array, ControlPoints, Frame, IntArray

HALF_PER_KM2 = 0.5
QUARTER_PER_KM2 = 0.25


@dataclass(frozen=True)
class Distribution:
    """Five figures of the distribution of a value over the points."""

    minimum: float
    median: float
    mean: float
    p90: float
    maximum: float


@dataclass(frozen=True)
class BlockQuality:
    """The quality figures of a block.

    Attributes:
        points: number of points.
        area_km2: of the block's outline.
        points_per_km2: over the whole outline.
        share_reaching_half, share_reaching_quarter: share of the 0.1 degree cells, weighted by their
            area inside the outline, with at least 1 point for 2 km2 and for 4 km2.
        images_per_point, views_per_point: numbers of different images, and of chips.
        sigma_horizontal_m: stated standard deviation, sqrt((east^2 + north^2) / 2).
        sigma_up_m: the same of the height.
        cells: the density itself.
    """

    points: int
    area_km2: float
    points_per_km2: float
    share_reaching_half: float
    share_reaching_quarter: float
    images_per_point: Distribution
    views_per_point: Distribution
    sigma_horizontal_m: Distribution
    sigma_up_m: Distribution
    cells: DensityCells


def block_quality(points: ControlPoints, images_per_point: IntArray, outline: Array) -> BlockQuality:
    """The quality figures of the points of a block.

    Args:
        points: of the block.
        images_per_point: (n,) number of different images that show each point.
        outline: (k, 2) lon, lat of the block, as for `density_cells`.
    """
    cells = density_cells(points.lon_lat_h[:, :2], outline)
    area_km2 = float(cells.area_km2.sum())
    horizontal_m, up_m = _sigmas_m(points)
    return BlockQuality(
        points=len(points),
        area_km2=area_km2,
        points_per_km2=len(points) / area_km2,
        share_reaching_half=share_reaching(cells, HALF_PER_KM2),
        share_reaching_quarter=share_reaching(cells, QUARTER_PER_KM2),
        images_per_point=distribution(images_per_point),
        views_per_point=distribution(np.diff(points.views.start)),
        sigma_horizontal_m=distribution(horizontal_m),
        sigma_up_m=distribution(up_m),
        cells=cells,
    )


def distribution(values: Array | IntArray) -> Distribution:
    """Five figures of the distribution of (n,) values, n > 0."""
    return Distribution(
        minimum=float(values.min()),
        median=float(np.median(values)),
        mean=float(values.mean()),
        p90=float(np.quantile(values, 0.9)),
        maximum=float(values.max()),
    )


def block_accuracy(quality: BlockQuality, frame: Frame) -> AccuracyStatement:
    """The accuracy of the median point of a block, in its frame and on the Earth."""
    return median_accuracy(quality.sigma_horizontal_m.median, quality.sigma_up_m.median, frame)


def produced_accuracy(points: ControlPoints) -> AccuracyStatement:
    """The accuracy of the median of new points of one block, in its frame and on the Earth."""
    horizontal_m, up_m = _sigmas_m(points)
    return median_accuracy(float(np.median(horizontal_m)), float(np.median(up_m)), points.frames[0])


def _sigmas_m(points: ControlPoints) -> tuple[Array, Array]:
    """Stated standard deviations (n,) of points: horizontal, a coordinate, and up."""
    variance = np.diagonal(points.covariance_m2, axis1=1, axis2=2)
    return np.sqrt(variance[:, :2].mean(axis=1)), np.sqrt(variance[:, 2])


def quality_document(quality: BlockQuality) -> dict[str, Any]:
    """The figures as JSON values; cells are lists of west, south, area in km2, number of points."""
    cells = quality.cells
    listed = np.column_stack([cells.lon_lat, cells.area_km2, cells.points]).tolist()
    return {**{k: v for k, v in asdict(quality).items() if k != "cells"}, "cells": listed}


def parse_quality_document(document: Mapping[str, Any]) -> BlockQuality:
    """The figures from a document of `quality_document`."""
    cells = np.array(document["cells"], dtype=np.float64).reshape(-1, 4)
    figures: dict[str, Any] = {
        name: Distribution(**value) if isinstance(value, dict) else value
        for name, value in document.items()
        if name != "cells"
    }
    return BlockQuality(
        **figures, cells=DensityCells(cells[:, :2], cells[:, 2], cells[:, 3].astype(np.int64))
    )
