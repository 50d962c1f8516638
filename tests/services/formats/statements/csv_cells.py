"""CSV files of ground points: names of columns, units, datums, dialects of spreadsheets."""

from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.gcp.rows import CSV_READER
from amers.services.statements import Subject
from tests.services.formats.statements.point_files import (
    ED50,
    FEET,
    MOON,
    NOBODY,
    UTM,
    add,
)

# CSV: names, units and datums of heights

for head, unit_m in {
    "height": 1.0,
    "h": 1.0,
    "z": 1.0,
    "Z": 1.0,
    "alt": 1.0,
    "Altitude": 1.0,
    "elevation": 1.0,
    "ELEV": 1.0,
    "POINT_Z": 1.0,
}.items():
    add(
        CSV_READER,
        Subject.UNIT,
        "assumed",
        "metres",
        f"lon,lat,{head}\n12,41,100\n",
        height_m=100.0 * unit_m,
    )
for head, unit_m in {
    "height_m": 1.0,
    "height_ft": 0.3048,
    "z [ft]": 0.3048,
    "h (US survey feet)": 1200 / 3937,
    "alt_cm": 0.01,
    "elevation(m)": 1.0,
    "Elev_Ft": 0.3048,
    "Height (ftUS)": 1200 / 3937,
    "z_mm": 0.001,
    "alt [km]": 1000.0,
    "elevation [dm]": 0.1,
    "Height (international feet)": 0.3048,
    "h_yd": 0.9144,
}.items():
    value = 100.0 if unit_m < 10 else 0.1
    add(
        CSV_READER,
        Subject.UNIT,
        "used",
        head,
        f"lon,lat,{head}\n12,41,{value}\n",
        height_m=value * unit_m,
    )
for head in ("h_ell", "Ellipsoidal height [m]", "HAE", "height above ellipsoid"):
    text = f"lon,lat,{head}\n12,41,100\n"
    add(CSV_READER, Subject.VERTICAL_DATUM, "used", "ellipsoid", text, stated=NOBODY, height_m=100.0)
    other = StatedByCaller("EGM96")
    add(CSV_READER, Subject.VERTICAL_DATUM, "refused", "EGM96 given", text, stated=other)
for head in ("height_egm96", "H (EGM2008)", "orthometric height", "Altitude (m AMSL)", "h above geoid"):
    text = f"lon,lat,{head}\n12,41,100\n"
    add(CSV_READER, Subject.VERTICAL_DATUM, "refused", "ellipsoid given", text)
for head in ("Höhe", "z_navd88", "ELLIPSHEIGHT", "height [ells]", "altitud", "hauteur_m", "Depth_m"):
    text = f"lon,lat,{head}\n12,41,100\n"
    add(CSV_READER, Subject.VERTICAL_DATUM, "refused", f"{head!r} may have heights", text)
add(
    CSV_READER,
    Subject.VERTICAL_DATUM,
    "named",
    "column geoid_height",
    "lon,lat,height,geoid_height\n12,41,100,48\n",
    height_m=100.0,
)
two = "lon,lat,h_ell,H_ortho\n12,41,100,52\n"
add(CSV_READER, Subject.VERTICAL_DATUM, "used", "h_ell", two, height_m=100.0)
add(
    CSV_READER, Subject.VERTICAL_DATUM, "refused", "'h_ell', 'H_ortho': name the one", two, stated=NOBODY
)
commented = "# heights: ellipsoid\nlon,lat,z\n12,41,100\n"
add(CSV_READER, Subject.VERTICAL_DATUM, "used", "line 1", commented, stated=NOBODY, height_m=100.0)
add(
    CSV_READER,
    Subject.VERTICAL_DATUM,
    "refused",
    "does not state the datum",
    "lon,lat,z\n12,41,100\n",
    stated=NOBODY,
)
add(CSV_READER, Subject.VERTICAL_DATUM, "refused", "found -9999 m", "lon,lat,z\n12,41,-9999\n")

