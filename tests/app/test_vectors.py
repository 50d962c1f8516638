"""Vectors between raw scenes and the map, on the command line."""

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin
from typer.testing import CliRunner

from amers.app.cli.main import app
from amers.app.errors import AmersError
from amers.services.formats.sensor_models.correction_json import format_correction
from amers.services.formats.sensor_models.rpc_text import format_rpc_text
from amers.services.formats.vector.layers import VectorLayer, read_layer, write_layer
from amers.services.geodesy import metres_per_degree
from amers.services.map_grid import xy_of_lon_lat
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import no_correction
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Frame
from tests.app.test_orthorectification import MODEL, in_the_image, write_inputs
from tests.geotiffs import write_geotiff

a_millimetre = 1e-3
a_micropixel = 1e-6
UTM = "EPSG:32631"

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def run(*words: object) -> dict:
    result = CliRunner().invoke(app, ["vectors", *(str(word) for word in words), "--json"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    printed: dict = json.loads(result.stdout)
    return printed


def drawn(path: Path, *wkt: str) -> Path:
    names = pa.table({"name": [f"feature {k}" for k in range(len(wkt))]})
    write_layer(path, VectorLayer("drawn", shapely.from_wkt(list(wkt)), names, None))
    return path


def on_ground(model: RpcModel, lines: list[float], samples: list[float]) -> np.ndarray:
    """Longitudes and latitudes at the height of the flat ground."""
    at = np.column_stack([lines, samples]).astype(np.float64)
    return model.locate(at, np.full(len(at), MODEL.ground_offset[2]))[:, :2]


@pytest.fixture
def inputs(tmp_path: Path) -> list[object]:
    scene, dem = write_inputs(tmp_path)
    return ["--scene", scene, "--dem", dem, "--vertical", "ellipsoid"]


def registered(folder: Path, model: RpcModel, frame: Frame | None = None) -> Path:
    """The folder of a registration whose model is off by a pixel, one standard deviation."""
    folder.mkdir()
    (folder / "refined_RPC.TXT").write_text(format_rpc_text(model))
    stated = {} if frame is None else {"frame": frame}
    text = format_correction(
        CorrectionAccuracy(
            no_correction((300, 400)), np.diag([1.0, 0, 0, 1.0, 0, 0]), np.zeros(2), **stated
        ),
        "shift",
        applies_to="tags",
        carried="refined_RPC.TXT",
    )
    (folder / "correction.json").write_text(text)
    return folder


@pytest.mark.parametrize("suffix", ["gpkg", "geojson", "shp", "fgb"])
def test_vectors_drawn_on_the_image_come_onto_the_map(
    suffix: str, inputs: list[object], tmp_path: Path
) -> None:
    lines = drawn(tmp_path / f"drawn.{suffix}", "LINESTRING (100.5 -50.5, 300.5 -250.5)")
    output = tmp_path / "out" / f"map.{suffix}"
    record = run("correct", lines, *inputs, "--to", UTM, "-o", output)
    assert record["features"] == 1
    assert record["vertices"] == 2
    assert record["added_vertices"] == 0
    assert record["relative_to_control_points"]["words"] == "none: the scene is not registered"
    assert record["on_the_earth"]["ce90_m"] is None
    layer = read_layer(output)
    assert layer.crs == UTM
    assert layer.attributes["name"].to_pylist() == ["feature 0"]
    expected = xy_of_lon_lat(UTM, on_ground(in_the_image(), [50, 250], [100, 300]))
    actual = shapely.get_coordinates(layer.geometries, include_z=True)
    np.testing.assert_allclose(actual[:, :2], expected, atol=a_millimetre)
    np.testing.assert_allclose(actual[:, 2], MODEL.ground_offset[2], atol=a_millimetre)


def test_other_pixel_coordinates_give_the_same_place(inputs: list[object], tmp_path: Path) -> None:
    places = []
    for pixels, wkt in (
        ("qgis", "POINT (100.5 -50.5)"),
        ("corner", "POINT (100.5 50.5)"),
        ("centre", "POINT (100 50)"),
    ):
        point = drawn(tmp_path / "a.gpkg", wkt)
        run("correct", point, *inputs, "--pixels", pixels, "-o", tmp_path / "b.fgb")
        places.append(shapely.get_coordinates(read_layer(tmp_path / "b.fgb").geometries)[0])
    np.testing.assert_allclose(places, [places[0]] * 3, atol=a_millimetre)


def test_the_accuracy_of_a_registered_scene_is_stated(inputs: list[object], tmp_path: Path) -> None:
    points = drawn(tmp_path / "drawn.gpkg", "POINT (100 -50)", "POINT (300 -250)")
    folder = registered(tmp_path / "a", in_the_image())
    options = [*inputs, "--sigma-px", 0, "--dem-sigma-m", 0, "-o", tmp_path / "map.gpkg"]
    record = run("correct", points, *options, "--registration", folder)
    ground = MODEL.ground_offset[None, :]
    north_m = 1.0 / np.linalg.norm(MODEL.project_derivative(ground)[0, 0, :2])
    assert record["relative_to_control_points"]["ce90_m"] == pytest.approx(2.146 * north_m, rel=0.05)
    assert record["on_the_earth"]["words"].endswith(
        "the sigma of the control points' common error is not stated"
    )
    columns = read_layer(tmp_path / "map.gpkg").attributes
    assert columns["ce90_m"].to_pylist() == pytest.approx([2.146 * north_m] * 2, rel=0.05)
    assert columns["ce90_earth"].to_pylist() == [None, None]

    stated = registered(tmp_path / "b", in_the_image(), Frame.from_sigmas(3.0, 3.0))
    record = run(
        "correct", points, *options, "--registration", stated, "--vertices", tmp_path / "v.gpkg"
    )
    earth_m, relative_m = (
        record[name]["ce90_m"] for name in ("on_the_earth", "relative_to_control_points")
    )
    assert earth_m > np.hypot(relative_m, 2.146 * 3.0) * 0.99
    vertices = read_layer(tmp_path / "v.gpkg")
    rows = vertices.attributes.to_pylist()
    assert [(row["feature"], row["vertex"]) for row in rows] == [(1, 1), (2, 1)]
    assert rows[0]["line"] == pytest.approx(49.5)
    assert max(row["ce90_earth"] for row in rows) == pytest.approx(earth_m)


def test_vertices_beyond_the_area_that_points_hold_have_no_accuracy(
    inputs: list[object], tmp_path: Path
) -> None:
    """Points hold lines 0 to 200, but for a hole: line 2 leaves them, point 3 is in the hole."""
    folder = registered(tmp_path / "a", in_the_image(), Frame.from_sigmas(3.0, 3.0))
    document = json.loads((folder / "correction.json").read_text())
    around = [[-0.5, -0.5], [-0.5, 399.5], [200.0, 399.5], [200.0, -0.5], [-0.5, -0.5]]
    hole = [[100.0, 100.0], [140.0, 100.0], [140.0, 160.0], [100.0, 160.0], [100.0, 100.0]]
    document["held_outline_px"] = [around, hole]
    (folder / "correction.json").write_text(json.dumps(document))
    lines = drawn(
        tmp_path / "drawn.gpkg",
        "LINESTRING (50 -50, 300 -150)",
        "LINESTRING (50 -50, 300 -250)",
        "POINT (130 -120)",
    )
    vertices = tmp_path / "v.gpkg"
    output = ["-o", tmp_path / "map.gpkg", "--vertices", vertices]
    record = run("correct", lines, *inputs, *output, "--registration", folder)
    rows = read_layer(vertices).attributes.to_pylist()
    columns = read_layer(tmp_path / "map.gpkg").attributes
    for column in ("ce90_m", "ce90_earth"):
        assert [value is None for value in columns[column].to_pylist()] == [False, True, True]
        assert [row[column] is None for row in rows] == [False, False, False, True, True]
    assert "unknown for 2 of 5 vertices" in record["relative_to_control_points"]["words"]
    assert record["relative_to_control_points"]["ce90_m"] is not None
    for wrong in ([[0.0, 0.0]], [[[0.0, 0.0], [1.0, 1.0]]], "all"):
        document["held_outline_px"] = wrong
        (folder / "correction.json").write_text(json.dumps(document))
        with pytest.raises(AmersError, match=r"correction\.json: held_outline_px"):
            run("correct", lines, *inputs, *output, "--registration", folder)


def test_the_registered_model_places_the_vectors(inputs: list[object], tmp_path: Path) -> None:
    folder = registered(tmp_path / "a", in_the_image(lines_off=7))
    point = drawn(tmp_path / "drawn.gpkg", "POINT (100.5 -50.5)")
    run("correct", point, *inputs, "--registration", folder, "--to", UTM, "-o", tmp_path / "map.fgb")
    expected = xy_of_lon_lat(UTM, on_ground(in_the_image(lines_off=7), [50], [100]))
    actual = shapely.get_coordinates(read_layer(tmp_path / "map.fgb").geometries)
    np.testing.assert_allclose(actual, expected, atol=a_millimetre)

    (folder / "refined_RPC.TXT").unlink()
    document = json.loads((folder / "correction.json").read_text())
    document["parameters_px"][0][0] = -7.0
    (folder / "correction.json").write_text(json.dumps(document))
    run("correct", point, *inputs, "--registration", folder, "--to", UTM, "-o", tmp_path / "map.fgb")
    actual = shapely.get_coordinates(read_layer(tmp_path / "map.fgb").geometries)
    np.testing.assert_allclose(actual, expected, atol=a_millimetre)


def test_an_unregistered_scene_has_the_accuracy_that_is_given(
    inputs: list[object], tmp_path: Path
) -> None:
    point = drawn(tmp_path / "drawn.gpkg", "POINT (100.5 -50.5)")
    sigmas = ["--sigma-m", 4, "--sigma-px", 0, "--dem-sigma-m", 0]
    record = run("correct", point, *inputs, *sigmas, "-o", tmp_path / "map.gpkg")
    assert record["on_the_earth"]["ce90_m"] == pytest.approx(4.0 * 2.146, rel=1e-3)


def test_vectors_of_the_map_come_into_the_image_and_back(inputs: list[object], tmp_path: Path) -> None:
    lon_lat = on_ground(in_the_image(), [50, 250, 100], [100, 300, 20])
    far = lon_lat[0] + 0.5
    wkt = [
        f"POLYGON (({', '.join(f'{lon} {lat}' for lon, lat in lon_lat[[0, 1, 2, 0]])}))",
        f"POINT ({far[0]} {far[1]})",
    ]
    shapes = VectorLayer("map", shapely.from_wkt(wkt), pa.table({"name": ["field", "far"]}), "EPSG:4326")
    write_layer(tmp_path / "map.gpkg", shapes)
    record = run("project", tmp_path / "map.gpkg", *inputs, "-o", tmp_path / "raw.gpkg")
    assert (record["features"], record["outside"], record["hidden_vertices"]) == (1, 1, 0)
    raw = read_layer(tmp_path / "raw.gpkg")
    assert raw.attributes.to_pylist() == [{"name": "field", "hidden": 0.0}]
    xy = shapely.get_coordinates(raw.geometries)
    np.testing.assert_allclose(xy[[0, -1]], [[100.5, -50.5]] * 2, atol=1e-3)
    run("correct", tmp_path / "raw.gpkg", *inputs, "--to", "EPSG:4326", "-o", tmp_path / "again.gpkg")
    again = read_layer(tmp_path / "again.gpkg").geometries[0]
    east, north = metres_per_degree(lon_lat[0, 1], 0.0)
    gap_m = shapely.hausdorff_distance(shapely.force_2d(again), shapes.geometries[0]) * max(east, north)
    assert gap_m < 0.5 * 2.0


def test_vectors_are_cut_at_the_border_of_the_image(inputs: list[object], tmp_path: Path) -> None:
    lon_lat = on_ground(in_the_image(), [-400, 150], [200, 200])
    line = shapely.linestrings([lon_lat])
    write_layer(tmp_path / "map.gpkg", VectorLayer("a", line, pa.table({"k": [1]}), "EPSG:4326"))
    options = [*inputs, "--pixels", "centre", "-o", tmp_path / "raw.gpkg"]
    run("project", tmp_path / "map.gpkg", *options)
    whole = read_layer(tmp_path / "raw.gpkg").geometries[0]
    assert whole.bounds[1] == pytest.approx(-400.0, abs=0.01)
    run("project", tmp_path / "map.gpkg", *options, "--clip")
    cut = read_layer(tmp_path / "raw.gpkg").geometries[0]
    assert cut.bounds[1] == pytest.approx(-0.5)
    assert cut.bounds[3] == pytest.approx(150.0, abs=0.01)


def test_features_without_ground_are_refused_by_name_or_left_out(
    inputs: list[object], tmp_path: Path
) -> None:
    lon, lat = on_ground(in_the_image(), [150], [200])[0]
    points = drawn(tmp_path / "drawn.gpkg", "POINT (5 -5)", "LINESTRING (200 -150, 390 -290)")
    small = tmp_path / "small.tif"
    place = from_origin(lon - 0.0006, lat + 0.0006, 0.0004, 0.0004)
    write_geotiff(
        small, np.full((3, 3), MODEL.ground_offset[2], np.float32), crs="EPSG:4326", transform=place
    )
    options = [*inputs[:2], "--dem", small, "--vertical", "ellipsoid", "-o", tmp_path / "map.gpkg"]
    with pytest.raises(AmersError, match=r"feature 1, vertex 1, at line 4\.5.*2 of 2 features.*--skip"):
        run("correct", points, *options)
    assert not (tmp_path / "map.gpkg").exists()
    near = drawn(tmp_path / "near.gpkg", "POINT (5 -5)", "POINT (200 -150)")
    record = run("correct", near, *options, "--skip-missed")
    assert (record["features"], record["left_out"]) == (1, [1])
    assert read_layer(tmp_path / "map.gpkg").attributes["name"].to_pylist() == ["feature 1"]


def test_what_cannot_be_meant_is_refused(inputs: list[object], tmp_path: Path) -> None:
    output = tmp_path / "map.gpkg"
    up = drawn(tmp_path / "up.gpkg", "POINT (100 50)", "POINT (100 250)")
    with pytest.raises(AmersError, match=r"2 of 2 vertices lie outside.*with --pixels corner all"):
        run("correct", up, *inputs, "-o", output)
    lon, lat = on_ground(in_the_image(), [150], [200])[0]
    placed = drawn(tmp_path / "placed.gpkg", f"POINT ({lon} {lat})")
    with pytest.raises(AmersError, match="longitudes and latitudes of the scene's ground"):
        run("correct", placed, *inputs, "-o", output)
    with pytest.raises(AmersError, match="inputs and outputs are one file"):
        run("correct", up, *inputs, "-o", up)
    with pytest.raises(AmersError, match="--pixels: upside found, one of qgis, corner, centre"):
        run("correct", up, *inputs, "--pixels", "upside", "-o", output)
    with pytest.raises(AmersError, match=r"no correction\.json found, the folder of a registration"):
        run("correct", up, *inputs, "--registration", tmp_path, "-o", output)
    with pytest.raises(AmersError, match="no known coordinate reference system found"):
        run("project", up, *inputs, "-o", output)
    with pytest.raises(AmersError, match=r"\.txt found, one of"):
        run("correct", up, *inputs, "-o", tmp_path / "map.txt")
    folder = registered(tmp_path / "other", in_the_image())
    (folder / "report.json").write_text('{"scene": {"lines": 10, "samples": 20}}')
    with pytest.raises(AmersError, match="an image of 10 x 20 pixels, the scene has 300 x 400"):
        run("correct", up, *inputs, "--registration", folder, "-o", output)
    assert not output.exists()


def test_a_canvas_shows_the_pixels_without_georeferencing(inputs: list[object], tmp_path: Path) -> None:
    scene, canvas = inputs[1], tmp_path / "canvas.vrt"
    result = CliRunner().invoke(app, ["vectors", "canvas", str(scene), "-o", str(canvas)])
    assert result.exit_code == 0, result.output
    with rasterio.open(str(scene)) as image, rasterio.open(canvas) as shown:
        assert image.rpcs is not None
        assert shown.rpcs is None
        assert shown.crs is None
        assert shown.transform.is_identity
        assert shown.gcps[0] == []
        assert shown.dtypes == image.dtypes
        np.testing.assert_array_equal(shown.read(), image.read())
    with pytest.raises(AmersError, match=r"\.tif found, \.vrt expected"):
        CliRunner().invoke(app, ["vectors", "canvas", str(scene), "-o", "a.tif"], catch_exceptions=False)


def test_an_image_on_a_map_is_refused(inputs: list[object], tmp_path: Path) -> None:
    up = drawn(tmp_path / "up.gpkg", "POINT (100 50)")
    with pytest.raises(AmersError, match="has a map grid, a raw image with a sensor model is expected"):
        run("correct", up, "--scene", inputs[3], *inputs[2:], "-o", tmp_path / "map.gpkg")


@pytest.mark.real_data
def test_details_of_one_image_are_found_where_they_project_into_another(
    real_data: Path, tmp_path: Path
) -> None:
    """Details of one view, corrected on the surface model and projected into the other view.

    190 m of relief seen 12.8 degrees apart are 85 px; the delivered models disagree by about a pixel,
    and state 8.5 m.
    """
    folder = real_data / "phr_calanques_triplet"
    ground = ["--dem", folder / "expected_output" / "dsm.tif", "--vertical", "ellipsoid"]
    ground += ["--fill-px", 10, "--skip-missed"]
    first, second = (folder / f"img_{view}.tif" for view in ("01", "03"))
    with rasterio.open(first) as one, rasterio.open(second) as other:
        images = [file.read(1).astype(np.float32) for file in (one, other)]
    half, reach = 16, 12
    line_sample = np.stack(
        np.meshgrid(*[np.arange(100, size - 100, 50) for size in images[0].shape], indexing="ij"),
        axis=-1,
    ).reshape(-1, 2)
    points = [f"POINT ({sample} {line})" for line, sample in line_sample]
    drawn(tmp_path / "drawn.gpkg", *points)
    drawn_on, mapped, projected = (tmp_path / f"{name}.gpkg" for name in ("drawn", "map", "raw"))
    ground += ["--pixels", "centre"]
    accurate = ["--sigma-m", 8.5 / 2.146, "--to", "EPSG:4979"]
    stated = run("correct", drawn_on, "--scene", first, *ground, *accurate, "-o", mapped)
    run("project", mapped, "--scene", second, *ground, "-o", projected)
    raw = read_layer(tmp_path / "raw.gpkg")
    offsets = []
    for name, hidden, (x, y) in zip(
        raw.attributes["name"].to_pylist(),
        raw.attributes["hidden"].to_pylist(),
        shapely.get_coordinates(raw.geometries),
        strict=True,
    ):
        line, sample = line_sample[int(name.split()[1])]
        row, column = round(y), round(x)
        room = half + reach
        inside = room <= row < images[1].shape[0] - room and room <= column < images[1].shape[1] - room
        if hidden or not inside:
            continue
        chip = images[0][line - half : line + half + 1, sample - half : sample + half + 1]
        patch = images[1][row - room : row + room + 1, column - room : column + room + 1]
        score = cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED)
        if score.max() > 0.8:
            best = np.array(np.unravel_index(score.argmax(), score.shape)) - reach
            offsets.append(best + [row - y, column - x])
    assert len(offsets) > 20
    off_px = np.hypot(*np.array(offsets).T)
    assert np.median(off_px) < 2.0
    scatter_px = np.hypot(*(np.array(offsets) - np.median(offsets, axis=0)).T)
    assert np.median(scatter_px) < 1.0
    assert np.quantile(off_px, 0.9) * 0.5 < stated["on_the_earth"]["ce90_m"]
