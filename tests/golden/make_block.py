"""Writes a small Amers block from the format description alone, without the code under test."""

import hashlib
import json
import struct
from datetime import UTC, date, datetime
from pathlib import Path

import make_rpc
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj

FOLDER = Path(__file__).parent / "invented_block"
LEFT_AT = datetime(2024, 6, 1, 10, 30, tzinfo=UTC)
RIGHT_AT = datetime(2024, 7, 2, 10, 45, 0, 500_000, tzinfo=UTC)
# image, sensor, time, incidence and azimuth of the view, elevation and azimuth of the sun
IMAGES = [
    ("left", "invented A", LEFT_AT, 12.5, 100.0, 61.0, 150.0),
    ("right", "invented B", RIGHT_AT, 20.25, 280.0, 58.5, 148.0),
]
# In Hilbert order: lon, lat, height, sigmas east, north, up, correlations, saliency, typology.
POINTS = [
    (12.29, 41.86, 105.25, 0.5, 0.75, 1.5, 0.25, -0.125, 0.5, 0.75, "crossing"),
    (12.41, 41.94, 612.5, 0.25, 0.25, 0.5, -0.5, 0.125, 0.0, 0.875, "roof"),
    (12.40, 41.87, -41.75, 1.25, 1.0, 2.5, 0.0, 0.0, 0.0, 0.5, None),
]
CHIP_FILE = "chips/0000.npy"
GSD_M = 2.0


def geometry(lon, lat, height):
    """WKB of a point with a height, ISO, little-endian."""
    return struct.pack("<BIddd", 1, 1001, lon, lat, height)


def points_table():
    columns = list(zip(*POINTS, strict=True))
    n, views = len(POINTS), len(IMAGES)
    float64 = dict(
        zip(
            ["sigma_east_m", "sigma_north_m", "sigma_up_m"]
            + ["corr_east_north", "corr_east_up", "corr_north_up"],
            columns[3:9],
            strict=True,
        )
    )
    fields = [
        ("id", pa.int64(), range(n), False),
        ("geometry", pa.binary(), [geometry(*point[:3]) for point in POINTS], False),
        *((name, pa.float64(), values, False) for name, values in float64.items()),
        ("n_views", pa.int16(), [views] * n, False),
        ("saliency", pa.float32(), columns[9], False),
        ("typology", pa.string(), columns[10], True),
        ("first_view", pa.date32(), [date(2024, 6, 1)] * n, True),
        ("last_view", pa.date32(), [date(2024, 7, 2)] * n, True),
        ("chip_file", pa.string(), [CHIP_FILE] * n, False),
        ("chip_row", pa.int64(), [views * i for i in range(n)], False),
        ("chip_count", pa.int16(), [views] * n, False),
    ]
    low, high = ([float(f(values)) for values in columns[:3]] for f in (min, max))
    column = {"encoding": "WKB", "geometry_types": ["Point Z"], "bbox": [*low, *high]}
    column["crs"] = pyproj.CRS.from_epsg(4979).to_json_dict()
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    return table(fields, {"geo": json.dumps(geo)})


def views_table():
    n, views = len(POINTS), len(IMAGES)
    number = np.tile(np.arange(views), n).tolist()
    of_image = [IMAGES[k] for k in number]
    fields = [
        ("point_id", pa.int64(), np.repeat(np.arange(n), views), False),
        ("view", pa.int16(), number, False),
        ("gsd_m", pa.float64(), [GSD_M] * n * views, False),
        ("image_id", pa.string(), [image[0] for image in of_image], False),
        ("sensor", pa.string(), [image[1] for image in of_image], False),
        ("acquired_at", pa.timestamp("us", tz="UTC"), [image[2] for image in of_image], True),
        ("incidence_deg", pa.float64(), [image[3] + 0.125 for image in of_image], True),
        ("azimuth_deg", pa.float64(), [image[4] - 0.25 for image in of_image], True),
        ("sun_elevation_deg", pa.float64(), [image[5] for image in of_image], True),
        ("sun_azimuth_deg", pa.float64(), [image[6] for image in of_image], True),
        ("chip_file", pa.string(), [CHIP_FILE] * n * views, False),
        ("chip_row", pa.int64(), range(n * views), False),
    ]
    return table(fields, {})


