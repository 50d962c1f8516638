"""Properties of images as stated by a catalogue, without pixels."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from amers.services.types import Array, BoolArray, IntArray

Shapes = npt.NDArray[np.object_]
"""Shapely geometries, or None."""


@dataclass(frozen=True)
class ImageCatalogue:
    """The n images of a catalogue.

    Attributes:
        id: (n,) str, unique.
        footprint: (n,) polygons or multipolygons with continuous longitudes, see
            `amers.services.imagery.footprints.footprint_on_ground`.
        mask: (n,) what hides the ground, clouds and the like, in the same form; its polygons may
            overlap, and it is empty where nothing does. None where the catalogue has no mask.
        acquired: (n,) datetime64[ms], UTC.
        cloud_percent: (n,) of the valid area; NaN when unknown.
        snow_percent: (n,) the same.
        incidence_deg: (n,) angle at the ground between the vertical and the line of sight of the image
            centre; NaN when unknown.
        azimuth_deg: (n,) direction from the ground to the sensor, clockwise from north; NaN when
            unknown.
        sun_elevation_deg, sun_azimuth_deg: (n,) at the centre of the image; NaN when unknown.
        platform: (n,) str, "" when unknown.
        orbit: (n,) int64, absolute orbit, which with the platform identifies a pass; -1 when unknown.
    """

    id: Shapes
    footprint: Shapes
    mask: Shapes
    acquired: npt.NDArray[np.datetime64]
    cloud_percent: Array
    snow_percent: Array
    incidence_deg: Array
    azimuth_deg: Array
    sun_elevation_deg: Array
    sun_azimuth_deg: Array
    platform: Shapes
    orbit: IntArray

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: IntArray | BoolArray) -> Self:
        """The images of some rows."""
        return type(self)(*(values[rows] for values in vars(self).values()))

    @property
    def has_mask(self) -> BoolArray:
        """(n,) whether the catalogue has a mask of the image."""
        return np.array([mask is not None for mask in self.mask], dtype=np.bool_)
