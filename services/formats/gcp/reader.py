"""Reading files of marked points and of ground points in any supported format."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from amers.services.datums import filled_sigmas
from amers.services.errors import (
    FormatError,
    InputError,
    MissingStatements,
    VerticalDatumError,
    refuse_unstated,
    reword,
)
from amers.services.formats.gcp.copernicus import COPERNICUS_KEY, parse_copernicus
from amers.services.formats.gcp.csv_points import (
    PIXEL_ORIGINS,
    CsvLayout,
    is_csv,
    lacks_pixel_origin,
    parse_csv,
)
from amers.services.formats.gcp.gcplib import is_gcplib, parse_gcplib
from amers.services.formats.gcp.json_formats import parse_geojson_points, parse_opf
from amers.services.formats.gcp.marked_points import ELLIPSOID, Heights, MarkedPoints
from amers.services.formats.gcp.odm import is_gcp_list, parse_gcp_list
from amers.services.formats.gcp.pci import is_pci_text, parse_pci_text
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_formats import (
    is_asp_gcp,
    is_envi_pts,
    is_qgis_points,
    parse_asp_gcp,
    parse_envi_pts,
    parse_qgis_points,
)
from amers.services.formats.text_files import read_text
from amers.services.statements import Subject
from amers.services.types import GroundPoints

_HEIGHTS_M = (-1000.0, 12_000.0)
"""Heights of ground above the ellipsoid."""
_ANY_MAP = "EPSG:3857"
"""Stands for an unknown reference system while a file is read for what else is missing."""
_OPTION = re.compile(r"--(?=(?:vertical|geoid|crs|columns|sigma-axes)\b)")
_SAME_PLACE = np.array([1e-9, 1e-9, 1e-4])
"""Largest difference of the positions of one point in its marks: degrees, degrees, metres."""


@dataclass(frozen=True)
class StatedByCaller:
    """What a caller states about a file whose format cannot.

    Attributes:
        heights: datum of the heights.
        sigma_axes: of the sigmas of an ASP `.gcp`; see `parse_asp_gcp`.
        csv: layout of a CSV file.
        options: first letters of the options that state these, for messages.
    """

    heights: Heights | None = None
    sigma_axes: str | None = None
    csv: CsvLayout = field(default_factory=lambda: CsvLayout({}))
    options: str = field(default="--", compare=False)


@dataclass(frozen=True)
class _Format:
    """A format: its name, whether a text has it, its parser, and the endings of its file names."""

    name: str
    fits: Callable[[str, StatedByCaller], bool]
    parse: Callable[[str, StatedByCaller, str], MarkedPoints]
    endings: tuple[str, ...] = ()


def read_control_points(path: Path, heights: Heights | None = None) -> MarkedPoints:
    """The marked points of a file in any format of `amers.services.formats.gcp.marked_points`.

    Args:
        path: of the file; its content decides on the format.
        heights: datum of the heights, where the file does not state it.

    Raises:
        FormatError: the file has none of these formats, its content is wrong, or nothing is marked.
        VerticalDatumError: the datum of the heights is neither in the file nor given, or the grid it
            needs is not installed.
    """
    points = _read_marks(path, StatedByCaller(heights))
    marked = points.take(points.is_marked)
    _refuse_two_positions(marked, path)
    if marked.datum_sigma_m == 0.0:
        return marked
    # An unknown sigma counts as none, but the datum is known no better.
    sigma_m = filled_sigmas(marked.sigma_m, (0.0, math.nan), marked.datum_sigma_m)
    return replace(marked, sigma_m=sigma_m)


def _read_marks(path: Path, stated: StatedByCaller) -> MarkedPoints:
    """The points of a file that must have marks; what is missing is named at once."""
    try:
        points = _read(path, stated)
    except (VerticalDatumError, MissingStatements) as error:
        if lacks_pixel_origin(_text(path), stated.csv):
            refuse_unstated([error, _unmarked(path, "points")])
        raise
    if len(points) and not points.is_marked.any():
        raise _unmarked(path, f"{len(points)} points")
    return points


def _unmarked(path: Path, found: str) -> FormatError:
    return FormatError(
        f"{path.name}: expected points with their positions in an image, found {found} "
        "without any; a CSV has them in the columns line and sample, after a first line with the "
        f"origin of its pixels such as '# pixel-origin=centre' ({', '.join(PIXEL_ORIGINS)})"
    )


def read_marked_ground(path: Path, stated: StatedByCaller = StatedByCaller()) -> MarkedPoints:
    """The points of a file with their marks, without those that are switched off.

    A point without any mark has one row.

    Args:
        path: of the file; its content decides on the format.
        stated: what the file does not state.

    Raises:
        FormatError, InputError, VerticalDatumError: as for `read_ground_points`; or nothing is marked.
    """
    return _used(_read_marks(path, stated), path)


def read_ground_points(path: Path, stated: StatedByCaller = StatedByCaller()) -> GroundPoints:
    """The ground points of a file in any format, each once, without those that are switched off.

    Args:
        path: of the file; its content decides on the format.
        stated: what the file does not state.

    Raises:
        FormatError, InputError, VerticalDatumError: as for `read_control_points`; or a point has two
            positions, or a sigma that is not positive.
    """
    return ground_points(read_used_points(path, stated))


def read_used_points(path: Path, stated: StatedByCaller = StatedByCaller()) -> MarkedPoints:
    """The points of a file, with marks where it has them, without those that are switched off.

    Args:
        path: of the file; its content decides on the format.
        stated: what the file does not state.

    Raises:
        FormatError, InputError, VerticalDatumError: as for `read_ground_points`.
    """
    return _used(_read(path, stated), path)


def read_or_missing(
    read: Callable[[Path, StatedByCaller], MarkedPoints], path: Path, stated: StatedByCaller
) -> tuple[MarkedPoints, list[InputError]]:
    """The points of a file, and an error for each missing statement, with any of which it is unusable.

    Args:
        read: reads the file.
        path: of the file.
        stated: what the file does not state.

    Raises:
        FormatError, InputError, VerticalDatumError: as `read` does, for anything else.
    """
    try:
        return read(path, stated), []
    except (VerticalDatumError, MissingStatements) as error:
        missing = error
    any_heights = replace(stated, heights=stated.heights or ELLIPSOID)
    any_map = replace(any_heights, csv=replace(stated.csv, crs=_ANY_MAP))
    for placeholder in (any_heights, any_map):
        try:
            return read(path, placeholder), [missing]
        except InputError:
            continue
    raise missing


def ground_points(used: MarkedPoints) -> GroundPoints:
    """The ground of marked points, each point once."""
    rows = np.sort(np.unique(used.id, return_index=True)[1])
    return GroundPoints(
        used.id[rows], used.lon_lat_h[rows], used.sigma_m[rows], used.statements, used.datum_sigma_m
    )


def _used(marks: MarkedPoints, path: Path) -> MarkedPoints:
    """The points that are not switched off; refuses two positions of one, and sigmas of 0 or less."""
    used = marks.take(marks.active | marks.check)
    if len(used) == 0:
        raise FormatError(
            f"{path.name}: expected points, found {len(marks)}, all switched off"
            if len(marks)
            else f"{path.name}: expected points, found none"
        )
    _refuse_two_positions(used, path)
    for row in np.flatnonzero((used.sigma_m <= 0.0).any(axis=1)):
        raise FormatError(
            f"{path.name}, point {used.id[row]}: sigmas: expected positive metres east, north, up, "
            f"found {used.sigma_m[row].tolist()}"
        )
    return used


def _refuse_two_positions(used: MarkedPoints, path: Path) -> None:
    _, first, point = np.unique(used.id, return_index=True, return_inverse=True)
    off = np.abs(used.lon_lat_h - used.lon_lat_h[first][point])
    for row in np.flatnonzero((off > _SAME_PLACE).any(axis=1)):
        raise FormatError(
            f"{path.name}, point {used.id[row]}: expected one position, found "
            f"{used.lon_lat_h[first][point][row].tolist()} and {used.lon_lat_h[row].tolist()}"
        )


def _read(path: Path, stated: StatedByCaller) -> MarkedPoints:
    text = _text(path)
    form = _format_of(text, path, stated)
    if form.name != "CSV" and (stated.csv.columns or stated.csv.crs):
        raise InputError(
            f"{path.name}: {stated.options}columns and {stated.options}crs are for CSV, found "
            f"{form.name}; leave them out"
        )
    if form.name != "ASP" and stated.sigma_axes is not None:
        raise InputError(
            f"{path.name}: {stated.options}sigma-axes is for ASP, found {form.name}; leave it out"
        )
    if stated.heights is not None and stated.heights != ELLIPSOID:
        _refuse_second_datum(form, text, path, stated)
    try:
        points = form.parse(text, stated, path.name)
    except InputError as error:
        reword(error, lambda text: _OPTION.sub(stated.options, text))
        raise
    _refuse_heights(points, path)
    told = [replace(one, note=_OPTION.sub(stated.options, one.note)) for one in points.statements]
    return _with_file_names(replace(points, statements=tuple(told)), path)


def _refuse_heights(points: MarkedPoints, path: Path) -> None:
    """Refuse heights that stand for no height."""
    height_m = points.lon_lat_h[:, 2]
    for row in np.flatnonzero((height_m < _HEIGHTS_M[0]) | (height_m > _HEIGHTS_M[1]))[:1]:
        raise FormatError(
            f"{path.name}, point {points.id[row]}: expected a height on the Earth, found "
            f"{height_m[row]:g} m above the ellipsoid; leave unknown heights empty, and check their unit"
        )


def _with_file_names(points: MarkedPoints, path: Path) -> MarkedPoints:
    """The points with the file names of their images, without the folders of another computer."""
    paths = np.unique(points.image).tolist()
    of_path = {image: re.split(r"[/\\]", image)[-1] for image in paths}
    if all(image == name for image, name in of_path.items()):
        return points
    first: dict[str, str] = {}
    for image, name in of_path.items():
        if first.setdefault(name.lower(), image) != image and image != name:
            raise FormatError(
                f"{path.name}: marks in {first[name.lower()]} and in {image}, which have one file name; "
                "expected images of different names: give each image a file of marks"
            )
    record = Record(path.name, list(points.statements))
    example = next(image for image, name in of_path.items() if image != name)
    record.used(Subject.IDENTITY, of_path[example], "names of images", f"of {example}, by file name")
    image = np.array([of_path[image] for image in points.image.tolist()], dtype=np.str_)
    return replace(points, image=image, statements=tuple(record.statements))


def _text(path: Path) -> str:
    """The text of a file, with the ends of lines of any system as "\\n"."""
    return read_text(path).replace("\r\n", "\n").replace("\r", "\n")


def _format_of(text: str, path: Path, stated: StatedByCaller) -> _Format:
    """The format of a text by its content; where that shows none, the one that its name announces."""
    fitting = [form for form in _FORMATS if form.fits(text, stated)]
    if len(fitting) > 1:
        # Columns of QGIS, too, have names of a position.
        fitting = [form for form in fitting if form.name != "CSV"]
    announced = [form for form in _FORMATS if path.suffix.lower() in form.endings][:1]
    if not fitting or ([form.name for form in fitting] == ["CSV"] and path.suffix != ".txt"):
        # The parser of the announced format names the place that does not fit.
        fitting = announced or fitting
    if len(fitting) != 1:
        found = " and ".join(form.name for form in fitting) or f"a first line {text.lstrip()[:60]!r}"
        raise FormatError(
            f"{path.name}: expected one of the formats {', '.join(form.name for form in _FORMATS)}; "
            f"found {found.splitlines()[0]}"
        )
    return fitting[0]


def _refuse_second_datum(form: _Format, text: str, path: Path, stated: StatedByCaller) -> None:
    """Refuse a datum of the caller for a file that states its own."""
    try:
        points = form.parse(text, replace(stated, heights=None), path.name)
    except (VerticalDatumError, MissingStatements):
        return
    if np.isfinite(points.lon_lat_h[:, 2]).any():
        raise VerticalDatumError(
            f"{path.name}: {stated.heights} given as datum of the heights, but {form.name} states "
            f"its own; leave {stated.options}vertical and {stated.options}geoid out"
        )


_FORMATS = (
    _Format(
        "OPF",
        lambda text, stated: text.lstrip()[:1] == "{" and '"gcps"' in text,
        lambda text, stated, source: parse_opf(text, source),
    ),
    _Format(
        "GeoJSON",
        lambda text, stated: text.lstrip()[:1] == "{" and '"FeatureCollection"' in text,
        lambda text, stated, source: parse_geojson_points(text, source),
        (".geojson", ".json"),
    ),
    _Format(
        "Copernicus GCP database",
        lambda text, stated: text.lstrip()[:1] == "{" and f'"{COPERNICUS_KEY}"' in text,
        lambda text, stated, source: parse_copernicus(text, stated.heights, source),
    ),
    _Format(
        "USGS GCPLib",
        lambda text, stated: is_gcplib(text),
        lambda text, stated, source: parse_gcplib(text, stated.heights, source),
    ),
    _Format(
        "ASP",
        lambda text, stated: is_asp_gcp(text),
        lambda text, stated, source: parse_asp_gcp(text, stated.heights, source, stated.sigma_axes),
        (".gcp",),
    ),
    _Format(
        "QGIS",
        lambda text, stated: is_qgis_points(text),
        lambda text, stated, source: parse_qgis_points(text, source),
        (".points",),
    ),
    _Format(
        "ENVI",
        lambda text, stated: is_envi_pts(text),
        lambda text, stated, source: parse_envi_pts(text, stated.heights, source),
        (".pts",),
    ),
    _Format(
        "PCI",
        lambda text, stated: is_pci_text(text),
        lambda text, stated, source: parse_pci_text(text, stated.heights, source),
    ),
    _Format(
        "ODM",
        lambda text, stated: is_gcp_list(text),
        lambda text, stated, source: parse_gcp_list(text, stated.heights, source),
        (".txt",),
    ),
    _Format(
        "CSV",
        lambda text, stated: is_csv(text, stated.csv),
        lambda text, stated, source: parse_csv(text, stated.csv, stated.heights, source),
        (".csv", ".tsv"),
    ),
)
