"""What `/schema` states of a property is what each format sends, unknown values included."""

import csv
import io
import math
from datetime import UTC, date, datetime

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pyogrio.raw
import pytest
import shapely

from tests.app.conformance.conftest import COLLECTIONS

ARROW = {
    "integer": {pa.int64()},
    "number": {pa.float32(), pa.float64()},
    "string": {pa.string()},
    "boolean": {pa.bool_()},
    "date": {pa.date32()},
    "date-time": {pa.timestamp("us", "UTC")},
}
OGR = {
    "integer": "OFTInteger64",
    "number": "OFTReal",
    "string": "OFTString",
    "date": "OFTDate",
    "date-time": "OFTDateTime",
}
FILES = ("parquet", "gpkg", "fgb")
a_millisecond_s = 0.001


@pytest.fixture(scope="module")
def store(store_with_unknowns):
    return store_with_unknowns


@pytest.fixture
def kinds(get):
    """The types of the properties of a collection by name, as its schema states them."""

    def kinds(name):
        members = get(f"/collections/{name}/schema").json()["properties"]
        del members["geometry"]
        return {name: member.get("format", member["type"]) for name, member in members.items()}

    return kinds


def downloaded(get, tmp_path, name, form, **parameters):
    reply = get(f"/collections/{name}/items", f=form, limit=1000, **parameters)
    assert reply.status_code == 200, reply.text
    path = tmp_path / f"{name}.{form}"
    path.write_bytes(reply.content)
    return path


def as_table(path):
    """The columns of a file; what is unknown is None."""
    if path.suffix == ".parquet":
        return pq.read_table(path).to_pydict()
    frame = pyogrio.read_dataframe(path, read_geometry=False)
    return {
        name: [None if pandas.isna(value) else value for value in frame[name]] for name in frame.columns
    }


def is_same(kind, sent, stated):
    """Whether a value of a file is that of GeoJSON."""
    if stated is None or sent is None:
        return sent is None and stated is None
    if kind == "date":
        day = sent.date() if isinstance(sent, datetime) else sent
        return day == date.fromisoformat(stated)
    if kind == "date-time":
        moment = sent if sent.tzinfo else sent.replace(tzinfo=UTC)
        return abs((moment - datetime.fromisoformat(stated)).total_seconds()) < a_millisecond_s
    return math.isclose(sent, stated, rel_tol=1e-6) if kind == "number" else sent == stated


@pytest.mark.parametrize("name", COLLECTIONS)
@pytest.mark.parametrize("form", FILES)
def test_columns_of_a_file_have_the_types_that_the_schema_states(get, kinds, tmp_path, name, form):
    path, stated = downloaded(get, tmp_path, name, form), kinds(name)
    if form == "parquet":
        fields = {field.name: field.type for field in pq.read_schema(path)}
        assert fields.pop("geometry") == pa.binary()
        assert set(fields) == set(stated)
        assert {name: kind for name, kind in fields.items() if kind not in ARROW[stated[name]]} == {}
        return
    info = pyogrio.read_info(path)
    # A FlatGeobuf has one type for dates and times.
    types = OGR | ({"date": "OFTDateTime"} if form == "fgb" else {})
    found = dict(zip(info["fields"].tolist(), info["ogr_types"], strict=True))
    assert found == {name: types[kind] for name, kind in stated.items()}


@pytest.mark.parametrize("name", COLLECTIONS)
@pytest.mark.parametrize("form", FILES)
def test_values_of_a_file_are_those_of_geojson(get, kinds, tmp_path, name, form):
    page = get(
        f"/collections/{name}/items", limit=1000, crs="http://www.opengis.net/def/crs/EPSG/0/3857"
    )
    stated, key = kinds(name), "number" if name == "blocks" else "id"
    features = {one["id"]: one["properties"] for one in page.json()["features"]}
    columns = as_table(downloaded(get, tmp_path, name, form))
    assert sorted(columns[key]) == sorted(features)
    for row, identifier in enumerate(columns[key]):
        for column, kind in stated.items():
            if column != key:
                sent = columns[column][row]
                assert is_same(kind, sent, features[identifier][column]), (column, sent)


@pytest.mark.parametrize("name", COLLECTIONS)
def test_members_of_geojson_and_columns_of_csv_are_those_of_the_schema(get, store, kinds, name):
    members = get(f"/collections/{name}/schema").json()
    stated, key = (
        kinds(name),
        next(key for key, member in members["properties"].items() if member.get("x-ogc-role") == "id"),
    )
    crs = "http://www.opengis.net/def/crs/EPSG/0/3857"
    for feature in get(f"/collections/{name}/items", limit=1000, crs=crs).json()["features"]:
        assert set(feature["properties"]) | {key} == set(stated)
        unknown = {member for member, value in feature["properties"].items() if value is None}
        assert not unknown & set(members["required"])
    rows = list(csv.DictReader(io.StringIO(get(f"/collections/{name}/items", f="csv", limit=1000).text)))
    assert set(stated) <= set(rows[0])
    for row in rows:
        assert "" not in {row[name] for name in members["required"] if name != "geometry"}


@pytest.mark.parametrize("box", [(5.2, 43.2, 5.25, 43.25), (5.22, 43.21, 5.23, 43.29), (0, 0, 1, 1)])
def test_a_flatgeobuf_has_an_index_that_finds_what_a_box_holds(get, made, tmp_path, box):
    path = downloaded(get, tmp_path, "points", "fgb")
    assert pyogrio.read_info(path)["capabilities"]["fast_spatial_filter"]
    _, _, _, (found, *_) = pyogrio.raw.read(path, bbox=box, columns=["id"])
    inside = shapely.intersects_xy(shapely.box(*box), made.points.lon_lat_h[:, :2])
    assert sorted(found.tolist()) == (2**26 + np.flatnonzero(inside)).tolist()


def test_a_flatgeobuf_keeps_an_order_that_was_asked_for_and_features_without_geometry(get, tmp_path):
    path = downloaded(get, tmp_path, "points", "fgb", sortby="-saliency")
    saliency = as_table(path)["saliency"]
    assert saliency == sorted(saliency, reverse=True)
    path = downloaded(get, tmp_path, "scenes", "fgb")
    assert len(as_table(path)["id"]) == 3
    assert pyogrio.read_info(downloaded(get, tmp_path, "scenes", "fgb", bbox="0,0,1,1"))["features"] == 1


@pytest.mark.parametrize("form", FILES)
def test_a_file_without_any_geometry_states_no_bounds(get, tmp_path, form):
    path = downloaded(get, tmp_path, "scenes", form, bbox="0,0,1,1")
    assert len(as_table(path)["id"]) == 1
    if form == "parquet":
        assert b"NaN" not in pq.read_schema(path).metadata[b"geo"]