# CSV: reference systems, units of x and y, order

flat = "lon,lat\n12,41\n"
add(CSV_READER, Subject.HORIZONTAL_DATUM, "assumed", "WGS 84", flat)
add(CSV_READER, Subject.HORIZONTAL_DATUM, "used", "ED50", f"# WKT: {ED50}\n" + flat)
add(CSV_READER, Subject.HORIZONTAL_DATUM, "used", "ED50", "# crs=EPSG:4230\n" + flat)
add(CSV_READER, Subject.HORIZONTAL_DATUM, "used", "WGS84", "lon,lat,datum\n12,41,WGS84\n")
add(CSV_READER, Subject.HORIZONTAL_DATUM, "refused", "found NAD27", "lon,lat,datum\n12,41,NAD27\n")
add(CSV_READER, Subject.HORIZONTAL_DATUM, "refused", "radius of 1,737 km", f"# WKT: {MOON}\n" + flat)
on_map = "x,y,zone\n275443.7,4646566.3,32N\n"
add(CSV_READER, Subject.HORIZONTAL_DATUM, "named", "32N", on_map, stated=UTM)
add(CSV_READER, Subject.HORIZONTAL_DATUM, "refused", "state it (--crs)", on_map)
add(
    CSV_READER,
    Subject.ORDER,
    "assumed",
    "x is east",
    "Easting,Northing\n275443.7,4646566.3\n",
    stated=UTM,
)
add(CSV_READER, Subject.ORDER, "refused", "exchanged", "x,y\n4646566.3,275443.7\n", stated=UTM)
add(CSV_READER, Subject.ORDER, "refused", "expected E or W", "lon,lat\n41N,12E\n")
add(CSV_READER, Subject.ORDER, "refused", "decimal comma as in other", "lon;lat;z\n12,5;41.5;100\n")
in_feet = "X [m],Y [m]\n980000,200000\n"
add(CSV_READER, Subject.UNIT, "refused", "has US survey foot", in_feet, stated=FEET)
add(CSV_READER, Subject.UNIT, "used", "US survey foot", "X [ft],Y [ft]\n980000,200000\n", stated=FEET)
add(
    CSV_READER, Subject.UNIT, "refused", "unit of the heights", "X,Y,Z\n980000,200000,100\n", stated=FEET
)
add(CSV_READER, Subject.UNIT, "refused", "expected metres, found ft", "lon,lat,z,unit\n12,41,100,ft\n")
add(CSV_READER, Subject.UNIT, "used", "column unit", "lon,lat,z,unit\n12,41,100,m\n")
add(CSV_READER, Subject.UNIT, "refused", "states feet", "# heights in feet\nlon,lat,z\n12,41,100\n")

# CSV: columns that state something of the others

for column, value in (
    ("elevation_unit", "ft"),
    ("Z Units", "US survey feet"),
    ("unit", "cm"),
    ("verticalUnits", "feet"),
):
    text = f"lon,lat,z,{column}\n12,41,100,{value}\n"
    add(CSV_READER, Subject.UNIT, "refused", f"expected metres, found {value}", text)
for column in ("height_datum", "vdatum", "Vertical Datum", "verticalDatum"):
    text = f"lon,lat,z,{column}\n12,41,100,EGM96\n"
    add(CSV_READER, Subject.VERTICAL_DATUM, "named", "EGM96", text, height_m=100.0)
for column in ("EPSG", "crs", "SRID", "hdatum"):
    text = f"lon,lat,{column}\n12,41,4230\n"
    add(CSV_READER, Subject.HORIZONTAL_DATUM, "refused", "found 4230", text)
add(CSV_READER, Subject.EPOCH, "named", "12.05.2021", "lon,lat,Datum\n12,41,12.05.2021\n")
emlid = "Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height\n1,2,52,12,41,100\n"
add(CSV_READER, Subject.HORIZONTAL_DATUM, "named", "column Easting", emlid, lon_lat=(12.0, 41.0))
add(CSV_READER, Subject.VERTICAL_DATUM, "named", "column Elevation", emlid, height_m=100.0)
for head in ("Up", "HT", "RL", "U"):
    text = f"E,N,{head}\n275443.7,4646566.3,100\n"
    add(CSV_READER, Subject.VERTICAL_DATUM, "refused", f"{head!r} may have", text, stated=UTM)

