"""Files of ground points: what they state of units, datums, pixels and images."""

import json
from dataclasses import replace

import numpy as np

from amers.services.formats.gcp.rows import (
    ASP_READER,
    COPERNICUS_READER,
    ENVI_READER,
    GCPLIB_READER,
    GEOJSON_READER,
    ODM_READER,
    OPF_READER,
    PCI_READER,
    QGIS_READER,
)
from amers.services.statements import Subject
from tests.services.formats.statements.point_files import (
    ED50,
    GOLDEN,
    MOON,
    NOBODY,
    add,
)

# ASP

ASP = "0 41 12 100 1 1 1 /home/u/a.tif 5 6 1 1\n"
add(ASP_READER, Subject.HORIZONTAL_DATUM, "assumed", "WGS 84", ASP, lon_lat=(12.0, 41.0))
add(ASP_READER, Subject.HORIZONTAL_DATUM, "used", "ED50", f"# WKT: {ED50}\n" + ASP)
add(ASP_READER, Subject.HORIZONTAL_DATUM, "used", "ED50", "# bundle_adjust --datum ED50\n" + ASP)
add(ASP_READER, Subject.HORIZONTAL_DATUM, "used", "ETRS89", "# CRS: EPSG:4258\n" + ASP)
add(ASP_READER, Subject.HORIZONTAL_DATUM, "refused", "of the Earth", f"# WKT: {MOON}\n" + ASP)
add(ASP_READER, Subject.HORIZONTAL_DATUM, "refused", "D_MARS", "# bundle_adjust --datum D_MARS\n" + ASP)
add(
    ASP_READER,
    Subject.HORIZONTAL_DATUM,
    "refused",
    "latitude and longitude",
    "# CRS: EPSG:32633\n" + ASP,
)
add(
    ASP_READER,
    Subject.HORIZONTAL_DATUM,
    "refused",
    "expected one reference system",
    "# datum: ED50\n# datum: NAD27\n" + ASP,
)
ellipsoidal = "# heights are metres above the WGS 84 ellipsoid\n" + ASP
add(ASP_READER, Subject.VERTICAL_DATUM, "used", "line 1", ellipsoidal, stated=NOBODY, height_m=100.0)
add(
    ASP_READER, Subject.VERTICAL_DATUM, "refused", "EGM96 by the file", "# vertical datum: EGM96\n" + ASP
)
add(ASP_READER, Subject.VERTICAL_DATUM, "refused", "--vertical", ASP, stated=NOBODY)
add(ASP_READER, Subject.UNIT, "assumed", "metres", ASP.strip() + " # corner of a barn\n")
add(ASP_READER, Subject.UNIT, "refused", "states feet", "# elevation in feet\n" + ASP)
add(ASP_READER, Subject.PIXEL_ORIGIN, "assumed", "centre", ASP)
add(ASP_READER, Subject.ORDER, "refused", "latitude before longitude", "# id lon lat height\n" + ASP)
add(ASP_READER, Subject.ACCURACY, "used", "equal", ASP)
add(ASP_READER, Subject.ACCURACY, "named", "--sigma-axes", ASP.replace("1 1 1", "1 2 3"))
add(ASP_READER, Subject.ACCURACY, "named", "fixed", ASP.replace("1 1 1", "1e-10 1e-10 1e-10"))
add(ASP_READER, Subject.EPOCH, "named", "2010.0", "# epoch 2010.0\n" + ASP)
add(ASP_READER, Subject.IDENTITY, "used", "a.tif", ASP)
same = ASP.strip() + " /home/v/a.tif 7 8 1 1\n"
add(ASP_READER, Subject.IDENTITY, "refused", "one file name", same)

# QGIS

