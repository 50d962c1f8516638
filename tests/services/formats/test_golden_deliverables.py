"""Deliverables compared with golden files, to the byte or number by number."""

import json
import re
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from pyproj import CRS, Geod
from rasterio.transform import Affine, RPCTransformer
from rasterio.warp import transform

from amers.services.formats.images.ortho import write_refined_ortho
from amers.services.formats.sensor_models.correction_json import (
    format_correction,
    parse_correction,
    parse_correction_accuracy,
)
from amers.services.formats.sensor_models.dimap import format_dimap_rpc
from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from amers.services.formats.vector.residual_layers import exaggeration_for, write_residual_layers
from amers.services.map_grid import MapGrid
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.reports.drawing import ACTIVE, DEACTIVATED, NOT_MATCHED
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.ortho import OrthoModel
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Frame, Measures

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

GOLDEN = Path(__file__).parents[2] / "golden"
MODEL = parse_rpc_text((GOLDEN / "invented_RPC.TXT").read_text())
CORRECTION = (GOLDEN / "invented_correction.json").read_text(encoding="utf-8")
RESIDUALS = json.loads((GOLDEN / "invented_residuals.json").read_text())

a_millionth_of_a_pixel = 1e-6
a_nanodegree = 1e-9
rounding = 1e-14
CORNER_OF_FIRST_PIXEL = 0.5
both_versions = pytest.mark.parametrize("name", ["RPC_invented_v2", "RPC_invented_v3"])


def ground() -> np.ndarray:
    """Ground points (60, 3) over the whole range of the invented RPC."""
    normalised = np.random.default_rng(5).uniform(-0.9, 0.9, (60, 3))
    return MODEL.ground_offset + normalised * MODEL.ground_scale


def refined() -> RpcModel:
    """The invented model with the golden correction, which changes offsets and scales only."""
    parameters_px = json.loads(CORRECTION)["parameters_px"]
    return replace(
        MODEL,
        image_offset=MODEL.image_offset + [parameters_px[0][0], parameters_px[1][0]],
        image_scale=MODEL.image_scale + [parameters_px[0][1], parameters_px[1][2]],
    )


def test_a_written_correction_is_identical_to_the_byte() -> None:
    correction = parse_correction(CORRECTION)
    covariance = np.full((6, 6), np.nan)
    np.fill_diagonal(covariance, 0.25)
    document = json.loads(CORRECTION)
    again = format_correction(
        CorrectionAccuracy(
            correction,
            covariance,
            np.array([0.125, 0.0625]),
            Frame(np.array([[4.0, 0.5, np.nan], [0.5, 9.0, np.nan], [np.nan] * 3])),
            0.375,
        ),
        "drift",
        applies_to=document["applies_to"],
        carried=document["carried"],
    )
    assert again == CORRECTION
    stated = parse_correction_accuracy(CORRECTION)
    np.testing.assert_array_equal(stated.covariance_px2, covariance)
    np.testing.assert_array_equal(stated.local_sigma_px, [0.125, 0.0625])
    np.testing.assert_array_equal(stated.frame.covariance_m2[:2, :2], [[4.0, 0.5], [0.5, 9.0]])
    assert stated.apart_px == 0.375


def test_a_correction_moves_positions_as_its_formula_says() -> None:
    correction = parse_correction(CORRECTION)
    corrected = CorrectedModel(MODEL, correction).project(ground())
    np.testing.assert_allclose(
        corrected, refined().project(ground()), atol=a_millionth_of_a_pixel, rtol=0
    )


@both_versions
def test_a_refined_dimap_differs_from_the_delivered_one_in_four_numbers(name: str) -> None:
    expected = (GOLDEN / f"{name}_refined.XML").read_text()
    written = format_dimap_rpc((GOLDEN / f"{name}.XML").read_text(), refined())
    number = re.compile(r">(-?[\d.]+(?:e-?\d+)?)<")
    assert number.sub("><", written) == number.sub("><", expected)
    np.testing.assert_allclose(
        np.array(number.findall(written), dtype=float),
        np.array(number.findall(expected), dtype=float),
        rtol=rounding,
    )


