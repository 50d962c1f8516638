"""Statements in comments of point files: reference system, vertical datum, unit, epoch."""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer

from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.formats.elevation.heights import unit_m
from amers.services.formats.gcp.marked_points import ELLIPSOID, Heights, parse_crs
from amers.services.formats.gcp.record import Record
from amers.services.statements import Statements, Subject
from amers.services.types import Array

_KEY = r"wkt|crs|srs|proj4?|projection|coordinate ?system|(?:coordinate |spatial )?reference(?: system)?"
_CRS = re.compile(
    rf"\bcrs=(?P<token>\S+)|^(?:{_KEY})\s*[:=]\s*(?P<rest>\S.*)$|(?P<code>\bEPSG:\d+(?:\+\d+)?)"
    r"|^(?P<wkt>(?:GEOGCS|PROJCS|COMPD_CS|GEO[DG]CRS|PROJCRS|COMPOUNDCRS|BOUNDCRS)\[.*)$"
    r"|^(?P<proj>\+proj=.*)$",
    re.IGNORECASE,
)
_DATUM = re.compile(
    r"(?:--datum[ =]+|\b(?:horizontal )?datum\s*[:=]\s*)((?!\d)[\w-]+(?: \d+)?)", re.IGNORECASE
)
_DATUMS = {
    "wgs84": "EPSG:4326",
    "dwgs1984": "EPSG:4326",
    "wgs1984": "EPSG:4326",
    "nad83": "EPSG:4269",
    "nad27": "EPSG:4267",
    "ed50": "EPSG:4230",
    "etrs89": "EPSG:4258",
}
_VERTICAL = re.compile(
    r"\b(?:heights?|elevations?|vertical(?:[ _-]?(?:datum|crs|reference))?)\s*[:=]\s*([\w:+-]+)",
    re.IGNORECASE,
)
_ABOVE_ELLIPSOID = re.compile(r"\bmetres above the (?:WGS ?84 )?ellipsoid", re.IGNORECASE)
_NOT_METRES = re.compile(
    r"\b(?:units?|heights?|elevations?|altitudes?|z)\b.*?\b((?:us[ -]?)?(?:survey )?(?:feet|foot|ft)|"
    r"us-?ft|cm|mm|centimet(?:er|re)s?|millimet(?:er|re)s?|yards?|fathoms?)\b",
    re.IGNORECASE,
)
_NAMED = {
    Subject.EPOCH: r"\bepoch\b",
    Subject.UNIT: r"\b(?:units?|feet|foot|ft)\b",
    Subject.VERTICAL_DATUM: r"\b(?:heights?|elevations?|geoid|vertical|msl)\b",
    Subject.HORIZONTAL_DATUM: r"\b(?:datum|projection|ellipsoid|nad ?\d\d|ed ?50|itrf\w*|etrs\w*)\b",
    Subject.ACCURACY: r"\b(?:accuracy|sigma|ce90|le90|rmse?)\b",
}
_EARTH_RADIUS_M = (6.33e6, 6.42e6)


@dataclass(frozen=True)
class Comments:
    """What the comments of a file state.

    Attributes:
        crs: reference system; None where they state none.
        heights: datum of the heights; None where they state none.
        statements: what was used, and what is not understood.
    """

    crs: CRS | None = None
    heights: str | None = None
    statements: Statements = ()


def comment_lines(text: str, prefix: str) -> Iterator[tuple[int, str]]:
    """Yield the number and the content of each comment."""
    for count, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith(prefix):
            yield count, line.strip().lstrip(prefix).strip()


def read_comments(
    lines: Iterable[tuple[int, str]], source: str, heights_unit_m: float = 1.0
) -> Comments:
    """The reference system and the datum of heights that comments state.

    Args:
        lines: number and content of each comment.
        source: name of the file, for messages.
        heights_unit_m: metres of the unit that the heights of the file have.

    Raises:
        FormatError: a reference system is not understood or not one of the Earth, two differ, or
            heights are stated in another unit than theirs.
        VerticalDatumError: two datums of heights differ.
    """
    crs: CRS | None = None
    heights: str | None = None
    record = Record(source)
    for count, line in lines:
        where = f"line {count}"
        unit = _NOT_METRES.search(line)
        if unit is not None and abs(unit_m(unit[1], source, where) / heights_unit_m - 1.0) < 1e-5:
            record.used(Subject.UNIT, unit[1], where)
        elif unit is not None:
            raise FormatError(
                f"{source}, {where}: {line[:80]!r} states {unit[1]}, but heights are read in "
                f"units of {heights_unit_m:.6g} m here; convert them and correct the comment"
            )
        vertical = _vertical(line, f"{source}, {where}")
        definition = _definition(line) if vertical is None or _CRS.search(line) else None
        if vertical is not None:
            heights = str(agreed_heights(heights, vertical, f"{source}, {where}"))
            record.used(Subject.VERTICAL_DATUM, vertical, where)
        if definition is not None:
            stated = earth_crs(definition, f"{source}, {where}")
            if crs is not None and crs != stated:
                raise FormatError(
                    f"{source}, {where}: {stated.name} stated, and {crs.name} before; expected one "
                    "reference system: remove the other"
                )
            crs = stated
        if vertical is None and definition is None and len(line.split()) > 1:
            for subject, pattern in _NAMED.items():
                if re.search(pattern, line, re.IGNORECASE):
                    record.not_used(subject, line[:80], where)
                    break
    return Comments(crs, heights, tuple(record.statements))


