"""Writes the same marked points in all formats, without the code under test."""

import hashlib
import json
from pathlib import Path

import make_rpc
import numpy as np
from pyproj import Transformer

HERE = Path(__file__).parent
IMAGE = "invented.tif"
LON_LAT_H = [
    (12.2912345678, 41.9391234567, 105.25),
    (12.4001234567, 41.9298765432, 612.5),
    (12.3456789012, 41.9012345678, 310.0),
    (12.2898765432, 41.8634567891, 3.125),
    (12.3987654321, 41.8587654321, -41.75),
]
SIGMA_EAST_NORTH_UP_M = [
    (0.5, 0.75, 1.5),
    (1.25, 1.0, 2.5),
    (0.25, 0.25, 0.5),
    (2.0, 1.5, 4.0),
    (1.0, 1.0, 2.0),
]
SIGMA_PX = [0.11, 0.22, 0.33, 0.44, 0.55]


def places():
    """Line and sample from the centre of the first pixel."""
    x, y, z = (
        (np.array(values) - offset) / scale
        for values, offset, scale in zip(
            zip(*LON_LAT_H, strict=True),
            (make_rpc.LONG_OFF, make_rpc.LAT_OFF, make_rpc.HEIGHT_OFF),
            (make_rpc.LONG_SCALE, make_rpc.LAT_SCALE, make_rpc.HEIGHT_SCALE),
            strict=True,
        )
    )
    model, t = make_rpc.polynomials(), make_rpc.terms(x, y, z)
    line = t @ model["LINE_NUM"] / (t @ model["LINE_DEN"]) * make_rpc.LINE_SCALE + make_rpc.LINE_OFF
    sample = t @ model["SAMP_NUM"] / (t @ model["SAMP_DEN"]) * make_rpc.SAMP_SCALE + make_rpc.SAMP_OFF
    return list(zip(line.tolist(), sample.tolist(), strict=True))


def rows():
    return list(
        enumerate(zip(LON_LAT_H, SIGMA_EAST_NORTH_UP_M, places(), SIGMA_PX, strict=True), start=11)
    )


def asp():
    lines = ["# invented, for bundle_adjust --use-lon-lat-height-gcp-error"]
    for number, ((lon, lat, h), (east, north, up), (line, sample), sigma) in rows():
        lines.append(
            f"{number}, {lat:.10f} {lon:.10f} {h} {north} {east} {up} "
            f"{IMAGE} {sample!r} {line!r} {sigma} {sigma}"
        )
    return "\n".join(lines) + "\n"


def qgis():
    lines = ["#CRS: EPSG:4326", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    for _, ((lon, lat, _), _, (line, sample), _) in rows():
        lines.append(f"{lon:.10f},{lat:.10f},{sample + 0.5!r},{-(line + 0.5)!r},1,0,0,0")
    return "\n".join(lines) + "\n"


def envi(projection, ground):
    lines = [
        "; ENVI Orthorectification Ground Control Points File",
        f"; projection info = {{{projection}}}",
    ]
    lines += ["; Map (x,y,elev), Image (x,y)", ";"]
    for (_, (_, _, (line, sample), _)), (x, y, h) in zip(rows(), ground, strict=True):
        lines.append(f"{x:.10f} {y:.10f} {h} {sample + 1.5!r} {line + 1.5!r}")
    return "\n".join(lines) + "\n"


def utm():
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True)
    return [(*to_utm.transform(lon, lat), h) for lon, lat, h in LON_LAT_H]


def odm():
    lines = ["EPSG:4326"]
    for number, ((lon, lat, h), _, (line, sample), _) in rows():
        lines.append(f"{lon:.10f} {lat:.10f} {h} {sample!r} {line!r} {IMAGE} {number}")
    return "\n".join(lines) + "\n"


def pci():
    lines = ["# layout=IDPLXYZePeLS crs=EPSG:4326 heights=ellipsoid"]
    for number, ((lon, lat, h), _, (line, sample), sigma) in rows():
        place = f"{sample + 0.5!r} {line + 0.5!r} {lon:.10f} {lat:.10f}"
        lines.append(f"{number} {place} {h} {sigma} {sigma} G")
    return "\n".join(lines) + "\n"


def opf():
    camera = int(hashlib.sha256(IMAGE.encode()).hexdigest()[:12], 16)
    gcps = []
    for number, ((lon, lat, h), (east, north, up), (line, sample), sigma) in rows():
        location = {
            "crs": {"definition": "EPSG:4979"},
            "coordinates": [lat, lon, h],
            "sigmas": [north, east, up],
        }
        mark = {"camera_id": camera, "position_px": [sample + 0.5, line + 0.5], "accuracy": sigma}
        gcps.append(
            {"id": str(number), "geolocation": location, "marks": [mark], "is_checkpoint": False}
        )
    document = {
        "format": "application/opf-input-control-points+json",
        "version": "1.0",
        "gcps": gcps,
        "mtps": [],
    }
    return (
        json.dumps({**document, "extensions": {"AMERS_images": {str(camera): IMAGE}}}, indent=1) + "\n"
    )


def geojson():
    features = []
    for number, (ground, (east, north, up), (line, sample), sigma) in rows():
        properties = {"status": "active", "line": line, "sample": sample, "sigma_px": sigma}
        properties |= {"sigma_east_m": east, "sigma_north_m": north, "sigma_up_m": up}
        geometry = {"type": "Point", "coordinates": list(ground)}
        features.append(
            {"type": "Feature", "id": number, "geometry": geometry, "properties": properties}
        )
    return (
        json.dumps({"type": "FeatureCollection", "image": IMAGE, "features": features}, indent=1) + "\n"
    )


