"""Formats of features and tiles, opened by other programs."""

import io
import json
import re
import sqlite3
from contextlib import closing
from datetime import timedelta
from itertools import pairwise
from xml.etree import ElementTree as ET

import geopandas
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyogrio.raw import read as read_features

from amers.app.db import superseding
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.features import items
from amers.app.usecases.history import suspend_point
from tests.app.served import serve_block
from tests.factories import make_block
from tests.statements import run_sql

ITEMS = "/collections/points/items"
TILES = "/collections/{}/tiles/WebMercatorQuad/{}/{}/{}"
a_tenth_of_a_millimetre_deg = 1e-9


@pytest.fixture
def made(connection, storage, tmp_path):
    """A published block of 60 points."""
    made = make_block(tmp_path / "block", count=60)
    serve_block(connection, storage, made.folder)
    connection.commit()
    return made


@pytest.fixture
def get(made, client, bearer):
    caller = bearer("read")
    return lambda path, **parameters: caller.get(path, params=parameters or None)


@pytest.mark.parametrize("form", ["fgb", "parquet", "gpkg"])
def test_a_file_of_points_opens_with_heights_reference_system_and_properties(get, made, tmp_path, form):
    reply = get(ITEMS, f=form)
    assert reply.status_code == 200, reply.text
    assert reply.headers["ogc-numberreturned"] == "60"
    path = tmp_path / f"points.{form}"
    path.write_bytes(reply.content)
    frame = geopandas.read_parquet(path) if form == "parquet" else geopandas.read_file(path)
    assert frame.crs.to_epsg() == 4979
    if form == "fgb":
        frame = frame.sort_values("id", ignore_index=True)  # They lie in the order of the index.
    found = np.column_stack([frame.geometry.x, frame.geometry.y, frame.geometry.z])
    assert_allclose(found, made.points.lon_lat_h, rtol=0, atol=0)
    assert frame["id"].tolist() == (2**26 + np.arange(60)).tolist()
    assert_allclose(frame["saliency"], made.points.saliency, rtol=1e-7)
    assert frame["typology"].isna().sum() == 15
    assert str(frame["first_view"][0])[:10] == "2023-03-01"


def test_a_span_of_time_holds_what_begins_or_ends_at_its_ends(get, connection):
    dates = run_sql(connection, "select min(first_view) as first, max(last_view) as last from point")
    edge = dates.fetchone()
    day_before, day_after = edge["first"] - timedelta(days=1), edge["last"] + timedelta(days=1)
    for span, holds in (
        (f"../{edge['first']}T00:00:00Z", "first"),
        (f"../{day_before}T23:59:59Z", None),
        (f"{edge['last']}T00:00:00Z/..", "last"),
        (f"{edge['last']}T23:59:59Z/..", "last"),
        (f"{day_after}T00:00:00Z/..", None),
    ):
        found = get(ITEMS, datetime=span, limit=100).json()["features"]
        assert bool(found) == (holds is not None), span
        assert {one["properties"][f"{holds}_view"] for one in found} <= {str(edge.get(holds))}, span


def test_the_next_page_is_for_the_kind_of_caller_who_asked_for_the_first(made, client, bearer):
    """A token tells where a page ends and how many features there are, to administrators of all."""
    admin, reader = bearer("admin"), bearer("read")
    for own, other in ((admin, reader), (reader, admin)):
        page = client.get(f"{ITEMS}?limit=10", headers=own).json()
        (following,) = (link["href"] for link in page["links"] if link["rel"] == "next")
        assert client.get(following, headers=own).status_code == 200
        assert client.get(following, headers=other).status_code == 400


def test_a_geopackage_of_points_has_styles_that_qgis_finds_by_layer_and_geometry_column(get, tmp_path):
    path = tmp_path / "points.gpkg"
    path.write_bytes(get(ITEMS, f="gpkg").content)
    with closing(sqlite3.connect(path)) as database:
        database.row_factory = sqlite3.Row
        styles = [dict(row) for row in database.execute("select * from layer_styles order by id")]
        ((table, column),) = database.execute(
            "select table_name, column_name from gpkg_geometry_columns"
        )
        assert database.execute("pragma integrity_check").fetchone()[0] == "ok"
    assert {(row["f_table_name"], row["f_geometry_column"]) for row in styles} == {(table, column)}
    assert [(row["styleName"], row["useAsDefault"]) for row in styles] == [
        ("Horizontal sigma", 1),
        ("Number of views", 0),
    ]
    properties = set(geopandas.read_file(path, layer="points").columns)
    for row in styles:
        renderer = ET.fromstring(row["styleQML"]).find("renderer-v2")
        assert renderer.get("type") == "graduatedSymbol"
        assert set(re.findall(r'"(\w+)"', renderer.get("attr"))) <= properties
        ranges = renderer.findall("ranges/range")
        symbols = {symbol.get("name"): symbol for symbol in renderer.findall("symbols/symbol")}
        assert [one.get("symbol") for one in ranges] == list(symbols)
        colours = {symbol.find("layer/prop[@k='color']").get("v") for symbol in symbols.values()}
        assert len(colours) == len(ranges)
        limits = [(float(one.get("lower")), float(one.get("upper"))) for one in ranges]
        assert all(before[1] == after[0] for before, after in pairwise(limits))