@both_versions
def test_gdal_reads_a_refined_dimap_as_the_corrected_model(name: str, tmp_path: Path) -> None:
    text = format_dimap_rpc((GOLDEN / f"{name}.XML").read_text(), refined())
    (tmp_path / "RPC_a.XML").write_text(text)
    identification = re.search(r"<Metadata_Identification>.*</Metadata_Identification>", text, re.S)
    (tmp_path / "DIM_a.XML").write_text(f"<Dimap_Document>{identification[0]}</Dimap_Document>")
    with rasterio.open(tmp_path / "IMG_a_R1C1.TIF", "w", "GTiff", 8, 8, 1, dtype=np.uint8) as file:
        file.write(np.ones((1, 8, 8), np.uint8))
    with rasterio.open(tmp_path / "IMG_a_R1C1.TIF") as file, RPCTransformer(file.rpcs) as gdal:
        line, sample = gdal.rowcol(*ground().T, op=np.positive)
    actual = np.column_stack([line, sample]) - CORNER_OF_FIRST_PIXEL
    np.testing.assert_allclose(actual, refined().project(ground()), atol=a_millionth_of_a_pixel, rtol=0)


def test_the_sidecar_of_an_ortho_image_has_the_golden_map_grid_for_any_reader(tmp_path: Path) -> None:
    step_xy = np.array([[0.0625, 0.5], [-0.5, 0.03125]])
    corner = np.array([300000.25, 4640000.75])
    grid = MapGrid("EPSG:32633", corner + step_xy @ [0.5, 0.5], step_xy, (30, 40))
    image = tmp_path / "map.tif"
    with rasterio.open(
        image, "w", "GTiff", 40, 30, 1, "EPSG:32633", Affine(1, 0, 3e5, 0, -1, 464e4), np.uint8
    ) as file:
        file.write(np.ones((1, 30, 40), np.uint8))
    (sidecar,) = write_refined_ortho(image, grid, tmp_path / "out")
    golden, written = (
        ElementTree.parse(path).getroot() for path in (GOLDEN / "invented_map.tif.aux.xml", sidecar)
    )
    assert written.findtext("GeoTransform").strip() == golden.findtext("GeoTransform").strip()
    assert written.find("SRS").attrib == golden.find("SRS").attrib
    assert CRS(written.findtext("SRS")) == CRS(golden.findtext("SRS"))
    shutil.copy(GOLDEN / "invented_map.tif.aux.xml", f"{image}.aux.xml")
    with rasterio.open(image) as file:
        x, y = file.xy(7, 11, offset="center")
        assert file.crs.to_epsg() == 32633
    (lon,), (lat,) = transform("EPSG:32633", "EPSG:4326", [x], [y])
    actual = OrthoModel(grid).project(np.array([[lon, lat, 0.0]]))
    np.testing.assert_allclose(actual, [[7.0, 11.0]], atol=a_millionth_of_a_pixel, rtol=0)


