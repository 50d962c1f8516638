"""Files of marked points: which reader a file is for."""

from collections.abc import Callable
from pathlib import Path

from services.errors import FormatError
from services.formats.gcp.json_formats import parse_geojson_points, parse_opf
from services.formats.gcp.marked_points import MarkedPoints
from services.formats.gcp.odm import parse_gcp_list
from services.formats.gcp.pci import is_pci_text, parse_pci_text
from services.formats.gcp.text_formats import parse_asp_gcp, parse_envi_pts, parse_qgis_points
from services.formats.sensor_models.rpc_files import read_text

Parser = Callable[[str, str | None, str], MarkedPoints]
"""From the text, what its heights are above where the format cannot say, and the name of the file."""


def read_control_points(path: Path, heights: str | None = None) -> MarkedPoints:
    """Read ground points marked in images, in any format of `services.formats.gcp.marked_points`.

    Args:
        path: `.gcp`, `.points`, `.pts`, `.txt` for ODM and PCI, `.geojson` and `.json` for GeoJSON, OPF.
        heights: of `.gcp`, `.pts` and `.txt`, which may not say what they are above: "ellipsoid" of
            WGS 84, or a vertical reference system such as "EPSG:5773".

    Raises:
        FormatError: when it is none of these files, or one that does not say what it should.
        VerticalDatumError: when the datum of the heights is neither in the file nor given, or the
            grid it needs is not installed.
    """
    parse = _PARSERS.get(path.suffix.lower())
    if parse is None:
        raise FormatError(f"{path.name}: expected a name that ends in one of {', '.join(_PARSERS)}")
    return parse(read_text(path), heights, path.name)


def _parse_json(text: str, heights: str | None, source: str) -> MarkedPoints:
    """OPF or GeoJSON; both say what their heights are above."""
    return (parse_opf if '"gcps"' in text else parse_geojson_points)(text, source)


def _parse_txt(text: str, heights: str | None, source: str) -> MarkedPoints:
    """PCI where the first line tells its columns, else ODM."""
    return (parse_pci_text if is_pci_text(text) else parse_gcp_list)(text, heights, source)


_PARSERS: dict[str, Parser] = {
    ".gcp": parse_asp_gcp,
    ".points": lambda text, heights, source: parse_qgis_points(text, source),
    ".pts": parse_envi_pts,
    ".txt": _parse_txt,
    ".geojson": _parse_json,
    ".json": _parse_json,
}