def _vertical(line: str, where: str) -> str | None:
    if _ABOVE_ELLIPSOID.search(line):
        return ELLIPSOID
    stated = _VERTICAL.search(line)
    if stated is None:
        return None
    try:
        return ELLIPSOID if vertical_crs(stated[1]) is None else stated[1]
    except VerticalDatumError as error:
        if re.fullmatch(r"ellipsoidal|hae", stated[1], re.IGNORECASE):
            return ELLIPSOID
        raise VerticalDatumError(f"{where}: {error}; correct or remove the comment") from None


def _definition(line: str) -> str | None:
    crs = _CRS.search(line)
    if crs is not None:
        return next(text for text in crs.groups() if text).strip()
    datum = _DATUM.search(line)
    return None if datum is None else _DATUMS.get(re.sub(r"[\s_-]", "", datum[1]).lower(), datum[1])


def earth_crs(definition: str, source: str) -> CRS:
    """The reference system of a definition, of the Earth.

    Raises:
        FormatError: it is not understood, or is one of another body.
    """
    crs = parse_crs(definition, source)
    low, high = _EARTH_RADIUS_M
    radius_m = crs.ellipsoid.semi_major_metre if crs.ellipsoid else None
    if radius_m is not None and not low < radius_m < high:
        raise FormatError(
            f"{source}: expected a reference system of the Earth, found {crs.name[:60]!r}, a body "
            f"with a radius of {radius_m / 1000.0:,.0f} km"
        )
    return crs


def agreed_heights(of_file: Heights | None, of_caller: Heights | None, source: str) -> Heights | None:
    """The datum of heights that a file or its caller states.

    Raises:
        VerticalDatumError: both do, and they differ.
    """
    if of_file is not None and of_caller is not None and str(of_file).lower() != str(of_caller).lower():
        raise VerticalDatumError(
            f"{source}: the heights are above {of_file} by the file itself, {of_caller} given; leave "
            "--vertical and --geoid out, or correct the file"
        )
    return of_caller if of_file is None else of_file


def check_axes(coordinates: Array, crs: CRS, source: str) -> None:
    """Refuse points that lie where their reference system is used only if x and y are exchanged.

    Args:
        coordinates: (n, 2 or 3) east or longitude first.
        crs: of the points.
        source: name of the file, for messages.

    Raises:
        FormatError: x and y are exchanged.
    """
    area = crs.area_of_use
    projected = crs.sub_crs_list[0] if crs.is_compound else crs
    if area is None or not len(coordinates) or area.east < area.west:
        return
    xy = coordinates[:, :2]
    as_given, exchanged = (_within(columns, projected, area.bounds) for columns in (xy, xy[:, ::-1]))
    if not as_given.any() and exchanged.all():
        raise FormatError(
            f"{source}: x {xy[0, 0]:.10g}, y {xy[0, 1]:.10g} is outside the area of {crs.name}, and all "
            f"{len(xy)} points are within it with x and y exchanged; expected east or longitude first: "
            "exchange the columns"
        )


def _within(xy: Array, crs: CRS, bounds: tuple[float, float, float, float]) -> np.ndarray:
    """Whether points (n,) lie in the area of use of their system, and a degree around it."""
    lon_lat = xy
    if crs.is_projected and crs.geodetic_crs is not None:
        to_degrees = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
        lon_lat = np.column_stack(to_degrees.transform(xy[:, 0], xy[:, 1]))
    west, south, east, north = bounds
    with np.errstate(invalid="ignore"):
        return (
            (lon_lat[:, 0] > west - 1.0)
            & (lon_lat[:, 0] < east + 1.0)
            & (lon_lat[:, 1] > south - 1.0)
            & (lon_lat[:, 1] < north + 1.0)
        )
