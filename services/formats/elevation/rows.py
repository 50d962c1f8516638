"""Treatment of the statements in files of terrains, geoids and map grids."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

_NEVER = (Subject.MODEL, Subject.ORDER, Subject.ACCURACY)
_OF_MAP = (
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "used",
        "The reference system of the file. Positions are transformed with the operation that PROJ "
        "selects for the middle of the file; the report names this operation and its accuracy.",
    ),
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "assumed",
        "A system without a named datum, on the ellipsoid of WGS 84 or GRS 1980, is used as WGS 84.",
    ),
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "refused",
        "A system without a usable transformation to WGS 84, such as a system on another ellipsoid "
        "without a named datum.",
    ),
)
_EPOCH = Treatment(
    Subject.EPOCH, "named", "The epoch of the coordinates. Positions are used as current WGS 84."
)
_SCALE = (
    "The unit of the band, otherwise the unit of the vertical system: US survey foot, ft, cm and "
    "others. Scale and offset are applied."
)
_UNIT = (
    Treatment(Subject.UNIT, "used", _SCALE),
    Treatment(
        Subject.UNIT,
        "assumed",
        "Heights are in metres if neither the band nor the vertical system states a unit.",
    ),
    Treatment(
        Subject.UNIT, "named", "The unit of the vertical system, if the band states another unit."
    ),
    Treatment(Subject.UNIT, "refused", "The stated unit is not a unit of length."),
)
_VERTICAL = (
    Treatment(
        Subject.VERTICAL_DATUM, "used", "The vertical system of the file, or the datum that you state."
    ),
    Treatment(
        Subject.VERTICAL_DATUM,
        "assumed",
        "Ellipsoidal heights in a national system are above the WGS 84 ellipsoid, as GNSS gives them. A "
        "system with three axes is the exception: it states its own ellipsoid.",
    ),
    Treatment(
        Subject.VERTICAL_DATUM,
        "refused",
        "No datum is stated, you state another datum than the file, or the datum counts depths.",
    ),
)
_VALIDITY = (
    Treatment(Subject.VALIDITY, "used", "Nodata value, mask or alpha band, as GDAL uses them."),
    Treatment(
        Subject.VALIDITY, "assumed", "Voids are -9999 and heights that do not occur on the Earth."
    ),
)

TERRAIN_READER = Reader(
    "Terrain: GeoTIFF, JPEG 2000, NITF",
    ("read_dem",),
    (
        *_OF_MAP,
        *_VERTICAL,
        *_UNIT,
        Treatment(Subject.PLACE, "used", "`.aux.xml` files and world files, as for images."),
        Treatment(Subject.PIXEL_ORIGIN, "used", "AREA_OR_POINT, as GDAL uses it."),
        *_VALIDITY,
        Treatment(Subject.BANDS, "named", "All bands except the first."),
        Treatment(Subject.BANDS, "refused", "The band has a palette of colours."),
        _EPOCH,
    ),
    (*_NEVER, Subject.IDENTITY),
)
GRID_READER = Reader(
    "Terrain: SRTM `.hgt`, `.bil`, `.flt`, `.asc`, DTED, ENVI, ERDAS",
    ("read_dem",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "The system of the format, of the header, or of the `.prj` file next to the image.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "No system is stated, or it has no usable transformation to WGS 84.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "The datum that you state, or a vertical system in the `.prj` file.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "assumed",
            "Heights of `.hgt` and DTED are above EGM96, as the documents of these formats say.",
        ),
        Treatment(Subject.VERTICAL_DATUM, "refused", "No datum is stated, in the other formats."),
        Treatment(
            Subject.UNIT, "used", "The unit of the format, or of the `.aux.xml` file next to the image."
        ),
        Treatment(Subject.UNIT, "assumed", "Heights are in metres."),
        Treatment(
            Subject.PLACE,
            "used",
            "The name of an `.hgt` file states its place; there is a node in each corner.",
        ),
        Treatment(Subject.PLACE, "refused", "The name of an `.hgt` file states no place."),
        Treatment(Subject.PIXEL_ORIGIN, "used", "The nodes of `.hgt` and DTED are points."),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "assumed",
            "In the other formats, the definition of their headers decides.",
        ),
        *_VALIDITY,
    ),
    (*_NEVER, Subject.BANDS, Subject.EPOCH, Subject.IDENTITY),
)
TILES_READER = Reader(
    "Terrain: VRT, folder, list of tiles",
    ("read_dem",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "Each tile is used in its own system, also if the system differs from that of the finest "
            "tile.",
        ),
        Treatment(Subject.VERTICAL_DATUM, "used", "The datum of the tiles, or of the sources of a VRT."),
        Treatment(Subject.VERTICAL_DATUM, "refused", "The tiles have different vertical datums."),
        Treatment(
            Subject.UNIT,
            "used",
            "The unit of each tile; for a VRT without units, the unit of its sources.",
        ),
        Treatment(Subject.UNIT, "refused", "The sources of a VRT have different units or scales."),
        Treatment(
            Subject.PLACE,
            "refused",
            "A VRT refers to files outside its folder or computes values, or a tile is missing.",
        ),
        Treatment(Subject.PIXEL_ORIGIN, "used", "The pixel origin of each tile."),
        Treatment(
            Subject.VALIDITY, "used", "Voids of one tile are filled with heights of the next tile."
        ),
        Treatment(
            Subject.IDENTITY, "refused", "Two files show the same ground, such as heights and a mask."
        ),
    ),
    (*_NEVER, Subject.BANDS, Subject.EPOCH),
)
GEOID_READER = Reader(
    "Grid of a geoid: GTX, GeoTIFF",
    (),
    (
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "A path names the grid. A name alone is enough for a grid in the folders of PROJ.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "The national datum of the heights, if you give a grid of a global geoid.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "The grid is of another geoid than the heights, such as EGM96 for heights above EGM2008. "
            "The grid does not exist. The grid does not cover the terrain.",
        ),
    ),
    tuple(subject for subject in Subject if subject is not Subject.VERTICAL_DATUM),
)
MAP_READER = Reader(
    "Map grid of an ortho-image",
    (),
    (
        *_OF_MAP,
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "The vertical part of a compound system, because an image has no heights.",
        ),
        Treatment(Subject.UNIT, "used", "The unit of the map, such as US survey feet."),
        Treatment(Subject.PLACE, "used", "`.aux.xml` files and world files, as GDAL uses them."),
        Treatment(Subject.PIXEL_ORIGIN, "used", "AREA_OR_POINT, as GDAL uses it."),
        _EPOCH,
    ),
    (*_NEVER, Subject.VALIDITY, Subject.BANDS, Subject.IDENTITY),
)
TERRAIN_READERS = (TERRAIN_READER, GRID_READER, TILES_READER, GEOID_READER, MAP_READER)
