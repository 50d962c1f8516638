"""Treatment of the statements in files of points."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

_NEVER = (Subject.MODEL, Subject.PLACE, Subject.BANDS)
_NO_DATUM = Treatment(
    Subject.VERTICAL_DATUM,
    "refused",
    "The heights have no stated datum. State it with `--vertical` or `--geoid`.",
)
_IN_COMMENT = Treatment(
    Subject.VERTICAL_DATUM,
    "used",
    "A comment states the datum of the heights, such as `# heights: EGM96`. If you state another datum, "
    "the file is refused.",
)
_OTHER_BODY = Treatment(
    Subject.HORIZONTAL_DATUM,
    "refused",
    "The stated system is not of the Earth, cannot be understood, or differs from a second stated "
    "system.",
)
_FEET_IN_COMMENT = Treatment(
    Subject.UNIT, "refused", "A comment states that heights are in feet or in another unit than metres."
)
_EPOCH = Treatment(
    Subject.EPOCH, "named", "An epoch in a comment. Each datum is used at its own reference epoch."
)
_ACCURACY = Treatment(Subject.ACCURACY, "named", "An accuracy in a comment.")
_FILE_NAMES = Treatment(
    Subject.IDENTITY,
    "used",
    "Images are identified by their file names. Folder names are ignored, because they may be of "
    "another computer.",
)
_EXCHANGED = Treatment(
    Subject.ORDER,
    "refused",
    "The points are in the area of their reference system only if x and y are exchanged.",
)

ASP_READER = Reader(
    "ASP `.gcp`",
    ("parse_asp_gcp",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "A comment states the datum, such as `# WKT: GEOGCS[...]` or `--datum NAD27`.",
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "Longitude and latitude are in WGS 84."),
        _OTHER_BODY,
        _IN_COMMENT,
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "Heights are in metres."),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The centre of the first pixel is (0, 0)."),
        Treatment(Subject.ORDER, "refused", "A comment states that longitude comes before latitude."),
        Treatment(
            Subject.ACCURACY,
            "used",
            "The three sigmas of a ground position, if they are equal or if `--sigma-axes` states their "
            "axes.",
        ),
        Treatment(
            Subject.ACCURACY,
            "named",
            "Unequal sigmas of a ground position without stated axes, and the tiny sigmas that mark "
            "fixed points.",
        ),
        _EPOCH,
        _FILE_NAMES,
        Treatment(
            Subject.IDENTITY, "refused", "Two images in different folders have the same file name."
        ),
    ),
    (*_NEVER, Subject.VALIDITY),
)
QGIS_READER = Reader(
    "QGIS `.points`",
    ("parse_qgis_points",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "A comment `#CRS:` states a code or WKT."),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "The file states no system, or one that cannot be understood or is not of the Earth.",
        ),
        _FEET_IN_COMMENT,
        Treatment(
            Subject.PIXEL_ORIGIN,
            "assumed",
            "The corner of the first pixel is (0, 0), and lines are negative numbers.",
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "refused",
            "The image coordinates are map coordinates instead of pixels, because the image is on a "
            "map.",
        ),
        Treatment(
            Subject.ORDER,
            "refused",
            "A row has more fields than the header has columns, for example because of decimal commas.",
        ),
        Treatment(
            Subject.VALIDITY,
            "used",
            "The column `enable` with 1, 0, true or false switches a point on or off.",
        ),
        Treatment(Subject.VALIDITY, "refused", "The column `enable` has another value."),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The columns `dX`, `dY` and `residual`, which belong to a fit in QGIS.",
        ),
        _EPOCH,
    ),
    (*_NEVER, Subject.VERTICAL_DATUM, Subject.IDENTITY),
)
ENVI_READER = Reader(
    "ENVI `.pts`",
    ("parse_envi_pts",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "`projection info` with Geographic or UTM, and WGS-84."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "`projection info` with another projection or datum, or a comment with another system.",
        ),
        _IN_COMMENT,
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "`units` of the projection: degrees or metres."),
        Treatment(Subject.UNIT, "assumed", "Elevations are in metres."),
        Treatment(Subject.UNIT, "refused", "`units=Feet`, or a comment that states feet."),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The corner of the first pixel is (1, 1)."),
        _EXCHANGED,
        _ACCURACY,
        _EPOCH,
    ),
    (*_NEVER, Subject.VALIDITY, Subject.IDENTITY),
)
PCI_READER = Reader(
    "PCI OrthoEngine text",
    ("parse_pci_text",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "`crs=` in the first line."),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "`heights=` in the first line."),
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "Heights are in metres."),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The corner of the first pixel is (0, 0)."),
        Treatment(Subject.ORDER, "used", "`layout=` in the first line states the order of the columns."),
        _EXCHANGED,
        Treatment(
            Subject.VALIDITY,
            "used",
            "Column S: G is a control point, I is an inactive point, C is a check point.",
        ),
        Treatment(Subject.VALIDITY, "refused", "Column S contains another letter."),
        Treatment(Subject.ACCURACY, "named", "The columns eX, eY and eZ, which PCI defines in pixels."),
        _EPOCH,
    ),
    (*_NEVER, Subject.IDENTITY),
)
ODM_READER = Reader(
    "ODM `gcp_list.txt`",
    ("parse_gcp_list",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "The first line: a code, a PROJ string, a name such as `WGS84 UTM 31N`, or WKT.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM, "assumed", "`WGS84 UTM 31` without N or S means the northern zone."
        ),
        _OTHER_BODY,
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "The first line states a reference system with heights, or a comment states the datum.",
        ),
        _NO_DATUM,
        Treatment(
            Subject.UNIT, "used", "The unit of a reference system with heights, or a unit in a comment."
        ),
        Treatment(
            Subject.UNIT,
            "assumed",
            "Heights have the unit of a projected reference system; otherwise they are in metres.",
        ),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The centre of the first pixel is (0, 0)."),
        _EXCHANGED,
        Treatment(Subject.VALIDITY, "used", "Points whose names begin with CHK- are check points."),
        _ACCURACY,
        _EPOCH,
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "Fields after the name of the point."),
    ),
    _NEVER,
)
CSV_READER = Reader(
    "CSV of points",
    ("parse_csv",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "A comment such as `# crs=EPSG:4230`, or a column that states WGS 84.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM, "assumed", "Columns of longitude and latitude are in WGS 84."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "named",
            "A column with zones or codes, if you state the system with `--crs`. Columns of a second "
            "position.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "Columns x and y without a stated system (`--crs`), a column that states another datum, or "
            "a system that is not of the Earth.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "The name of the height column, such as `h_ell` or `height_egm96`, or a comment.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "Further columns of heights, the height of the geoid, and the name of a datum in a column, "
            "if another statement decides.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "No datum is stated, or you state another datum than the file. Also refused are several "
            "columns of heights, and a column that may contain heights but has a name that Amers does "
            "not understand.",
        ),
        Treatment(
            Subject.UNIT,
            "used",
            "The name of the column, such as `height_ft`, `z [cm]` or `h (US survey feet)`.",
        ),
        Treatment(Subject.UNIT, "assumed", "Heights are in metres if the column names no unit."),
        Treatment(
            Subject.UNIT,
            "refused",
            "Columns x and y name another unit than their reference system has. Heights have no unit "
            "although x and y are in feet. A column states another unit than metres.",
        ),
        Treatment(Subject.PIXEL_ORIGIN, "used", "A comment such as `# pixel-origin=centre`."),
        Treatment(Subject.PIXEL_ORIGIN, "named", "Columns of line and sample without a stated origin."),
        Treatment(
            Subject.PIXEL_ORIGIN, "refused", "The comment states an origin that Amers does not know."
        ),
        Treatment(
            Subject.ORDER,
            "assumed",
            "x is east and y is north, even if the reference system has other axes.",
        ),
        Treatment(
            Subject.ORDER,
            "refused",
            "Longitudes have the letter N or S, x and y are exchanged, or decimal commas and decimal "
            "points are mixed.",
        ),
        Treatment(
            Subject.VALIDITY, "used", "Columns active, enabled and check with 1, 0, true or false."
        ),
        Treatment(Subject.VALIDITY, "named", "A column such as status that contains other words."),
        Treatment(
            Subject.ACCURACY, "used", "Columns `sigma_…_m`, also with other units in their names."
        ),
        Treatment(Subject.ACCURACY, "named", "Other accuracies: CE90, LE90, RMSE, DOP."),
        Treatment(Subject.EPOCH, "named", "An epoch in a column or in a comment."),
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "All other columns."),
        Treatment(Subject.IDENTITY, "refused", "Two rows give one point different positions."),
    ),
    _NEVER,
)
GEOJSON_READER = Reader(
    "GeoJSON of points",
    ("parse_geojson_points",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "The member `crs` of older GeoJSON."),
        Treatment(
            Subject.HORIZONTAL_DATUM, "assumed", "Coordinates are in WGS 84, as RFC 7946 requires."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "named",
            "`coordRefSys` of JSON-FG, because `geometry` is in WGS 84 there.",
        ),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "The member `heights`, which Amers writes."),
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "Properties that contain heights in addition to the coordinates.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "The third coordinate is missing, or it is 0 and a property contains a height.",
        ),
        Treatment(Subject.UNIT, "named", "A property that states a unit."),
        Treatment(Subject.PIXEL_ORIGIN, "used", "The member `pixel_origin`, which Amers writes."),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The centre of the first pixel is (0, 0)."),
        Treatment(Subject.PIXEL_ORIGIN, "refused", "`pixel_origin` states another origin."),
        Treatment(
            Subject.ORDER,
            "refused",
            "A latitude is above 90 degrees, or the points are in the area of their system only if x "
            "and y are exchanged.",
        ),
        Treatment(Subject.VALIDITY, "used", "The properties status and check."),
        Treatment(Subject.ACCURACY, "used", "The properties `sigma_…`."),
        Treatment(Subject.ACCURACY, "named", "All other properties."),
        Treatment(Subject.EPOCH, "named", "The member `coordinateEpoch`, or a property."),
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "All other properties."),
    ),
    _NEVER,
)
OPF_READER = Reader(
    "OPF control points",
    ("parse_opf",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "The `crs` of each point."),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "A `crs` with heights."),
        Treatment(
            Subject.VERTICAL_DATUM,
            "assumed",
            "With a `crs` without heights, heights are above the ellipsoid.",
        ),
        Treatment(Subject.UNIT, "used", "The unit of the `crs`."),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The corner of the first pixel is (0, 0)."),
        Treatment(Subject.ORDER, "used", "The order of the axes of the `crs`."),
        _EXCHANGED,
        Treatment(Subject.VALIDITY, "used", "`is_checkpoint` marks check points."),
        Treatment(Subject.ACCURACY, "used", "`sigmas` and `accuracy`."),
        Treatment(Subject.EPOCH, "named", "The `epoch` of a `crs`."),
        Treatment(
            Subject.IDENTITY,
            "assumed",
            "If the file names no images, the ids of cameras are used as the names of images.",
        ),
        Treatment(Subject.IDENTITY, "named", "Manual tie points."),
    ),
    _NEVER,
)
GCPLIB_READER = Reader(
    "USGS GCPLib",
    ("parse_gcplib",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "Longitude and latitude are in WGS 84."),
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "Elevations are in metres."),
        Treatment(
            Subject.ORDER,
            "used",
            "The map coordinates are y before x. Amers compares them with latitude and longitude.",
        ),
        Treatment(
            Subject.ORDER,
            "refused",
            "The map coordinates and the longitude and latitude are different positions.",
        ),
        Treatment(Subject.EPOCH, "named", "The date of the image from which the chip was cut."),
        Treatment(Subject.ACCURACY, "named", "The flag ABS or REL."),
    ),
    (*_NEVER, Subject.PIXEL_ORIGIN, Subject.VALIDITY, Subject.IDENTITY),
)
COPERNICUS_READER = Reader(
    "Copernicus Sentinel-2 GCP database",
    ("parse_copernicus",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "Longitude and latitude are in WGS 84."),
        Treatment(Subject.HORIZONTAL_DATUM, "refused", "`EPSG` is not a UTM zone of WGS 84."),
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "`@unit` of `Altimetry`."),
        Treatment(Subject.UNIT, "refused", "`@unit` is not a known unit of length."),
        Treatment(
            Subject.ORDER,
            "used",
            "The map coordinates are `X`, then `Y`. Amers compares them with longitude and latitude.",
        ),
        Treatment(
            Subject.ORDER,
            "refused",
            "The map coordinates and the longitude and latitude are different positions.",
        ),
        Treatment(Subject.ACCURACY, "named", "`Quality_Indicators`."),
    ),
    (*_NEVER, Subject.PIXEL_ORIGIN, Subject.VALIDITY, Subject.EPOCH, Subject.IDENTITY),
)
POINT_READERS = (
    CSV_READER,
    ASP_READER,
    QGIS_READER,
    ENVI_READER,
    PCI_READER,
    ODM_READER,
    GEOJSON_READER,
    OPF_READER,
    GCPLIB_READER,
    COPERNICUS_READER,
)