# Files of Metashape

METASHAPE = (
    '# CoordinateSystem: GEOGCS["WGS 84",DATUM["World Geodetic System 1984",'
    'SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]\n'
    "#Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_(m),Error_(m),Z_est\n1,12,41,100,0.02,0.03,99\n"
)
add(CSV_READER, Subject.HORIZONTAL_DATUM, "used", "WGS 84", METASHAPE, height_m=100.0)
add(CSV_READER, Subject.ACCURACY, "named", "Accuracy_(m)", METASHAPE)
add(CSV_READER, Subject.VERTICAL_DATUM, "named", "Z_est", METASHAPE)

# CSV: dialects of spreadsheets

eu = "id;lon;lat;height_m\np;12,25;41,5;100,5\n"
dms = "lon,lat,height_m\n12°15'00.0\"E,41°30'0\"N,100.5\n"
for text in (
    eu,
    eu.replace(";", "\t"),
    eu.replace(";", "|"),
    eu.encode("utf-32"),
    "sep=;\n" + eu,
    "\ufeff" + eu,
    eu.encode("utf-16"),
    b"\xfe\xff" + eu.encode("utf-16-be"),
    eu.replace("\n", "\r"),
    eu.replace("\n", "\r\n"),
    '"lon","lat","height_m"\n"12,25","41,5","100,5"\n',
    dms,
    dms.replace("°", " ").replace("'", " ").replace('"', " "),
    "lon,lat,height_m\n12:15:00,41:30:00,100.5\n",
    "lon,lat,height_m\n12 15.0 E,N 41 30.0,100.5\n",
    "lon,lat,height_m\n12.25E,41.5N,100.5\n",
    "#Label,Longitude,Latitude,height_m\n1,12.25,41.5,100.5\n",
):
    add(CSV_READER, Subject.UNIT, "used", "height_m", text, height_m=100.5, lon_lat=(12.25, 41.5))
add(
    CSV_READER, Subject.ORDER, "refused", "line 2: expected 4 fields", "id,lon,lat,z\np,12,25,41,5,100\n"
)

# CSV: marks, flags, accuracy, other columns

marked = "lon,lat,image,line,sample\n12,41,C:\\data\\a.tif,5,6\n"
centre = "# pixel-origin=centre\n"
add(CSV_READER, Subject.PIXEL_ORIGIN, "used", "centre", centre + marked)
add(CSV_READER, Subject.PIXEL_ORIGIN, "named", "line, sample", marked)
add(CSV_READER, Subject.PIXEL_ORIGIN, "refused", "expected one of", centre.replace("c", "s") + marked)
add(CSV_READER, Subject.IDENTITY, "used", "a.tif", centre + marked)
flags = "lon,lat,enabled\n12,41,1\n13,41,0\n"
add(CSV_READER, Subject.VALIDITY, "used", "1 of 2", flags)
add(CSV_READER, Subject.VALIDITY, "named", "column status", "lon,lat,status\n12,41,fixed\n")
sigmas = "lon,lat,sigma_horizontal_cm,CE90_m,epoch,remark\n12,41,5,0.1,2010.5,barn\n"
add(CSV_READER, Subject.ACCURACY, "used", "sigma_horizontal_cm", sigmas)
add(CSV_READER, Subject.ACCURACY, "named", "CE90_m", sigmas)
add(CSV_READER, Subject.EPOCH, "named", "2010.5", sigmas)
add(CSV_READER, Subject.IDENTITY, "named", "column remark", sigmas)
add(CSV_READER, Subject.IDENTITY, "refused", "expected one position", "id,lon,lat\na,12,41\na,13,41\n")
