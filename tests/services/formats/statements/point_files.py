"""Cells of files of ground points: a text, what the caller states, and the first point."""

from pathlib import Path

import numpy as np

from amers.services.formats.gcp.csv_points import CsvLayout
from amers.services.formats.gcp.marked_points import MarkedPoints
from amers.services.formats.gcp.reader import StatedByCaller, read_used_points
from amers.services.formats.reader_rows import Outcome, Reader
from amers.services.statements import Subject
from tests.services.formats.statements.cell import cell

GOLDEN = Path(__file__).parents[3] / "golden"
ELLIPSOID = StatedByCaller("ellipsoid")
NOBODY = StatedByCaller()
UTM = StatedByCaller("ellipsoid", csv=CsvLayout({}, "EPSG:32633"))
FEET = StatedByCaller("ellipsoid", csv=CsvLayout({}, "EPSG:2263"))
MOON = (
    'GEOGCS["Moon",DATUM["D_Moon",SPHEROID["Moon",1737400,0]],PRIMEM["Greenwich",0],'
    'UNIT["Degree",0.0174532925199433]]'
)
ED50 = (
    'GEOGCS["ED50",DATUM["European_Datum_1950",SPHEROID["International 1924",6378388,297],'
    'AUTHORITY["EPSG","6230"]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],'
    'AUTHORITY["EPSG","4230"]]'
)
a_centimetre_deg = 1e-7
a_millimetre = 1e-3


def add(
    reader: Reader,
    subject: Subject,
    outcome: Outcome,
    shows: str,
    text: str | bytes,
    *,
    stated: StatedByCaller = ELLIPSOID,
    height_m: float | None = None,
    lon_lat: tuple[float, float] | None = None,
    name: str = "points",
) -> None:
    """A cell: a text is read, its first point has a height or a position, or it is refused."""

    def read(folder: Path) -> MarkedPoints:
        path = folder / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        points = read_used_points(path, stated)
        if height_m is not None:
            assert abs(points.lon_lat_h[0, 2] - height_m) < a_millimetre
        if lon_lat is not None:
            assert np.abs(points.lon_lat_h[0, :2] - lon_lat).max() < a_centimetre_deg
        return points

    cell(reader.name, subject, outcome, shows)(read)
