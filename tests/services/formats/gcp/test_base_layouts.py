"""GCPLib, its chips and archives of the Copernicus database, to the bytes that public software makes.

Sources: the writer `ias_gcp_write_gcplib` of the USGS in C (`%lf`: six decimals) and in Perl (names of
word characters only), its `ias_gcp_read_image` (headerless, little-endian), and software that downloads
the collection sentinel-2-gri-l1c-gcp and unpacks its archives.
"""

import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from amers.services.formats.gcp.base_chips import open_base_chip, read_base_chips
from amers.services.formats.gcp.gcplib import gcplib_records, parse_gcplib
from amers.services.formats.gcp.reader import StatedByCaller, read_ground_points
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.map_grid import xy_of_lon_lat
from amers.services.sensors.ortho import OrthoModel
from tests.services.chip_bases import base_points, brightness, chip_around, write_copernicus

A_METRE_DEG = 1e-5
COMMENTS = (
    ("Unique Ground Control Point ID", "integer"),
    ("Name of the chip image", "string"),
    ("Reference line", "double"),
    ("Reference sample", "double"),
    ("True latitude of reference point in degrees", "double"),
    ("True longitude of reference point in degrees", "double"),
    ("Projection x value of reference point in meters", "double"),
    ("Projection y value of reference point in meters", "double"),
    ("Elevation at the Ground Control Point in meters", "double"),
    ("Pixel size x value in meters", "double"),
    ("Pixel size y value in meters", "double"),
    ("Chip size in lines", "double"),
    ("Chip size in samples", "double"),
    ("Ground Control Point source", "string"),
    ("Ground Control Point type", "string"),
    ("Chip projection", "string"),
    ("Projection UTM zone", "integer"),
    ("Acquisition date", "string in form mm-dd-yyyy"),
    ("Absolute or relative flag", "string, should be ABS or REL"),
    ("Image chip data type", "string"),
)


def gcplib_bytes(records: list[tuple[object, ...]]) -> bytes:
    """A file with the header of the writer in C: doubles have six decimals, lines end with a newline."""
    lines = [f"# {name} - {kind}" for name, kind in COMMENTS] + ["BEGIN", str(len(records))]
    for record in records:
        words = [f"{word:.6f}" if isinstance(word, float) else str(word) for word in record]
        assert len(words) == len(COMMENTS)
        lines.append(" ".join(words))
        assert len(lines[-1]) < 300  # the buffer of the reader
    return ("\n".join(lines) + "\n").encode("ascii")


def record(
    number: int,
    lon_lat: tuple[float, float],
    zone: int,
    xy: np.ndarray,
    pixels: tuple[float, ...] = (15.0, 15.0, 64.0, 64.0),
) -> tuple[object, ...]:
    """A record with a point at the pixel (32, 32) of a chip, counted from (0, 0).

    Its pixels are given by their steps in x and y, metres, and the numbers of lines and samples.
    """
    place = (32.0, 32.0, lon_lat[1], lon_lat[0], float(xy[1]), float(xy[0]), 90.0)
    kind = ("GLS+", "GRAYSCALE", "UTM", zone, "07-14-1999", "ABS", "BYTE")
    return (str(number), f"p190r031_{number:04d}_chip", *place, *pixels, *kind)


def test_points_and_chips_of_the_writer_of_the_usgs(tmp_path: Path) -> None:
    records, rng = [], np.random.default_rng(3)
    for number, point in enumerate(base_points(3), start=1):
        grid, pixels = chip_around(point, 15.0, 64, rng)
        xy = grid.xy(np.array([[32.0, 32.0]]))[0]
        lon, lat = grid.lon_lat(np.array([[32.0, 32.0]]))[0].tolist()
        records.append(record(number, (lon, lat), 33, xy))
        (tmp_path / str(records[-1][1])).write_bytes(np.rint(pixels).astype("<u1").tobytes())
    path = tmp_path / "GCPLib"
    path.write_bytes(gcplib_bytes(records))
    ground = read_ground_points(path, StatedByCaller("ellipsoid"))
    assert ground.id.tolist() == [str(number) for number in range(1, 10)]
    stated = np.array([(row[5], row[4], row[8]) for row in records], dtype=float)
    assert np.allclose(ground.lon_lat_h[:, :2], stated[:, :2], atol=A_METRE_DEG / 10.0)
    for chip in read_base_chips(path, tmp_path, "centre"):
        scene = open_base_chip(chip)
        assert isinstance(scene, Scene)
        assert isinstance(scene.model, OrthoModel)
        pixels = scene.image.pixels  # type: ignore[attr-defined]
        at = np.stack(np.mgrid[:64, :64], axis=-1).reshape(-1, 2).astype(float)
        assert np.corrcoef(pixels.ravel(), brightness(scene.model.grid.xy(at)))[0, 1] > 0.99


