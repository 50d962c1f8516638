"""Map position of an image: its own geotransform, `.aux.xml`, or a world file with its `.prj`.

GDAL's order: `.aux.xml`, the image itself, the world file. GDAL does not read a `.prj` beside an image;
other programs do, and it is used where nothing else states the reference system.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.transform import Affine

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.text_files import parse_number, parse_xml, read_text
from amers.services.statements import Statement, Statements, Subject, Use

AUX_READER = Reader(
    "`.aux.xml` of GDAL and QGIS",
    (),
    (
        Treatment(
            Subject.MODEL,
            "used",
            "The metadata domain RPC contains a model. In the order of GDAL, this model "
            "comes after the tags of a GeoTIFF.",
        ),
        Treatment(Subject.MODEL, "refused", "A number of the RPC is missing."),
        Treatment(
            Subject.PLACE,
            "used",
            "GeoTransform states the map grid. It has precedence over the geotransform of the image.",
        ),
        Treatment(Subject.PLACE, "refused", "GeoTransform does not consist of six numbers."),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "SRS states the reference system. It has precedence over the system of the image.",
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "refused", "SRS is not WKT."),
    ),
    never=(
        Subject.PIXEL_ORIGIN,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.VALIDITY,
        Subject.BANDS,
        Subject.IDENTITY,
        Subject.ACCURACY,
    ),
)
WORLD_FILE_READER = Reader(
    "World files (`.tfw`, `.j2w`, `.wld`) with `.prj`",
    (),
    (
        Treatment(
            Subject.PLACE,
            "used",
            "A world file exists, and neither the image nor its `.aux.xml` file has a geotransform.",
        ),
        Treatment(
            Subject.PLACE,
            "named",
            "A world file exists, and its geotransform differs from the geotransform of the image.",
        ),
        Treatment(Subject.PLACE, "refused", "The world file does not consist of six numbers."),
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "A `.prj` file exists, and no other file states a system."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "The image and a `.prj` file state no system, or the content of the `.prj` file is not WKT.",
        ),
    ),
    never=(
        Subject.MODEL,
        Subject.PIXEL_ORIGIN,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.VALIDITY,
        Subject.BANDS,
        Subject.IDENTITY,
        Subject.ACCURACY,
    ),
)

SAME_PX = 0.01
"""Geotransforms that differ by less in the image are the same."""

_WORLD_FILES = {
    "GTiff": (".tfw", ".tifw", ".tiffw", ".wld"),
    "JP2OpenJPEG": (".j2w", ".jp2w", ".wld"),
    "NITF": (".ntfw", ".nfw", ".wld"),
}


@dataclass(frozen=True)
class Georeference:
    """The map grid of an image, as far as it is stated.

    Attributes:
        crs: its reference system; None where nothing states one.
        transform: from sample and line, counted from the corner of the first pixel; identity where
            nothing states one.
        statements: of the files, where there is more than the image itself.
    """

    crs: CRS | None
    transform: Affine
    statements: Statements = ()


def georeference(path: FilePlace, dataset: rasterio.DatasetReader) -> Georeference:
    """The map grid of an image by its own statements and those of the files beside it.

    At an address, the image alone is read.

    Raises:
        FormatError: a file beside the image that decides cannot be read.
    """
    own = Georeference(dataset.crs, dataset.transform)
    if not isinstance(path, Path):
        return own
    path = path.resolve()
    found = [
        (file, part)
        for file, part in (_of_aux(path), _world_file(path, dataset.driver))
        if file is not None and part is not None
    ]
    if not found:
        return own
    own_file = (path, own) if not own.transform.is_identity else None
    order = [one for one in found if one[0].suffix == ".xml"]
    order += [own_file] if own_file is not None else []
    order += [one for one in found if one[0].suffix != ".xml"]
    file, used = next((one for one in order if not one[1].transform.is_identity), (path, own))
    stated = [(other, part.crs) for other, part in [*order, (path, own)] if part.crs is not None]
    crs_file, crs = stated[0] if stated else (file, None)
    if crs is None:
        crs_file, crs = _prj(path)
    shape = dataset.height, dataset.width
    statements = [_said(file, "geotransform", Use.USED)]
    if crs is not None and own.crs is not None and crs != own.crs:
        note = f"{crs_file.name} is used as GDAL does"
        statements.append(_said(path, "reference system", Use.NOT_USED, own.crs.to_string()[:60], note))
    if crs is not None and crs_file != file:
        statements.append(_said(crs_file, "reference system", Use.USED, crs.to_string()[:60]))
    for other, part in order:
        if other == file or part.transform.is_identity:
            continue
        apart_px = _apart_px(used.transform, part.transform, shape)
        if apart_px >= SAME_PX:
            note = f"{apart_px:.2f} px from {file.name}, which is used as GDAL does"
            statements.append(_said(other, "geotransform", Use.NOT_USED, "another map grid", note))
    return Georeference(crs, used.transform, tuple(statements))


def _said(file: Path, where: str, use: Use, value: str = "map grid", note: str = "") -> Statement:
    return Statement(file.name, Subject.PLACE, use, value, where=where, note=note)


def _of_aux(path: Path) -> tuple[Path, Georeference | None]:
    """The map grid in the `.aux.xml` of an image, if any."""
    file = Path(f"{path}.aux.xml")
    if not os.path.isfile(file):
        return file, None
    root = parse_xml(read_text(file), file.name)
    text, wkt = root.findtext("GeoTransform"), (root.findtext("SRS") or "").strip()
    if text is None and not wkt:
        return file, None
    numbers = [
        parse_number(word, "GeoTransform", file.name) for word in (text or "0,1,0,0,0,1").split(",")
    ]
    if len(numbers) != 6:
        raise FormatError(f"{file.name}: GeoTransform: {len(numbers)} numbers found, 6 expected")
    return file, Georeference(_crs(wkt, file) if wkt else None, Affine.from_gdal(*numbers))


def _world_file(path: Path, driver: str) -> tuple[Path, Georeference | None]:
    """The geotransform in the world file of an image; it counts from the centre of the first pixel."""
    stem = os.path.splitext(path)[0]
    for suffix in _WORLD_FILES.get(driver, ()):
        for name in (stem + suffix, stem + suffix.upper()):
            if os.path.isfile(name):
                file = Path(name)
                words = read_text(file).split()
                if len(words) != 6:
                    raise FormatError(
                        f"{file.name}: {len(words)} numbers found, the 6 of a world file expected"
                    )
                a, d, b, e, c, f = (parse_number(word, "world file", file.name) for word in words)
                centre = Affine(a, b, c, d, e, f)
                return file, Georeference(None, centre @ Affine.translation(-0.5, -0.5))
    return path, None


def _prj(path: Path) -> tuple[Path, CRS | None]:
    """The reference system in the `.prj` beside an image, if any."""
    for file in (path.with_suffix(".prj"), path.with_suffix(".PRJ")):
        if file.is_file():
            return file, _crs(read_text(file).strip(), file)
    return path, None


def _crs(wkt: str, file: Path) -> CRS:
    try:
        return CRS.from_wkt(wkt, morph_from_esri_dialect=True)
    except CRSError:
        raise FormatError(
            f"{file.name}: {wkt[:40]!r} found, a reference system as WKT expected; write it anew, for "
            "instance with `gdalsrsinfo -o wkt EPSG:…`"
        ) from None


def _apart_px(used: Affine, other: Affine, shape: tuple[int, int]) -> float:
    """Largest distance between two geotransforms at the corners of an image, pixels of the first one."""
    if used.is_degenerate:
        return np.inf
    lines, samples = shape
    corners = np.array([[0, 0], [samples, 0], [0, lines], [samples, lines]], dtype=np.float64)
    back = ~used @ other
    return float(max(np.hypot(*(np.array(back @ tuple(corner)) - corner)) for corner in corners))
