"""Distortions without a sensor model: jitter, bows, lost lines, seams, displaced ground."""

from collections import OrderedDict
from dataclasses import dataclass
from itertools import accumulate, product
from typing import Literal, Protocol

import numpy as np
from numpy.polynomial.legendre import legval

from amers.services.imagery.source import ImageSource, Window, sample_image
from amers.services.types import Array, BoolArray, FloatImage, IntArray

Turn = Literal["", "swapped", "mirrored", "upside down"]

_STEPS = 400
_CLOSE_PX = 1e-10
_TILE_PX, _CACHED_TILES = 256, 256


class Displacement(Protocol):
    """A smooth displacement, which changes by less than a pixel from one pixel to the next."""

    def at(self, line_sample: Array) -> Array:
        """Displacements (n, 2) of lines and samples at positions (n, 2), pixels."""
        ...


@dataclass(frozen=True)
class Waves:
    """Oscillations of the line of sight in time: the same for all samples of a line.

    Attributes:
        amplitude_px: (k, 2) of lines and samples.
        period_px: (k,) lines, at line 0.
        phase: (k, 2) radians.
        chirp_per_px: growth of the frequencies with each line, as a share of those at line 0.
    """

    amplitude_px: Array
    period_px: Array
    phase: Array
    chirp_per_px: float = 0.0

    def at(self, line_sample: Array) -> Array:
        """Displacements (n, 2) at positions (n, 2), pixels."""
        line = line_sample[:, :1]
        turns = line * (1.0 + 0.5 * self.chirp_per_px * line) / self.period_px
        angle = 2.0 * np.pi * turns[:, :, None] + self.phase
        return np.asarray((self.amplitude_px * np.sin(angle)).sum(axis=1))


@dataclass(frozen=True)
class Bend:
    """Legendre polynomials along one axis of the image.

    Attributes:
        coefficient_px: (d, 2) of lines and samples, from degree 0 on: displacements at the last pixel.
        axis: 0 along lines, 1 along samples.
        size: of the image along the axis.
    """

    coefficient_px: Array
    axis: int
    size: int

    def at(self, line_sample: Array) -> Array:
        """Displacements (n, 2) at positions (n, 2), pixels."""
        half = (self.size - 1.0) / 2.0
        return np.asarray(legval(line_sample[:, self.axis] / half - 1.0, self.coefficient_px).T)


@dataclass(frozen=True)
class Kink:
    """An attitude rate that changes at once.

    Attributes:
        line: where.
        rate: (2,) displacement of lines and samples for each line from there on.
    """

    line: float
    rate: Array

    def at(self, line_sample: Array) -> Array:
        """Displacements (n, 2) at positions (n, 2), pixels."""
        return np.asarray(np.maximum(line_sample[:, :1] - self.line, 0.0) * self.rate)


@dataclass(frozen=True)
class Step:
    """Lines that were lost, or delivered twice.

    Attributes:
        line: the first line that is not where it should be.
        lines: number lost before it; negative for lines that are delivered again from it on.
    """

    line: int
    lines: int


@dataclass(frozen=True)
class Seam:
    """A place behind which the image was taken by another detector, or is another image.

    Attributes:
        axis: 0 for a seam between lines, 1 for one between samples.
        at: first line, or sample, behind it.
        shift_px: (2,) the pixels behind it show what the image in front of it has this far from them.
    """

    axis: int
    at: int
    shift_px: Array


@dataclass(frozen=True)
class MovedGround:
    """An elliptic part of the image that shows what belongs elsewhere.

    Attributes:
        centre: (2,) line and sample.
        half_axes_px: (2,) along the direction, and across.
        direction_rad: of the first axis, from the axis of lines to that of samples.
        shift_px: (2,) its pixels show what an image without it has this far from them.
    """

    centre: Array
    half_axes_px: Array
    direction_rad: float
    shift_px: Array

    def contains(self, line_sample: Array) -> BoolArray:
        """Whether pixels (n, 2) belong to the part."""
        offset = line_sample - self.centre
        cos, sin = np.cos(self.direction_rad), np.sin(self.direction_rad)
        axes = offset @ np.array([[cos, -sin], [sin, cos]]) / self.half_axes_px
        return np.asarray((axes**2).sum(axis=1) <= 1.0)