QGIS = "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual\n275443.7,4646566.3,5.5,-6.5,1,0.1,0.2,0.3\n"
CRS_LINE = "#CRS: EPSG:32633\n"
add(QGIS_READER, Subject.HORIZONTAL_DATUM, "used", "UTM zone 33N", CRS_LINE + QGIS)
add(
    QGIS_READER,
    Subject.HORIZONTAL_DATUM,
    "used",
    "UTM zone 33N",
    "\ufeff# saved by me\n" + CRS_LINE + QGIS,
)
add(QGIS_READER, Subject.HORIZONTAL_DATUM, "refused", "does not state its reference", QGIS)
add(QGIS_READER, Subject.HORIZONTAL_DATUM, "refused", "of the Earth", f"#CRS: {MOON}\n" + QGIS)
add(QGIS_READER, Subject.UNIT, "refused", "states feet", CRS_LINE + "# units: feet\n" + QGIS)
add(QGIS_READER, Subject.PIXEL_ORIGIN, "assumed", "corner", CRS_LINE + QGIS)
mapped = QGIS.replace("5.5,-6.5", "275440.1,4646560.2")
add(QGIS_READER, Subject.PIXEL_ORIGIN, "refused", "that is on a map", CRS_LINE + mapped)
commas = QGIS.replace("275443.7,4646566.3,5.5,-6.5", "275443,7,4646566,3,5,5,-6,5")
add(QGIS_READER, Subject.ORDER, "refused", "decimal points", CRS_LINE + commas)
for word in ("true", "1.0", "yes"):
    add(
        QGIS_READER,
        Subject.VALIDITY,
        "used",
        "1 of 1",
        CRS_LINE + QGIS.replace(",1,0.1", f",{word},0.1"),
    )
add(QGIS_READER, Subject.VALIDITY, "refused", "1 or 0", CRS_LINE + QGIS.replace(",1,0.1", ",maybe,0.1"))
add(QGIS_READER, Subject.ACCURACY, "named", "residual", CRS_LINE + QGIS)
add(QGIS_READER, Subject.EPOCH, "named", "2010", CRS_LINE + "# epoch 2010\n" + QGIS)

# ENVI

ENVI = (GOLDEN / "invented_utm.pts").read_text()
add(ENVI_READER, Subject.HORIZONTAL_DATUM, "used", "UTM zone 33N", ENVI)
add(ENVI_READER, Subject.HORIZONTAL_DATUM, "refused", "NAD-27", ENVI.replace("WGS-84", "NAD-27"))
add(ENVI_READER, Subject.HORIZONTAL_DATUM, "refused", "beside", "; CRS: EPSG:32632\n" + ENVI)
heights = "; elevations are metres above the WGS 84 ellipsoid\n"
add(ENVI_READER, Subject.VERTICAL_DATUM, "used", "line 1", heights + ENVI, stated=NOBODY)
add(ENVI_READER, Subject.VERTICAL_DATUM, "refused", "--vertical", ENVI, stated=NOBODY)
add(ENVI_READER, Subject.UNIT, "used", "Meters", ENVI)
add(ENVI_READER, Subject.UNIT, "assumed", "metres", ENVI)
add(ENVI_READER, Subject.UNIT, "refused", "units=Feet", ENVI.replace("units=Meters", "units=Feet"))
add(ENVI_READER, Subject.UNIT, "refused", "states ft", "; z in ft\n" + ENVI)
add(ENVI_READER, Subject.PIXEL_ORIGIN, "assumed", "1, 1", ENVI)
lines = [
    line if line[0] == ";" else " ".join(np.array(line.split())[[1, 0, 2, 3, 4]])
    for line in ENVI.splitlines()
]
add(ENVI_READER, Subject.ORDER, "refused", "exchanged", "\n".join(lines))
add(ENVI_READER, Subject.ACCURACY, "named", "accuracy 2 m", "; accuracy 2 m\n" + ENVI)
add(ENVI_READER, Subject.EPOCH, "named", "2010", "; epoch 2010\n" + ENVI)

# PCI

PCI = "# layout=IDPLXYZeXS crs=EPSG:32633 heights=ellipsoid\n1 5 6 275443.7 4646566.3 100 0.5 G\n"
add(PCI_READER, Subject.HORIZONTAL_DATUM, "used", "UTM zone 33N", PCI, stated=NOBODY)
add(
    PCI_READER,
    Subject.HORIZONTAL_DATUM,
    "refused",
    "of the Earth",
    PCI.replace("EPSG:32633", "IAU_2015:30100"),
)
add(PCI_READER, Subject.HORIZONTAL_DATUM, "refused", "one reference", PCI + "# CRS: EPSG:32632\n")
add(PCI_READER, Subject.VERTICAL_DATUM, "used", "ellipsoid", PCI, stated=NOBODY, height_m=100.0)
add(
    PCI_READER,
    Subject.VERTICAL_DATUM,
    "refused",
    "--vertical",
    PCI.replace(" heights=ellipsoid", ""),
    stated=NOBODY,
)
add(PCI_READER, Subject.UNIT, "assumed", "metres", PCI, stated=NOBODY)
add(PCI_READER, Subject.UNIT, "refused", "states feet", PCI + "# Units: feet\n")
add(PCI_READER, Subject.PIXEL_ORIGIN, "assumed", "corner", PCI)
add(PCI_READER, Subject.ORDER, "used", "IDPLXYZeXS", PCI)
add(PCI_READER, Subject.ORDER, "refused", "exchanged", PCI.replace("PLXYZ", "PLYXZ"))
add(PCI_READER, Subject.VALIDITY, "used", "G, I, C", PCI)
add(PCI_READER, Subject.VALIDITY, "refused", "expected G, I or C", PCI.replace(" G\n", " X\n"))
add(PCI_READER, Subject.ACCURACY, "named", "eX", PCI)
add(PCI_READER, Subject.EPOCH, "named", "2010", PCI + "# epoch 2010\n")

