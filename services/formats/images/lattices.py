"""Common grid of many files on maps: the grid of one of them, extended over all."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.map_grid import MapGrid
from amers.services.types import IntArray

_SAME_PX = 0.01
"""Files with pixels this near to the pixels of the common grid are copied, others are interpolated."""
_BORDER = 17
"""Positions along a side of a file whose place in the common grid is computed."""


@dataclass(frozen=True)
class Placed:
    """Where a file lies in the common grid.

    Attributes:
        path: of the file.
        grid: its own.
        is_aligned: whether its pixels are pixels of the common grid; else it is interpolated.
        low, high: (2,) first and last pixel of the common grid that it can reach.
    """

    path: FilePlace
    grid: MapGrid
    is_aligned: bool
    low: tuple[int, int]
    high: tuple[int, int]


def placed_on(lattice: MapGrid, grids: dict[FilePlace, MapGrid]) -> tuple[MapGrid, tuple[Placed, ...]]:
    """The grid of all files on the lattice of one of them, and their places in it.

    Raises:
        FormatError: a file lies outside the domain of the map of the lattice.
    """
    reaches = {path: _reach(lattice, grid, path) for path, grid in grids.items()}
    low = np.min([first for first, _ in reaches.values()], axis=0)
    high = np.max([last for _, last in reaches.values()], axis=0)
    shape = (int(high[0] - low[0] + 1), int(high[1] - low[1] + 1))
    origin_xy = lattice.xy(low[None, :].astype(np.float64))[0]
    return replace(lattice, origin_xy=origin_xy, shape=shape), tuple(
        Placed(
            path, grids[path], _is_aligned(lattice, grids[path]), _node(first - low), _node(last - low)
        )
        for path, (first, last) in reaches.items()
    )


def _is_aligned(lattice: MapGrid, own: MapGrid) -> bool:
    """Whether the pixels of a file are pixels of the lattice."""
    if own.crs != lattice.crs:
        return False
    at = lattice.line_sample_of_xy(own.origin_xy[None, :])[0]
    stretch = np.linalg.inv(lattice.step_xy) @ own.step_xy - np.eye(2)
    off_px = np.abs(stretch) @ np.array(own.shape) + np.abs(at - np.rint(at))
    return bool((off_px < _SAME_PX).all())


def _reach(lattice: MapGrid, own: MapGrid, path: FilePlace) -> tuple[IntArray, IntArray]:
    """First and last pixel (2,) of the lattice that a file can reach, half a step beyond its own."""
    if _is_aligned(lattice, own):
        first = np.rint(lattice.line_sample_of_xy(own.origin_xy[None, :])[0]).astype(np.int64)
        return first, first + np.array(own.shape) - 1
    axes = [np.linspace(-0.5, size - 0.5, _BORDER) for size in own.shape]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    at = lattice.line_sample(own.lon_lat(positions))
    at = at[np.isfinite(at).all(axis=1)]
    if len(at) == 0:
        raise FormatError(f"{path}: lies outside the map of the other files; keep it apart from them")
    return np.floor(at.min(axis=0)).astype(np.int64), np.ceil(at.max(axis=0)).astype(np.int64)


def _node(position: IntArray) -> tuple[int, int]:
    return int(position[0]), int(position[1])
