"""Writes the deliverables of a registration, without the code under test."""

import json
from pathlib import Path

import make_rpc
import numpy as np
from pyproj import CRS

HERE = Path(__file__).parent
# A shift of 40 lines and -25 samples and a drift of 2 and -1.5 px at the edges of the RPC's own range.
LINE, SAMPLE = (40.0, 2.0), (-25.0, -1.5)
SEMI_MAJOR_M, FLATTENING = 6378137.0, 1.0 / 298.257223563
EXAGGERATION = 500.0
# id, lon, lat, height, line, sample, sigma, score, residuals (line, sample px; east, north m), reason
POINTS = [
    (7, 12.3001, 41.9011, 105.25, 11000.5, 9000.25, 0.05, 0.93, 0.125, -0.25, -0.125, -0.0625, ""),
    (9, 12.3402, 41.8902, 612.5, 13000.0, 14000.75, 0.08, 0.88, -1.5, 2.25, 1.125, 0.75, "deactivated"),
    (12, 12.3803, 41.8703, 310.0, None, None, None, 0.41, None, None, None, None, "low_score"),
    (31, 12.3604, 41.9104, -41.75, 8000.25, 20000.5, 0.11, 0.97, 0.0625, 0.5, 0.25, -0.03125, ""),
]  # fmt: skip
NAMES = "point_id lon lat height_m line sample sigma_px score residual_line_px residual_sample_px"
NAMES = [*NAMES.split(), "residual_east_m", "residual_north_m", "reason"]


def correction():
    document = {
        "format": "amers-image-correction/1",
        "applies_to": "invented RPC, « tags »",
        "carried": "RPC_invented_v2.XML: the corrected model, exactly",
        "pixel_origin": "the centre of the first pixel is line 0, sample 0",
        "formula": "(line, sample) + parameters_px (1, t_line, t_sample), "
        "t = ((line, sample) - centre_px) / half_size_px",
        "order": "drift",
        "parameters_px": [[LINE[0], LINE[1], 0.0], [SAMPLE[0], 0.0, SAMPLE[1]]],
        "centre_px": [make_rpc.LINE_OFF, make_rpc.SAMP_OFF],
        "half_size_px": [make_rpc.LINE_SCALE, make_rpc.SAMP_SCALE],
        "covariance_px2": [[0.25 if i == j else None for j in range(6)] for i in range(6)],
        "local_sigma_px": [0.125, 0.0625],
        "frame_covariance_m2": [[4.0, 0.5, None], [0.5, 9.0, None], [None, None, None]],
        "apart_px": 0.375,
    }
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def dimap(name, first):
    """The delivered document with four changed numbers: offsets and scales of the image."""
    text = (HERE / name).read_text()
    line, sample = make_rpc.LINE_OFF + first, make_rpc.SAMP_OFF + first
    for was, becomes, key in (
        (line, line + LINE[0], "LINE_OFF"),
        (sample, sample + SAMPLE[0], "SAMP_OFF"),
        (make_rpc.LINE_SCALE, make_rpc.LINE_SCALE + LINE[1], "LINE_SCALE"),
        (make_rpc.SAMP_SCALE, make_rpc.SAMP_SCALE + SAMPLE[1], "SAMP_SCALE"),
    ):
        assert text.count(f"<{key}>{was!r}</{key}>") == 1
        text = text.replace(f"<{key}>{was!r}</{key}>", f"<{key}>{becomes!r}</{key}>")
    return text


def sidecar():
    """A rotated and mirrored map grid in UTM zone 33, with the geotransform of the pixel corner."""
    crs = CRS.from_epsg(32633).to_wkt("WKT2_2019").replace("&", "&amp;").replace("<", "&lt;")
    return (
        '<PAMDataset>\n  <SRS dataAxisToSRSAxisMapping="1,2">' + crs + "</SRS>\n"
        "  <GeoTransform>300000.25, 0.5, 0.0625, 4640000.75, 0.03125, -0.5</GeoTransform>\n"
        "</PAMDataset>\n"
    )


def metres_per_degree(lat, height):
    """Metres per degree east and north, from the radii of curvature of the ellipsoid."""
    e2 = FLATTENING * (2.0 - FLATTENING)
    w2 = 1.0 - e2 * np.sin(np.radians(lat)) ** 2
    across, along = SEMI_MAJOR_M / np.sqrt(w2), SEMI_MAJOR_M * (1.0 - e2) / w2**1.5
    return np.radians(1.0) * np.array([(across + height) * np.cos(np.radians(lat)), along + height])


def residuals():
    """The points, their attributes, and both ends of the line of each matched point."""
    rows = [dict(zip(NAMES, values, strict=True)) for values in POINTS]
    for row in rows:
        row["status"] = {"": "active", "deactivated": "deactivated"}.get(row["reason"], "not matched")
        if row["line"] is None:
            continue
        residual = np.array([row["residual_east_m"], row["residual_north_m"]])
        row["residual_m"] = float(np.hypot(*residual))
        start = np.array([row["lon"], row["lat"]])
        end = start + EXAGGERATION * residual / metres_per_degree(row["lat"], row["height_m"])
        row["line_to"] = [*end.tolist(), row["height_m"]]
    return json.dumps({"exaggeration": EXAGGERATION, "points": rows}, indent=1) + "\n"


if __name__ == "__main__":
    for name, text in {
        "invented_correction.json": correction(),
        "RPC_invented_v2_refined.XML": dimap("RPC_invented_v2.XML", 1),
        "RPC_invented_v3_refined.XML": dimap("RPC_invented_v3.XML", 0),
        "invented_map.tif.aux.xml": sidecar(),
        "invented_residuals.json": residuals(),
    }.items():
        (HERE / name).write_text(text, encoding="utf-8")
