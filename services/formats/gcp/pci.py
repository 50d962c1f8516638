"""Marked points in text files of PCI's OrthoEngine, where a string of letters defines the columns.

Source: CATALYST Professional, "Understanding formats for text files containing GCPs". Such a file
states neither its columns nor its reference system. PCI ignores lines that do not have the columns
requested, so Amers states both in a first line: `# layout=IDPLXYZS crs=EPSG:4326 heights=ellipsoid`.

Pixels count from the corner of the first one, as in PCI's own files (PCIDSK) read by GDAL.
"""

import math
import re

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.gcp.comments import (
    agreed_heights,
    check_axes,
    comment_lines,
    earth_crs,
    read_comments,
)
from amers.services.formats.gcp.marked_points import (
    ELLIPSOID,
    Heights,
    MarkedPoints,
    marked_points,
    to_wgs84,
)
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_lines import (
    content_lines,
    coordinate_array,
    format_deg,
    format_m,
    format_px,
    parse_numbers,
    sequential_ids,
)
from amers.services.statements import Subject

PCI_CORNER_PX = 0.5
"""PCI counts pixels from the corner of the first one."""

_HEADER = re.compile(r"#\s*layout=(\S+)\s+crs=(\S+)(?:\s+heights=(\S+))?\s*")
_COLUMN = re.compile(r"ID|e[PLXYZ]|[PLXYZS]")
_FIELD = re.compile(r'"[^"]*"|[^\s,"]+')


def is_pci_text(text: str) -> bool:
    """Whether the first line of a text declares the columns of a PCI text file."""
    return _HEADER.fullmatch(text.partition("\n")[0]) is not None


def format_pci_text(points: MarkedPoints) -> str:
    """The points as a text file of PCI, in longitude and latitude, with the status of each.

    The errors of pixel and line are written when all of them are known. Spaces in names become
    underscores.
    """
    has_sigmas = bool(np.isfinite(points.sigma_px).all())
    layout = "IDPLXYZePeLS" if has_sigmas else "IDPLXYZS"
    lines = [f"# layout={layout} crs=EPSG:4326 heights={ELLIPSOID}"]
    for i in range(len(points)):
        lon, lat, height_m = points.lon_lat_h[i]
        line, sample = points.line_sample[i] + PCI_CORNER_PX
        fields = [re.sub(r"[\s,\"]", "_", str(points.id[i])), format_px(sample), format_px(line)]
        fields += [format_deg(lon), format_deg(lat), format_m(height_m)]
        fields += [format_px(points.sigma_px[i])] * 2 if has_sigmas else []
        fields.append("C" if points.check[i] else "G" if points.active[i] else "I")
        lines.append(" ".join(fields))
    return "\n".join(lines) + "\n"


def parse_pci_text(text: str, heights: Heights | None = None, source: str = "PCI text") -> MarkedPoints:
    """The marked points of a text file of PCI whose first line declares columns and reference system.

    Errors on the ground (eX, eY, eZ) are ignored: PCI's help defines them in pixels.

    Args:
        text: contents of the file; spaces, tabs or commas separate fields.
        heights: datum of the heights where the first line does not state it: "ellipsoid" or a vertical
            reference system.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form; PCI itself would ignore it.
        VerticalDatumError: neither the file nor the caller states the datum of the heights.
    """
    header = _HEADER.fullmatch(text.partition("\n")[0])
    if header is None:
        raise FormatError(
            f"{source}: expected a first line like '# layout=IDPLXYZ crs=EPSG:32633 heights=ellipsoid'"
        )
    layout, definition, stated_heights = header.groups()
    columns = _columns(layout, source)
    comments = read_comments(comment_lines(text, "#"), source)
    crs = earth_crs(definition, source)
    record = Record(source, list(comments.statements))
    record.used(Subject.ORDER, layout, "line 1")
    if stated_heights is not None:
        record.used(Subject.VERTICAL_DATUM, stated_heights, "line 1")
    rows = []
    for where, line in content_lines(text, "#", source):
        fields = [field.strip('"') for field in _FIELD.findall(line)]
        if len(fields) != len(columns):
            raise FormatError(
                f"{where}: expected the {len(columns)} fields {layout}, found {len(fields)}"
            )
        rows.append(_Row(dict(zip(columns, fields, strict=True)), where))
    coordinates = coordinate_array([(row.number("X"), row.number("Y"), row.number("Z")) for row in rows])
    pixels = [(row.number("L") - PCI_CORNER_PX, row.number("P") - PCI_CORNER_PX) for row in rows]
    check_axes(coordinates, crs, source)
    datum = agreed_heights(stated_heights or comments.heights, heights, source)
    ground = to_wgs84(coordinates, crs if "Z" in columns else crs.to_2d(), datum, source)
    if "Z" in columns:
        record.assumed(Subject.UNIT, "metres", "column Z")
    record.assumed(Subject.PIXEL_ORIGIN, "the corner of the first pixel is 0, 0")
    errors = [name for name in ("eX", "eY", "eZ") if name in columns]
    if errors:
        record.not_used(Subject.ACCURACY, ", ".join(errors), "", "PCI defines them in pixels")
    if "S" in columns:
        record.used(Subject.VALIDITY, "G, I, C", "column S")
    return marked_points(
        [row.fields["ID"] for row in rows] if "ID" in columns else sequential_ids(pixels),
        ground,
        pixels,
        statements=tuple(record.statements),
        sigma_px=[math.hypot(row.number("eP"), row.number("eL")) / math.sqrt(2.0) for row in rows],
        active=[row.status != "I" for row in rows],
        check=[row.status == "C" for row in rows],
    )


class _Row:
    """The fields of one line, by the letters of their columns."""

    def __init__(self, fields: dict[str, str], where: str) -> None:
        self.fields, self.where = fields, where
        self.status = fields.get("S", "G")
        if self.status not in ("G", "I", "C"):
            raise FormatError(f"{where}: S: expected G, I or C, found {self.status[:20]!r}")

    def number(self, column: str) -> float:
        """The number in a column; NaN where the file has no such column."""
        if column not in self.fields:
            return math.nan
        return parse_numbers([self.fields[column]], [column], self.where)[0]


def _columns(layout: str, source: str) -> list[str]:
    """The columns that a string of letters declares."""
    columns = _COLUMN.findall(layout)
    if "".join(columns) != layout or len(set(columns)) != len(columns):
        raise FormatError(
            f"{source}: layout: expected some of ID P L X Y Z eP eL eX eY eZ S, each at most once, "
            f"found {layout[:60]!r}"
        )
    missing = [name for name in "PLXY" if name not in columns]
    if missing:
        raise FormatError(f"{source}: layout: expected P, L, X and Y, found no {', '.join(missing)}")
    return columns
