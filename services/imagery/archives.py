"""Archives of ortho-images for bases: their names in catalogues, and their stated accuracy."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import shapely

CE95_TO_SIGMA = 1.0 / math.sqrt(2.0 * math.log(20.0))
"""Ratio of one standard deviation of each coordinate to CE95, for a circular normal law: 1 / 2.4477."""
LE90_TO_SIGMA = 1.0 / 1.6449
"""Ratio of one standard deviation to LE90, for a normal law."""


@dataclass(frozen=True)
class StatedAccuracy:
    """What a producer states of the place of its ortho-images, a coordinate, one sigma, metres.

    Attributes:
        own_m: error of a date, independent of other dates.
        common_m: error that all dates of this statement share, such as that of a reference image.
        since_baseline: the statement holds from this processing baseline on; "" for all.
    """

    own_m: float
    common_m: float = 0.0
    since_baseline: str = ""

    @property
    def total_m(self) -> float:
        """Both together."""
        return math.hypot(self.own_m, self.common_m)


@dataclass(frozen=True)
class Archive:
    """A collection of images of one kind, as catalogues have it.

    Attributes:
        name: for messages.
        collections: ids in catalogues; an item of another collection is not taken.
        image: asset with the pixels.
        mask: asset with classes or bits of what hides the ground; "" for none.
        hidden_classes: values of the mask that hide the ground, or that change too much for points.
        hidden_bits: bits of the mask, any of which does so.
        gsd_m: ground sampling, metres.
        nodata: value of the image without data.
        scale: factor of pixel values before they are stored as 16 bits.
        offset: added to pixel values from the baseline `offset_since` on, unless the property
            `offset_applied` is true.
        offset_since: processing baseline.
        offset_applied: name of the property.
        quality: name of the property whose value must be one of `qualities`, where an item has it.
        qualities: for which `accuracy` holds.
        accuracy: statements of the producer, by rising baseline.
        bytes_per_px: of the compressed image, for plans.
        attribution: words that the terms of the data ask for; {years} is replaced.
        license: of a block made of them.
        terms: address of the terms.
        sign: address that signs others, with {href}; "" where addresses can be read as they are.
    """

    name: str
    collections: tuple[str, ...]
    image: str
    mask: str = ""
    hidden_classes: tuple[int, ...] = ()
    hidden_bits: tuple[int, ...] = ()
    gsd_m: float = 10.0
    nodata: float = 0.0
    scale: float = 1.0
    offset: float = 0.0
    offset_since: str = ""
    offset_applied: str = ""
    quality: str = ""
    qualities: tuple[str, ...] = ()
    accuracy: tuple[StatedAccuracy, ...] = ()
    bytes_per_px: float = 1.5
    attribution: str = ""
    license: str = "proprietary"
    terms: str = ""
    sign: str = ""

    def stated(self, baseline: str) -> StatedAccuracy:
        """The statement for a processing baseline; an unknown one ("") gets the first."""
        held = [one for one in self.accuracy if _at_least(baseline, one.since_baseline)]
        return (held or list(self.accuracy))[-1 if held else 0]

    def offset_of(self, baseline: str, properties: Mapping[str, Any]) -> float:
        """What is added to the pixel values of an image."""
        is_applied = bool(self.offset_applied) and properties.get(self.offset_applied) is True
        holds = bool(self.offset_since) and bool(baseline) and _at_least(baseline, self.offset_since)
        return self.offset if holds and not is_applied else 0.0


@dataclass(frozen=True)
class ArchiveImage:
    """One image of an archive, as its item states it.

    Attributes:
        id: of the item.
        acquired: UTC.
        platform: "" when unknown.
        orbit: relative orbit or path, as text; "" when unknown.
        tile: name of the piece of the map that the image fills; images of one tile show one place.
        baseline: processing baseline; "" when unknown.
        footprint: longitude and latitude.
        cloud, snow: shares, 0 to 1; 0 when unknown.
        sun_deg: elevation and azimuth of the sun.
        offset: added to pixel values.
        accuracy: what the producer states.
    """

    id: str
    acquired: datetime
    platform: str
    orbit: str
    tile: str
    baseline: str
    footprint: shapely.Geometry
    cloud: float
    snow: float
    sun_deg: tuple[float, float]
    offset: float
    accuracy: StatedAccuracy

    @property
    def date(self) -> str:
        """Day, platform and orbit: images of one pass, whatever their tile, have one value."""
        return f"{self.acquired:%Y-%m-%d} {self.platform} {self.orbit}".strip()

    @property
    def season(self) -> int:
        """0 for December to February, and so on."""
        return self.acquired.month % 12 // 3


def _at_least(baseline: str, least: str) -> bool:
    return _numbers(baseline) >= _numbers(least)


def _numbers(version: str) -> tuple[int, ...]:
    """A version as numbers: 05.09, 5.9 and N0509 are equal."""
    plain = version.strip("Nn")
    parts = [plain[:2], plain[2:]] if len(plain) == 4 and plain.isdigit() else plain.split(".")
    return tuple(int(part) for part in parts if part.isdigit())


SENTINEL_2 = Archive(
    name="sentinel-2",
    collections=("sentinel-2-l2a", "sentinel-2-c1-l2a", "sentinel-2-l2a-c1"),
    image="red",
    mask="scl",
    hidden_classes=(0, 1, 3, 6, 8, 9, 10, 11),
    offset=-1000.0,
    offset_since="04.00",
    offset_applied="earthsearch:boa_offset_applied",
    accuracy=(
        StatedAccuracy(20.0 * CE95_TO_SIGMA),
        StatedAccuracy(
            5.0 * CE95_TO_SIGMA / math.sqrt(2.0),
            math.sqrt(8.0**2 - 5.0**2 / 2.0) * CE95_TO_SIGMA,
            "04.00",
        ),
    ),
    bytes_per_px=1.5,
    attribution="Contains modified Copernicus Sentinel data {years}",
    terms="https://sentinels.copernicus.eu/documents/247904/690755/Sentinel_Data_Legal_Notice",
)
"""Sentinel-2 level 2A: the red band at 10 m, its scene classification at 20 m.

