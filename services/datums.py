"""Horizontal datums: the transformation from a reference system to WGS 84, and its accuracy."""

import math
import re
import warnings
from dataclasses import dataclass
from functools import cache

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import BoundCRS
from pyproj.crs.coordinate_operation import ToWGS84Transformation
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest, TransformerGroup

from amers.services.errors import FormatError
from amers.services.statements import Statement, Subject, Use
from amers.services.types import Array

WGS84 = "EPSG:4326"
_SAME_DEG = 1e-7
"""Largest difference of positions that a null operation leaves as they are: a centimetre."""
_LIKE_WGS84 = (6378137.0, 298.2572, 1e-4)
"""Semi-major axis and inverse flattening, with its tolerance, of WGS 84 and GRS 1980."""
_NO_STEP = re.compile(r"axis order change|Conversion from|Inverse of (?!.* to )|Null geographic offset")


@dataclass(frozen=True)
class DatumShift:
    """The operation of PROJ that leads from a reference system to WGS 84 at one place.

    Attributes:
        system: name of the reference system.
        name: of the operation; "" where there is nothing to do.
        accuracy_m: as the database of PROJ states it; NaN where unknown.
        is_null: whether it leaves positions as they are: the two systems are taken as one.
        is_assumed: the system has no datum, and an ellipsoid on which it can only be like WGS 84.
        missing: a sentence on grids with which PROJ would have a more accurate operation; "" without.
    """

    system: str
    name: str
    accuracy_m: float
    is_null: bool
    is_assumed: bool = False
    missing: str = ""

    @property
    def sigma_m(self) -> float:
        """What the operation adds to the sigma of positions: its accuracy, unless it is null."""
        return 0.0 if self.is_null or math.isnan(self.accuracy_m) else self.accuracy_m

    def statement(
        self, file: str, where: str = "reference system", *, has_sigmas: bool = True
    ) -> Statement:
        """The statement of a file in this system, whose positions have sigmas or not."""
        if self.is_assumed:
            note = (
                "the file names no datum, on an ellipsoid of WGS 84: its positions are taken as WGS 84"
            )
            return Statement(file, Subject.HORIZONTAL_DATUM, Use.ASSUMED, self.system, where, note)
        if not self.name:
            note = ""
        elif math.isnan(self.accuracy_m):
            note = f"{self.name}, of unknown accuracy"
        else:
            note = f"{self.name}, accuracy {self.accuracy_m:.3g} m"
            if self.is_null:
                note += ", which leaves positions as they are"
            elif has_sigmas:
                note += ", which enters the sigmas"
        return Statement(
            file, Subject.HORIZONTAL_DATUM, Use.USED, self.system, where, note + self.missing
        )


def filled_sigmas(sigma_m: Array, stated_m: tuple[float, float], datum_sigma_m: float) -> Array:
    """Sigmas (n, 3) of points, with those that somebody states for points without any.

    Args:
        sigma_m: (n, 3) east, north, up, with the accuracy of the datum; NaN where unknown.
        stated_m: horizontal and up, without the accuracy of the datum.
        datum_sigma_m: that accuracy.
    """
    horizontal_m = math.hypot(stated_m[0], datum_sigma_m)
    return np.where(np.isnan(sigma_m), [horizontal_m, horizontal_m, stated_m[1]], sigma_m)


@cache
def horizontal(crs: str) -> CRS:
    """The horizontal part of a reference system, WKT or a code.

    A system without a datum on the ellipsoid of WGS 84, or on GRS 1980 which differs by 0.1 mm, is taken
    as WGS 84: the systems in use on these ellipsoids differ from it by 2 m at most.
    """
    parsed = CRS.from_user_input(crs)
    flat = _flat(parsed)
    return _taken_as_wgs84(flat) if _has_no_datum(flat) else flat


@cache
def from_wgs84(crs: str) -> Transformer:
    """Longitude and latitude to map positions, by an operation that is never a guess of PROJ.

    Raises:
        ProjError: there is none.
    """
    return Transformer.from_crs(WGS84, horizontal(crs), always_xy=True, allow_ballpark=False)


@cache
def to_wgs84(crs: str) -> Transformer:
    """Map positions to longitude and latitude, by an operation that is never a guess of PROJ.

    Raises:
        ProjError: there is none.
    """
    return Transformer.from_crs(horizontal(crs), WGS84, always_xy=True, allow_ballpark=False)


def datum_shift(crs: str, xy: Array, source: str) -> DatumShift:
    """The operation by which a position (2,) in a reference system, WKT or a code, becomes WGS 84.

    Args:
        crs: of the position; only its horizontal part is used.
        xy: easting or longitude first.
        source: name of the file, for messages.

    Raises:
        FormatError: there is no usable operation.
    """
    return _datum_shift(crs, float(xy[0]), float(xy[1]), source)


