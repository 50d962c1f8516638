"""Content of the report on a base of control points from an open archive."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from amers.services.production.date_frames import DateFrames
from amers.services.quality.accuracy_statement import AccuracyStatement, accuracy_document
from amers.services.types import Array, IntArray

FORMAT = "amers-base/1"
VERDICT = "made"


@dataclass(frozen=True)
class ImageRow:
    """An image of a base.

    Attributes:
        name: id of its item.
        tile: that it shows.
        date: day, platform and orbit.
        orbit: "" when unknown.
        clear_percent: clear share of the region, by its mask.
        error_m: (2,) east, north, by which its date lies off the frame of the base.
        stated_m: error that the producer states, a coordinate, one standard deviation.
        points: number that it shows and confirms.
    """

    name: str
    tile: str
    date: str
    orbit: str
    clear_percent: float
    error_m: Array
    stated_m: float
    points: int


@dataclass(frozen=True)
class Costs:
    """What a base took.

    Attributes:
        bytes: read at addresses by the command that ended the work.
        bytes_per_km2: of the region.
        share_of_full_images: of their pixels, 0 to 1.
        cpu_s_per_point: seconds of a core of all tasks.
    """

    bytes: int
    bytes_per_km2: float
    share_of_full_images: float
    cpu_s_per_point: float


@dataclass(frozen=True)
class BaseReport:
    """The report on a base.

    Attributes:
        block: name of the block.
        archive: of the images.
        area_km2: of the region.
        outlines: (n, 2) longitudes and latitudes of the parts of the region, closed.
        lon_lat_h: (n, 3) of the points.
        dates_of_points: (n,) number of images in which each point was found.
        images: that were used.
        left_out: words for images that were chosen and not used.
        unused_items: number of items of the catalogues that cannot be used.
        frames: errors of the dates, and what remains.
        date_names: of the errors.
        accuracy: of the points.
        costs: what it took.
        attribution, terms: of the data; terms are an address.
        catalogues: that were contacted.
        finished_at: UTC.
        software_version: of Amers.
    """

    block: str
    archive: str
    area_km2: float
    outlines: tuple[Array, ...]
    lon_lat_h: Array
    dates_of_points: IntArray
    images: tuple[ImageRow, ...]
    left_out: tuple[str, ...]
    unused_items: int
    frames: DateFrames
    date_names: tuple[str, ...]
    accuracy: AccuracyStatement
    costs: Costs
    attribution: str
    terms: str
    catalogues: tuple[str, ...]
    finished_at: datetime
    software_version: str

    def document(self) -> dict[str, Any]:
        """Members of the JSON document: the points are those of the block."""
        shown = {name: value for name, value in vars(self).items() if name not in _NOT_SHOWN}
        return {
            "format": FORMAT,
            "verdict": VERDICT,
            "block": {"id": self.block},
            **shown,
            **accuracy_document(self.accuracy),
            "points": len(self.lon_lat_h),
        }


_NOT_SHOWN = ("block", "lon_lat_h", "dates_of_points", "accuracy")