Classes that hide the ground: no data, saturated, shadow of clouds, water, clouds of two probabilities,
cirrus, snow. Since baseline 04.00 1,000 is added to pixel values (ESA, 25 January 2022).
Accuracy: 20 m at 95 % without control points (GMES-GSEG-EOPG-TN-09-0008, table 4-6). Refined on the
Global Reference Image: 8 m at 95 %, of which dates of one orbit differ by 5 m at 95 % (ESA, "Forthcoming
deployment of the Copernicus Sentinel-2 products geometric refinement", 22 March 2021); the rest is taken
as common to all dates. Refinement was deployed step by step from March 2021 on, and items do not state
whether their product is refined: it is assumed from baseline 04.00 (January 2022) on, and the
disagreement of dates shows where it does not hold.
"""

LANDSAT = Archive(
    name="landsat",
    collections=("landsat-c2-l2", "landsat-c2l2-sr"),
    image="red",
    mask="qa_pixel",
    hidden_bits=(0, 1, 2, 3, 4, 5, 7),
    gsd_m=30.0,
    quality="landsat:collection_category",
    qualities=("T1",),
    accuracy=(StatedAccuracy(12.0 / math.sqrt(2.0)),),
    bytes_per_px=1.4,
    attribution="Landsat images courtesy of the U.S. Geological Survey",
    license="CC0-1.0",
    terms="https://www.usgs.gov/landsat-missions/landsat-data-access",
)
"""Landsat 8 and 9, Collection 2, level 2: the red band at 30 m.

Bits of QA_PIXEL: fill, dilated cloud, cirrus, cloud, shadow of clouds, snow, water. Accuracy: a radial
root mean square error of at most 12 m for Tier 1 (USGS, Landsat Collections); its parts are unknown, and
dates are taken as independent only as far as their orbits agree.
"""

COPERNICUS_DEM = Archive(
    name="copernicus-dem",
    collections=("cop-dem-glo-30",),
    image="data",
    gsd_m=30.0,
    nodata=-32767.0,
    accuracy=(
        StatedAccuracy(
            2.0 * LE90_TO_SIGMA / math.sqrt(2.0), math.sqrt(4.0**2 - 2.0**2 / 2.0) * LE90_TO_SIGMA
        ),
    ),
    bytes_per_px=1.8,
    attribution=(
        "produced using Copernicus WorldDEM-30 © DLR e.V. 2010-2014 and © Airbus Defence and Space GmbH "
        "2014-2018 provided under COPERNICUS by the European Union and ESA; all rights reserved"
    ),
)
"""Copernicus DEM, GLO-30: heights above EGM2008 of the surface as radar saw it.

Accuracy of heights: LE90 of 4 m absolute, and of 2 m between two places of a tile on slopes up to 20 %
(Copernicus DEM product handbook); the rest is taken as common to a region.
"""

ARCHIVES = {one.name: one for one in (SENTINEL_2, LANDSAT)}
"""Archives that are known by name."""
