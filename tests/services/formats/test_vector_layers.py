"""Layers of vectors keep their features, and files that are none are refused."""

import json
from contextlib import suppress
from datetime import date, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyogrio
import pytest
import shapely

from amers.services.errors import FormatError, InputError
from amers.services.formats.vector.layers import VectorLayer, read_layer, write_layer
from amers.services.formats.vector.pixel_coordinates import (
    PIXEL_ORIGINS,
    PixelOrigin,
    check_inside,
    line_sample_of_xy,
    xy_of_line_sample,
)

FORMATS = ["gpkg", "geojson", "shp", "fgb"]
a_nanodegree = 1e-9
of_every_format = pytest.mark.parametrize("suffix", FORMATS)


def layer() -> VectorLayer:
    shapes = shapely.from_wkt(["POINT Z (2.5 43.25 100)", "POINT Z (2.123456789012 43.5 7)"])
    table = pa.table(
        {
            "name": ["a", "β ; \" '"],
            "count": pa.array([1, None], pa.int32()),
            "large": pa.array([2**40, -1], pa.int64()),
            "height": pa.array([1.5, None], pa.float64()),
            "day": pa.array([date(2020, 2, 29), None]),
        }
    )
    return VectorLayer("houses", np.array([*shapes, None], dtype=object)[:2], table, "EPSG:4326")


