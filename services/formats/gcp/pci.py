"""Marked points as text files of PCI's OrthoEngine, whose columns are told by a string of letters.

Source: CATALYST Professional, "Understanding formats for text files containing GCPs". Such a file says
neither its columns nor its reference system. PCI leaves aside lines that do not fit the columns asked
for, so a first line tells both here: `# layout=IDPLXYZS crs=EPSG:4326 heights=ellipsoid`.

Pixels count from the corner of the first one, as GDAL has them from PCI's own files (PCIDSK).
"""

import math
import re

import numpy as np

from services.errors import FormatError
from services.formats.gcp.marked_points import (
    ELLIPSOID,
    MarkedPoints,
    crs_from,
    ground_from,
    marked_points,
)
from services.formats.gcp.text_lines import (
    coordinate_array,
    counted_ids,
    format_deg,
    format_m,
    format_px,
    lines_of,
    numbers_of,
)

PCI_CORNER_PX = 0.5
"""PCI counts from the corner of the first pixel."""

_HEADER = re.compile(r"#\s*layout=(\S+)\s+crs=(\S+)(?:\s+heights=(\S+))?\s*")
_COLUMN = re.compile(r"ID|e[PLXYZ]|[PLXYZS]")
_FIELD = re.compile(r'"[^"]*"|[^\s,"]+')


def is_pci_text(text: str) -> bool:
    """Whether a text begins with the line that tells PCI's columns."""
    return _HEADER.fullmatch(text.partition("\n")[0]) is not None


def format_pci_text(points: MarkedPoints) -> str:
    """The points as a text file of PCI, in longitude and latitude, with the status of each.

    Errors of pixel and line are written when all are known. Blanks in names become underscores.
    """
    known = bool(np.isfinite(points.sigma_px).all())
    layout = "IDPLXYZePeLS" if known else "IDPLXYZS"
    lines = [f"# layout={layout} crs=EPSG:4326 heights={ELLIPSOID}"]
    for i in range(len(points)):
        lon, lat, height_m = points.lon_lat_h[i]
        line, sample = points.line_sample[i] + PCI_CORNER_PX
        fields = [re.sub(r"[\s,\"]", "_", str(points.id[i])), format_px(sample), format_px(line)]
        fields += [format_deg(lon), format_deg(lat), format_m(height_m)]
        fields += [format_px(points.sigma_px[i])] * 2 if known else []
        fields.append("C" if points.check[i] else "G" if points.active[i] else "I")
        lines.append(" ".join(fields))
    return "\n".join(lines) + "\n"


def parse_pci_text(text: str, heights: str | None = None, source: str = "PCI text") -> MarkedPoints:
    """Read a text file of PCI whose first line tells its columns and its reference system.

    Errors of the ground (eX, eY, eZ) are left aside: PCI's help gives them in pixels.

    Args:
        text: contents of the file; fields are divided by blanks, tabs or commas.
        heights: above what, where the first line does not say it: "ellipsoid" or a vertical system.
        source: its name, for the messages.

    Raises:
        FormatError: when a line is not of that form; PCI would pass over it.
        VerticalDatumError: when nobody says what the heights are above.
    """
    header = _HEADER.fullmatch(text.partition("\n")[0])
    if header is None:
        raise FormatError(
            f"{source}: expected a first line like '# layout=IDPLXYZ crs=EPSG:32633 heights=ellipsoid'"
        )
    layout, definition, above = header.groups()
    columns = _columns(layout, source)
    rows = []
    for where, line in lines_of(text, "#", source):
        fields = [field.strip('"') for field in _FIELD.findall(line)]
        if len(fields) != len(columns):
            raise FormatError(f"{where}: expected {len(columns)} fields, {layout}, found {len(fields)}")
        rows.append(_Row(dict(zip(columns, fields, strict=True)), where))
    coordinates = coordinate_array([(row.number("X"), row.number("Y"), row.number("Z")) for row in rows])
    pixels = [(row.number("L") - PCI_CORNER_PX, row.number("P") - PCI_CORNER_PX) for row in rows]
    crs = crs_from(definition, source)
    if "Z" in columns:
        ground = ground_from(coordinates, crs, above or heights, source)
    else:
        ground = ground_from(np.nan_to_num(coordinates, nan=0.0), crs.to_2d(), ELLIPSOID, source)
        ground[:, 2] = np.nan
    return marked_points(
        [row.fields["ID"] for row in rows] if "ID" in columns else counted_ids(pixels),
        ground,
        pixels,
        sigma_px=[math.hypot(row.number("eP"), row.number("eL")) / math.sqrt(2.0) for row in rows],
        active=[row.status != "I" for row in rows],
        check=[row.status == "C" for row in rows],
    )


class _Row:
    """The fields of a line by the letters of their columns."""

    def __init__(self, fields: dict[str, str], where: str) -> None:
        self.fields, self.where = fields, where
        self.status = fields.get("S", "G")
        if self.status not in ("G", "I", "C"):
            raise FormatError(f"{where}: S should be G, I or C, found {self.status[:20]!r}")

    def number(self, column: str) -> float:
        """NaN without the column."""
        if column not in self.fields:
            return math.nan
        return numbers_of([self.fields[column]], [column], self.where)[0]


def _columns(layout: str, source: str) -> list[str]:
    """The columns that a string of letters stands for."""
    columns = _COLUMN.findall(layout)
    if "".join(columns) != layout or len(set(columns)) != len(columns):
        raise FormatError(
            f"{source}: layout should be made of ID P L X Y Z eP eL eX eY eZ S, each once, "
            f"found {layout[:60]!r}"
        )
    missing = [name for name in "PLXY" if name not in columns]
    if missing:
        raise FormatError(f"{source}: layout should have P, L, X and Y, found no {', '.join(missing)}")
    return columns
