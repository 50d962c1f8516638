"""The chips of one point for other tools: PNG to view, GeoTIFF with raw values, NPZ with metadata."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import cv2
import numpy as np
from rasterio.crs import CRS
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from amers.services.conventions import CHIP_CENTRE
from amers.services.geodesy import metres_per_degree
from amers.services.types import Acquisition, Array, ChipArray

LOW_PERCENTILE, HIGH_PERCENTILE = 1.0, 99.0
"""Percentiles of the valid pixels that a stretch maps to black and white."""


@dataclass(frozen=True)
class LabelledChips:
    """The chips of one point, with their geometry and their images.

    Attributes:
        lon_lat_h: (3,) position of the point.
        chips: (n, 101, 101) raw values, 0 is nodata.
        gsd_m: (n,) ground sampling distance.
        incidence_deg, azimuth_deg: (n,) direction from the point to the sensor, NaN when unknown.
        images: the image of each chip.
    """

    lon_lat_h: Array
    chips: ChipArray
    gsd_m: Array
    incidence_deg: Array
    azimuth_deg: Array
    images: tuple[Acquisition, ...]


def format_chip_png(chip: ChipArray) -> bytes:
    """One chip (101, 101) as an 8-bit PNG with stretched contrast."""
    return _png(stretch_contrast(chip))


def format_sheet_png(labelled: LabelledChips) -> bytes:
    """All chips of a point as one PNG, with a row for each ground sampling distance.

    The contrast of each chip is stretched separately.
    """
    rows = [
        np.hstack([stretch_contrast(chip) for chip in labelled.chips[labelled.gsd_m == gsd]])
        for gsd in np.unique(labelled.gsd_m)
    ]
    width = max(row.shape[1] for row in rows)
    return _png(np.vstack([np.pad(row, ((0, 0), (0, width - row.shape[1]))) for row in rows]))


def stretch_contrast(chip: ChipArray) -> ChipArray:
    """The chip in uint8, with its 1st to 99th percentile mapped to 1 to 255; nodata stays 0."""
    valid = chip > 0
    if not valid.any():
        return np.zeros(chip.shape, dtype=np.uint8)
    low, high = np.percentile(chip[valid], [LOW_PERCENTILE, HIGH_PERCENTILE])
    share = (chip.astype(np.float64) - low) / max(high - low, 1.0)
    return np.where(valid, 1.0 + np.clip(share, 0.0, 1.0) * 254.0, 0.0).astype(np.uint8)


def format_chip_tiff(chip: ChipArray, lon_lat_h: Array, gsd_m: float) -> bytes:
    """One chip (101, 101) as a GeoTIFF with its raw values.

    The reference system is the azimuthal equidistant projection of WGS 84 with its centre at the point,
    where its axes point east and north.
    """
    lon, lat, _ = (float(v) for v in lon_lat_h)
    east_m, north_m = pixel_size_on_ellipsoid_m(lon_lat_h, gsd_m)
    corner = CHIP_CENTRE + 0.5
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            height=chip.shape[0],
            width=chip.shape[1],
            count=1,
            dtype=chip.dtype.name,
            nodata=0,
            crs=CRS.from_proj4(f"+proj=aeqd +lat_0={lat!r} +lon_0={lon!r} +datum=WGS84 +units=m"),
            transform=Affine(east_m, 0.0, -corner * east_m, 0.0, -north_m, corner * north_m),
            compress="deflate",
            predictor=2,
        ) as file:
            file.write(chip, 1)
        return bytes(memory.read())


def pixel_size_on_ellipsoid_m(lon_lat_h: Array, gsd_m: float) -> tuple[float, float]:
    """Size of a pixel of a chip on the ellipsoid, east and north, metres.

    The plane of a chip lies at the height of its point; map projections lie on the ellipsoid.
    """
    _, lat, height_m = (float(v) for v in lon_lat_h)
    on_ellipsoid, at_height = metres_per_degree(lat, 0.0), metres_per_degree(lat, height_m)
    east_m, north_m = (gsd_m * low / high for low, high in zip(on_ellipsoid, at_height, strict=True))
    return east_m, north_m


def format_chips_npz(labelled: LabelledChips) -> bytes:
    """All chips of a point with their metadata, as a NumPy archive without pickled objects."""
    out = BytesIO()
    times = [image.acquired_at for image in labelled.images]
    np.savez(
        out,
        chips=labelled.chips,
        lon_lat_h=labelled.lon_lat_h,
        gsd_m=labelled.gsd_m,
        incidence_deg=labelled.incidence_deg,
        azimuth_deg=labelled.azimuth_deg,
        image_id=_texts([image.image_id for image in labelled.images]),
        sensor=_texts([image.sensor for image in labelled.images]),
        acquired_at=np.array(
            ["NaT" if time is None else time.replace(tzinfo=None) for time in times],
            dtype="datetime64[us]",
        ),
        sun_elevation_deg=np.array([image.sun_elevation_deg for image in labelled.images]),
        sun_azimuth_deg=np.array([image.sun_azimuth_deg for image in labelled.images]),
    )
    return out.getvalue()


def _texts(values: Sequence[str]) -> np.ndarray:
    return np.array(values, dtype=np.str_)


def _png(pixels: ChipArray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])