@of_every_format
def test_a_layer_survives_a_round_trip(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"houses.{suffix}"
    write_layer(path, layer())
    again = read_layer(path)
    assert again.name == "houses"
    assert again.crs == "EPSG:4326"
    np.testing.assert_allclose(
        shapely.get_coordinates(again.geometries, include_z=True),
        shapely.get_coordinates(layer().geometries, include_z=True),
        atol=a_nanodegree,
    )
    written, read = layer().attributes.to_pylist(), again.attributes.to_pylist()
    midnight = datetime.min.time()
    for row in written if suffix == "fgb" else []:
        row["day"] = row["day"] and datetime.combine(row["day"], midnight)
    assert read == written
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_geopackage_keeps_the_numbers_of_its_features(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    table = layer().attributes.append_column("fid", pa.array([7, 20]))
    write_layer(path, VectorLayer("houses", layer().geometries, table, None))
    first = read_layer(path)
    write_layer(path, first)
    again = read_layer(path)
    assert again.fid is not None
    assert again.fid.tolist() == [7, 20]
    assert again.crs is None


def test_features_without_a_geometry_stay(tmp_path: Path) -> None:
    shapes = np.array([None, shapely.Point(1, 2)], dtype=object)
    for suffix in FORMATS:
        write_layer(tmp_path / f"a.{suffix}", VectorLayer("a", shapes, layer().attributes, "EPSG:4326"))
        again = read_layer(tmp_path / f"a.{suffix}").geometries
        assert shapely.is_missing(again).tolist() == [True, False]


def test_single_and_multiple_geometries_become_multiple_ones(tmp_path: Path) -> None:
    shapes = shapely.from_wkt(["LINESTRING (0 0, 1 1)", "MULTILINESTRING ((0 0, 1 1), (2 2, 3 3))"])
    write_layer(tmp_path / "a.gpkg", VectorLayer("a", shapes, layer().attributes, None))
    assert pyogrio.read_info(tmp_path / "a.gpkg")["geometry_type"] == "MultiLineString"
    mixed = np.array([shapes[0], shapely.Point(1, 2)], dtype=object)
    write_layer(tmp_path / "b.gpkg", VectorLayer("b", mixed, layer().attributes, None))
    assert len(read_layer(tmp_path / "b.gpkg").geometries) == 2
    with pytest.raises(InputError, match=r"a shapefile has one type of geometry, LineString, Point"):
        write_layer(tmp_path / "b.shp", VectorLayer("b", mixed, layer().attributes, None))


@pytest.mark.parametrize("suffix", ["gpkg", "geojson"])
def test_geometries_of_several_types_keep_their_heights(suffix: str, tmp_path: Path) -> None:
    shapes = shapely.from_wkt(["POINT Z (1 2 3)", "POLYGON Z ((0 0 1, 1 0 2, 1 1 3, 0 0 1))"])
    mixed = VectorLayer("b", shapes, layer().attributes, "EPSG:4326")
    write_layer(tmp_path / f"b.{suffix}", mixed)
    again = read_layer(tmp_path / f"b.{suffix}").geometries
    assert [shape.wkt for shape in again] == [shape.wkt for shape in shapes]
    with pytest.raises(InputError, match=r"a FlatGeobuf with heights has one type of geometry"):
        write_layer(tmp_path / "b.fgb", mixed)


def test_a_layer_among_several_must_be_named(tmp_path: Path) -> None:
    path = tmp_path / "two.gpkg"
    for name in ("roads", "rivers"):
        pyogrio.write_arrow(
            layer().attributes.append_column("geometry", pa.array(shapely.to_wkb(layer().geometries))),
            path,
            layer=name,
            driver="GPKG",
            geometry_name="geometry",
            geometry_type="Point Z",
            crs="EPSG:4326",
            append=path.exists(),
        )
    with pytest.raises(InputError, match="roads, rivers found; add --layer"):
        read_layer(path)
    with pytest.raises(InputError, match="no layer 'walls' with geometries; it has roads, rivers"):
        read_layer(path, "walls")
    assert read_layer(path, "rivers").name == "rivers"


def test_a_failed_write_leaves_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    write_layer(path, layer())
    before = path.read_bytes()
    twice = pa.table({"a": pa.array([1, 2], pa.duration("s"))})
    with pytest.raises(FormatError, match="cannot be written"):
        write_layer(path, VectorLayer("houses", layer().geometries, twice, None))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.gpkg"]


@of_every_format
def test_a_file_of_another_kind_is_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_text("<OGRVRTDataSource/>")
    with pytest.raises(FormatError, match=r"expected a .* file, found another kind"):
        read_layer(path)
    with pytest.raises(FormatError, match="cannot be opened: No such file"):
        read_layer(tmp_path / f"none.{suffix}")


@of_every_format
def test_truncated_files_are_refused_or_read_without_a_crash(suffix: str, tmp_path: Path) -> None:
    whole = tmp_path / f"whole.{suffix}"
    write_layer(whole, layer())
    content = whole.read_bytes()
    for size in np.linspace(0, len(content) - 1, 12).astype(int):
        path = tmp_path / f"part.{suffix}"
        path.write_bytes(content[:size])
        with suppress(FormatError, InputError):
            read_layer(path)


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.kml found, one of \.gpkg, \.geojson"):
        read_layer(tmp_path / "a.kml")


@pytest.mark.parametrize("origin", PIXEL_ORIGINS)
def test_pixel_coordinates_survive_a_round_trip(origin: PixelOrigin) -> None:
    xy = np.random.default_rng(1).uniform(-9.0, 9.0, (20, 2))
    again = xy_of_line_sample(line_sample_of_xy(xy, origin), origin)
    np.testing.assert_allclose(again, xy, atol=1e-12)


@pytest.mark.parametrize(
    ("origin", "xy"), [("qgis", [3.5, -2.5]), ("corner", [3.5, 2.5]), ("centre", [3.0, 2.0])]
)
def test_the_centre_of_a_pixel_has_whole_numbers(origin: PixelOrigin, xy: list[float]) -> None:
    np.testing.assert_allclose(line_sample_of_xy(np.array([xy]), origin), [[2.0, 3.0]])


def test_vertices_outside_the_image_are_refused_with_what_would_fit() -> None:
    xy = np.array([[10.0, 20.0], [300.0, 90.0]])
    check_inside(xy, (100, 310), "corner", 0.0)
    check_inside(xy + [16.0, 0.0], (100, 310), "corner", 6.0)
    with pytest.raises(InputError, match=r"2 of 2 vert.*y 90, by 90\.0 px: with --pixels corner all"):
        check_inside(xy, (100, 310), "qgis", 5.0)
    with pytest.raises(InputError, match=r"1 of 2 vertices.*by 50\.0 px: give the image"):
        check_inside(xy, (100, 250), "corner", 5.0)


@pytest.mark.parametrize("suffix", ["gpkg", "fgb"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_feature_whose_coordinates_are_no_numbers_is_left_out_by_name(
    suffix: str, value: float, tmp_path: Path
) -> None:
    path = tmp_path / f"a.{suffix}"
    shapes = shapely.linestrings([[[0, 0], [1, 1]], [[0, 0], [1, 1]], [[5, 5], [6, 6]]])
    shapely.set_coordinates(shapes, [[0, 0], [1, 1], [0, 0], [1, value], [5, 5], [6, 6]])
    table = pa.table({"name": ["a", "b", "c"]})
    write_layer(path, VectorLayer("a", shapes, table, "EPSG:4326"))
    read = read_layer(path)
    assert read.unusable == {1: "a coordinate is not a number or infinite"}
    assert shapely.is_missing(read.geometries).tolist() == [False, True, False]
    assert read.take(np.array([1, 2])).unusable == {0: read.unusable[1]}


def test_a_feature_of_an_unknown_type_is_left_out_by_name(tmp_path: Path) -> None:
    point = {"type": "Point", "coordinates": [1, 2]}
    circle = {"type": "Circle", "coordinates": [1, 2], "radius": 3}
    shapes = [point, circle, {"type": "GeometryCollection", "geometries": [point, circle]}, None, point]
    features = [
        {"type": "Feature", "properties": {"n": n}, "geometry": one} for n, one in enumerate(shapes)
    ]
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    read = read_layer(path)
    assert read.unusable == {row: "unknown type of geometry 'Circle'" for row in (1, 2)}
    assert shapely.is_missing(read.geometries).tolist() == [False, True, True, True, False]
    assert read.attributes["n"].to_pylist() == [0, 1, 2, 3, 4]


def test_a_file_without_any_feature_that_can_be_used_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    path.write_text('{"type": "Feature", "properties": {}, "geometry": {"type": "Circle"}}')
    with pytest.raises(
        FormatError, match=r"a\.geojson: no feature can be used; feature 1: unknown type"
    ):
        read_layer(path)


NAMES = ["geom", "geometry", "fid", "ogc_fid", "GEOM", "Name", "name", "geom_1", "wkb_geometry"]


@pytest.mark.parametrize("suffix", ["gpkg", "geojson", "fgb"])
def test_attributes_of_all_names_survive(suffix: str, tmp_path: Path) -> None:
    """Some under other names, which are told: drivers take small and capital letters for the same."""
    path = tmp_path / f"a.{suffix}"
    table = pa.table({name: [f"{name} 1", f"{name} 2"] for name in NAMES})
    renamed = write_layer(path, VectorLayer("a", layer().geometries, table, "EPSG:4326"))
    again = read_layer(path)
    assert not shapely.is_missing(again.geometries).any()
    read = again.attributes.to_pydict()
    for name in NAMES:
        assert read[renamed.get(name, name)] == [f"{name} 1", f"{name} 2"]
    taken = {"geom", "geometry", "fid", "ogc_fid"} if suffix == "gpkg" else set()
    assert set(renamed) == {"GEOM", "name"} | taken
    assert len({renamed.get(name, name).lower() for name in NAMES}) == len(NAMES)


def test_columns_that_are_added_replace_those_in_capital_letters(tmp_path: Path) -> None:
    table = pa.table({"CE90_M": ["mine", "mine"]})
    first = VectorLayer("a", layer().geometries, table, None)
    changed = first.changed(first.geometries, {"ce90_m": np.array([1.0, 2.0])}, None)
    assert changed.attributes.to_pydict() == {"ce90_m": [1.0, 2.0]}


def test_features_that_are_taken_keep_their_numbers_attributes_and_reasons() -> None:
    shapes = shapely.points(np.arange(5.0), 0.0)
    table, numbers = pa.table({"name": list("abcde")}), np.array([10, 11, 12, 13, 14])
    layer = VectorLayer("layer", shapes, table, "EPSG:4326", numbers, {1: "a curve", 4: "damaged"})
    taken = layer.take(np.array([4, 0, 3]))
    assert taken.fid is not None
    assert taken.fid.tolist() == [14, 10, 13]
    assert taken.attributes["name"].to_pylist() == ["e", "a", "d"]
    assert shapely.get_x(taken.geometries).tolist() == [4.0, 0.0, 3.0]
    assert taken.unusable == {0: "damaged"}
