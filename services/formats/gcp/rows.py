"""What the readers of files of points do with each statement in them."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

_NEVER = (Subject.MODEL, Subject.PLACE, Subject.BANDS)
_NO_DATUM = Treatment(
    Subject.VERTICAL_DATUM,
    "refused",
    "heights without a datum, unless `--vertical` or `--geoid` states it",
)
_IN_COMMENT = Treatment(
    Subject.VERTICAL_DATUM,
    "used",
    "in a comment, such as `# heights: EGM96`; refused where the caller differs",
)
_OTHER_BODY = Treatment(
    Subject.HORIZONTAL_DATUM,
    "refused",
    "of the Moon or another body, not understood, or two that differ",
)
_FEET_IN_COMMENT = Treatment(
    Subject.UNIT, "refused", "a comment that states heights in feet or another unit than metres"
)
_EPOCH = Treatment(Subject.EPOCH, "named", "in a comment; datums are taken at their own epoch")
_ACCURACY = Treatment(Subject.ACCURACY, "named", "in a comment")
_FILE_NAMES = Treatment(
    Subject.IDENTITY, "used", "images by their file names, without the folders of another computer"
)
_EXCHANGED = Treatment(
    Subject.ORDER,
    "refused",
    "points that lie in the area of their reference system only with x and y exchanged",
)

ASP_READER = Reader(
    "ASP `.gcp`",
    ("parse_asp_gcp",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "in a comment: `# WKT: GEOGCS[...]`, `--datum NAD27`"
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "WGS 84"),
        _OTHER_BODY,
        _IN_COMMENT,
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "metres"),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "the centre of the first pixel is (0, 0)"),
        Treatment(Subject.ORDER, "refused", "a comment that states longitude before latitude"),
        Treatment(
            Subject.ACCURACY, "used", "sigmas on the ground that are equal, or whose axes are stated"
        ),
        Treatment(
            Subject.ACCURACY,
            "named",
            "sigmas on the ground that differ, without their axes; of fixed points",
        ),
        _EPOCH,
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "refused", "images in two folders with one file name"),
    ),
    (*_NEVER, Subject.VALIDITY),
)
QGIS_READER = Reader(
    "QGIS `.points`",
    ("parse_qgis_points",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "`#CRS:`, a code or WKT, in any comment"),
        Treatment(Subject.HORIZONTAL_DATUM, "refused", "none, not understood, or of another body"),
        _FEET_IN_COMMENT,
        Treatment(
            Subject.PIXEL_ORIGIN,
            "assumed",
            "the corner of the first pixel is (0, 0), lines are negative",
        ),
        Treatment(Subject.PIXEL_ORIGIN, "refused", "coordinates of a map in place of pixels"),
        Treatment(Subject.ORDER, "refused", "a row of more fields than columns, as with decimal commas"),
        Treatment(Subject.VALIDITY, "used", "`enable`: 1, 0, true, false"),
        Treatment(Subject.VALIDITY, "refused", "`enable` with any other value"),
        Treatment(Subject.ACCURACY, "named", "`dX`, `dY`, `residual` of a fit in QGIS"),
        _EPOCH,
    ),
    (*_NEVER, Subject.VERTICAL_DATUM, Subject.IDENTITY),
)
ENVI_READER = Reader(
    "ENVI `.pts`",
    ("parse_envi_pts",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "`projection info`: Geographic or UTM with WGS-84"),
        Treatment(
            Subject.HORIZONTAL_DATUM, "refused", "any other `projection info`, or another in a comment"
        ),
        _IN_COMMENT,
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "`units` of the projection: degrees, metres"),
        Treatment(Subject.UNIT, "assumed", "elevations in metres"),
        Treatment(Subject.UNIT, "refused", "`units=Feet`; a comment that states feet"),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "the corner of the first pixel is (1, 1)"),
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
        Treatment(Subject.HORIZONTAL_DATUM, "used", "`crs=` of the first line"),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "`heights=` of the first line"),
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "heights in metres"),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "the corner of the first pixel is (0, 0)"),
        Treatment(Subject.ORDER, "used", "`layout=` of the first line"),
        _EXCHANGED,
        Treatment(Subject.VALIDITY, "used", "column S: G, I, C"),
        Treatment(Subject.VALIDITY, "refused", "column S with any other letter"),
        Treatment(Subject.ACCURACY, "named", "eX, eY, eZ, which PCI defines in pixels"),
        _EPOCH,
    ),
    (*_NEVER, Subject.IDENTITY),
)
ODM_READER = Reader(
    "ODM `gcp_list.txt`",
    ("parse_gcp_list",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "first line: code, PROJ string, `WGS84 UTM 31N`, WKT"
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM, "assumed", "the northern zone, of `WGS84 UTM 31` without N or S"
        ),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "of a reference system with heights; in a comment"),
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "of a reference system with heights; the same in a comment"),
        Treatment(Subject.UNIT, "assumed", "the unit of a projected reference system; else metres"),
        _FEET_IN_COMMENT,
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "the centre of the first pixel is (0, 0)"),
        _EXCHANGED,
        Treatment(Subject.VALIDITY, "used", "names that begin with CHK- are check points"),
        _ACCURACY,
        _EPOCH,
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "fields after the name of the point"),
    ),
    _NEVER,
)
CSV_READER = Reader(
    "CSV of points",
    ("parse_csv",),
    (
        Treatment(
            Subject.HORIZONTAL_DATUM, "used", "in a comment: `# crs=EPSG:4230`; a column with WGS 84"
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "lon and lat are WGS 84"),
        Treatment(
            Subject.HORIZONTAL_DATUM, "named", "a column with zones or codes, where `--crs` is given"
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "none of x and y; a column with another datum; another body",
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "used",
            "in the name of the column: `h_ell`, `height_egm96`; in a comment",
        ),
        Treatment(
            Subject.VERTICAL_DATUM, "named", "columns of other heights, and of the height of the geoid"
        ),
        Treatment(
            Subject.VERTICAL_DATUM,
            "refused",
            "none; another one than the caller states; several columns of heights; a column that may "
            "have heights and is not understood",
        ),
        Treatment(
            Subject.UNIT,
            "used",
            "in the name of the column: `height_ft`, `z [cm]`, `h (US survey feet)`",
        ),
        Treatment(Subject.UNIT, "assumed", "heights in metres, where the column names no unit"),
        Treatment(
            Subject.UNIT,
            "refused",
            "x and y in another unit than their reference system; heights without a unit beside feet; a "
            "column with another unit than metres",
        ),
        Treatment(Subject.PIXEL_ORIGIN, "used", "in a comment: `# pixel-origin=centre`"),
        Treatment(Subject.PIXEL_ORIGIN, "named", "columns line and sample whose origin is not stated"),
        Treatment(Subject.PIXEL_ORIGIN, "refused", "an origin that is not known"),
        Treatment(
            Subject.ORDER, "assumed", "x is east, y is north, also where the axes of the system differ"
        ),
        Treatment(
            Subject.ORDER, "refused", "longitudes with N or S; x and y exchanged; decimal commas mixed"
        ),
        Treatment(Subject.VALIDITY, "used", "columns active, enabled, check with 1, 0, true, false"),
        Treatment(Subject.VALIDITY, "named", "a column such as status with other words"),
        Treatment(Subject.ACCURACY, "used", "columns `sigma_…_m`, also in other units"),
        Treatment(Subject.ACCURACY, "named", "any other: CE90, LE90, RMSE, DOP"),
        Treatment(Subject.EPOCH, "named", "a column or a comment"),
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "any other column"),
        Treatment(Subject.IDENTITY, "refused", "a point with two positions"),
    ),
    _NEVER,
)
GEOJSON_READER = Reader(
    "GeoJSON of points",
    ("parse_geojson_points",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "member `crs` of older GeoJSON"),
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "WGS 84, by RFC 7946"),
        Treatment(
            Subject.HORIZONTAL_DATUM, "named", "`coordRefSys` of JSON-FG: its `geometry` is in WGS 84"
        ),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "member `heights` of Amers"),
        Treatment(Subject.VERTICAL_DATUM, "named", "properties with other heights than the coordinates"),
        Treatment(
            Subject.VERTICAL_DATUM, "refused", "no third coordinate, or 0 beside a property with heights"
        ),
        Treatment(Subject.UNIT, "named", "a property"),
        Treatment(Subject.PIXEL_ORIGIN, "used", "member `pixel_origin` of Amers"),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "the centre of the first pixel is (0, 0)"),
        Treatment(Subject.PIXEL_ORIGIN, "refused", "any other"),
        Treatment(
            Subject.ORDER, "refused", "a latitude beyond 90 degrees; x and y exchanged in their system"
        ),
        Treatment(Subject.VALIDITY, "used", "properties status and check"),
        Treatment(Subject.ACCURACY, "used", "properties `sigma_…`"),
        Treatment(Subject.ACCURACY, "named", "any other property"),
        Treatment(Subject.EPOCH, "named", "`coordinateEpoch`, or a property"),
        _FILE_NAMES,
        Treatment(Subject.IDENTITY, "named", "any other property"),
    ),
    _NEVER,
)
OPF_READER = Reader(
    "OPF control points",
    ("parse_opf",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "`crs` of each point"),
        _OTHER_BODY,
        Treatment(Subject.VERTICAL_DATUM, "used", "of a `crs` with heights"),
        Treatment(Subject.VERTICAL_DATUM, "assumed", "the ellipsoid, of a `crs` without heights"),
        Treatment(Subject.UNIT, "used", "of the `crs`"),
        Treatment(Subject.PIXEL_ORIGIN, "assumed", "the corner of the first pixel is (0, 0)"),
        Treatment(Subject.ORDER, "used", "the axes of the `crs`"),
        _EXCHANGED,
        Treatment(Subject.VALIDITY, "used", "`is_checkpoint`"),
        Treatment(Subject.ACCURACY, "used", "`sigmas`, `accuracy`"),
        Treatment(Subject.EPOCH, "named", "`epoch` of a `crs`"),
        Treatment(Subject.IDENTITY, "assumed", "ids of cameras are the names of images"),
        Treatment(Subject.IDENTITY, "named", "manual tie points"),
    ),
    _NEVER,
)
GCPLIB_READER = Reader(
    "USGS GCPLib",
    ("parse_gcplib",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "WGS 84"),
        _NO_DATUM,
        Treatment(Subject.UNIT, "assumed", "elevations in metres"),
        Treatment(Subject.ORDER, "used", "y before x on the map, compared with latitude and longitude"),
        Treatment(Subject.ORDER, "refused", "a position on the map that is not that of the degrees"),
        Treatment(Subject.EPOCH, "named", "date of the image of the chip"),
        Treatment(Subject.ACCURACY, "named", "ABS or REL"),
    ),
    (*_NEVER, Subject.PIXEL_ORIGIN, Subject.VALIDITY, Subject.IDENTITY),
)
COPERNICUS_READER = Reader(
    "Copernicus Sentinel-2 GCP database",
    ("parse_copernicus",),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "WGS 84"),
        Treatment(Subject.HORIZONTAL_DATUM, "refused", "an `EPSG` that is no UTM zone of WGS 84"),
        _NO_DATUM,
        Treatment(Subject.UNIT, "used", "`@unit` of `Altimetry`"),
        Treatment(Subject.UNIT, "refused", "no known unit of length"),
        Treatment(Subject.ORDER, "used", "`X`, `Y`, compared with longitude and latitude"),
        Treatment(Subject.ORDER, "refused", "a position on the map that is not that of the degrees"),
        Treatment(Subject.ACCURACY, "named", "`Quality_Indicators`"),
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
