"""Statements of a file about its map grid."""

from dataclasses import replace
from pathlib import Path

from pyproj import CRS

from amers.services.datums import DatumShift, horizontal
from amers.services.formats.images.geokeys import coordinate_epoch
from amers.services.formats.images.georeference import georeference
from amers.services.formats.images.raster import OpenImage
from amers.services.map_grid import MapGrid
from amers.services.statements import Statement, Statements, Subject, Use

_PLAIN_UNITS = ("metre", "degree")


def map_statements(
    image: OpenImage, grid: MapGrid, shift: DatumShift, *, has_sigmas: bool = True
) -> Statements:
    """Datum, unit, epoch, pixel origin and place of a map grid.

    Args:
        image: the file.
        grid: its map grid.
        shift: the datum shift of its reference system.
        has_sigmas: whether its positions have sigmas, which the accuracy of the shift enters.
    """
    name = image.path.name
    said = [shift.statement(name, has_sigmas=has_sigmas)]
    point = image.dataset.tags().get("AREA_OR_POINT", "")
    origin = Statement(name, Subject.PIXEL_ORIGIN, Use.USED, point, "AREA_OR_POINT", "as in GDAL")
    if not point:
        note = "the corner of the first pixel has the position of the grid"
        origin = replace(origin, use=Use.ASSUMED, value="Area", where="", note=note)
    said.append(origin)
    unit = horizontal(grid.crs).axis_info[0].unit_name
    if unit.lower() not in _PLAIN_UNITS:
        said.append(Statement(name, Subject.UNIT, Use.USED, unit, "map grid"))
    epoch = coordinate_epoch(image.path) if isinstance(image.path, Path) else None
    if epoch is not None:
        note = "positions are taken as WGS 84 of today; plates move up to 0.1 m a year"
        said.append(
            Statement(name, Subject.EPOCH, Use.NOT_USED, f"{epoch:.2f}", "CoordinateEpochGeoKey", note)
        )
    return (*georeference(image.path, image.dataset).statements, *said)


def unused_heights(image: OpenImage, grid: MapGrid) -> Statements:
    """The vertical reference system of an image whose pixels are no heights."""
    crs = CRS.from_wkt(grid.crs)
    if len(crs.axis_info) < 3:
        return ()
    vertical = crs.sub_crs_list[1].name if crs.is_compound else "the ellipsoid"
    where, note = "reference system", "an image has no heights"
    return (Statement(image.path.name, Subject.VERTICAL_DATUM, Use.NOT_USED, vertical, where, note),)
