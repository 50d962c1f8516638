"""Files of heights: images as for scenes, and grids and VRTs from the disk of the operator.

| kind | driver of GDAL | files beside it |
|---|---|---|
| SRTM `.hgt`, also zipped | SRTMHGT | none: its name gives its place |
| `.bil`, `.bip`, `.bsq`, `.flt` | EHdr | `.hdr`, `.prj` |
| ESRI ASCII `.asc` | AAIGrid | `.prj` |
| DTED `.dt0`, `.dt1`, `.dt2` | DTED | none |
| ERDAS `.img` | HFA | `.ige` |
| ENVI, any ending | ENVI | `.hdr` |
| `.vrt` | VRT | files in its folder or below |

GDAL opens each with this driver alone. These kinds name other files; uploads of strangers are images.
"""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import rasterio

from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.datasets import GDAL_CACHE, as_format_error
from amers.services.formats.images.raster import RasterImage, check_declaration, open_values
from amers.services.formats.images.signatures import DRIVER_OF_SIGNATURE
from amers.services.formats.images.validity import validity_of
from amers.services.formats.images.working_copy import Pixels
from amers.services.formats.pieces import IMAGE_SUFFIXES, PieceKind
from amers.services.formats.text_files import parse_number, parse_xml, read_text
from amers.services.imagery.source import Window

DRIVER_OF_SUFFIX = {
    ".hgt": "SRTMHGT",
    ".bil": "EHdr",
    ".bip": "EHdr",
    ".bsq": "EHdr",
    ".flt": "EHdr",
    ".asc": "AAIGrid",
    ".dt0": "DTED",
    ".dt1": "DTED",
    ".dt2": "DTED",
    ".img": "HFA",
    ".vrt": "VRT",
}
HEIGHTS_OF_FORMAT = {"SRTMHGT": "EGM96", "DTED": "EGM96"}
"""Vertical datum of formats by their documents. Sources: NASA, SRTM User Guide; MIL-PRF-89020B."""
_HGT = re.compile(r"[NS]\d{2}[EW]\d{3}(\.[^/]*)?\.hgt(\.zip)?", re.IGNORECASE)
_OPTIONS = GDAL_CACHE | {"GDAL_DISABLE_READDIR_ON_OPEN": "TRUE", "GTIFF_REPORT_COMPD_CS": "YES"}
_VRT_ELEMENTS = frozenset(
    re.findall(
        r"\w+",
        """VRTDataset SRS GeoTransform Metadata MDI VRTRasterBand NoDataValue HideNoDataValue ColorInterp
        UnitType Offset Scale Description CategoryNames Category ColorTable Entry Histograms HistItem
        HistMin HistMax BucketCount IncludeOutOfRange Approximate HistCounts MaskBand SimpleSource
        ComplexSource AveragedSource SourceFilename SourceBand SourceProperties SrcRect DstRect NODATA
        ScaleOffset ScaleRatio UseMaskBand BlockXSize BlockYSize OverviewList Overview""",
    )
)
"""What gdalbuildvrt and gdal_translate write; nothing of it computes or reads other than files."""
_DEEPEST_VRT = 3


