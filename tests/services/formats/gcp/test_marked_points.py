"""Marked points: all formats give the same points, agree with GDAL, and survive a round trip."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.control import GroundControlPoint
from rasterio.transform import RPCTransformer, from_gcps

from amers.services.errors import AmersError, FormatError, InputError, VerticalDatumError
from amers.services.formats.gcp.json_formats import (
    format_opf,
    opf_camera_id,
    parse_geojson_points,
    parse_opf,
)
from amers.services.formats.gcp.marked_points import MarkedPoints, marked_points, parse_crs
from amers.services.formats.gcp.odm import format_gcp_list, parse_gcp_list
from amers.services.formats.gcp.pci import format_pci_text, parse_pci_text
from amers.services.formats.gcp.reader import read_control_points
from amers.services.formats.gcp.text_formats import (
    format_asp_gcp,
    format_envi_pts,
    format_qgis_points,
    parse_asp_gcp,
    parse_envi_pts,
    parse_qgis_points,
)
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text

GOLDEN = Path(__file__).parents[3] / "golden"
MODEL = parse_rpc_text((GOLDEN / "invented_RPC.TXT").read_text())
FILES = [
    "invented.gcp",
    "invented.points",
    "invented.pts",
    "invented_utm.pts",
    "invented_gcp_list.txt",
    "invented_pci.txt",
    "invented_opf.json",
    "invented.geojson",
    "invented_orthority.geojson",
    "invented_feet.txt",
]
TEXTS = {name: (GOLDEN / name).read_text() for name in FILES}

a_millionth_of_a_pixel = 1e-6
a_nanodegree = 1e-9
a_micrometre = 1e-6
CORNER_OF_FIRST_PIXEL = 0.5

FORMATS = [
    (format_asp_gcp, lambda text: parse_asp_gcp(text, "ellipsoid"), "invented.gcp"),
    (format_qgis_points, parse_qgis_points, "invented.points"),
    (format_envi_pts, lambda text: parse_envi_pts(text, "ellipsoid"), "invented.pts"),
    (format_gcp_list, lambda text: parse_gcp_list(text, "ellipsoid"), "invented_gcp_list.txt"),
    (format_pci_text, parse_pci_text, "invented_pci.txt"),
    (format_opf, parse_opf, "invented_opf.json"),
]
every_format = pytest.mark.parametrize(
    ("write", "parse", "golden"), FORMATS, ids=["asp", "qgis", "envi", "odm", "pci", "opf"]
)


def golden_points() -> MarkedPoints:
    return parse_geojson_points(TEXTS["invented.geojson"])


def gdal_position(points: MarkedPoints) -> np.ndarray:
    """Line and sample of ground points computed by GDAL, from the corner of the first pixel."""
    with RPCTransformer(gdal_rpc(MODEL)) as transformer:
        rows, columns = transformer.rowcol(*points.lon_lat_h.T, op=np.positive)
    return np.column_stack([rows, columns])


def numbers(text: str) -> list[list[float]]:
    """All numbers in the lines that are not comments, read without the code under test."""
    lines = [line for line in text.splitlines() if line[:1] not in "#;m"]
    fields = [[v for v in re.split(r"[ ,]+", line) if re.fullmatch(r"[-\d.]+", v)] for line in lines]
    return [[float(v) for v in row] for row in fields if row]


@pytest.mark.parametrize("name", FILES)
def test_every_golden_file_reads_to_the_same_points_in_the_pixels_of_gdal(name: str) -> None:
    points, expected = read_control_points(GOLDEN / name, "ellipsoid"), golden_points()
    assert points.active.all()
    assert not points.check.any()
    on_ground = np.abs(points.lon_lat_h - expected.lon_lat_h)
    assert on_ground[:, :2].max() < a_nanodegree
    if name == "invented.points":
        assert np.isnan(points.lon_lat_h[:, 2]).all()
    else:
        assert on_ground[:, 2].max() < a_micrometre
    by_gdal = gdal_position(expected) - CORNER_OF_FIRST_PIXEL
    assert np.abs(points.line_sample - by_gdal).max() < a_millionth_of_a_pixel


def test_a_format_keeps_the_sigmas_and_names_it_has_a_place_for() -> None:
    expected = golden_points()
    assert expected.sigma_m[0].tolist() == [0.5, 0.75, 1.5]
    for name in ("invented.gcp", "invented_opf.json"):
        points = read_control_points(GOLDEN / name, "ellipsoid")
        assert points.id.tolist() == expected.id.tolist()
        assert points.image.tolist() == ["invented.tif"] * 5
        np.testing.assert_array_equal(points.sigma_m, expected.sigma_m)
        np.testing.assert_allclose(points.sigma_px, expected.sigma_px, rtol=1e-15)
    odm, pci = (
        read_control_points(GOLDEN / f"invented_{name}.txt", "ellipsoid") for name in ("gcp_list", "pci")
    )
    assert odm.id.tolist() == pci.id.tolist() == expected.id.tolist()
    assert odm.image.tolist() == ["invented.tif"] * 5
    np.testing.assert_allclose(pci.sigma_px, expected.sigma_px, rtol=1e-15)


@every_format
def test_what_is_written_is_the_golden_file(write, parse, golden: str) -> None:
    written = write(golden_points())
    if golden.endswith(".json"):
        assert json.loads(written) == json.loads(TEXTS[golden])
        return
    for ours, theirs in zip(numbers(written), numbers(TEXTS[golden]), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=a_nanodegree)


@every_format
@given(data=st.data())
@settings(max_examples=60)
@pytest.mark.long
def test_any_point_survives_a_round_trip(write, parse, golden: str, data: st.DataObject) -> None:
    n = data.draw(st.integers(0, 4))
    pixel = st.floats(-1e5, 1e6)
    positive = st.floats(1e-3, 1e3)
    rows = st.lists(
        st.tuples(st.floats(-180.0, 180.0), st.floats(-90.0, 90.0), st.floats(-500.0, 9000.0)),
        min_size=n,
        max_size=n,
    )
    points = marked_points(
        [str(k) for k in range(1, n + 1)],
        data.draw(rows),
        data.draw(st.lists(st.tuples(pixel, pixel), min_size=n, max_size=n)),
        sigma_m=data.draw(st.lists(st.tuples(positive, positive, positive), min_size=n, max_size=n)),
        sigma_px=data.draw(st.lists(positive, min_size=n, max_size=n)),
        image=["image.tif"] * n,
    )
    again = parse(write(points))
    assert again.id.tolist() == points.id.tolist()
    assert np.abs(again.line_sample - points.line_sample).max(initial=0) < a_millionth_of_a_pixel
    moved = np.nan_to_num(again.lon_lat_h - points.lon_lat_h)
    assert np.abs(moved).max(initial=0) < a_micrometre


def test_gdal_recovers_a_geotransform_from_marks_of_qgis_and_pci(
    tmp_path: Path,
) -> None:
    """QGIS passes its points to GDAL as column and negative row."""
    place = Affine(1e-4, 0.0, 12.0, 0.0, -1e-4, 42.0)
    line_sample = np.array([[0.0, 0.0], [0.0, 999.0], [799.0, 999.0], [799.0, 0.0], [400.0, 500.0]])
    lon, lat = place @ (line_sample.T[::-1] + CORNER_OF_FIRST_PIXEL)
    points = marked_points(["a", "b", "c", "d", "e"], np.column_stack([lon, lat, 0 * lon]), line_sample)
    of_qgis = [
        GroundControlPoint(row=-minus_row, col=column, x=x, y=y)
        for x, y, column, minus_row, *_ in numbers(format_qgis_points(points))
    ]
    of_pci = [
        GroundControlPoint(row=line, col=pixel, x=x, y=y, z=z)
        for pixel, line, x, y, z in numbers(format_pci_text(points))
    ]
    path, stored = tmp_path / "a.pix", {"gcps": of_pci, "crs": "EPSG:4326"}
    with rasterio.open(path, "w", "PCIDSK", 1000, 800, 1, dtype=np.uint8, **stored):
        pass
    with rasterio.open(path) as file:
        for gcps in (of_qgis, file.gcps[0]):
            assert from_gcps(gcps).almost_equals(place, precision=a_nanodegree)


def test_the_image_centre_is_the_centre_for_odm() -> None:
    """ODM adds half a pixel and counts from the image centre, in units of the longer side."""
    lines, samples = 3000, 4000
    middle = marked_points(["a"], [(12.0, 42.0, 0.0)], [((lines - 1) / 2, (samples - 1) / 2)])
    _, _, _, im_x, im_y, *_ = numbers(format_gcp_list(middle))[0]
    assert ((im_x + 0.5 - samples / 2) / samples, (im_y + 0.5 - lines / 2) / samples) == (0.0, 0.0)


def test_only_active_points_are_written_and_qgis_has_the_others_disabled() -> None:
    points = replace(golden_points(), active=np.array([True, False, True, True, True]))
    held_out = replace(points, check=np.array([False, False, False, True, False]))
    assert len(numbers(format_asp_gcp(held_out))) == len(numbers(format_envi_pts(held_out))) == 3
    assert parse_qgis_points(format_qgis_points(held_out)).active.tolist() == [1, 0, 1, 0, 1]
    for write, parse in (FORMATS[3][:2], FORMATS[5][:2]):
        assert parse(write(held_out)).check.tolist() == [False, False, True, False]
    pci = parse_pci_text(format_pci_text(held_out))
    assert pci.active.tolist() == [True, False, True, True, True]
    assert pci.check.tolist() == held_out.check.tolist()


def test_a_point_seen_in_two_images_is_one_point_with_two_marks() -> None:
    points = golden_points()
    twice = replace(
        points, id=np.array(["1", "1", "2", "3", "4"]), image=np.array(["a", "b", "a", "a", "a"])
    )
    for write, parse in ((FORMATS[0][0], FORMATS[0][1]), (format_opf, parse_opf)):
        again = parse(write(twice))
        assert again.id.tolist() == ["1", "1", "2", "3", "4"]
        assert again.image.tolist() == ["a", "b", "a", "a", "a"]
    assert len(json.loads(format_opf(twice))["gcps"]) == 4


def test_spaces_in_the_name_of_an_image_do_not_break_an_asp_line() -> None:
    points = replace(golden_points(), image=np.full(5, "my image, 2.tif"))
    assert parse_asp_gcp(format_asp_gcp(points), "ellipsoid").image[0] == "my_image__2.tif"


def test_residuals_in_qgis_are_computed_minus_observed_with_lines_upwards() -> None:
    points = replace(golden_points(), residual_px=np.tile([0.3, -0.4], (5, 1)))
    assert numbers(format_qgis_points(points))[0][5:] == [0.4, 0.3, 0.5]


@pytest.mark.parametrize("write", [format_asp_gcp, format_opf])
def test_unknown_sigmas_are_an_error_in_a_format_that_needs_them(write) -> None:
    with pytest.raises(InputError, match=r"point 11: .*unknown"):
        write(replace(golden_points(), sigma_px=np.full(5, np.nan)))


def test_a_gcp_list_in_utm_is_read_and_unnamed_points_are_distinguished_by_their_ground() -> None:
    marks = numbers(TEXTS["invented_utm.pts"])
    lines = [
        f"{x!r}\t{y!r}\t{h!r}\t{px - 1.5!r} {py - 1.5!r} {i}.tif"
        for i in "ab"
        for x, y, h, px, py in marks
    ]
    points = parse_gcp_list("\n".join(["WGS84 UTM 33N", "# a comment", *lines]), "ellipsoid")
    assert points.id.tolist() == ["1", "2", "3", "4", "5"] * 2
    expected = golden_points()
    assert np.abs(points.lon_lat_h[:5] - expected.lon_lat_h).max() < a_micrometre
    assert np.abs(points.line_sample[5:] - expected.line_sample).max() < a_millionth_of_a_pixel


def test_points_of_a_gcp_list_without_heights_have_none() -> None:
    points = golden_points()
    flat = replace(points, lon_lat_h=points.lon_lat_h * [1.0, 1.0, np.nan])
    assert np.isnan(parse_gcp_list(format_gcp_list(flat)).lon_lat_h[:, 2]).all()


def test_a_pci_text_may_have_its_columns_in_any_order_with_names_of_several_words() -> None:
    text = '# layout=SXYPLID crs=EPSG:4326\nC,12.5,42.5,10.5,20.5,"old mill"\nG\t12.5\t42.5\t1\t2\tb\n'
    points = parse_pci_text(text)
    assert points.id.tolist() == ["old mill", "b"]
    assert points.check.tolist() == [True, False]
    assert points.line_sample.tolist() == [[20.0, 10.0], [1.5, 0.5]]
    assert np.isnan(points.lon_lat_h[:, 2]).all()
    assert np.isnan(points.sigma_px).all()


def test_a_pci_text_has_pixel_errors_only_when_all_are_known() -> None:
    points = golden_points()
    partly = replace(points, sigma_px=np.array([0.1, np.nan, 0.1, 0.1, 0.1]))
    assert "ePeL" not in format_pci_text(partly)
    assert len(parse_pci_text(format_pci_text(partly))) == 5


@pytest.mark.parametrize("name", ["invented.gcp", "invented.pts", "invented_gcp_list.txt"])
def test_heights_without_a_datum_are_refused(name: str) -> None:
    with pytest.raises(VerticalDatumError, match="does not state the datum of its heights"):
        read_control_points(GOLDEN / name)
    with pytest.raises(VerticalDatumError, match=r"EPSG:4326 given; .* a vertical reference system"):
        read_control_points(GOLDEN / name, "EPSG:4326")
    with pytest.raises(VerticalDatumError, match=r"sea given; expected ellipsoid, EGM84"):
        read_control_points(GOLDEN / name, "sea")


@pytest.mark.parametrize(
    "definition",
    [
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad",
        "+init=/etc/passwd:root",
        "+proj=longlat +ellps=WGS84 +nadgrids=/etc/passwd",
        "+proj=longlat +ellps=WGS84 +geoidgrids=http://127.0.0.1:9/x +type=crs",
    ],
)
def test_a_reference_system_that_names_files_is_refused(definition: str) -> None:
    with pytest.raises(FormatError, match="expected a reference system"):
        parse_crs(definition, "a file")


def test_the_geoid_height_of_an_opf_point_is_added() -> None:
    document = json.loads(TEXTS["invented_opf.json"])
    for gcp in document["gcps"]:
        gcp["geolocation"]["crs"] = {"definition": "EPSG:4326+5773", "geoid_height": 48.5}
    raised = parse_opf(json.dumps(document)).lon_lat_h - golden_points().lon_lat_h
    np.testing.assert_allclose(raised, np.tile([0.0, 0.0, 48.5], (5, 1)), atol=a_micrometre)


def test_an_opf_of_a_two_dimensional_system_has_ellipsoidal_heights_and_its_own_order_of_axes() -> None:
    document = json.loads(TEXTS["invented_opf.json"])
    for gcp, line in zip(document["gcps"], numbers(TEXTS["invented_utm.pts"]), strict=True):
        gcp["geolocation"] |= {"crs": {"definition": "EPSG:32633"}, "coordinates": line[:3]}
    points = parse_opf(json.dumps(document))
    assert np.abs(points.lon_lat_h - golden_points().lon_lat_h).max() < a_micrometre
    assert points.sigma_m[0].tolist() == [0.75, 0.5, 1.5]


def test_an_opf_without_our_extension_names_images_by_camera_id() -> None:
    document = json.loads(TEXTS["invented_opf.json"])
    del document["extensions"]
    assert parse_opf(json.dumps(document)).image[0] == str(opf_camera_id("invented.tif"))


def test_points_that_a_registration_did_not_match_are_no_marks(tmp_path: Path) -> None:
    document = json.loads(TEXTS["invented.geojson"])
    document["features"][1]["properties"] |= {"line": None, "sample": None, "status": "not matched"}
    document["features"][2]["properties"] |= {"status": "deactivated"}
    path = tmp_path / "points.geojson"
    path.write_text(json.dumps(document))
    points = read_control_points(path)
    assert points.id.tolist() == ["11", "13", "14", "15"]
    assert points.active.tolist() == [True, False, True, True]


@pytest.mark.parametrize(
    ("name", "was", "becomes", "message"),
    [
        ("invented.gcp", " 105.25", "", "line 2: expected id, lat"),
        ("invented.gcp", "105.25", "high", "line 2: height: expected a number, found 'high'"),
        ("invented.points", "#CRS: EPSG:4326\n", "", "does not state its reference system"),
        ("invented.points", "mapX", "X", "expected a line that starts with mapX,mapY"),
        ("invented.points", "12.2912345678", "nan", "line 3: mapX: expected a number, found 'nan'"),
        ("invented.points", "EPSG:4326", "moon", "expected a reference system, .* found 'moon'"),
        ("invented.pts", "WGS-84", "NAD27", "projection info: expected .* found 'Geographic"),
        (
            "invented.pts",
            " 105.25",
            "",
            "line 5: expected map x, map y, elevation, .*, found 4",
        ),
        (
            "invented_gcp_list.txt",
            "EPSG:4326",
            "the moon",
            "expected a reference system, .* found 'the moon'",
        ),
        ("invented_gcp_list.txt", " invented.tif 11", "", "line 2: expected geo_x, .* found 5 fields"),
        ("invented_gcp_list.txt", "105.25", "high", "line 2: geo_z: expected a number, found 'high'"),
        ("invented_pci.txt", "EPSG:4326", "moon", "expected a reference system, .* found 'moon'"),
        (
            "invented_pci.txt",
            "IDPLXYZ",
            "IDPLXYQ",
            "layout: expected some of ID P L .* found 'IDPLXYQeP",
        ),
        ("invented_pci.txt", "IDPLXYZ", "IDPLXZZ", "each at most once, found 'IDPLXZZ"),
        ("invented_pci.txt", "PLXYZ", "PLZ", "layout: expected P, L, X and Y, found no X, Y"),
        ("invented_pci.txt", " 105.25", "", "line 2: expected the 9 fields IDPLXYZePeLS, found 8"),
        ("invented_pci.txt", "105.25", "high", "line 2: Z: expected a number, found 'high'"),
        ("invented_pci.txt", "0.11 G", "0.11 X", "line 2: S: expected G, I or C, found 'X'"),
        ("invented_opf.json", '"1.0"', '"2.0"', "expected OPF 1, found version '2.0'"),
        ("invented_opf.json", "application/opf-input", "x", "expected a document of the format"),
        ("invented_opf.json", "position_px", "place", "gcp 1: position_px: expected 2 numbers"),
        ("invented_opf.json", "EPSG:4979", "EPSG:1", "gcp 1: expected a reference system"),
        ("invented.geojson", '"Point"', '"Line"', "feature 1: expected a Point"),
        ("invented.geojson", "FeatureCollection", "X", "expected a GeoJSON FeatureCollection"),
        ("invented.geojson", '"line": 44', '"line": "a', "JSON|expected 2 numbers"),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, name: str, was: str, becomes: str, message: str) -> None:
    assert was in TEXTS[name]
    path = tmp_path / name
    path.write_text(TEXTS[name].replace(was, becomes))
    with pytest.raises(FormatError, match=message):
        read_control_points(path, "ellipsoid")


def test_a_geojson_point_without_a_height_is_refused() -> None:
    document = json.loads(TEXTS["invented.geojson"])
    document["features"][0]["geometry"]["coordinates"].pop()
    with pytest.raises(VerticalDatumError, match="feature 1: expected longitude, latitude and height"):
        parse_geojson_points(json.dumps(document))


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "points.xyz").write_text("1,2,3")
    with pytest.raises(FormatError, match=r"one of the formats OPF, .*; found a first line '1,2,3'"):
        read_control_points(tmp_path / "points.xyz")


@pytest.mark.parametrize("name", FILES)
@given(data=st.data())
@settings(max_examples=60)
@pytest.mark.thorough
def test_a_garbled_file_gives_points_or_an_amers_error(name: str, data: st.DataObject) -> None:
    text = TEXTS[name]
    start = data.draw(st.integers(0, len(text)))
    cut = data.draw(st.integers(0, 200))
    garbled = text[:start] + data.draw(st.text(max_size=30)) + text[start + cut :]
    parse = {
        ".gcp": lambda t: parse_asp_gcp(t, "ellipsoid"),
        ".points": parse_qgis_points,
        ".pts": lambda t: parse_envi_pts(t, "ellipsoid"),
        ".json": parse_opf,
        ".geojson": parse_geojson_points,
        ".txt": parse_pci_text if "pci" in name else lambda t: parse_gcp_list(t, "ellipsoid"),
    }[Path(name).suffix]
    try:
        parse(garbled)
    except AmersError:
        return