@pytest.mark.parametrize("form", ["fgb", "parquet", "gpkg", "csv"])
def test_a_file_without_features_opens_too(get, tmp_path, form):
    path = tmp_path / f"none.{form}"
    path.write_bytes(get(ITEMS, f=form, bbox="0,0,1,1").content)
    if form == "csv":
        assert path.read_text().startswith("id,lon_deg,lat_deg,height_m")
    elif form == "parquet":
        assert len(geopandas.read_parquet(path)) == 0
    else:
        assert len(read_features(path)[1] if read_features(path)[1] is not None else []) == 0


@pytest.mark.parametrize("name", ["blocks", "density"])
@pytest.mark.parametrize("form", ["fgb", "parquet", "gpkg"])
def test_outlines_open_as_polygons(get, tmp_path, name, form):
    path = tmp_path / f"outlines.{form}"
    path.write_bytes(get(f"/collections/{name}/items", f=form).content)
    frame = geopandas.read_parquet(path) if form == "parquet" else geopandas.read_file(path)
    assert frame.crs.to_epsg() == 4326
    assert set(frame.geom_type) == {"Polygon"}
    assert_allclose(frame.total_bounds, [5.2, 43.2, 5.3, 43.3], atol=1e-9)
    assert frame["n_points"].sum() == 60


def test_pages_of_files_follow_each_other_by_the_header_link(get):
    for form in ["csv", "fgb", "parquet", "gpkg"]:
        reply, returned = get(ITEMS, f=form, limit=25), []
        while True:
            returned.append(int(reply.headers["ogc-numberreturned"]))
            assert reply.headers["ogc-numbermatched"] == "60", form
            following = reply.links.get("next")
            if following is None:
                break
            kind = reply.headers["content-type"].replace("; charset=utf-8", "")
            assert following["type"] == kind
            reply = get(following["url"])
        assert returned == [25, 25, 10], form


def test_a_format_is_chosen_by_the_header_accept(client, bearer, made):
    for accept, kind in (
        ("application/flatgeobuf", "application/flatgeobuf"),
        ("text/csv;q=0.5, application/geo+json", "application/geo+json"),
        ("application/json", "application/geo+json"),
        ("image/png, */*", "application/geo+json"),
        ("text/html,application/xhtml+xml,*/*;q=0.8", "text/html"),
    ):
        reply = client.get(ITEMS, headers={**bearer("read"), "Accept": accept})
        assert reply.headers["content-type"].startswith(kind), accept


def test_a_large_page_is_streamed_with_the_same_content(get, monkeypatch):
    whole = get(ITEMS, limit=50).json()
    monkeypatch.setattr(items, "LARGEST_TEXT", 10)
    monkeypatch.setattr("amers.app.db.features.pages.ROWS_AT_ONCE", 7)
    streamed = get(ITEMS, limit=50).json()
    assert streamed["features"] == whole["features"]
    for member in ("numberMatched", "numberReturned", "links"):
        assert streamed[member] == whole[member]
    assert get(ITEMS, limit=60).json()["numberReturned"] == 60
    assert "next" not in [link["rel"] for link in get(ITEMS, limit=60).json()["links"]]
    assert get(ITEMS, limit=50, bbox="0,0,1,1").json()["features"] == []


def test_density_is_that_of_published_blocks_only(get, connection):
    cells = get("/collections/density/items").json()["features"]
    assert sum(cell["properties"]["n_points"] for cell in cells) == 60
    cell = cells[0]["properties"]
    assert cell["points_per_km2"] == pytest.approx(cell["n_points"] / cell["area_km2"])
    assert cell["area_km2"] == pytest.approx(90.2, abs=0.1)
    lifecycle.withdraw_block(connection, "calanques")
    connection.commit()
    assert get("/collections/density/items").json()["features"] == []
    levels = run_sql(connection, "select count(*) as n from density_cell").fetchone()
    assert levels == {"n": 0}