@dataclass(frozen=True)
class Distortion:
    """A map from the pixels of a delivered image to those of the undistorted one.

    A pixel first jumps, by lost lines, seams and moved ground, is then displaced smoothly, and last
    turned.

    Attributes:
        shape: lines and samples of the delivered image.
        smooth: displacements that add up.
        steps: in the order of their lines. The middle line stays in its place.
        moved: ground that is elsewhere.
        turn: "swapped" lines and samples, "mirrored" along samples, "upside down" along lines.
        seams: along each axis in their order. The middle of the image stays in its place.
    """

    shape: tuple[int, int]
    smooth: tuple[Displacement, ...] = ()
    steps: tuple[Step, ...] = ()
    moved: MovedGround | None = None
    turn: Turn = ""
    seams: tuple[Seam, ...] = ()

    @property
    def is_none(self) -> bool:
        """Whether it leaves every pixel where it is."""
        return not (self.smooth or self.steps or self.moved or self.seams or self.turn)

    def undistorted(self, line_sample: Array) -> Array:
        """Positions (n, 2) in the undistorted image of pixels (n, 2)."""
        return self.after_jump(line_sample + self.jump(line_sample))

    def distorted(self, line_sample: Array) -> Array:
        """Pixels (n, 2) that show positions (n, 2) of the undistorted image, within 1e-9 px.

        NaN where a position is not delivered, or more than once: the ground of lost lines, of repeated
        ones, below and within moved ground.
        """
        target = self._turned(line_sample)
        place = target.copy()
        for _ in range(_STEPS):
            change = target - self._displaced(place)
            place += change
            if not (np.abs(change) > _CLOSE_PX).any():
                break
        found = np.full(place.shape, np.nan)
        times = np.zeros(len(place), dtype=np.int64)
        for jump in self.jumps():
            pixel = place - jump
            shows = (self.jump(pixel) == jump).all(axis=1)
            found[shows] = pixel[shows]
            times += shows
        found[(times != 1) | ~np.isfinite(place).all(axis=1)] = np.nan
        return found

    def is_moved(self, line_sample: Array) -> BoolArray:
        """Whether pixels (n, 2) show moved ground."""
        if self.moved is None:
            return np.zeros(len(line_sample), dtype=bool)
        return self.moved.contains(line_sample)

    def is_unique(self, line_sample: Array) -> BoolArray:
        """Whether what pixels (n, 2) show is where it belongs, and shown nowhere else."""
        once = np.isfinite(self.distorted(self.undistorted(line_sample))).all(axis=1)
        return np.asarray(once & ~self.is_moved(line_sample))

    def jump(self, line_sample: Array) -> Array:
        """What is not smooth of the displacements (n, 2) at pixels (n, 2): a few whole values."""
        out = np.zeros(line_sample.shape)
        out[:, 0] = self._lines_before()[self._steps_passed(line_sample[:, 0])]
        for axis in (0, 1):
            out += self._shifts(axis)[self._seams_passed(axis, line_sample[:, axis])]
        if self.moved is not None:
            out[self.is_moved(line_sample)] += self.moved.shift_px
        return out

    def jumps(self) -> list[Array]:
        """All values (2,) that `jump` has."""
        lines = [np.array([line, 0.0]) for line in np.unique(self._lines_before())]
        moved = [np.zeros(2)] if self.moved is None else [np.zeros(2), self.moved.shift_px]
        # In the order of `jump`: equal sums are the same number.
        parts = product(lines, self._shifts(0), self._shifts(1), moved)
        return list(
            np.unique([line + first + second + last for line, first, second, last in parts], axis=0)
        )

    def after_jump(self, line_sample: Array) -> Array:
        """Positions (n, 2) in the undistorted image after the jump of their pixels: a smooth map."""
        return self._turned(self._displaced(line_sample))

    def _displaced(self, line_sample: Array) -> Array:
        out = line_sample.copy()
        for displacement in self.smooth:
            out += displacement.at(line_sample)
        return out

    def _turned(self, line_sample: Array) -> Array:
        """Positions turned, which is also how they are turned back."""
        line, sample = line_sample.T
        lines, samples = self.shape
        if self.turn == "swapped":
            line, sample = sample, line
        elif self.turn == "mirrored":
            sample = samples - 1.0 - sample
        elif self.turn == "upside down":
            line = lines - 1.0 - line
        return np.column_stack([line, sample])

    def _steps_passed(self, line: Array) -> IntArray:
        return np.asarray(np.searchsorted([step.line - 0.5 for step in self.steps], line, side="right"))

    def _seams_passed(self, axis: int, position: Array) -> IntArray:
        at = [seam.at - 0.5 for seam in self.seams if seam.axis == axis]
        return np.asarray(np.searchsorted(at, position, side="right"))

    def _shifts(self, axis: int) -> Array:
        """Shifts (k + 1, 2) of the parts between seams along an axis, from the middle on."""
        shifts = [np.zeros(2), *(seam.shift_px for seam in self.seams if seam.axis == axis)]
        total = np.cumsum(shifts, axis=0)
        return total - total[self._seams_passed(axis, np.array([(self.shape[axis] - 1.0) / 2.0]))]

    def _lines_before(self) -> Array:
        """Lines (k + 1,) that are lost before each part of the image, from the middle on."""
        lost = np.array(list(accumulate((step.lines for step in self.steps), initial=0)), np.float64)
        return lost - lost[self._steps_passed(np.array([(self.shape[0] - 1.0) / 2.0]))]


