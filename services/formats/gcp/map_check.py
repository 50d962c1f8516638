"""Check of positions that a file states twice, in degrees and on a map."""

import math

import numpy as np

from amers.services.errors import FormatError
from amers.services.map_grid import xy_of_lon_lat

_FALSE_NORTHING_M = 10_000_000.0


def checked_zone(
    lon_lat: tuple[float, float], xy: tuple[float, float], utm: str, tolerance_m: float, where: str
) -> str:
    """The UTM zone of a position on a map, which must be that of its longitude and latitude.

    Northings south of the equator may count from the equator, as in northern zones, or from a false
    northing of 10,000 km, as in southern ones, whatever the record says: products of Landsat state
    northern zones everywhere.

    Args:
        lon_lat: degrees, WGS 84.
        xy: the position that the file states on the map, easting first, metres.
        utm: code of the UTM zone.
        tolerance_m: largest distance between both.
        where: place in the file, for the message.

    Returns:
        Code of the zone, north or south, in which the place has this northing.

    Raises:
        FormatError: they are farther apart, as they are when two coordinates are swapped.
    """
    x, y = xy_of_lon_lat(utm, np.array([lon_lat]))[0].tolist()
    if not math.hypot(xy[0] - x, math.remainder(xy[1] - y, _FALSE_NORTHING_M)) <= tolerance_m:
        raise FormatError(
            f"{where}: longitude {lon_lat[0]:.6f}, latitude {lon_lat[1]:.6f} lie at {x:.1f} m east, "
            f"{y:.1f} m north in {utm}, but the record states {xy[0]:.1f} m east, {xy[1]:.1f} m north; "
            f"expected the same place within {tolerance_m:g} m: mend the record (are two coordinates "
            "swapped?)"
        )
    false_northings = round((xy[1] - y) / _FALSE_NORTHING_M)
    if false_northings == 0:
        return utm
    return f"EPSG:{327 if false_northings > 0 else 326}{utm[-2:]}"