def test_density_counts_points_that_are_served(get, connection):
    def counted():
        cells = get("/collections/density/items").json()["features"]
        row, column = tile_of(5.25, 43.25, 3)
        return sum(cell["properties"]["n_points"] for cell in cells), get(
            TILES.format("density", 3, row, column)
        ).content

    whole = counted()
    run_sql(
        connection,
        "update point set suspended_at = now(), suspended_because = 'gone' where id < %s",
        [2**26 + 7],
    )
    superseding.count_unserved(connection)
    connection.commit()
    fewer = counted()
    assert (whole[0], fewer[0]) == (60, 53)
    assert fewer[1] != whole[1]
    run_sql(connection, "update point set suspended_at = null, suspended_because = null")
    superseding.count_unserved(connection)
    connection.commit()
    assert counted()[0] == 60


def tile_of(lon, lat, z):
    x = int((lon + 180.0) / 360.0 * 2**z)
    mercator = np.arcsinh(np.tan(np.radians(lat))) / np.pi
    return int((1.0 - mercator) / 2.0 * 2**z), x


def test_a_tile_has_the_features_of_its_place_in_a_layer_of_the_collection(get, made, tmp_path):
    for name, z in [("points", 8), ("points", 3), ("density", 0), ("blocks", 6)]:
        y, x = tile_of(5.25, 43.25, z)
        reply = get(TILES.format(name, z, y, x))
        assert reply.headers["content-type"] == "application/vnd.mapbox-vector-tile", name
        path = tmp_path / "tile.mvt"
        path.write_bytes(reply.content)
        meta, _, geometry, values = read_features(path, layer=name)
        fields = dict(zip(meta["fields"].tolist(), values, strict=True))
        if (name, z) == ("points", 8):
            assert sorted(fields["id"]) == (2**26 + np.arange(60)).tolist(), name
            assert len(geometry) == 60, name
        else:
            assert sum(fields["n_points"]) == 60, name
        apart = get(TILES.format(name, z, (y + 3) % 2**z, x)).content
        assert apart == (reply.content if z == 0 else b""), name


def test_density_cells_are_twice_as_wide_for_each_zoom_before_the_sixth(get, tmp_path):
    for z, level in [(9, 0), (6, 0), (5, 1), (2, 4), (0, 6)]:
        reply = get(TILES.format("density", z, *tile_of(5.25, 43.25, z)))
        (tmp_path / "tile.mvt").write_bytes(reply.content)
        meta, _, _, values = read_features(tmp_path / "tile.mvt", layer="density", CLIP="NO")
        fields = dict(zip(meta["fields"].tolist(), values, strict=True))
        assert set(fields["level"].tolist()) == {level}, z


def test_a_tile_states_the_horizontal_accuracy_of_each_point(get, made, tmp_path):
    reply = get(TILES.format("points", 8, *tile_of(5.25, 43.25, 8)))
    (tmp_path / "tile.mvt").write_bytes(reply.content)
    meta, _, _, values = read_features(tmp_path / "tile.mvt", layer="points")
    fields = dict(zip(meta["fields"].tolist(), values, strict=True))
    variance_m2 = np.diagonal(made.points.covariance_m2, 0, 1, 2)[:, :2].mean(axis=1)
    stated_m = fields["sigma_horizontal_m"][np.argsort(fields["id"])]
    assert_allclose(stated_m, np.sqrt(variance_m2), rtol=1e-5)


def test_a_tile_has_the_health_of_points_that_scenes_have_tried(get, connection, tmp_path):
    """One point failed in six scenes where all others served."""
    tried = "insert into point_history (point_id, attempts, successes, expected) values (%s, 6, %s, 6)"
    for point, successes in ((2**26, 0), (2**26 + 1, 6)):
        run_sql(connection, tried, [point, successes])
    connection.commit()
    reply = get(TILES.format("points", 8, *tile_of(5.25, 43.25, 8)))
    (tmp_path / "tile.mvt").write_bytes(reply.content)
    meta, _, _, values = read_features(tmp_path / "tile.mvt", layer="points")
    fields = dict(zip(meta["fields"].tolist(), values, strict=True))
    health = dict(zip(fields["id"].tolist(), fields["health"].tolist(), strict=True))
    assert health[2**26] == pytest.approx(5.0 / 11.0)
    assert health[2**26 + 1] == 1.0
    assert np.isnan([value for point, value in health.items() if point > 2**26 + 1]).all()


