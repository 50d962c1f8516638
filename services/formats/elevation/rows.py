"""Treatment of the statements in files of terrains, geoids and map grids."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

_NEVER = (Subject.MODEL, Subject.ORDER, Subject.ACCURACY)
_OF_MAP = (
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "used",
        "The file states its reference system. Amers transforms positions with the "
        "operation that PROJ selects for the middle of the file. The report names "
        "this operation and its accuracy.",
    ),
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "assumed",
        "The system has no named datum, but the ellipsoid of WGS 84 or GRS 1980: "
        "Amers uses it as WGS 84.",
    ),
    Treatment(
        Subject.HORIZONTAL_DATUM,
        "refused",
        "The system has no usable transformation to WGS 84, for example because it "
        "has no named datum and another ellipsoid.",
    ),
)
_EPOCH = Treatment(
    Subject.EPOCH,
    "named",
    "The file states an epoch of the coordinates. Amers uses the positions as current WGS 84.",
)
_SCALE = (
    "The band, or otherwise the vertical system, states the unit, such as US "
    "survey foot, ft or cm. Amers also applies scale and offset of the band."
)
_UNIT = (
    Treatment(Subject.UNIT, "used", _SCALE),
    Treatment(
        Subject.UNIT,
        "assumed",
        "Heights are in metres if neither the band nor the vertical system states a unit.",
    ),
    Treatment(Subject.UNIT, "named", "The vertical system states another unit than the band."),
    Treatment(Subject.UNIT, "refused", "The stated unit is not a unit of length."),
)
_VERTICAL = (
    Treatment(
        Subject.VERTICAL_DATUM, "used", "The file or you (`--vertical`) state the vertical datum."
    ),
    Treatment(
        Subject.VERTICAL_DATUM,
        "assumed",
        "Heights in a national system are ellipsoidal: Amers assumes heights above "
        "the WGS 84 ellipsoid, as from GNSS. A system with three axes is the "
        "exception, because it states its own ellipsoid.",
    ),
    Treatment(
        Subject.VERTICAL_DATUM,
        "refused",
        "No datum is stated, you state another datum than the file, or the datum is one of depths.",
    ),
)
_VALIDITY = (
    Treatment(
        Subject.VALIDITY,
        "used",
        "A nodata value, a mask or an alpha band states which heights are valid. "
        "Amers uses it as GDAL does.",
    ),
    Treatment(
        Subject.VALIDITY,
        "assumed",
        "Heights of -9999, and heights that do not occur on the Earth, are voids.",
    ),
)

TERRAIN_READER = Reader(
    "Terrain: GeoTIFF, JPEG 2000, NITF",
    ("read_dem",),
    (
        *_OF_MAP,
        *_VERTICAL,
        *_UNIT,
        Treatment(
            Subject.PLACE,
            "used",
            "An `.aux.xml` file or a world file states the map grid, as for images.",
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "used",
            "AREA_OR_POINT states whether a value is for a pixel area or a point. Amers "
            "uses it as GDAL does.",
        ),
        *_VALIDITY,
        Treatment(Subject.BANDS, "named", "The file has further bands. Amers reads the first band."),
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
            "The format, the header or the `.prj` file states the system.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "No system is stated, or it has no usable transformation to WGS 84.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "You (`--vertical`) or the `.prj` file state the vertical datum.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "assumed",
            "The format is `.hgt` or DTED: heights are above EGM96, as the specifications"
            " of these formats state.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM, "refused", "The file has another format, and no datum is stated."
        ),
        Treatment(Subject.UNIT, "used", "The format, or the `.aux.xml` file, states the unit."),
        Treatment(Subject.UNIT, "assumed", "Heights are in metres."),
        Treatment(
            Subject.PLACE,
            "used",
            "The name of an `.hgt` file states its position. There is a height node in each corner.",
        ),
        Treatment(Subject.PLACE, "refused", "The name of an `.hgt` file states no position."),
        Treatment(
            Subject.PIXEL_ORIGIN, "used", "The format is `.hgt` or DTED: the height nodes are points."
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "assumed",
            "The file has another format: the definition of its header states the pixel origin.",
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
            "Each tile states its system. Amers uses each tile in its own system, also if"
            " the systems differ.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "The tiles, or the sources of a VRT, state the vertical datum.",
        ),
        Treatment(Subject.VERTICAL_DATUM, "refused", "The tiles have different vertical datums."),
        Treatment(
            Subject.UNIT,
            "used",
            "Each tile states its unit. For a VRT without units, its sources state the unit.",
        ),
        Treatment(Subject.UNIT, "refused", "The sources of a VRT have different units or scales."),
        Treatment(
            Subject.PLACE,
            "refused",
            "A VRT refers to files outside its folder or computes values, or a tile is missing.",
        ),
        Treatment(Subject.PIXEL_ORIGIN, "used", "Each tile states its pixel origin."),
        Treatment(
            Subject.VALIDITY,
            "used",
            "Each tile states its voids. Amers fills voids of one tile with heights of the next tile.",
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
            "You name the grid with `--geoid`: by a path, or by the file name alone if "
            "the grid is in a folder of PROJ.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "The heights have a national datum, but you name a grid of a global geoid.",
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
            "The image has a compound system with a vertical part. An image has no heights.",
        ),
        Treatment(
            Subject.UNIT, "used", "The system of the map states the unit, such as US survey feet."
        ),
        Treatment(
            Subject.PLACE,
            "used",
            "An `.aux.xml` file or a world file states the map grid. Amers uses it as GDAL does.",
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "used",
            "AREA_OR_POINT states whether a value is for a pixel area or a point. Amers "
            "uses it as GDAL does.",
        ),
        _EPOCH,
    ),
    (*_NEVER, Subject.VALIDITY, Subject.BANDS, Subject.IDENTITY),
)
TERRAIN_READERS = (TERRAIN_READER, GRID_READER, TILES_READER, GEOID_READER, MAP_READER)