class DistortedImage:
    """A part of an image, resampled once by the spline of `sample_image` where it is read.

    Attributes:
        distortion: of the part.
    """

    def __init__(
        self, image: ImageSource, distortion: Distortion, corner: tuple[int, int] = (0, 0)
    ) -> None:
        """Prepare a part of an image.

        Args:
            image: from which pixels are taken, also beyond the part.
            distortion: its undistorted positions count from the corner.
            corner: line and sample of the image where the undistorted part begins.
        """
        self.distortion = distortion
        self._image, self._corner = image, np.array(corner, dtype=np.float64)
        self._tiles: OrderedDict[tuple[int, int], FloatImage] = OrderedDict()

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.distortion.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, float32; NaN outside the part and where the image has none."""
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        start = np.array([window.line, window.sample])
        first, last = np.maximum(start, 0), np.minimum(start + out.shape, self.shape)
        if not (last > first).all():
            return out
        low, high = first // _TILE_PX, (last - 1) // _TILE_PX
        for row in range(low[0], high[0] + 1):
            for column in range(low[1], high[1] + 1):
                pixels = self._tile(row, column)
                corner = np.array([row, column]) * _TILE_PX
                a, b = np.maximum(first, corner), np.minimum(last, corner + pixels.shape)
                (r0, c0), (r1, c1) = a - start, b - start
                (i0, j0), (i1, j1) = a - corner, b - corner
                out[r0:r1, c0:c1] = pixels[i0:i1, j0:j1]
        return out

    def _tile(self, row: int, column: int) -> FloatImage:
        """A tile, kept until many others were read."""
        if (row, column) not in self._tiles:
            self._tiles[row, column] = self._resampled(np.array([row, column]) * _TILE_PX)
            while len(self._tiles) > _CACHED_TILES:
                self._tiles.popitem(last=False)
        return self._tiles[row, column]

    def _resampled(self, first: IntArray) -> FloatImage:
        """Pixels of the tile that begins at a line and sample (2,)."""
        lines, samples = (int(n) for n in np.minimum(first + _TILE_PX, self.shape) - first)
        pixels = np.indices((lines, samples)).reshape(2, -1).T.astype(np.float64) + first
        jumps = self.distortion.jump(pixels)
        out = np.full(len(pixels), np.nan, dtype=np.float32)
        for jump in self.distortion.jumps():
            here = (jumps == jump).all(axis=1)
            if here.any():
                position = self.distortion.after_jump(pixels[here] + jump) + self._corner
                out[here] = sample_image(self._image, position[None, :, :], 1.0)[0]
        return out.reshape(lines, samples)