def test_a_registration_that_counts_changes_the_tags_of_points_and_of_no_other_tile(get, connection):
    """A registration that began before another changes them too, when it ends after the other."""
    points = TILES.format("points", 8, *tile_of(5.25, 43.25, 8))
    others = [
        TILES.format(name, z, *tile_of(5.25, 43.25, z)) for name, z in (("points", 7), ("blocks", 8))
    ]
    tags, before = [get(points).headers["etag"]], [get(other).headers["etag"] for other in others]
    for scene, began in (("a", "2026-01-01 12:00:01+00"), ("b", "2026-01-01 12:00:00+00")):
        run_sql(
            connection,
            "insert into registration (id, block_versions, options, report, verdict, files, scene_key,"
            " counted, created_at)"
            " values (gen_random_uuid(), '[]', '{}', '{}', 'good', '{}', %s, true, %s)",
            [scene, began],
        )
        connection.commit()
        tags.append(get(points).headers["etag"])
    assert len(set(tags)) == 3
    assert [get(other).headers["etag"] for other in others] == before


def test_a_tile_has_the_points_of_its_margin_so_that_no_symbol_is_cut(get, made, tmp_path):
    """The margin is 64 of 4096 parts of a tile: the points nearer to the tile are in it too."""
    lon, lat = np.radians(made.points.lon_lat_h[:, :2]).T
    world = np.column_stack([lon / np.pi + 1.0, 1.0 - np.arcsinh(np.tan(lat)) / np.pi]) / 2.0
    tried = 0
    for z in range(8, 18):
        place = world * 2**z
        beyond = place - np.floor(place)
        for axis in range(2):
            parts = 4096.0 * beyond[:, axis]
            for row in np.flatnonzero((parts > 35.0) & (parts < 62.0)).tolist():
                column_row = np.floor(place[row]).astype(int)
                column_row[axis] -= 1
                reply = get(TILES.format("points", z, *column_row[::-1].tolist()))
                (tmp_path / "tile.mvt").write_bytes(reply.content)
                meta, _, _, values = read_features(tmp_path / "tile.mvt", layer="points", CLIP="NO")
                fields = dict(zip(meta["fields"].tolist(), values, strict=True))
                assert 2**26 + row in fields["id"], (z, column_row, axis)
                tried += 1
    assert tried >= 4


def test_the_tag_of_a_tile_changes_when_a_point_is_suspended_and_is_not_that_of_other_viewers(
    get, bearer, connection
):
    points, blocks = (TILES.format(name, 8, *tile_of(5.25, 43.25, 8)) for name in ("points", "blocks"))
    before = get(points).headers["etag"]
    suspend_point(connection, 2**26 + 3, "a house was built")
    connection.commit()
    assert get(points).headers["etag"] != before
    of_administrators = bearer("admin").get(blocks).headers["etag"]
    assert of_administrators != get(blocks).headers["etag"]


def test_a_tile_that_has_not_changed_is_not_sent_again(made, client, bearer, connection):
    caller = bearer("read")
    path = TILES.format("points", 8, *tile_of(5.25, 43.25, 8))
    first = caller.get(path)
    again = client.get(path, headers={**caller, "If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    lifecycle.withdraw_block(connection, "calanques")
    connection.commit()
    after = client.get(path, headers={**caller, "If-None-Match": first.headers["etag"]})
    assert (after.status_code, after.content) == (200, b"")


def test_tilesets_are_described_and_tiles_outside_the_grid_are_not_found(get):
    listed = get("/collections/points/tiles").json()["tilesets"]
    assert [one["dataType"] for one in listed] == ["vector"]
    one = get("/collections/points/tiles/WebMercatorQuad").json()
    assert one["layers"][0]["id"] == "points"
    grid = get("/tileMatrixSets/WebMercatorQuad").json()
    assert grid["tileMatrices"][0]["cellSize"] == pytest.approx(156543.03392804097)
    for path in (
        TILES.format("points", 8, 256, 0),
        TILES.format("points", 25, 0, 0),
        TILES.format("points", 0, 0, 0).replace("Web", "World"),
    ):
        assert get(path).status_code == 404, path


def test_html_pages_escape_text(get, connection):
    run_sql(connection, "update block set title = '<script>alert(1)</script>'")
    connection.commit()
    page = get("/collections/blocks/items", f="html").text
    assert "&lt;script&gt;" in page
    assert "<script>" not in page
    assert json.loads(get("/collections/blocks/items").text)["features"][0]["properties"]["title"]
    assert (
        io.StringIO(get("/collections/blocks/items", f="csv").text).readline().startswith("number,wkt")
    )
