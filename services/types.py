"""Data types that the services exchange: frozen dataclasses of arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from amers.services.statements import Statements

Array = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
StrArray = npt.NDArray[np.str_]
ChipArray = npt.NDArray[Any]


class Progress(Protocol):
    """A function to which a long computation reports its progress."""

    def __call__(self, fraction: float, message: str) -> None:
        """Report the completed fraction (0 to 1) and a short description of the current step."""
        ...


def no_progress(fraction: float, message: str) -> None:
    """Ignore the progress."""


def part_of(progress: Progress, start: float, share: float) -> Progress:
    """The progress function of a part that starts at `start` and is a `share` of the whole."""
    return lambda fraction, message: progress(start + share * fraction, message)


@dataclass(frozen=True)
class Acquisition:
    """Sensor, time and geometry of the acquisition of an image.

    Attributes:
        image_id: name of the image, unique within a block.
        sensor: platform or instrument, "" when unknown.
        acquired_at: UTC, None when unknown.
        incidence_deg: angle at the ground between the vertical and the line of sight of the image
            centre; NaN when unknown.
        azimuth_deg: direction from the ground to the sensor, clockwise from north; NaN when unknown.
        sun_elevation_deg, sun_azimuth_deg: at the centre of the image; NaN when unknown.
    """

    image_id: str
    sensor: str = ""
    acquired_at: datetime | None = None
    incidence_deg: float = float("nan")
    azimuth_deg: float = float("nan")
    sun_elevation_deg: float = float("nan")
    sun_azimuth_deg: float = float("nan")


@dataclass(frozen=True)
class Views:
    """The m views of n points: those of point i are the rows `start[i]` to `start[i + 1]`.

    The views of a point have the order of its chips: finest ground sampling first.

    Attributes:
        start: (n + 1,) int64.
        gsd_m: (m,) ground sampling distance of each chip, metres.
        image: (m,) int64, rows of `images`.
        incidence_deg, azimuth_deg: (m,) direction from the point to the sensor.
        health: (m,) `health` of the view: how often it agrees with the measure of its point; 1 without a
            history.
        images: the images the chips were cut from.
    """

    start: IntArray
    gsd_m: Array
    image: IntArray
    incidence_deg: Array
    azimuth_deg: Array
    health: Array
    images: tuple[Acquisition, ...]


@dataclass(frozen=True)
class Frame:
    """Position of the frame of a block on the Earth: an error that all points of the block share.

    Attributes:
        covariance_m2: (3, 3) of east, north, up; NaN where it is not stated.
        shared_m2: (3, 3) of what neighbouring points of the block are off by together, beyond its frame:
            deformations, by the errors of its images. It is part of the covariance of every point; zero
            where it is not stated.
        how_to_state: what a user gives to state it; "" where nothing can be given.
        assumed: values that it follows from and no file states, with the options for them; "" for none.
    """

    covariance_m2: Array
    shared_m2: Array = field(default_factory=lambda: np.zeros((3, 3)))
    how_to_state: str = field(default="", compare=False)
    assumed: str = field(default="", compare=False)

    @classmethod
    def from_sigmas(cls, horizontal_m: float, up_m: float) -> Self:
        """The frame of independent errors, one standard deviation a coordinate; NaN when unknown."""
        known = np.diag(np.array([horizontal_m, horizontal_m, up_m]) ** 2)
        unknown = np.isnan(np.diagonal(known))
        return cls(np.where(unknown[:, None] | unknown[None, :], np.nan, np.nan_to_num(known)))

    @property
    def sigma_m(self) -> float:
        """Horizontal standard deviation a coordinate, root mean square of both; NaN when unknown."""
        return float(np.sqrt(np.trace(self.covariance_m2[:2, :2]) / 2.0))

    @property
    def sigma_up_m(self) -> float:
        """Standard deviation of the height; NaN when unknown."""
        return float(np.sqrt(self.covariance_m2[2, 2]))


UNKNOWN_FRAME = Frame(np.full((3, 3), np.nan))


@dataclass(frozen=True)
class SurfaceHeights:
    """The surface at the places of n points: a statement for elevation models and other tools.

    The height of a point itself is that of the content of its chip, which registration searches.

    Attributes:
        height_m: (n,) above the ellipsoid, in the frame of the point's block, of what stands at its
            longitude and latitude; NaN when unknown.
        sigma_m: (n,) one standard deviation relative to the frame, with what neighbouring points share;
            NaN when unknown.
    """

    height_m: Array
    sigma_m: Array


@dataclass(frozen=True)
class ControlPoints:
    """n control points, their views and the positions of their chips in files.

    Attributes:
        id: (n,) int64, unique.
        lon_lat_h: (n, 3).
        covariance_m2: (n, 3, 3) of east, north, up, relative to the frame of the point's block.
        block: (n,) int64, rows of `frames`.
        frames: of the blocks that the points come from.
        saliency: (n,) 0 to 1, how precisely the chip of the point can be located.
        health: (n,) `health` of the point: how often it is active in the final adjustment; 1 without a
            history.
        views: the views of the points.
        chip_file: (n,) int64, rows of `chip_files`.
        chip_row: (n,) int64, row of the first chip of the point in its file; the others follow it.
        chip_files: names of the files in their `ChipSource`.
        surface: heights of the surface at the points; None where they are not stated.
    """

    id: IntArray
    lon_lat_h: Array
    covariance_m2: Array
    block: IntArray
    frames: tuple[Frame, ...]
    saliency: Array
    health: Array
    views: Views
    chip_file: IntArray
    chip_row: IntArray
    chip_files: tuple[str, ...]
    surface: SurfaceHeights | None = None

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: IntArray) -> "ControlPoints":
        """The points of the given rows, in that order."""
        counts = np.diff(self.views.start)[rows]
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        view_rows = np.repeat(self.views.start[:-1][rows] - start[:-1], counts) + np.arange(start[-1])
        views = Views(
            start=start,
            gsd_m=self.views.gsd_m[view_rows],
            image=self.views.image[view_rows],
            incidence_deg=self.views.incidence_deg[view_rows],
            azimuth_deg=self.views.azimuth_deg[view_rows],
            health=self.views.health[view_rows],
            images=self.views.images,
        )
        return ControlPoints(
            id=self.id[rows],
            lon_lat_h=self.lon_lat_h[rows],
            covariance_m2=self.covariance_m2[rows],
            block=self.block[rows],
            frames=self.frames,
            saliency=self.saliency[rows],
            health=self.health[rows],
            views=views,
            chip_file=self.chip_file[rows],
            chip_row=self.chip_row[rows],
            chip_files=self.chip_files,
            surface=None
            if self.surface is None
            else SurfaceHeights(self.surface.height_m[rows], self.surface.sigma_m[rows]),
        )


@dataclass(frozen=True)
class GroundPoints:
    """n points of known ground without chips, such as those of another base.

    Attributes:
        id: (n,) str, unique.
        lon_lat_h: (n, 3); the height is NaN where unknown.
        sigma_m: (n, 3) east, north, up, one standard deviation; NaN where unknown.
        statements: of their file.
        datum_sigma_m: accuracy of the transformation of their datum, one standard deviation of a
            horizontal coordinate. It is in `sigma_m` where that is known.
    """

    id: StrArray
    lon_lat_h: Array
    sigma_m: Array
    statements: Statements = ()
    datum_sigma_m: float = 0.0

    def __len__(self) -> int:
        return len(self.id)


HEALTH_PRIOR_TRIES = 5.0
"""Successful tries added to every point and view, so that a single failure changes little."""


def health(expected: Array | IntArray, succeeded: Array | IntArray) -> Array:
    """Success rate (n,) of points or views, relative to the others in the same registrations.

    Five successes are added to both counts: health is 1 without a history, 0.83 after one failure where
    all others succeed, 0.5 after five. A failure where only half of the others succeed counts half.
    Health never exceeds 1.

    Args:
        expected: (n,) sum, over the registrations that tried the point or view, of the share of all
            tried points or views that succeeded.
        succeeded: (n,) number of registrations in which the point stayed active, or the view agreed
            with the measure of its point.
    """
    ratio = (succeeded + HEALTH_PRIOR_TRIES) / (expected + HEALTH_PRIOR_TRIES)
    return np.asarray(np.minimum(ratio, 1.0))


class ChipSource(Protocol):
    """A source of chips: a block folder or the storage of the service."""

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.
        """
        ...


