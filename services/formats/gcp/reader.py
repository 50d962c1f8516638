"""Reading files of marked points in any supported format."""

from collections.abc import Callable
from pathlib import Path

from services.errors import FormatError
from services.formats.gcp.json_formats import parse_geojson_points, parse_opf
from services.formats.gcp.marked_points import MarkedPoints
from services.formats.gcp.odm import parse_gcp_list
from services.formats.gcp.pci import is_pci_text, parse_pci_text
from services.formats.gcp.text_formats import parse_asp_gcp, parse_envi_pts, parse_qgis_points
from services.formats.text_files import read_text

Parser = Callable[[str, str | None, str], MarkedPoints]
"""Called with the text, the datum of its heights where the format cannot state it, and the file name."""


def read_control_points(path: Path, heights: str | None = None) -> MarkedPoints:
    """The marked points of a file in any format of `services.formats.gcp.marked_points`.

    Args:
        path: `.gcp`, `.points`, `.pts`, `.txt` for ODM and PCI, `.geojson` and `.json` for GeoJSON, OPF.
        heights: datum of the heights of `.gcp`, `.pts` and `.txt`, which may not state it: "ellipsoid"
            (of WGS 84) or a vertical reference system such as "EPSG:5773".

    Raises:
        FormatError: the file has none of these formats, or its content is wrong.
        VerticalDatumError: the datum of the heights is neither in the file nor given, or the grid it
            needs is not installed.
    """
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise FormatError(f"{path.name}: expected a file name that ends in {', '.join(_PARSERS)}")
    return parse(read_text(path), heights, path.name)


def _parse_json(text: str, heights: str | None, source: str) -> MarkedPoints:
    """The points of an OPF or a GeoJSON; both state the datum of their heights."""
    return (parse_opf if '"gcps"' in text else parse_geojson_points)(text, source)


def _parse_txt(text: str, heights: str | None, source: str) -> MarkedPoints:
    """The points of a PCI text, where the first line declares its columns, else of an ODM list."""
    return (parse_pci_text if is_pci_text(text) else parse_gcp_list)(text, heights, source)


_PARSERS: dict[str, Parser] = {
    ".gcp": parse_asp_gcp,
    ".points": lambda text, heights, source: parse_qgis_points(text, source),
    ".pts": parse_envi_pts,
    ".txt": _parse_txt,
    ".geojson": _parse_json,
    ".json": _parse_json,
}