# ODM

ODM = "EPSG:32633\n275443.7 4646566.3 100 5 6 /home/u/my image.JPG CHK-a more words\n"
add(ODM_READER, Subject.HORIZONTAL_DATUM, "used", "UTM zone 33N", ODM)
add(ODM_READER, Subject.HORIZONTAL_DATUM, "used", "33S", ODM.replace("EPSG:32633", "WGS84 UTM 33S"))
add(ODM_READER, Subject.HORIZONTAL_DATUM, "used", "33N", ODM.replace("EPSG", "epsg").encode("utf-16"))
add(ODM_READER, Subject.HORIZONTAL_DATUM, "refused", "first line", ODM + "# CRS: EPSG:32632\n")
moon_string = ODM.replace("EPSG:32633", "+proj=longlat +R=1737400 +no_defs")
add(ODM_READER, Subject.HORIZONTAL_DATUM, "refused", "of the Earth", moon_string)
in_space = "EPSG:4979\n12 41 100 5 6 a.JPG g\n"
add(ODM_READER, Subject.VERTICAL_DATUM, "used", "ellipsoid", in_space, stated=NOBODY, height_m=100.0)
add(ODM_READER, Subject.VERTICAL_DATUM, "refused", "--vertical", ODM, stated=NOBODY)
add(ODM_READER, Subject.UNIT, "used", "metre", in_space, stated=NOBODY)
add(ODM_READER, Subject.UNIT, "assumed", "metre", ODM, height_m=100.0)
us_feet = "EPSG:2263\n980000 200000 100 5 6 a.JPG g\n"
add(ODM_READER, Subject.UNIT, "assumed", "US survey foot", us_feet, height_m=100.0 * 1200 / 3937)
add(ODM_READER, Subject.UNIT, "used", "US survey feet", us_feet + "# units: US survey feet\n")
no_letter = ODM.replace("EPSG:32633", "WGS84 UTM 33")
add(ODM_READER, Subject.HORIZONTAL_DATUM, "assumed", "northern", no_letter)
add(ODM_READER, Subject.UNIT, "refused", "states feet", ODM + "# heights are in feet\n")
add(ODM_READER, Subject.PIXEL_ORIGIN, "assumed", "centre", ODM)
add(
    ODM_READER,
    Subject.ORDER,
    "refused",
    "exchanged",
    "WGS84 UTM 33N\n4646566.3 275443.7 100 5 6 a.JPG\n",
)
add(ODM_READER, Subject.VALIDITY, "used", "1 check points", ODM)
add(ODM_READER, Subject.ACCURACY, "named", "accuracy 2 cm", ODM + "# accuracy 2 cm\n")
add(ODM_READER, Subject.EPOCH, "named", "2010", ODM + "# epoch 2010\n")
add(ODM_READER, Subject.IDENTITY, "used", "my image.JPG", ODM)
add(ODM_READER, Subject.IDENTITY, "named", "more words", ODM)

# GeoJSON


def geojson(
    coordinates: list[float], members: dict[str, object] | None = None, **properties: object
) -> str:
    """One point."""
    feature = {
        "type": "Feature",
        "geometry": {"type": "Point", "coordinates": coordinates},
        "properties": properties,
    }
    return json.dumps({"type": "FeatureCollection", "features": [feature]} | (members or {}))


def crs(name: str) -> dict[str, object]:
    """The member of older GeoJSON."""
    return {"crs": {"type": "name", "properties": {"name": name}}}


AT = [12.0, 41.0, 100.0]
ON_MAP = [275443.7, 4646566.3, 100.0]
add(GEOJSON_READER, Subject.HORIZONTAL_DATUM, "assumed", "RFC 7946", geojson(AT), stated=NOBODY)
for code in ("EPSG:32633", "urn:ogc:def:crs:EPSG::32633"):
    text = geojson(ON_MAP, crs(code))
    add(GEOJSON_READER, Subject.HORIZONTAL_DATUM, "used", "33N", text, stated=NOBODY, height_m=100.0)
