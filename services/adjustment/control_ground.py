"""Control of a block adjustment: points with known ground positions, and their common frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amers.services.types import Array, BoolArray, Frame, IntArray


@dataclass(frozen=True)
class ControlGround:
    """c known ground positions of observed points.

    The error of a position is its own plus that of its frame, which all points of a source share: two
    hundred points of a base that lies 3 m off are 3 m off together. A frame whose covariance is unknown
    gives the block its shape, not its place.

    Attributes:
        point: (c,) int64, rows of the points of the observations; a point may be known from several
            sources.
        lon_lat_h: (c, 3).
        covariance_m2: (c, 3, 3) of east, north, up, relative to the frame; infinite on the diagonal
            where a coordinate is not known (planimetry only, height only).
        source: (c,) int64, rows of `frames`.
        frames: of the sources.
        names: of the points, for messages and reports.
        by_hand: (c,) points that people marked in the images: their observations keep the sigmas they
            state, whatever the residuals of measures by correlation are; none of them by default.
    """

    point: IntArray
    lon_lat_h: Array
    covariance_m2: Array
    source: IntArray
    frames: tuple[Frame, ...]
    names: tuple[str, ...]
    by_hand: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.point)

    @cached_property
    def whitening(self) -> Array:
        """Square roots (c, 3, 3) of the inverse covariances: rows of unknown coordinates are zero."""
        out = np.zeros((len(self), 3, 3))
        for i, covariance in enumerate(self.covariance_m2):
            known = np.isfinite(np.diagonal(covariance))
            inside = np.ix_(known, known)
            values, vectors = np.linalg.eigh(covariance[inside])
            out[i][inside] = (vectors / np.sqrt(np.maximum(values, _EXACT_M**2))).T
        return out

    def take(self, rows: IntArray) -> "ControlGround":
        """The known positions of the given rows, in that order, with all frames."""
        return ControlGround(
            self.point[rows],
            self.lon_lat_h[rows],
            self.covariance_m2[rows],
            self.source[rows],
            self.frames,
            tuple(self.names[row] for row in rows.tolist()),
            self.is_by_hand[rows],
        )

    @property
    def is_by_hand(self) -> BoolArray:
        """(c,) points that people marked in the images."""
        return np.zeros(len(self), dtype=np.bool_) if self.by_hand is None else self.by_hand

    def marks(self, point: IntArray) -> BoolArray:
        """Which observations (m,) of given points people made."""
        return np.asarray(np.isin(point, self.point[self.is_by_hand]))

    @property
    def known(self) -> BoolArray:
        """(c, 3) coordinates that are known: east, north, up."""
        return np.isfinite(np.diagonal(self.covariance_m2, 0, 1, 2))

    def frame_covariances(self) -> list[Array]:
        """Covariances (3, 3) of the frames, with what the points of a block share beyond its frame.

        NaN where unknown, 1 for coordinates that no point has.
        """
        out = []
        for number, frame in enumerate(self.frames):
            absent = ~self.known[self.source == number].any(axis=0)
            apart = absent[:, None] | absent[None, :]
            out.append(np.where(apart, np.eye(3), frame.covariance_m2 + frame.shared_m2))
        return out

    def known_coordinates(self) -> IntArray:
        """Number (c,) of coordinates that are known."""
        return np.asarray(self.known.sum(axis=1), dtype=np.int64)


def joined_ground(parts: Sequence[ControlGround]) -> ControlGround:
    """The known ground of several parts, whose points have their numbers already."""
    if not parts:
        return NO_CONTROL
    start = np.cumsum([0] + [len(part.frames) for part in parts[:-1]])
    return ControlGround(
        point=np.concatenate([part.point for part in parts]),
        lon_lat_h=np.concatenate([part.lon_lat_h for part in parts]),
        covariance_m2=np.concatenate([part.covariance_m2 for part in parts]),
        source=np.concatenate([part.source + by for part, by in zip(parts, start, strict=True)]),
        frames=tuple(frame for part in parts for frame in part.frames),
        names=tuple(name for part in parts for name in part.names),
        by_hand=np.concatenate([part.is_by_hand for part in parts]),
    )


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