@dataclass(frozen=True)
class HeightsImage(RasterImage):
    """The band of heights of a file, with what is stated of it outside the file.

    Attributes:
        unit: of the heights, as it is stated; "" where it is not.
        crs: the reference system of the file with that of the heights, WKT; "" without.
        scale, offset: from values to heights in their unit.
        images_only: as it was opened.
    """

    unit: str = ""
    crs: str = ""
    scale: float = 1.0
    offset: float = 0.0
    images_only: bool = field(default=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        """In another process the file is opened again."""
        path = self.path if isinstance(self.path, Address) else self.path.resolve()
        return open_heights, (path, self.images_only)


HEIGHTS = PieceKind(
    "files of heights",
    (*IMAGE_SUFFIXES, *DRIVER_OF_SUFFIX, ".hgt.zip"),
    ("data", "elevation", "dem"),
    is_deep=False,
)
"""Which files of a folder are heights, by their names; a VRT lists others of the folder."""


def open_heights(path: FilePlace, images_only: bool = False, deep: int = 0) -> HeightsImage:
    """Open the first band of a file of heights.

    Args:
        path: of the file; at an address only an image is read.
        images_only: only a GeoTIFF, JPEG 2000 or NITF, which names no other file.
        deep: number of VRTs through which it was reached.

    Raises:
        FormatError: the file cannot be used.
        VerticalDatumError: the sources of a VRT contradict each other.
    """
    driver = None
    if isinstance(path, Path) and path.is_file() and not images_only:
        driver = _driver(path)
    if driver is None or isinstance(path, Address):
        image = open_values(path)
    else:
        of_sources = _vrt_sources(path, deep) if driver == "VRT" else None
        with as_format_error(path, f"a readable file of {driver}"), rasterio.Env(**_OPTIONS):
            dataset = rasterio.open(path.resolve(), driver=driver)
        if driver != "VRT":  # a VRT has no pixels of its own
            check_declaration(path, dataset, one_band(1))
        pixels, validity = Pixels(path, dataset, is_copied=False), validity_of(path, dataset)
        image = RasterImage(path, dataset, pixels, one_band(1), validity, statements=validity.statements)
        try:
            image.read(Window(image.shape[0] - 1, image.shape[1] - 1, 1, 1))
        except FormatError:
            dataset.close()
            raise
    heights = _stated(image, images_only)
    return heights if driver != "VRT" or of_sources is None else _inherited(heights, of_sources)


def _stated(image: RasterImage, images_only: bool) -> HeightsImage:
    """The band with its unit and scale, of the file itself or of the `.aux.xml` beside it."""
    dataset = image.dataset
    scale, offset = float(dataset.scales[0]), float(dataset.offsets[0])
    aux = _aux_band(image.path) if isinstance(image.path, Path) else {}
    unit = dataset.units[0] or aux.get("UnitType", "")
    name = f"{image.path.name}.aux.xml"
    if (scale, offset) == (1.0, 0.0):
        scale = parse_number(aux.get("Scale", "1"), "Scale", name)
        offset = parse_number(aux.get("Offset", "0"), "Offset", name)
    fields = {name: getattr(image, name) for name in RasterImage.__dataclass_fields__}
    wkt = "" if dataset.crs is None else dataset.crs.to_wkt(version="WKT2_2019")
    return HeightsImage(
        **fields, unit=unit, crs=wkt, scale=scale, offset=offset, images_only=images_only
    )


def _aux_band(path: Path) -> dict[str, str]:
    """What the `.aux.xml` beside a file states of its first band."""
    file = path.resolve().with_name(f"{path.resolve().name}.aux.xml")
    if not file.is_file():
        return {}
    for band in parse_xml(read_text(file), file.name).iter("PAMRasterBand"):
        if band.get("band", "1") == "1":
            return {part.tag: (part.text or "").strip() for part in band if (part.text or "").strip()}
    return {}


def _driver(path: Path) -> str | None:
    """The driver of a grid; None for images, which their first bytes show."""
    with path.open("rb") as file:
        start = file.read(16)
    if any(start.startswith(signature) for signature in DRIVER_OF_SIGNATURE):
        return None
    if path.name.lower().endswith((".hgt", ".hgt.zip")):
        if _HGT.fullmatch(path.name) is None:
            raise FormatError(
                f"{path}: the place of an .hgt is in its name, such as N44E005.hgt; name it so"
            )
        return "SRTMHGT"
    headers = [path.with_suffix(suffix) for suffix in (".hdr", ".HDR")]
    headers += [path.with_name(f"{path.name}.hdr")]
    if any(header.is_file() and read_text(header).lstrip().startswith("ENVI") for header in headers):
        return "ENVI"
    driver = DRIVER_OF_SUFFIX.get(path.suffix.lower())
    if driver is None:
        raise FormatError(
            f"{path}: expected a GeoTIFF, JPEG 2000 or NITF image, ENVI with its .hdr, or one of "
            f"{', '.join(DRIVER_OF_SUFFIX)}, found another kind of file; convert it (gdal_translate)"
        )
    return driver


def _vrt_sources(path: Path, deep: int) -> HeightsImage:
    """What the sources of a VRT state: the same unit, scale and vertical datum; one of them, closed.

    Raises:
        FormatError: it refers to what is not a file in its folder or below, or is no list of sources.
        VerticalDatumError: the sources contradict each other.
    """
    if deep >= _DEEPEST_VRT:
        raise FormatError(f"{path}: a VRT in a VRT in a VRT found; build one of the files themselves")
    root = parse_xml(read_text(path), path.name)
    foreign = [node.tag for node in root.iter() if node.tag not in _VRT_ELEMENTS]
    foreign += [str(node.get("subClass")) for node in root.iter() if node.get("subClass")]
    if root.tag != "VRTDataset" or foreign:
        raise FormatError(
            f"{path}: {(foreign or [root.tag])[0]} found; a VRT as gdalbuildvrt writes it expected: "
            "convert this one into a GeoTIFF (gdal_translate)"
        )
    folder = path.resolve().parent
    names = {(node.text or "", node.get("relativeToVRT") == "1") for node in root.iter("SourceFilename")}
    if not names:
        raise FormatError(f"{path}: a VRT without any source found; files of heights expected")
    found: dict[tuple[Any, ...], HeightsImage] = {}
    for name, is_relative in sorted(names):
        file = (folder / name if is_relative else Path(name)).resolve()
        if not name or "://" in name or not file.is_relative_to(folder) or not file.is_file():
            raise FormatError(
                f"{path}: source {name[:80]!r} found, an existing file in the folder of the VRT or "
                "below expected: put them together, and build it anew"
            )
        image = open_heights(file, deep=deep + 1)
        image.close()
        found.setdefault((image.unit, image.scale, image.offset, _vertical_part(image.crs)), image)
    if len(found) > 1:
        first, second = list(found.items())[:2]
        raise VerticalDatumError(
            f"{path}: {first[1].path.name} states {_said(first[0])}, {second[1].path.name} "
            f"{_said(second[0])}: the same in all sources expected; convert them first"
        )
    return next(iter(found.values()))


def _said(stated: tuple[Any, ...]) -> str:
    unit, scale, offset, vertical = stated
    return (
        f"unit {unit or 'none'}, scale {scale:g}, offset {offset:g}, heights in {vertical or 'nothing'}"
    )


def _vertical_part(wkt: str) -> str:
    """The name of the vertical reference system in a WKT; "" without."""
    match = re.search(r'VERT(?:CRS|_CS|CS)\["([^"]*)"', wkt)
    return match[1] if match else ""


def _inherited(vrt: HeightsImage, source: HeightsImage) -> HeightsImage:
    """A VRT with what it does not repeat of its sources."""
    if (vrt.scale, vrt.offset) != (source.scale, source.offset) and (source.scale, source.offset) != (
        1,
        0,
    ):
        raise FormatError(
            f"{vrt.path}: {source.path.name} has a scale of {source.scale:g} and an offset of "
            f"{source.offset:g}, which the VRT does not repeat: convert the sources first "
            "(gdal_translate -unscale)"
        )
    is_lost = _vertical_part(source.crs) and not _vertical_part(vrt.crs)
    return replace(vrt, unit=vrt.unit or source.unit, crs=source.crs if is_lost else vrt.crs)
