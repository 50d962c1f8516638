"""What travels between the services: frozen dataclasses of arrays."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ChipArray = npt.NDArray[Any]


class Progress(Protocol):
    """How a long computation tells where it stands."""

    def __call__(self, fraction: float, message: str) -> None:
        """Report the fraction done (0 to 1) and, in a few words, the work under way."""
        ...


def no_progress(fraction: float, message: str) -> None:
    """Progress that nobody watches."""


def part_of(progress: Progress, start: float, share: float) -> Progress:
    """Progress of a part, as progress of the whole."""
    return lambda fraction, message: progress(start + share * fraction, message)


@dataclass(frozen=True)
class Acquisition:
    """How and when an image was taken.

    Attributes:
        image_id: name of the image, unique within a block.
        sensor: platform or instrument, "" when unknown.
        acquired_at: UTC, None when unknown.
        incidence_deg: angle between the vertical and the line of sight at the ground, at the centre.
        azimuth_deg: from the ground to the sensor, clockwise from north.
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
    """The views of n points, flattened: those of point i are rows `start[i]` to `start[i + 1]`.

    Within a point they are ordered as its chips are: finest ground sampling first.

    Attributes:
        start: (n + 1,) int64.
        gsd_m: (m,) ground sampling of each chip, metres.
        image: (m,) int64, rows of `images`.
        incidence_deg, azimuth_deg: (m,) direction from the point to the sensor.
        health: (m,) how often the view agreed with the measure of its point where it was tried, as
            `health` has it; 1 without a history.
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
class ControlPoints:
    """n control points and where their chips lie.

    Attributes:
        id: (n,) int64, unique.
        lon_lat_h: (n, 3).
        covariance_m2: (n, 3, 3) of east, north, up, relative to the frame of the point's block.
        saliency: (n,) 0 to 1, how well the point's chip can be located.
        health: (n,) how often the point was active at the end where it was tried, as `health` has it;
            1 without a history.
        views: the views of the points.
        chip_file: (n,) int64, rows of `chip_files`.
        chip_row: (n,) int64, row of the point's first chip in its file; its views follow.
        chip_files: names by which a `ChipSource` knows the files.
    """

    id: IntArray
    lon_lat_h: Array
    covariance_m2: Array
    saliency: Array
    health: Array
    views: Views
    chip_file: IntArray
    chip_row: IntArray
    chip_files: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: IntArray) -> "ControlPoints":
        """The points of the given rows, in that order."""
        counts = np.diff(self.views.start)[rows]
        start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        kept = np.repeat(self.views.start[:-1][rows] - start[:-1], counts) + np.arange(start[-1])
        views = Views(
            start=start,
            gsd_m=self.views.gsd_m[kept],
            image=self.views.image[kept],
            incidence_deg=self.views.incidence_deg[kept],
            azimuth_deg=self.views.azimuth_deg[kept],
            health=self.views.health[kept],
            images=self.views.images,
        )
        return ControlPoints(
            id=self.id[rows],
            lon_lat_h=self.lon_lat_h[rows],
            covariance_m2=self.covariance_m2[rows],
            saliency=self.saliency[rows],
            health=self.health[rows],
            views=views,
            chip_file=self.chip_file[rows],
            chip_row=self.chip_row[rows],
            chip_files=self.chip_files,
        )


HEALTH_PRIOR_TRIES = 5.0
"""Successful tries every point and view begins with: one failure says little, ten say much."""


def health(expected: Array | IntArray, succeeded: Array | IntArray) -> Array:
    """How often points or views served, against how often others served where they were tried.

    Five successes are added to both: 1 without a history, 0.83 after one failure where all others
    served, 0.5 after five; half as much is lost where only half of the others served. Never above 1.

    Args:
        expected: (n,) sum, over the registrations that tried it, of the share of all they tried that
            served.
        succeeded: (n,) registrations in which a point stayed active, or a view agreed with its point's
            measure.
    """
    ratio = (succeeded + HEALTH_PRIOR_TRIES) / (expected + HEALTH_PRIOR_TRIES)
    return np.asarray(np.minimum(ratio, 1.0))


class ChipSource(Protocol):
    """Where chips are read from: a block folder or the storage of the service."""

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.
        """
        ...


def point_chips(points: ControlPoints, chips: ChipSource, row: int) -> ChipArray:
    """All the chips of one point, in the order of its views.

    Returns:
        (views, 101, 101) uint8 or uint16; 0 is nodata.
    """
    count = int(points.views.start[row + 1] - points.views.start[row])
    return chips.read(points.chip_files[points.chip_file[row]], int(points.chip_row[row]), count)


@dataclass(frozen=True)
class Measures:
    """What a registration did with each of n points that its scene could show.

    Attributes:
        point_id: (n,) int64.
        lon_lat_h: (n, 3).
        predicted: (n, 2) line, sample by the model before registration.
        line_sample: (n, 2) where the point was found; NaN where it was not.
        sigma_px: (n,) one standard deviation a coordinate, pixels of the scene; NaN where not found.
        score: (n,) best correlation seen; NaN where none was computed.
        views: (n,) int64, how many views of the point agree on the measure.
        by_gradient: (n,) found by the edges of the chips only: the radiometry has changed.
        residual_px: (n, 2) found minus computed by the refined model, line and sample; NaN where not
            found.
        residual_m: (n, 2) the same on the ground, east and north.
        matched: (n,) found, and views agree.
        active: (n,) used by the final adjustment; a subset of `matched`.
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

    def status(self, row: int) -> str:
        """The status of a point: "active", "deactivated" or "not matched"."""
        if self.active[row]:
            return "active"
        return "deactivated" if self.matched[row] else "not matched"


@dataclass(frozen=True)
class ViewMeasures:
    """What a registration did with each of k views that it tried.

    Attributes:
        point: (k,) int64, rows of the registration's `Measures`; ascending.
        view: (k,) int64, number of the view within its point.
        score: (k,) best correlation; NaN where none was computed.
        agreed: (k,) found where the measure of the point is, to the tolerance of the views.
        reason: (k,) str, why the view was not found; "" where it was.
    """

    point: IntArray
    view: IntArray
    score: Array
    agreed: BoolArray
    reason: npt.NDArray[np.str_]


@dataclass(frozen=True)
class Observations:
    """m image positions of points seen in several images.

    Attributes:
        point: (m,) int64, rows of whatever holds the points; ascending.
        image: (m,) int64, rows of whatever holds the images.
        line_sample: (m, 2) pixels.
        sigma_px: (m,) one standard deviation a coordinate.
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