@cache
def _datum_shift(crs: str, x: float, y: float, source: str) -> DatumShift:
    system = horizontal(crs)
    name = _system_name(system)
    try:
        transformer = to_wgs84(crs)
        lon, lat = transformer.transform(x, y, errcheck=True)
    except ProjError:
        raise FormatError(
            f"{source}: reference system: {name}: expected one with a transformation to WGS 84"
            f"{missing_grids(system) or ', PROJ knows none'}; state its code, or a "
            "definition with its datum (such as +towgs84=…), as in gdal_edit.py -a_srs EPSG:CODE"
        ) from None
    try:
        operation = transformer.get_last_used_operation()
    except ProjError:  # there is only one
        operation = transformer
    accuracy_m = operation.accuracy if operation.accuracy is not None else -1.0
    steps = [step for step in operation.description.split(" + ") if not _NO_STEP.match(step)]
    is_null = _is_null(system, x, y, lon, lat)
    return DatumShift(
        name,
        " + ".join(steps),
        accuracy_m if accuracy_m >= 0.0 else math.nan,
        is_null,
        _has_no_datum(_flat(CRS.from_user_input(crs))),
        "" if is_null else _better(system, lon, lat, accuracy_m),
    )


def missing_grids(crs: CRS, area: AreaOfInterest | None = None) -> str:
    """Which grids PROJ lacks to reach WGS 84 from a CRS, and where they are; "" when it lacks none.

    They are those of the first operation whose grids are published, and of one grid if there is one.
    """
    lacking = [
        (
            not all(grid.url for grid in step.grids if not grid.available),
            [grid.short_name for grid in step.grids if not grid.available],
        )
        for step in transformations(crs, area).unavailable_operations
        if not all(grid.available for grid in step.grids)
    ]
    if not lacking:
        return ""
    is_unpublished, names = min(lacking, key=lambda step: (step[0], len(step[1])))
    message = f": PROJ has no {' and '.join(names)} installed"
    if not is_unpublished:
        runs = " and ".join(f"pyproj sync --file {name}" for name in names)
        message += f"; the package proj-data of conda-forge has it, or run: {runs}"
    if "us_nga_egm96_15.tif" in names:
        message += "; or install the package proj-data of Debian, which has it as egm96_15.gtx"
    return message


def area_of(place: Array) -> AreaOfInterest:
    """The area of one longitude and latitude (2,), for the choice of an operation."""
    lon, lat = (float(value) for value in place)
    return AreaOfInterest(lon, lat, lon, lat)


def transformations(crs: CRS, area: AreaOfInterest | None = None) -> TransformerGroup:
    """The transformations to WGS 84 that are not approximate, of all areas or of one."""
    with warnings.catch_warnings():
        # PROJ warns that the best transformation is not installed; the callers handle it.
        warnings.simplefilter("ignore", UserWarning)
        return TransformerGroup(
            crs, "EPSG:4979", always_xy=True, allow_ballpark=False, area_of_interest=area
        )


def _system_name(system: CRS) -> str:
    own = system.source_crs if system.is_bound and system.source_crs is not None else system
    on = f" on {own.ellipsoid.name}" if own.name.lower() == "unknown" and own.ellipsoid else ""
    return f"{own.name}{on}"


def _flat(crs: CRS) -> CRS:
    if crs.is_bound and crs.source_crs is not None and crs.source_crs.is_compound:
        return BoundCRS(crs.source_crs.sub_crs_list[0], WGS84, crs.coordinate_operation)
    return crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()


def _has_no_datum(crs: CRS) -> bool:
    """Whether a system states no datum, but an ellipsoid on which it can only be like WGS 84."""
    ellipsoid = crs.ellipsoid
    if crs.is_bound or ellipsoid is None or not (crs.is_geographic or crs.is_projected):
        return False
    radius_m, flattening, tolerance = _LIKE_WGS84
    if ellipsoid.semi_major_metre != radius_m:
        return False
    if abs(ellipsoid.inverse_flattening - flattening) > tolerance:
        return False
    datum = crs.datum.name if crs.datum is not None else "unknown"
    return (
        re.match(r"unknown|unnamed|undefined|not.specified|d_unknown", datum, re.IGNORECASE) is not None
    )


def _taken_as_wgs84(crs: CRS) -> CRS:
    return BoundCRS(crs, WGS84, ToWGS84Transformation(crs.geodetic_crs, 0, 0, 0))


def _is_null(system: CRS, x: float, y: float, lon: float, lat: float) -> bool:
    own = system.source_crs if system.is_bound and system.source_crs is not None else system
    there = Transformer.from_crs(own, own.geodetic_crs, always_xy=True).transform(x, y)
    off = np.array([(there[0] - lon + 180.0) % 360.0 - 180.0, there[1] - lat])
    return bool(np.abs(off).max() <= _SAME_DEG)


def _better(system: CRS, lon: float, lat: float, accuracy_m: float) -> str:
    """A sentence on a more accurate operation of this place whose grid PROJ lacks."""
    area = area_of(np.array([lon, lat]))
    better = [
        (operation.accuracy, grid.short_name)
        for operation in transformations(system, area).unavailable_operations
        for grid in list(operation.grids)[:1]
        if grid.url and 0.0 <= operation.accuracy < accuracy_m
    ]
    if not better:
        return ""
    best_m, grid = min(better)
    return f"; {best_m:.3g} m with its grid: pyproj sync --file {grid}"