def measures() -> Measures:
    """The golden points as the measures of a registration."""
    points = RESIDUALS["points"]

    def column(name: str) -> np.ndarray:
        return np.array([np.nan if p[name] is None else p[name] for p in points], dtype=np.float64)

    reason = np.array([p["reason"] for p in points])
    matched = np.isfinite(column("line"))
    line_sample = np.column_stack([column("line"), column("sample")])
    return Measures(
        point_id=np.array([p["point_id"] for p in points]),
        lon_lat_h=np.column_stack([column("lon"), column("lat"), column("height_m")]),
        predicted=line_sample + 3.0,
        line_sample=line_sample,
        sigma_px=column("sigma_px"),
        score=column("score"),
        views=matched.astype(np.int64),
        by_gradient=np.zeros(len(points), dtype=bool),
        residual_px=np.column_stack([column("residual_line_px"), column("residual_sample_px")]),
        residual_m=np.column_stack([column("residual_east_m"), column("residual_north_m")]),
        matched=matched,
        active=reason == "",
        reason=reason,
    )


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The layers of residuals, which replace older ones."""
    made = tmp_path_factory.mktemp("layers") / "residuals.gpkg"
    for exaggeration in (1.0, RESIDUALS["exaggeration"]):
        write_residual_layers(made, measures(), "invented", exaggeration)
    return made


@pytest.mark.parametrize("factor", [1e-4, 1.0, 3.0, 1e4])
def test_most_residuals_are_drawn_up_to_a_25th_of_the_diagonal_of_the_points(factor: float) -> None:
    """By 1, 2 or 5 times a power of ten, never smaller than they are."""
    scaled = replace(measures(), residual_m=factor * measures().residual_m)
    found, (lon, lat) = exaggeration_for(scaled), scaled.lon_lat_h[:, :2].T
    length_m = np.linalg.norm(scaled.residual_m[scaled.active], axis=1)
    drawn_m = found * np.quantile(length_m, 0.9)
    diagonal_m = Geod(ellps="WGS84").inv(lon.min(), lat.min(), lon.max(), lat.max())[2]
    assert f"{found:e}"[0] in "125"
    assert found >= 1.0
    assert drawn_m <= 1.001 * diagonal_m / 25.0 or found == 1.0
    assert 2.5 * drawn_m > 0.999 * diagonal_m / 25.0


def rows_of(path: Path, layer: str) -> tuple[list[dict], list[np.ndarray]]:
    """Attributes and coordinates of a layer of a GeoPackage, from its SQLite and its WKB."""
    with sqlite3.connect(path) as database:
        database.row_factory = sqlite3.Row
        rows = [dict(row) for row in database.execute(f"SELECT * FROM {layer} ORDER BY fid")]
        ((srs,),) = [
            tuple(row)
            for row in database.execute(
                "SELECT organization_coordsys_id FROM gpkg_contents JOIN gpkg_spatial_ref_sys "
                "USING (srs_id) WHERE table_name = ?",
                [layer],
            )
        ]
    assert srs == 4979
    envelope_bytes = (0, 32, 48, 48, 64)
    shapes = []
    for row in rows:
        blob = row.pop("geom")
        assert blob[:2] == b"GP"
        shape = shapely.from_wkb(blob[8 + envelope_bytes[blob[3] >> 1 & 7] :])
        shapes.append(shapely.get_coordinates(shape, include_z=True))
    return rows, shapes


def test_the_layers_of_residuals_have_the_golden_rows_and_lines(path: Path) -> None:
    golden = RESIDUALS["points"]
    rows, places = rows_of(path, "control_points")
    assert len(rows) == len(golden)
    for row, place, expected in zip(rows, places, golden, strict=True):
        assert place.tolist() == [[expected["lon"], expected["lat"], expected["height_m"]]]
        for name in set(expected) - {"lon", "lat", "line_to", "residual_m"}:
            assert row[name] == expected[name]
    actual = [point for point in golden if "line_to" in point]
    rows, lines = rows_of(path, "residuals")
    assert [row["point_id"] for row in rows] == [point["point_id"] for point in actual]
    for row, line, expected in zip(rows, lines, actual, strict=True):
        assert row["exaggeration"] == RESIDUALS["exaggeration"]
        assert row["residual_m"] == pytest.approx(expected["residual_m"], rel=rounding)
        assert line[0].tolist() == [expected["lon"], expected["lat"], expected["height_m"]]
        np.testing.assert_allclose(line[1], expected["line_to"], atol=a_nanodegree, rtol=0)


def test_gdal_reads_both_layers_of_residuals_with_their_reference_system(path: Path) -> None:
    kinds = {name: pyogrio.read_info(path, layer=name) for name, _ in pyogrio.list_layers(path)}
    assert {name: info["geometry_type"] for name, info in kinds.items()} == {
        "held_area": "MultiPolygon",
        "residuals": "LineString Z",
        "control_points": "Point Z",
        "layer_styles": None,
    }
    assert {kinds[name]["crs"] for name in ("residuals", "control_points")} == {"EPSG:4979"}


def test_qgis_finds_arrows_of_residuals_in_the_colours_of_the_report(path: Path) -> None:
    with closing(sqlite3.connect(path)) as database:
        columns = dict(database.execute("select table_name, column_name from gpkg_geometry_columns"))
        styles = database.execute(
            "select f_table_name, f_geometry_column, useAsDefault, styleQML from layer_styles"
        ).fetchall()
        assert database.execute("pragma integrity_check").fetchone() == ("ok",)
    drawn = {}
    for layer, column, is_default, qml in styles:
        assert (columns[layer], 1) == (column, is_default)
        renderer = ElementTree.fromstring(qml).find("renderer-v2")
        assert renderer is not None
        if layer == "held_area":
            drawn_area = [one.get("class") for one in renderer.iterfind("symbols/symbol/layer")]
            assert (renderer.get("type"), drawn_area) == ("singleSymbol", ["SimpleFill"])
            continue
        assert (renderer.get("type"), renderer.get("attr")) == ("categorizedSymbol", "status")
        colours = [one.get("v") for one in renderer.iterfind(".//prop[@k='color']")]
        words = [one.get("value") for one in renderer.iterfind("categories/category")]
        kinds = {one.get("class") for one in renderer.iterfind("symbols/symbol/layer")}
        drawn[layer] = kinds, dict(zip(words, colours, strict=True))
    colours_of_the_report = {
        word: ",".join(map(str, (*bytes.fromhex(colour[1:]), 255)))
        for word, colour in zip(
            ("active", "deactivated", "not matched"), (ACTIVE, DEACTIVATED, NOT_MATCHED), strict=True
        )
    }
    assert drawn == {
        "residuals": ({"ArrowLine"}, colours_of_the_report),
        "control_points": ({"SimpleMarker"}, colours_of_the_report),
    }