crs84 = geojson(AT, crs("urn:ogc:def:crs:OGC:1.3:CRS84"))
add(GEOJSON_READER, Subject.HORIZONTAL_DATUM, "used", "CRS84", crs84, lon_lat=(12.0, 41.0))
add(GEOJSON_READER, Subject.HORIZONTAL_DATUM, "refused", "of the Earth", geojson(AT, crs(MOON)))
add(
    GEOJSON_READER,
    Subject.HORIZONTAL_DATUM,
    "refused",
    "name of a reference",
    geojson(AT, {"crs": {"type": "link"}}),
)
add(GEOJSON_READER, Subject.HORIZONTAL_DATUM, "named", "7415", geojson(AT, {"coordRefSys": "EPSG:7415"}))
above = {"heights": "metres above the WGS 84 ellipsoid"}
add(GEOJSON_READER, Subject.VERTICAL_DATUM, "used", "ellipsoid", geojson(AT, above))
add(
    GEOJSON_READER,
    Subject.VERTICAL_DATUM,
    "refused",
    "heights: expected",
    geojson(AT, {"heights": "EGM96"}),
)
add(GEOJSON_READER, Subject.VERTICAL_DATUM, "refused", "found 2 numbers", geojson(AT[:2], elevation=100))
add(
    GEOJSON_READER,
    Subject.VERTICAL_DATUM,
    "refused",
    "heights of 0",
    geojson([*AT[:2], 0], elevation=100),
)
add(GEOJSON_READER, Subject.VERTICAL_DATUM, "named", "elevation_ft", geojson(AT, elevation_ft=328))
add(GEOJSON_READER, Subject.UNIT, "named", "ft", geojson(AT, unit="ft"))
origin = {"pixel_origin": "the centre of the first pixel is line 0, sample 0"}
add(GEOJSON_READER, Subject.PIXEL_ORIGIN, "used", "centre", geojson(AT, origin))
add(GEOJSON_READER, Subject.PIXEL_ORIGIN, "assumed", "centre", geojson(AT))
add(
    GEOJSON_READER,
    Subject.PIXEL_ORIGIN,
    "refused",
    "pixel_origin",
    geojson(AT, {"pixel_origin": "corner"}),
)
add(GEOJSON_READER, Subject.ORDER, "refused", "latitude within 90", geojson([12.0, 141.0, 100.0]))
turned = geojson([ON_MAP[1], ON_MAP[0], 100.0], crs("EPSG:32633"))
add(GEOJSON_READER, Subject.ORDER, "refused", "exchanged", turned)
add(GEOJSON_READER, Subject.VALIDITY, "used", "status", geojson(AT, status="active"))
add(GEOJSON_READER, Subject.ACCURACY, "used", "sigmas", geojson(AT, sigma_east_m=1.0))
add(GEOJSON_READER, Subject.ACCURACY, "named", "ce90", geojson(AT, ce90=1.0))
add(GEOJSON_READER, Subject.EPOCH, "named", "2010.5", geojson(AT, {"coordinateEpoch": 2010.5}))
add(GEOJSON_READER, Subject.EPOCH, "named", "2010.5", geojson(AT, epoch=2010.5))
add(GEOJSON_READER, Subject.IDENTITY, "used", "a.tif", geojson(AT, image="/data/a.tif"))
add(GEOJSON_READER, Subject.IDENTITY, "named", "barn", geojson(AT, code="barn"))

# OPF


def opf(
    definition: str = "EPSG:4979",
    coordinates: tuple[float, ...] = (41.0, 12.0, 100.0),
    **members: object,
) -> str:
    """One point with one mark."""
    document = json.loads((GOLDEN / "invented_opf.json").read_text())
    document["gcps"] = document["gcps"][:1]
    point = document["gcps"][0]
    point["geolocation"] |= {
        "crs": {"definition": definition} | members.pop("crs", {}),  # type: ignore[operator]
        "coordinates": coordinates,
    }
    point["is_checkpoint"] = True
    return json.dumps(document | members)


