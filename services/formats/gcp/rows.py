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
    Subject.EPOCH,
    "named",
    "A comment states an epoch. Amers uses each datum at its own reference epoch.",
)
_ACCURACY = Treatment(Subject.ACCURACY, "named", "A comment states an accuracy.")
_FILE_NAMES = Treatment(
    Subject.IDENTITY,
    "used",
    "The file names images. Amers identifies them by their file names and ignores"
    " the folder names, which may be of another computer.",
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
            "A ground position has three sigmas, and they are equal or `--sigma-axes` "
            "states their axes.",
        ),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The three sigmas of a ground position differ, but their axes are not stated."
            " Or the sigmas are tiny, which only marks a fixed point.",
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
            "The columns `dX`, `dY` and `residual` contain residuals of a fit in QGIS.",
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
            Subject.HORIZONTAL_DATUM, "used", "`projection info` states Geographic or UTM, and WGS-84."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "`projection info` states another projection or datum, or a comment states another system.",
        ),
        _IN_COMMENT,
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "`units` of the projection states degrees or metres."),
        Treatment(Subject.UNIT, "assumed", "Elevations are in metres."),
        Treatment(Subject.UNIT, "refused", "`units=Feet` or a comment states that the unit is feet."),
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
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "`crs=` in the first line states the reference system."
        ),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "`heights=` in the first line states the datum."),
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "Heights are in metres."),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The corner of the first pixel is (0, 0)."),
        Treatment(Subject.ORDER, "used", "`layout=` in the first line states the order of the columns."),
        _EXCHANGED,
        Treatment(
            Subject.VALIDITY,
            "used",
            "The column S contains the kind of a point: G is a control point, I an "
            "inactive point, C a check point.",
        ),
        Treatment(Subject.VALIDITY, "refused", "The column S contains a letter other than G, I and C."),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The columns eX, eY and eZ contain errors, which PCI defines in pixels.",
        ),
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
            "The first line states the system as a code, a PROJ string, WKT, or a name "
            "such as `WGS84 UTM 31N`.",
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
            Subject.UNIT, "used", "A reference system with heights, or a comment, states the unit."
        ),
        Treatment(
            Subject.UNIT,
            "assumed",
            "Heights have the unit of a projected reference system; otherwise they are in metres.",
        ),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The centre of the first pixel is (0, 0)."),
        _EXCHANGED,
        Treatment(
            Subject.VALIDITY,
            "used",
            "The name of a point begins with `CHK-`: the point is a check point.",
        ),
        _ACCURACY,
        _EPOCH,
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "A line contains fields after the name of the point."),
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
            "A comment such as `# crs=EPSG:4230` states the system, or a column states WGS 84.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM, "assumed", "Columns of longitude and latitude are in WGS 84."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "named",
            "A column contains zones or codes, but you state the system with `--crs`. Or "
            "columns contain a second position.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "Columns x and y have no stated system (state it with `--crs`). Or a column "
            "states a datum other than WGS 84, or the system is not of the Earth.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "The name of the height column, such as `h_ell` or `height_egm96`, or a "
            "comment states the datum.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "The file has further columns of heights, a column with the height of the "
            "geoid, or the name of a datum in a column, and another statement states the "
            "datum.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "No datum is stated, or you state another datum than the file. Or there are "
            "several columns of heights, or a column may contain heights but Amers does "
            "not understand its name.",
        ),
        Treatment(
            Subject.UNIT,
            "used",
            "The name of the column states the unit, such as `height_ft`, `z [cm]` or `h "
            "(US survey feet)`.",
        ),
        Treatment(Subject.UNIT, "assumed", "Heights are in metres if the column names no unit."),
        Treatment(
            Subject.UNIT,
            "refused",
            "Columns x and y name another unit than their reference system has. Heights have no unit "
            "although x and y are in feet. A column states another unit than metres.",
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "used",
            "A comment such as `# pixel-origin=centre` states the pixel origin.",
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "named",
            "The file has columns of line and sample, but states no pixel origin.",
        ),
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
            Subject.VALIDITY,
            "used",
            "The columns `active`, `enabled` and `check` contain 1, 0, true or false: "
            "points can be inactive, or check points.",
        ),
        Treatment(Subject.VALIDITY, "named", "A column such as `status` contains other words."),
        Treatment(
            Subject.ACCURACY,
            "used",
            "Columns `sigma_…_m` contain standard deviations. Their names can also contain other units.",
        ),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The file states other measures of accuracy, such as CE90, LE90, RMSE or DOP.",
        ),
        Treatment(Subject.EPOCH, "named", "A column or a comment states an epoch of the coordinates."),
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "The file has columns other than those named here."),
        Treatment(Subject.IDENTITY, "refused", "Two rows give one point different positions."),
    ),
    _NEVER,
)
GEOJSON_READER = Reader(
    "GeoJSON of points",
    ("parse_geojson_points",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "used",
            "The member `crs` of older GeoJSON states the reference system.",
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM, "assumed", "Coordinates are in WGS 84, as RFC 7946 requires."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "named",
            "The member `coordRefSys` of JSON-FG states a system. `geometry` is in WGS 84"
            " in such a file.",
        ),
        _OTHER_BODY,
        Treatment(
            Subject.VERTICAL_DATUM, "used", "The member `heights`, which Amers writes, states the datum."
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "named",
            "Properties contain heights in addition to the coordinates.",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "The third coordinate is missing, or it is 0 and a property contains a height.",
        ),
        Treatment(Subject.UNIT, "named", "A property states a unit."),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "used",
            "The member `pixel_origin`, which Amers writes, states the pixel origin.",
        ),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The centre of the first pixel is (0, 0)."),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "refused",
            "The member `pixel_origin` states an origin that Amers does not know.",
        ),
        Treatment(
            Subject.ORDER,
            "refused",
            "A latitude is above 90 degrees, or the points are in the area of their system only if x "
            "and y are exchanged.",
        ),
        Treatment(
            Subject.VALIDITY,
            "used",
            "The properties `status` and `check` state which points are inactive or check points.",
        ),
        Treatment(Subject.ACCURACY, "used", "The properties `sigma_…` contain standard deviations."),
        Treatment(Subject.ACCURACY, "named", "A feature has properties other than those named here."),
        Treatment(Subject.EPOCH, "named", "The member `coordinateEpoch` or a property states an epoch."),
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "A feature has properties other than those named here."),
    ),
    _NEVER,
)
OPF_READER = Reader(
    "OPF control points",
    ("parse_opf",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "The `crs` of each point states the reference system."
        ),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "The `crs` of a point is a system with heights."),
        Treatment(
            Subject.VERTICAL_DATUM,
            "assumed",
            "Heights are above the ellipsoid if the `crs` is a system without heights.",
        ),
        Treatment(Subject.UNIT, "used", "The `crs` states the unit."),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "The corner of the first pixel is (0, 0)."),
        Treatment(Subject.ORDER, "used", "The `crs` states the order of its axes."),
        _EXCHANGED,
        Treatment(Subject.VALIDITY, "used", "`is_checkpoint` marks check points."),
        Treatment(
            Subject.ACCURACY, "used", "The members `sigmas` and `accuracy` state standard deviations."
        ),
        Treatment(Subject.EPOCH, "named", "The `crs` states an `epoch`."),
        Treatment(
            Subject.IDENTITY,
            "assumed",
            "If the file names no images, the ids of cameras are used as the names of images.",
        ),
        Treatment(Subject.IDENTITY, "named", "The file contains manual tie points."),
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
        Treatment(
            Subject.EPOCH, "named", "The file states the date of the image from which the chip was cut."
        ),
        Treatment(Subject.ACCURACY, "named", "A point has the flag ABS or REL."),
    ),
    (*_NEVER, Subject.PIXEL_ORIGIN, Subject.VALIDITY, Subject.IDENTITY),
)
COPERNICUS_READER = Reader(
    "Copernicus Sentinel-2 GCP database",
    ("parse_copernicus",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "Longitude and latitude are in WGS 84."),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "`EPSG` states a system that is not a UTM zone of WGS 84.",
        ),
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "The attribute `unit` of `Altimetry` states the unit."),
        Treatment(
            Subject.UNIT, "refused", "The attribute `unit` of `Altimetry` is not a known unit of length."
        ),
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
        Treatment(Subject.ACCURACY, "named", "A point has `Quality_Indicators`."),
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
