"""What the readers of terrains, geoids and map grids do with each statement in their files."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

_NEVER = (Subject.MODEL, Subject.ORDER, Subject.ACCURACY)
_OF_MAP = (
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "used",
        "by the operation of PROJ for the middle of the file, which is named with its accuracy",
    ),
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "assumed",
        "a system that names no datum, on the ellipsoid of WGS 84 or GRS 1980, is taken as WGS 84",
    ),
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "refused",
        "a system without a usable transformation, such as one on another ellipsoid without datum",
    ),
)
_EPOCH = Treatment(Subject.EPOCH, "named", "of coordinates: positions are taken as WGS 84 of today")
_SCALE = "US survey foot, ft, cm … of the band, else of the vertical system; with scale and offset"
_UNIT = (
    Treatment(Subject.UNIT, "used", _SCALE),
    Treatment(Subject.UNIT, "assumed", "metres, where neither band nor vertical system has a unit"),
    Treatment(Subject.UNIT, "named", "of the vertical system, where that of the band is another"),
    Treatment(Subject.UNIT, "refused", "a word that is no unit of length"),
)
_VERTICAL = (
    Treatment(Subject.VERTICAL_DATUM, "used", "of a compound system, or as the caller states it"),
    Treatment(
        Subject.VERTICAL_DATUM,
        "assumed",
        "heights above the ellipsoid in a national system are above that of WGS 84, as GNSS gives; "
        "a system with three axes states its own ellipsoid",
    ),
    Treatment(Subject.VERTICAL_DATUM, "refused", "none; another one than the caller states; depths"),
)
_VALIDITY = (
    Treatment(Subject.VALIDITY, "used", "nodata value, mask or alpha, as GDAL takes them"),
    Treatment(Subject.VALIDITY, "assumed", "voids are -9999, and heights that no ground has"),
)

TERRAIN_READER = Reader(
    "Terrain: GeoTIFF, JPEG 2000, NITF",
    ("read_dem",),
    (
        *_OF_MAP,
        *_VERTICAL,
        *_UNIT,
        Treatment(Subject.PLACE, "used", "`.aux.xml` and world files, as for images"),
        Treatment(Subject.PIXEL_ORIGIN, "used", "AREA_OR_POINT, as in GDAL"),
        *_VALIDITY,
        Treatment(Subject.BANDS, "named", "all but the first"),
        Treatment(Subject.BANDS, "refused", "a band with a palette of colours"),
        _EPOCH,
    ),
    (*_NEVER, Subject.IDENTITY),
)
GRID_READER = Reader(
    "Terrain: SRTM `.hgt`, `.bil`, `.flt`, `.asc`, DTED, ENVI, ERDAS",
    ("read_dem",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "of the format, the header or the `.prj` beside"),
        Treatment(Subject.HORIZONTAL_DATUM, "refused", "none; one without a usable transformation"),
        Treatment(Subject.VERTICAL_DATUM, "used", "as the caller states it"),
        Treatment(
            Subject.VERTICAL_DATUM,
            "assumed",
            "EGM96 in `.hgt` and DTED, by their documents",
        ),
        Treatment(Subject.VERTICAL_DATUM, "refused", "none, in the other formats"),
        Treatment(Subject.UNIT, "used", "of the format, or of the `.aux.xml` beside"),
        Treatment(Subject.UNIT, "assumed", "metres"),
        Treatment(Subject.PLACE, "used", "of an `.hgt` by its name: a node in each corner"),
        Treatment(Subject.PLACE, "refused", "an `.hgt` whose name has no place"),
        Treatment(Subject.PIXEL_ORIGIN, "used", "nodes of `.hgt` and DTED are points"),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "of the others, as their headers are defined"),
        *_VALIDITY,
    ),
    (*_NEVER, Subject.BANDS, Subject.EPOCH, Subject.IDENTITY),
)
TILES_READER = Reader(
    "Terrain: VRT, folder, list of tiles",
    ("read_dem",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "of each tile; others than that of the finest"),
        Treatment(Subject.VERTICAL_DATUM, "used", "of the tiles; of the sources of a VRT"),
        Treatment(Subject.VERTICAL_DATUM, "refused", "tiles above different datums"),
        Treatment(Subject.UNIT, "used", "of each tile; of the sources, where a VRT repeats none"),
        Treatment(Subject.UNIT, "refused", "sources of a VRT in different units or scales"),
        Treatment(Subject.PLACE, "refused", "a VRT that leaves its folder or computes; a missing tile"),
        Treatment(Subject.PIXEL_ORIGIN, "used", "of each tile"),
        Treatment(Subject.VALIDITY, "used", "voids of one tile get the heights of the next"),
        Treatment(Subject.IDENTITY, "refused", "two tiles of the same ground, such as heights and mask"),
    ),
    (*_NEVER, Subject.BANDS, Subject.EPOCH),
)
GEOID_READER = Reader(
    "Grid of a geoid: GTX, GeoTIFF",
    (),
    (
        Treatment(
            Subject.VERTICAL_DATUM, "used", "by its path, or its name alone where PROJ keeps its grids"
        ),
        Treatment(Subject.VERTICAL_DATUM, "named", "a national datum of heights, above a global geoid"),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "EGM96 for heights above EGM2008 and the like; no grid; a grid of another region",
        ),
    ),
    tuple(subject for subject in Subject if subject is not Subject.VERTICAL_DATUM),
)
MAP_READER = Reader(
    "Map grid of an ortho-image",
    (),
    (
        *_OF_MAP,
        Treatment(Subject.VERTICAL_DATUM, "named", "of a compound system: an image has no heights"),
        Treatment(Subject.UNIT, "used", "of the map, such as US survey feet"),
        Treatment(Subject.PLACE, "used", "`.aux.xml` and world files, as in GDAL"),
        Treatment(Subject.PIXEL_ORIGIN, "used", "AREA_OR_POINT, as in GDAL"),
        _EPOCH,
    ),
    (*_NEVER, Subject.VALIDITY, Subject.BANDS, Subject.IDENTITY),
)
TERRAIN_READERS = (TERRAIN_READER, GRID_READER, TILES_READER, GEOID_READER, MAP_READER)