def table(fields, metadata):
    schema = pa.schema([pa.field(name, kind, null) for name, kind, _, null in fields], metadata)
    return pa.Table.from_arrays([pa.array(values, kind) for _, kind, values, _ in fields], schema=schema)


def chips():
    """Chips of ramps that differ by chip, row and column, with a header written by hand."""
    count = len(POINTS) * len(IMAGES)
    number, row, column = np.indices((count, 101, 101))
    pixels = ((31 * number + 3 * row + 5 * column) % 255 + 1).astype(np.uint8)
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({count}, 101, 101), }}"
    header += " " * (127 - 10 - len(header)) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + pixels.tobytes()


def document(checksums):
    def instant(value):
        return value.isoformat().replace("+00:00", "Z")

    images = [
        {
            "image_id": name,
            "sensor": sensor,
            "acquired_at": instant(time),
            "incidence_deg": incidence,
            "azimuth_deg": azimuth,
            "sun_elevation_deg": elevation,
            "sun_azimuth_deg": sun_azimuth,
            "model": f"models/{name}_RPC.TXT" if name == "left" else None,
        }
        for name, sensor, time, incidence, azimuth, elevation, sun_azimuth in IMAGES
    ]
    return {
        "type": "Collection",
        "stac_version": "1.0.0",
        "id": "invented",
        "title": "Invented points",
        "description": "Three points of no place",
        "license": "Apache-2.0",
        "extent": {
            "spatial": {"bbox": [[12.28, 41.85, 12.42, 41.95]]},
            "temporal": {"interval": [[instant(IMAGES[0][2]), instant(IMAGES[1][2])]]},
        },
        "links": [],
        "amers:format": "amers-block/1",
        "amers:version": "2",
        "amers:created": "2024-08-01T12:00:00Z",
        "amers:epoch": 2024.5,
        "amers:vertical_datum": "EPSG:4979 ellipsoidal height",
        "amers:outline": [[12.28, 41.85], [12.42, 41.85], [12.42, 41.95], [12.28, 41.95]],
        "amers:specification": {
            "gsds_m": [GSD_M],
            "chip_size": 101,
            "min_views": 2,
            "points_per_km2": None,
        },
        "amers:counts": {
            "points": len(POINTS),
            "views": len(POINTS) * len(IMAGES),
            "images": len(IMAGES),
        },
        "amers:accuracy": {
            "relative": [],
            "absolute": [
                {"name": "frame_sigma_m", "value": 2.5, "count": 2, "against": "models of the images"}
            ],
        },
        "amers:frame": {"covariance_m2": [[6.25, 0.5, 1.0], [0.5, 6.25, -2.0], [1.0, -2.0, 25.0]]},
        "amers:provenance": {
            "software": "by hand",
            "version": "1",
            "sources": ["left", "right"],
            "options": {},
        },
        "amers:images": images,
        "amers:checksums": checksums,
    }


if __name__ == "__main__":
    for name in ("chips", "models"):
        (FOLDER / name).mkdir(parents=True, exist_ok=True)
    pq.write_table(points_table(), FOLDER / "points.parquet", compression="zstd")
    pq.write_table(views_table(), FOLDER / "views.parquet", compression="zstd")
    (FOLDER / CHIP_FILE).write_bytes(chips())
    (FOLDER / "models" / "left_RPC.TXT").write_text(make_rpc.text(make_rpc.polynomials()))
    files = sorted(file for file in FOLDER.rglob("*") if file.is_file() and file.name != "block.json")
    checksums = {
        file.relative_to(FOLDER).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
    }
    (FOLDER / "block.json").write_text(json.dumps(document(checksums), indent=1) + "\n")
