"""Places of a reference image as control points, with chips cut from the reference."""

from dataclasses import dataclass

import numpy as np

from amers.services.imagery.source import image_gsd_m, image_gsds_m, render_chip
from amers.services.matching.reference_image import Reference
from amers.services.types import Acquisition, Array, ChipArray, ControlPoints, Views


def reference_points(
    lon_lat_h: Array, reference: Reference, gsd_m: float | None = None
) -> ControlPoints:
    """Places on the ground (n, 3) as control points, each with one chip cut from the reference.

    `ReferenceChips` reads the chips.

    Args:
        lon_lat_h: the places.
        reference: what the chips are cut from.
        gsd_m: ground sampling of the chips; that of the reference when None.
    """
    n = len(lon_lat_h)
    unknown = np.full(n, np.nan)
    covariance_m2 = np.tile(np.eye(3) * reference.sigma_m**2, (n, 1, 1))
    covariance_m2[:, 2, 2] = reference.height_sigma_m(lon_lat_h) ** 2
    rows = np.arange(n)
    return ControlPoints(
        id=rows,
        lon_lat_h=lon_lat_h,
        covariance_m2=covariance_m2,
        block=np.zeros(n, dtype=np.int64),
        frames=(reference.frame,),
        saliency=np.ones(n),
        health=np.ones(n),
        views=Views(
            start=np.arange(n + 1),
            gsd_m=image_gsds_m(reference.model, lon_lat_h) if gsd_m is None else np.full(n, gsd_m),
            image=np.zeros(n, dtype=np.int64),
            incidence_deg=unknown,
            azimuth_deg=unknown,
            health=np.ones(n),
            images=(Acquisition("reference"),),
        ),
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=rows,
        chip_files=("reference",),
    )


@dataclass(frozen=True)
class ReferenceChips:
    """Chips of reference points, cut from the reference when they are read.

    Attributes:
        reference: what they are cut from.
        lon_lat_h: (n, 3) the points, by their rows.
        gsd_m: ground sampling of the chips; that of the reference when None.
    """

    reference: Reference
    lon_lat_h: Array
    gsd_m: float | None = None

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Chips (count, 101, 101) uint16, each stretched over the whole range; 0 is nodata."""
        return np.stack([self._chip(ground) for ground in self.lon_lat_h[row : row + count]])

    def _chip(self, ground: Array) -> ChipArray:
        gsd_m = self.gsd_m or image_gsd_m(self.reference.model, ground)
        pixels = render_chip(self.reference.image, self.reference.model, ground, gsd_m)
        valid = np.isfinite(pixels)
        if not valid.any():
            return np.zeros(pixels.shape, dtype=np.uint16)
        low, high = float(pixels[valid].min()), float(pixels[valid].max())
        stretched = 1.0 + (pixels - low) * (65534.0 / max(high - low, 1e-12))
        return np.where(valid, stretched, 0.0).astype(np.uint16)