def orthority():
    features = []
    for number, (ground, _, (line, sample), _) in rows():
        properties = {"filename": IMAGE, "ji": [sample, line], "id": str(number), "info": None}
        geometry = {"type": "Point", "coordinates": list(ground)}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def ecef_sigmas():
    """The same points with sigmas of x, y and z, as ASP reads them by default, and one fixed point."""
    lines = []
    for number, ((lon, lat, h), _, (line, sample), sigma) in rows():
        sigmas = "1e-10 1e-10 1e-10" if number == 13 else "1.0 2.0 3.0"
        lines.append(
            f"{number} {lat:.10f} {lon:.10f} {h} {sigmas} {IMAGE} {sample!r} {line!r} {sigma} {sigma}"
        )
    return "\n".join(lines) + "\n"


def gcplib(utm_points):
    names = [
        "Unique Ground Control Point ID - integer",
        "Name of the chip image - string",
        "Reference line",
        "Reference sample",
        "Latitude",
        "Longitude",
        "Projection X",
        "Projection Y",
        "Elevation",
        "Pixel size X",
        "Pixel size Y",
        "Chip lines",
        "Chip samples",
        "Source",
        "Type",
        "Projection",
        "Zone",
        "Date",
        "Absolute or relative",
        "Data type",
    ]
    lines = [f"# {name}" for name in names] + ["BEGIN", str(len(LON_LAT_H))]
    for (number, ((lon, lat, h), *_)), (x, y, _) in zip(rows(), utm_points, strict=True):
        lines.append(
            f"{number} gcp_{number}.chip 31.500000 31.500000 {lat:.10f} {lon:.10f} {y:.6f} {x:.6f} "
            f"{h:.6f} 30.000000 30.000000 64.000000 64.000000 GLS+ GRAYSCALE UTM 33 07-14-1999 ABS BYTE"
        )
    return "\n".join(lines) + "\n"


def copernicus(utm_points):
    gcps = []
    for (number, ((lon, lat, h), *_)), (x, y, _) in zip(rows(), utm_points, strict=True):
        info = {"Longitude": f"{lon:.10f}", "Latitude": f"{lat:.10f}", "EPSG": "32633"}
        info |= {"Altimetry": {"@unit": "m", "#text": str(h)}, "X": f"{x:.4f}", "Y": f"{y:.4f}"}
        measure = {"Chips": {"Chip_File": f"{number}_00.TIF"}}
        measures = [measure, {"Chips": {"Chip_File": {"Chip_File": f"{number}_01.TIF"}}}]
        gcps.append(
            {
                "ID": str(number),
                "GCP_Info": info,
                "Quality_Indicators": {"Quality_Score": "3"},
                "GRI_List": {"GRI_Measure": measure if number % 2 else measures},
            }
        )
    return json.dumps({"GCP_DB": {"GCP": gcps}}, indent=1) + "\n"


def comma_separated():
    lines = [
        "# pixel-origin=centre",
        "id,lon,lat,height_m,sigma_east_m,sigma_north_m,sigma_up_m,image,line,sample,sigma_px,remark",
    ]
    for number, ((lon, lat, h), (east, north, up), (line, sample), sigma) in rows():
        place = f"{lon:.10f},{lat:.10f},{h},{east},{north},{up}"
        lines.append(f'{number},{place},{IMAGE},{line!r},{sample!r},{sigma},"a corner, sharp"')
    return "\n".join(lines) + "\n"


def semicolon_separated(utm_points):
    """Other names and order, positions on a map, no marks, and one unknown sigma."""
    lines = ["N;E;ALT;PT;SH;SV"]
    for (number, ((_, _, h), (_, north, up), *_)), (x, y, _) in zip(rows(), utm_points, strict=True):
        lines.append(f"{y:.10f};{x:.10f};{h};{number};{north};{'' if number == 13 else up}")
    return "\r\n".join(lines) + "\r\n"


def feet():
    """ODM's list in feet: a projection in US survey feet whose heights are feet too."""
    projection = "+proj=utm +zone=33 +datum=WGS84 +units=us-ft +no_defs"
    foot_m = 1200 / 3937
    lines = [projection]
    for (x, y, h), (number, (_, _, (line, sample), _)) in zip(utm(), rows(), strict=True):
        ground = f"{x / foot_m!r} {y / foot_m!r} {h / foot_m!r}"
        lines.append(f"{ground} {sample!r} {line!r} {IMAGE} {number}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    for name, text in {
        "invented.gcp": asp(),
        "invented.points": qgis(),
        "invented.pts": envi("Geographic Lat/Lon, WGS-84, units=Degrees", LON_LAT_H),
        "invented_utm.pts": envi("UTM, 33, North, WGS-84, units=Meters", utm()),
        "invented_gcp_list.txt": odm(),
        "invented_pci.txt": pci(),
        "invented_opf.json": opf(),
        "invented.geojson": geojson(),
        "invented_orthority.geojson": orthority(),
        "invented_ecef.gcp": ecef_sigmas(),
        "invented_feet.txt": feet(),
        "invented_gcplib.txt": gcplib(utm()),
        "invented_copernicus.json": copernicus(utm()),
        "invented.csv": comma_separated(),
        "invented_mapped.csv": semicolon_separated(utm()),
    }.items():
        (HERE / name).write_text(text)
