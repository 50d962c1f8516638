"""The points of a surface, for programs that show and edit point clouds."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.services.errors import CoverageError
from amers.services.formats.images.surfaces import SurfaceImage, open_surface
from amers.services.formats.point_cloud import CloudPoints, write_point_cloud
from amers.services.surface.tiles import LARGEST_TILE, windows_of
from amers.services.types import Progress, no_progress


@dataclass(frozen=True)
class PointCloud:
    """A point cloud that was written.

    Attributes:
        path: of the file.
        points: their number.
        lowest_m, highest_m: of their heights above the ellipsoid.
    """

    path: Path
    points: int
    lowest_m: float
    highest_m: float


@dataclass
class _Blocks:
    """The points of a surface, one window after the other."""

    surface: SurfaceImage
    max_sigma_m: float
    progress: Progress
    heights_m: list[tuple[float, float]] = field(default_factory=list)

    def __iter__(self) -> Iterator[CloudPoints]:
        windows = windows_of(self.surface.grid.shape, LARGEST_TILE)
        for number, window in enumerate(windows):
            self.progress(number / len(windows), f"points: {number} of {len(windows)} tiles")
            tile = self.surface.read(window)
            kept = np.isfinite(tile.height_m) & (tile.sigma_m <= self.max_sigma_m)
            if not kept.any():
                continue
            height_m = tile.height_m[kept].astype(np.float64)
            xy = self.surface.grid.xy(np.argwhere(kept) + [window.line, window.sample])
            self.heights_m.append((height_m.min(), height_m.max()))
            yield CloudPoints(np.column_stack([xy, height_m]), tile.sigma_m[kept], tile.views[kept])
        if not self.heights_m:
            most = f" with a standard deviation of at most {self.max_sigma_m:g} m"
            raise CoverageError(
                f"{self.surface.image.path}: no cell has a height"
                f"{most if math.isfinite(self.max_sigma_m) else ''}"
            )


def write_surface_points(
    surface: Path,
    output: Path,
    *,
    max_sigma_m: float | None = None,
    progress: Progress = no_progress,
) -> PointCloud:
    """Write every cell of a surface that has a height as a point, as LAZ or LAS.

    Args:
        surface: surface, as `amers surface make` writes it.
        output: the file; an existing one is replaced.
        max_sigma_m: cells whose standard deviation is larger are left out; None takes all.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used.
        CoverageError: no cell has such a height.
    """
    if output.resolve() == surface.resolve():
        raise InputError(f"{output}: the output would replace the surface; choose another name")
    with open_surface(surface) as opened:
        blocks = _Blocks(opened, np.inf if max_sigma_m is None else max_sigma_m, progress)
        count = write_point_cloud(output, opened.grid, blocks)
    low, high = np.array(blocks.heights_m).T
    return PointCloud(output, count, float(low.min()), float(high.max()))