def test_a_set_without_points_is_empty() -> None:
    """The Perl of the USGS warns, and writes the file."""
    assert len(parse_gcplib(gcplib_bytes([]).decode(), "ellipsoid").line_sample) == 0


@pytest.mark.parametrize("zone", [33, -33])
@pytest.mark.parametrize("false_northing_m", [0.0, 10_000_000.0])
def test_chips_south_of_the_equator_lie_where_their_latitude_says(
    tmp_path: Path, zone: int, false_northing_m: float
) -> None:
    """The Perl of the USGS accepts no sign of a zone; northings may count from either origin.

    Pixels of 15 m from west to east are 30 m from north to south; there are 64 lines of 48.
    """
    lon_lat = (15.2, -12.5)
    xy = xy_of_lon_lat("EPSG:32633", np.array([lon_lat]))[0] + [0.0, false_northing_m]
    path = tmp_path / "GCPLib"
    path.write_bytes(gcplib_bytes([record(1, lon_lat, zone, xy, (15.0, 30.0, 64.0, 48.0))]))
    (found,) = gcplib_records(path.read_text())
    assert found.crs == ("EPSG:32733" if false_northing_m else "EPSG:32633")
    values = np.arange(64 * 48, dtype=np.uint8).reshape(64, 48) | 1
    (tmp_path / "p190r031_0001_chip").write_bytes(values.tobytes())
    scene = open_base_chip(read_base_chips(path, tmp_path, "centre")[0])
    assert isinstance(scene, Scene)
    assert isinstance(scene.model, OrthoModel)
    corners = np.array([[32.0, 32.0], [0.0, 0.0], [63.0, 47.0]])
    expected = xy + (corners - 32.0)[:, ::-1] * [15.0, -30.0]
    assert np.allclose(scene.model.grid.xy(corners), expected, atol=0.01)
    assert np.allclose(scene.model.grid.lon_lat(corners)[0], lon_lat, atol=A_METRE_DEG)
    np.testing.assert_array_equal(scene.image.read(Window(0, 0, 64, 48)), values)


def test_an_unpacked_archive_of_the_copernicus_database_is_read(tmp_path: Path) -> None:
    """Its chips lie in the folder L1C_chips beside the document, which has lists, or single objects."""
    made = write_copernicus(tmp_path / "made", base_points(3), measures=2)
    document = json.loads(made.read_text())
    for gcp in document["GCP_DB"]["GCP"]:
        gcp["GCP_Info"]["Altimetry"] = {"@unit": "m", "#text": gcp["GCP_Info"]["Altimetry"]}
        gcp["GCP_Info"]["EPSG"] = int(gcp["GCP_Info"]["EPSG"])
        gcp["Quality_Indicators"] = {"Quality_Score": 3}
    top = "S2__USER_GCP_L1C_T33UVT"
    with tarfile.open(tmp_path / "delivered.tar.gz", "w:gz") as archive:
        content = json.dumps(document, indent=2).encode()
        entry = tarfile.TarInfo(f"{top}/GCP_T33UVT.json")
        entry.size = len(content)
        archive.addfile(entry, io.BytesIO(content))
        for chip in sorted((tmp_path / "made" / "chips").iterdir()):
            archive.add(chip, f"{top}/L1C_chips/{chip.name}")
    with tarfile.open(tmp_path / "delivered.tar.gz") as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    folder = tmp_path / "unpacked" / top
    path = folder / "GCP_T33UVT.json"
    assert len(read_ground_points(path, StatedByCaller("ellipsoid"))) == 9
    for chips_folder in (folder, folder / "L1C_chips"):
        chips = read_base_chips(path, chips_folder)
        assert len(chips) == 18
        assert all(isinstance(open_base_chip(chip), Scene) for chip in chips)