def point_chips(points: ControlPoints, chips: ChipSource, row: int) -> ChipArray:
    """All chips of one point, in the order of its views.

    Returns:
        (views, 101, 101) uint8 or uint16; 0 is nodata.
    """
    count = int(points.views.start[row + 1] - points.views.start[row])
    return chips.read(points.chip_files[points.chip_file[row]], int(points.chip_row[row]), count)


@dataclass(frozen=True)
class Measures:
    """The results of a registration for each of the n points within its scene.

    Attributes:
        point_id: (n,) int64.
        lon_lat_h: (n, 3).
        predicted: (n, 2) line, sample by the model before registration.
        line_sample: (n, 2) measured position; NaN where the point was not found.
        sigma_px: (n,) one standard deviation of each coordinate, pixels of the scene; NaN where the
            point was not found.
        score: (n,) best correlation; NaN where none was computed.
        views: (n,) int64, number of views of the point that agree on the measure.
        by_gradient: (n,) whether the point was found by the gradients of its chips only, which happens
            when the radiometry has changed.
        residual_px: (n, 2) measured minus computed by the refined model, line and sample; NaN where the
            point was not found.
        residual_m: (n, 2) the same on the ground, east and north.
        matched: (n,) whether the point was found and its views agree.
        active: (n,) whether the final adjustment used the point; a subset of `matched`.
        reason: (n,) str, why a point is not active; "" for active points.
    """

    point_id: IntArray
    lon_lat_h: Array
    predicted: Array
    line_sample: Array
    sigma_px: Array
    score: Array
    views: IntArray
    by_gradient: BoolArray
    residual_px: Array
    residual_m: Array
    matched: BoolArray
    active: BoolArray
    reason: npt.NDArray[np.str_]

    def take(self, rows: IntArray | BoolArray) -> "Measures":
        """The results of some of the points."""
        return Measures(**{name: values[rows] for name, values in vars(self).items()})

    def status(self, row: int) -> str:
        """The status of a point: "active", "deactivated" or "not matched"."""
        if self.active[row]:
            return "active"
        return "deactivated" if self.matched[row] else "not matched"


