"""Control of a block adjustment: points whose ground positions are known, with the frames they share."""

from dataclasses import dataclass

import numpy as np

from services.types import Array, BoolArray, Frame, IntArray


@dataclass(frozen=True)
class ControlGround:
    """c known ground positions of observed points.

    The error of a position is its own plus that of its frame, which all points of a source share: two
    hundred points of a base that lies 3 m off are 3 m off together. A frame whose covariance is unknown
    gives the block its shape, not its place.

    Attributes:
        point: (c,) int64, rows of the points of the observations; each at most once.
        lon_lat_h: (c, 3).
        covariance_m2: (c, 3, 3) of east, north, up, relative to the frame; infinite on the diagonal
            where a coordinate is not known (planimetry only, height only).
        source: (c,) int64, rows of `frames`.
        frames: of the sources.
        names: of the points, for messages and reports.
    """

    point: IntArray
    lon_lat_h: Array
    covariance_m2: Array
    source: IntArray
    frames: tuple[Frame, ...]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.point)

    def whitening(self) -> Array:
        """Square roots (c, 3, 3) of the inverse covariances: rows of unknown coordinates are zero."""
        out = np.zeros((len(self), 3, 3))
        for i, covariance in enumerate(self.covariance_m2):
            known = np.isfinite(np.diagonal(covariance))
            inside = np.ix_(known, known)
            values, vectors = np.linalg.eigh(covariance[inside])
            out[i][inside] = (vectors / np.sqrt(np.maximum(values, _EXACT_M**2))).T
        return out

    @property
    def known(self) -> BoolArray:
        """(c, 3) coordinates that are known: east, north, up."""
        return np.isfinite(np.diagonal(self.covariance_m2, 0, 1, 2))

    def known_coordinates(self) -> IntArray:
        """Number (c,) of coordinates that are known."""
        return self.known.sum(axis=1).astype(np.int64)


_EXACT_M = 1e-4
"""Standard deviation of a coordinate that is stated to be exact."""

NO_CONTROL = ControlGround(
    point=np.empty(0, dtype=np.int64),
    lon_lat_h=np.empty((0, 3)),
    covariance_m2=np.empty((0, 3, 3)),
    source=np.empty(0, dtype=np.int64),
    frames=(),
    names=(),
)