add(OPF_READER, Subject.HORIZONTAL_DATUM, "used", "WGS 84", opf(), stated=NOBODY, lon_lat=(12.0, 41.0))
add(OPF_READER, Subject.HORIZONTAL_DATUM, "refused", "of the Earth", opf(MOON), stated=NOBODY)
add(OPF_READER, Subject.VERTICAL_DATUM, "used", "ellipsoid", opf(), stated=NOBODY, height_m=100.0)
in_utm = opf("EPSG:32633", (275443.7, 4646566.3, 100.0))
add(OPF_READER, Subject.VERTICAL_DATUM, "assumed", "ellipsoid", in_utm, stated=NOBODY, height_m=100.0)
add(OPF_READER, Subject.UNIT, "used", "metre", opf(), stated=NOBODY)
opf_feet = opf("EPSG:2263", (980000.0, 200000.0, 100.0))
feet_m = 100.0 * 1200 / 3937
add(OPF_READER, Subject.UNIT, "used", "US survey foot", opf_feet, stated=NOBODY, height_m=feet_m)
add(OPF_READER, Subject.PIXEL_ORIGIN, "assumed", "corner", opf(), stated=NOBODY)
add(OPF_READER, Subject.ORDER, "used", "Lat, Lon", opf(), stated=NOBODY)
opf_turned = opf("EPSG:32633", (4646566.3, 275443.7, 100.0))
add(OPF_READER, Subject.ORDER, "refused", "exchanged", opf_turned, stated=NOBODY)
add(OPF_READER, Subject.VALIDITY, "used", "check points", opf(), stated=NOBODY)
add(OPF_READER, Subject.ACCURACY, "used", "sigmas", opf(), stated=NOBODY)
add(OPF_READER, Subject.EPOCH, "named", "2010.5", opf(crs={"epoch": 2010.5}), stated=NOBODY)
add(OPF_READER, Subject.IDENTITY, "assumed", "camera_id", opf(extensions={}), stated=NOBODY)
add(OPF_READER, Subject.IDENTITY, "named", "2 manual tie points", opf(mtps=[{}, {}]), stated=NOBODY)

# GCPLib and Copernicus

LIBRARY = (GOLDEN / "invented_gcplib.txt").read_text()
add(GCPLIB_READER, Subject.HORIZONTAL_DATUM, "assumed", "WGS 84", LIBRARY)
add(GCPLIB_READER, Subject.VERTICAL_DATUM, "refused", "--vertical", LIBRARY, stated=NOBODY)
control = replace(NOBODY, options="--control-")
add(GCPLIB_READER, Subject.VERTICAL_DATUM, "refused", "(--control-geoid)", LIBRARY, stated=control)
add(GCPLIB_READER, Subject.UNIT, "assumed", "metres", LIBRARY, height_m=105.25)
add(GCPLIB_READER, Subject.ORDER, "used", "y before", LIBRARY)
mirrored = LIBRARY.replace("41.9391234567 12.2912345678", "12.2912345678 41.9391234567")
add(GCPLIB_READER, Subject.ORDER, "refused", "swapped", mirrored)
add(GCPLIB_READER, Subject.EPOCH, "named", "1999-07-14", LIBRARY)
add(GCPLIB_READER, Subject.ACCURACY, "named", "ABS", LIBRARY)
DATABASE = (GOLDEN / "invented_copernicus.json").read_text()
add(COPERNICUS_READER, Subject.HORIZONTAL_DATUM, "assumed", "WGS 84", DATABASE)
add(COPERNICUS_READER, Subject.HORIZONTAL_DATUM, "refused", "EPSG", DATABASE.replace("32633", "25833"))
add(COPERNICUS_READER, Subject.VERTICAL_DATUM, "refused", "--vertical", DATABASE, stated=NOBODY)
add(COPERNICUS_READER, Subject.UNIT, "used", "Altimetry", DATABASE, height_m=105.25)
unit_ft = DATABASE.replace('"@unit": "m"', '"@unit": "ft"')
add(COPERNICUS_READER, Subject.UNIT, "used", "Altimetry", unit_ft, height_m=105.25 * 0.3048)
add(
    COPERNICUS_READER,
    Subject.UNIT,
    "refused",
    "'ell",
    DATABASE.replace('"@unit": "m"', '"@unit": "ell"'),
)
add(COPERNICUS_READER, Subject.ORDER, "used", "compared", DATABASE)
add(
    COPERNICUS_READER,
    Subject.ORDER,
    "refused",
    "but the record",
    DATABASE.replace("275443.7319", "375443.7"),
)
add(COPERNICUS_READER, Subject.ACCURACY, "named", "Quality", DATABASE)