@dataclass(frozen=True)
class ViewMeasures:
    """The results of a registration for each of the k views that it tried.

    Attributes:
        point: (k,) int64, rows of the registration's `Measures`; ascending.
        view: (k,) int64, number of the view within its point.
        score: (k,) best correlation; NaN where none was computed.
        agreed: (k,) whether the view was found at the measure of its point, within the tolerance of the
            views.
        reason: (k,) str, why the view was not found; "" where it was.
    """

    point: IntArray
    view: IntArray
    score: Array
    agreed: BoolArray
    reason: npt.NDArray[np.str_]


@dataclass(frozen=True)
class Observations:
    """m observations of points in several images.

    Attributes:
        point: (m,) int64, rows of the caller's points; ascending.
        image: (m,) int64, rows of the caller's images.
        line_sample: (m, 2) pixels.
        sigma_px: (m,) one standard deviation of each coordinate.
    """

    point: IntArray
    image: IntArray
    line_sample: Array
    sigma_px: Array

    def __len__(self) -> int:
        return len(self.point)

    def take(self, rows: BoolArray | IntArray) -> "Observations":
        """The observations of the given rows, in that order."""
        return Observations(
            self.point[rows], self.image[rows], self.line_sample[rows], self.sigma_px[rows]
        )


def joined_observations(parts: Sequence[Observations]) -> Observations:
    """All observations of one part or more, whose points are numbered one after the other."""
    columns = [vars(part) for part in parts]
    return Observations(**{name: np.concatenate([of[name] for of in columns]) for name in columns[0]})
