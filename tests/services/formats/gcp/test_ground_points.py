"""Ground points of other bases: every format gives the same points, and refuses what it cannot know."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from amers.services.errors import AmersError, FormatError, InputError, VerticalDatumError
from amers.services.formats.elevation import geoid
from amers.services.formats.gcp.copernicus import parse_copernicus
from amers.services.formats.gcp.csv_points import CsvLayout, parse_columns, parse_csv
from amers.services.formats.gcp.gcplib import parse_gcplib
from amers.services.formats.gcp.json_formats import parse_geojson_points
from amers.services.formats.gcp.reader import StatedByCaller, read_control_points, read_ground_points
from amers.services.types import GroundPoints

GOLDEN = Path(__file__).parents[3] / "golden"
MAPPED = CsvLayout(
    parse_columns("id=PT,x=E,y=N,height_m=ALT,sigma_horizontal_m=SH,sigma_up_m=SV"), "EPSG:32633"
)
ELLIPSOID = StatedByCaller("ellipsoid")
STATED = {
    "invented.gcp": ELLIPSOID,
    "invented_ecef.gcp": StatedByCaller("ellipsoid", "ecef"),
    "invented.pts": ELLIPSOID,
    "invented_utm.pts": ELLIPSOID,
    "invented_gcp_list.txt": ELLIPSOID,
    "invented_feet.txt": ELLIPSOID,
    "invented_pci.txt": StatedByCaller(),
    "invented_opf.json": StatedByCaller(),
    "invented.geojson": StatedByCaller(),
    "invented_orthority.geojson": StatedByCaller(),
    "invented_gcplib.txt": ELLIPSOID,
    "invented_copernicus.json": ELLIPSOID,
    "invented.csv": ELLIPSOID,
    "invented_mapped.csv": StatedByCaller("ellipsoid", csv=MAPPED),
}
TEXTS = {name: (GOLDEN / name).read_text() for name in STATED}
WITHOUT_MARKS = ["invented_gcplib.txt", "invented_copernicus.json", "invented_mapped.csv"]
WITHOUT_DATUM = [name for name, stated in STATED.items() if stated.heights == "ellipsoid"]

a_nanodegree = 1e-9
a_micrometre = 1e-6


def truth() -> GroundPoints:
    points = parse_geojson_points(TEXTS["invented.geojson"])
    return GroundPoints(points.id, points.lon_lat_h, points.sigma_m)


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", STATED)
def test_every_golden_file_gives_the_same_ground_under_any_file_name(name: str, tmp_path: Path) -> None:
    # The content decides, so that the name does not matter.
    points = read_ground_points(written(tmp_path, "points", TEXTS[name]), STATED[name])
    off = np.abs(points.lon_lat_h - truth().lon_lat_h)
    assert off[:, :2].max() < a_nanodegree
    assert off[:, 2].max() < a_micrometre
    if name not in ("invented.pts", "invented_utm.pts"):
        assert points.id.tolist() == truth().id.tolist()


def test_sigmas_come_from_the_files_that_have_them_and_are_unknown_elsewhere() -> None:
    for name in ("invented.gcp", "invented_opf.json", "invented.geojson", "invented.csv"):
        points = read_ground_points(GOLDEN / name, STATED[name])
        np.testing.assert_array_equal(points.sigma_m, truth().sigma_m)
    for name in ("invented_gcplib.txt", "invented_copernicus.json", "invented_orthority.geojson"):
        assert np.isnan(read_ground_points(GOLDEN / name, STATED[name]).sigma_m).all()
    mapped = read_ground_points(GOLDEN / "invented_mapped.csv", STATED["invented_mapped.csv"]).sigma_m
    np.testing.assert_array_equal(mapped[:, 0], truth().sigma_m[:, 1])
    assert np.isnan(mapped[:, 2]).tolist() == [False, False, True, False, False]


def test_sigmas_of_an_asp_file_are_those_of_x_y_z_unless_stated(tmp_path: Path) -> None:
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    stated = read_ground_points(GOLDEN / "invented_ecef.gcp", STATED["invented_ecef.gcp"])
    for row, (lon, lat, h) in enumerate(truth().lon_lat_h):
        if row == 2:  # fixed in ASP's adjustment: no accuracy
            assert np.isnan(stated.sigma_m[row]).all()
            continue
        steps = np.diag([1e-5, 1e-5, 1.0])
        axes = [
            np.subtract(to_ecef.transform(*([lon, lat, h] + s)), to_ecef.transform(*([lon, lat, h] - s)))
            for s in steps
        ]
        expected = [np.linalg.norm(a / np.linalg.norm(a) * [1.0, 2.0, 3.0]) for a in axes]
        np.testing.assert_allclose(stated.sigma_m[row], expected, rtol=1e-6)
    unstated = read_ground_points(GOLDEN / "invented_ecef.gcp", ELLIPSOID)
    assert np.isnan(unstated.sigma_m).all()
    local = read_ground_points(
        GOLDEN / "invented_ecef.gcp", StatedByCaller("ellipsoid", "lat-lon-height")
    )
    assert local.sigma_m[0].tolist() == [2.0, 1.0, 3.0]
    equal = TEXTS["invented_ecef.gcp"].replace("1.0 2.0 3.0", "2.0 2.0 2.0")
    same = read_ground_points(written(tmp_path, "equal.gcp", equal), ELLIPSOID)
    assert same.sigma_m[0].tolist() == [2.0, 2.0, 2.0]


@pytest.mark.parametrize("name", WITHOUT_DATUM)
def test_heights_without_a_datum_are_refused_with_the_way_to_state_it(name: str) -> None:
    stated = StatedByCaller(None, STATED[name].sigma_axes, STATED[name].csv)
    with pytest.raises(VerticalDatumError, match=r"does not state the datum .*--vertical.*--geoid"):
        read_ground_points(GOLDEN / name, stated)


@pytest.mark.parametrize(
    ("datum", "grid"), [("EGM96", "us_nga_egm96_15.tif"), ("EPSG:5720", "fr_ign_RAF18.tif")]
)
def test_a_missing_grid_is_named_with_the_package_that_has_it(
    datum: str, grid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(geoid, "grid_folders", list)  # the machine may have it
    with pytest.raises(VerticalDatumError) as refusal:
        read_ground_points(GOLDEN / "invented_gcplib.txt", StatedByCaller(datum))
    message = str(refusal.value)
    assert message.startswith("invented_gcplib.txt: heights in ")
    assert f"PROJ has no {grid}" in message
    assert "proj-data of conda-forge" in message
    assert f"pyproj sync --file {grid}" in message
    assert "--geoid" in message


@pytest.mark.parametrize("name", ["invented_gcplib.txt", "invented_copernicus.json", "invented.csv"])
def test_the_grid_of_a_geoid_raises_every_point_by_its_height_there(name: str, tmp_path: Path) -> None:
    # A plane as geoid, in a GTX file written by hand: 40 m + 1 m a degree of longitude east of 0.
    lines, samples, step = 181, 361, 1.0
    heights = np.tile(40.0 + np.arange(-180.0, 181.0), (lines, 1))
    header = np.array([-90.0, -180.0, step, step]).astype(">f8").tobytes()
    header += np.array([lines, samples]).astype(">i4").tobytes()
    grid = tmp_path / "plane.gtx"
    grid.write_bytes(header + np.clip(heights, -100.0, 100.0).astype(">f4").tobytes())
    stated = StatedByCaller(grid, csv=STATED[name].csv)
    raised = read_ground_points(GOLDEN / name, stated).lon_lat_h - truth().lon_lat_h
    np.testing.assert_allclose(raised[:, 2], 40.0 + truth().lon_lat_h[:, 0], atol=1e-4)
    assert np.abs(raised[:, :2]).max() < a_nanodegree


@pytest.mark.real_data
def test_the_height_of_egm96_agrees_with_proj_where_the_grid_is_present(real_data: Path) -> None:
    grid = real_data / "geoid" / "egm96_15.gtx"
    points = read_ground_points(GOLDEN / "invented_gcplib.txt", StatedByCaller(grid))
    raised_m = points.lon_lat_h[:, 2] - truth().lon_lat_h[:, 2]
    assert ((raised_m > 47.0) & (raised_m < 49.5)).all()  # around Rome


@pytest.mark.parametrize("name", ["invented.geojson", "invented_opf.json", "invented_pci.txt"])
def test_a_second_datum_is_refused_where_the_file_states_its_own(name: str) -> None:
    with pytest.raises(VerticalDatumError, match=r"EGM96 given .* states its own; leave --vertical"):
        read_ground_points(GOLDEN / name, StatedByCaller("EGM96"))


def test_a_datum_in_feet_is_refused_for_heights_in_metres() -> None:
    with pytest.raises(VerticalDatumError, match=r"are metres, those of NAVD88 .*foot: state the datum"):
        read_ground_points(GOLDEN / "invented_gcplib.txt", StatedByCaller("EPSG:6360"))


@pytest.mark.parametrize("name", WITHOUT_MARKS)
def test_points_without_marks_are_no_marked_points(name: str, tmp_path: Path) -> None:
    text = TEXTS[name]
    if name == "invented_mapped.csv":
        text = "lon,lat\n12.3,41.9\n"
    with pytest.raises(FormatError, match="expected points with their positions in an image"):
        read_control_points(written(tmp_path, "points", text), "ellipsoid")


def test_a_point_marked_twice_is_one_point_and_has_one_position(tmp_path: Path) -> None:
    document = json.loads(TEXTS["invented_orthority.geojson"])
    document["features"] += [dict(feature) for feature in document["features"]]
    path = written(tmp_path, "twice.geojson", json.dumps(document))
    assert read_ground_points(path).id.tolist() == truth().id.tolist()
    document["features"][5] = json.loads(json.dumps(document["features"][5]))
    document["features"][5]["geometry"]["coordinates"][2] += 1.0
    with pytest.raises(FormatError, match="point 11: expected one position, found"):
        read_ground_points(written(tmp_path, "moved.geojson", json.dumps(document)))


def test_points_that_are_switched_off_are_left_out_and_check_points_stay(tmp_path: Path) -> None:
    text = TEXTS["invented_pci.txt"].replace("0.11 G", "0.11 I").replace("0.22 G", "0.22 C")
    assert read_ground_points(written(tmp_path, "a.txt", text)).id.tolist() == ["12", "13", "14", "15"]
    off = written(tmp_path, "b.txt", TEXTS["invented_pci.txt"].replace(" G\n", " I\n"))
    with pytest.raises(FormatError, match="expected points, found 5, all switched off"):
        read_ground_points(off)


def test_points_without_heights_need_no_datum(tmp_path: Path) -> None:
    for text in ("lon,lat\n12.3,41.9\n", (GOLDEN / "invented.points").read_text()):
        points = read_ground_points(written(tmp_path, "flat", text))
        assert np.isnan(points.lon_lat_h[:, 2]).all()


def test_an_envi_file_of_an_image_on_a_map_has_no_heights(tmp_path: Path) -> None:
    text = TEXTS["invented.pts"].replace("Map (x,y,elev)", "Map (x,y)")
    lines = [
        line if line[0] == ";" else " ".join(line.split()[:2] + line.split()[3:])
        for line in text.splitlines()
    ]
    points = read_control_points(written(tmp_path, "map.pts", "\n".join(lines)))
    expected = parse_geojson_points(TEXTS["invented.geojson"])
    assert np.isnan(points.lon_lat_h[:, 2]).all()
    assert np.abs(points.line_sample - expected.line_sample).max() < 1e-6


@pytest.mark.parametrize(("origin", "corner_px"), [("centre", 0.0), ("corner", 0.5), ("corner-1", 1.5)])
def test_pixels_of_a_csv_count_from_the_origin_that_its_first_line_states(
    origin: str, corner_px: float, tmp_path: Path
) -> None:
    text = TEXTS["invented.csv"]
    stated = text.replace("pixel-origin=centre", f"pixel-origin={origin}")
    points = read_control_points(written(tmp_path, "stated.csv", stated), "ellipsoid")
    expected = parse_geojson_points(TEXTS["invented.geojson"])
    np.testing.assert_allclose(points.line_sample, expected.line_sample - corner_px, atol=1e-9)
    assert points.image.tolist() == ["invented.tif"] * 5
    unstated = written(tmp_path, "unstated.csv", text.partition("\n")[2])
    with pytest.raises(FormatError, match=r"found 5 points without any; .*'# pixel-origin=centre'"):
        read_control_points(unstated, "ellipsoid")
    assert len(read_ground_points(unstated, ELLIPSOID)) == 5


@pytest.mark.parametrize(
    ("name", "was", "becomes", "message"),
    [
        ("invented_gcplib.txt", "BEGIN\n5", "BEGIN\n6", "6 records stated, 5 found"),
        ("invented_gcplib.txt", "BEGIN\n5", "BEGIN\nfive", "number of records .* found 'five'"),
        ("invented_gcplib.txt", " ABS BYTE", " ABS", "line 23: expected the 20 fields .* found 19"),
        ("invented_gcplib.txt", " 105.250000", " high", "line 23: elevation: expected a number"),
        ("invented_gcplib.txt", "07-14-1999", "14-07-1999", "date: expected month-day-year.*14-07-1999"),
        ("invented_gcplib.txt", " ABS ", " ABC ", "absolute_or_relative: expected ABS or REL"),
        (
            "invented_gcplib.txt",
            "UTM 33",
            "UTM 34",
            "lie at .* m east, .* in EPSG:32634, but the record",
        ),
        ("invented_gcplib.txt", "41.9391234567 12.2912345678", "12.2912345678 41.9391234567", "swapped"),
        ("invented_gcplib.txt", "41.9391234567", "141.9391234567", "latitude within 90 degrees"),
        ("invented_copernicus.json", '"GCP_Info"', '"Info"', "GCP 1: expected a GCP_Info"),
        ("invented_copernicus.json", '"105.25"', '"high"', "ID 11: Altimetry: expected a number"),
        ("invented_copernicus.json", '"#text"', '"text"', "ID 11: Altimetry: expected a number"),
        ("invented_copernicus.json", "32633", "4326", "EPSG: expected the code of a UTM zone"),
        ("invented_copernicus.json", "32633", "32632", "but the record states"),
        ("invented_copernicus.json", '"ID": "12"', '"ID": "11"', "GCP 2: ID 11 has longitude"),
        ("invented_copernicus.json", '"ID": "12"', '"ID": null', "GCP 2: ID: expected a name"),
        ("invented_copernicus.json", '"GCP":', '"GCPS":', "expected GCP_DB with a list GCP"),
        ("invented.csv", "12.2912345678", "12,29", "line 3: expected 12 fields, .* found 13"),
        ("invented.csv", "12.2912345678", "east", "line 3: lon: expected a number, found 'east'"),
        ("invented.csv", "12.2912345678", "", "line 3: expected lon and lat, found an empty field"),
        ("invented.csv", "=centre", "=middle", "line 1: pixel-origin: expected one of centre, corner"),
        ("invented.csv", "lon,lat", "lon,lon", "columns: found 2 columns 'lon', expected one"),
        ("invented.csv", ",line,", ",row,", "expected both columns line and sample"),
        ("invented.csv", "0.5,0.75,1.5", "0.5,-0.75,1.5", "point 11: sigmas: expected positive metres"),
        ("invented_mapped.csv", "E;", "X;", "expected a column 'E' for x, found N, X, ALT"),
        ("invented_opf.json", '"id": "12"', '"id": null', "gcp 2: id: expected a name, found None"),
        ("invented_ecef.gcp", "1.0 2.0 3.0", "1.0 0.0 3.0", "line 1: sigmas .* found 1.0 0.0 3.0"),
        ("invented_ecef.gcp", " 41.93", " 141.93", "line 1: expected a latitude within 90 degrees"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_place(
    tmp_path: Path, name: str, was: str, becomes: str, message: str
) -> None:
    assert was in TEXTS[name]
    path = written(tmp_path, name, TEXTS[name].replace(was, becomes))
    with pytest.raises(FormatError, match=message):
        read_ground_points(path, STATED[name])


def test_a_csv_on_a_map_without_its_system_is_refused() -> None:
    with pytest.raises(InputError, match=r"one reference system of x and y, found none; .*--crs"):
        parse_csv(TEXTS["invented_mapped.csv"], CsvLayout(MAPPED.columns), "ellipsoid")


def test_a_csv_may_state_its_system_itself_but_only_once(tmp_path: Path) -> None:
    layout = CsvLayout(MAPPED.columns)
    path = written(tmp_path, "map.csv", "# crs=EPSG:32633\n" + TEXTS["invented_mapped.csv"])
    points = read_ground_points(path, StatedByCaller("ellipsoid", csv=layout))
    assert np.abs(points.lon_lat_h - truth().lon_lat_h)[:, :2].max() < a_nanodegree
    with pytest.raises(InputError, match="found EPSG:32633 and EPSG:32633"):
        read_ground_points(path, STATED["invented_mapped.csv"])
    with pytest.raises(InputError, match=r"has lon and lat, degrees .*; leave --crs out"):
        read_ground_points(
            GOLDEN / "invented.csv", StatedByCaller("ellipsoid", csv=CsvLayout({}, "EPSG:32633"))
        )


def test_what_is_stated_for_another_format_is_refused() -> None:
    with pytest.raises(InputError, match="--columns and --crs are for CSV, found USGS GCPLib"):
        read_ground_points(GOLDEN / "invented_gcplib.txt", STATED["invented_mapped.csv"])
    with pytest.raises(InputError, match="--sigma-axes is for ASP, found CSV"):
        read_ground_points(GOLDEN / "invented.csv", StatedByCaller("ellipsoid", "ecef"))


@pytest.mark.parametrize("columns", ["lon", "lon=", "east=X", "lon=A,lon=B", ""])
def test_columns_that_name_no_known_value_are_refused(columns: str) -> None:
    with pytest.raises(InputError, match="expected NAME=COLUMN of the file"):
        parse_columns(columns)


def test_a_text_of_no_known_format_is_refused_with_the_list_of_formats(tmp_path: Path) -> None:
    path = written(tmp_path, "notes.md", "# Points\n12.3 41.9 100\n")
    with pytest.raises(
        FormatError, match=r"one of the formats OPF, GeoJSON, .* CSV; found a first line"
    ):
        read_ground_points(path, ELLIPSOID)
    both = TEXTS["invented_pci.txt"] + TEXTS["invented.pts"]
    with pytest.raises(FormatError, match="found ENVI and PCI"):
        read_ground_points(written(tmp_path, "both", both), ELLIPSOID)


PARSERS: dict[str, Callable[[str], object]] = {
    "invented_gcplib.txt": lambda text: parse_gcplib(text, "ellipsoid"),
    "invented_copernicus.json": lambda text: parse_copernicus(text, "ellipsoid"),
    "invented.csv": lambda text: parse_csv(text, CsvLayout({}), "ellipsoid"),
    "invented_mapped.csv": lambda text: parse_csv(text, MAPPED, "ellipsoid"),
}


@pytest.mark.parametrize("name", PARSERS)
@given(data=st.data())
@settings(max_examples=60)
def test_a_garbled_file_gives_points_or_an_amers_error(name: str, data: st.DataObject) -> None:
    text = TEXTS[name]
    start = data.draw(st.integers(0, len(text)))
    cut = data.draw(st.integers(0, 200))
    garbled = text[:start] + data.draw(st.text(max_size=30)) + text[start + cut :]
    try:
        PARSERS[name](garbled)
    except AmersError:
        return
