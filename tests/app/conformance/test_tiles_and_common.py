"""OGC API - Tiles - Part 1 (OGC 20-057) and Common - Part 1 (OGC 19-072), by requirement."""

import numpy as np
import pytest
from pyogrio.raw import read as read_features

REL = "http://www.opengis.net/def/rel/ogc/1.0"
MVT = "application/vnd.mapbox-vector-tile"
TILED = ("points", "density", "blocks")


def links(document, rel):
    return [link for link in document["links"] if link["rel"] == rel]


def tile_of(lon, lat, z):
    """Row and column of the tile of a place."""
    x = (lon + 180.0) / 360.0
    y = (1.0 - np.arcsinh(np.tan(np.radians(lat))) / np.pi) / 2.0
    return int(y * 2**z), int(x * 2**z)


def test_tiles_core_a_tile_is_at_its_template_and_there_is_none_beyond_the_grid(get, made):
    tileset = get("/collections/points/tiles/WebMercatorQuad").json()
    template = links(tileset, "item")[0]
    assert template["templated"]
    row, column = tile_of(5.25, 43.25, 10)

    def tile(z, y, x):
        path = template["href"]
        for name, value in (("tileMatrix", z), ("tileRow", y), ("tileCol", x)):
            path = path.replace(f"{{{name}}}", str(value))
        return get(path)

    assert tile(10, row, column).status_code == 200
    assert tile(10, 2**10, column).status_code == 404
    assert tile(10, row, 2**10).status_code == 404
    assert tile(25, 0, 0).status_code == 404
    assert tile("ten", 0, 0).status_code in (400, 404, 422)


@pytest.mark.parametrize("name", TILED)
def test_tiles_tileset_describes_its_layer_and_its_grid(get, name):
    tileset = get(f"/collections/{name}/tiles/WebMercatorQuad").json()
    assert tileset["dataType"] == "vector"
    assert tileset["crs"].endswith("EPSG/0/3857")
    grid = get(links(tileset, f"{REL}/tiling-scheme")[0]["href"]).json()
    assert grid["uri"] == tileset["tileMatrixSetURI"]
    assert [matrix["id"] for matrix in grid["tileMatrices"]] == [str(z) for z in range(25)]
    for finer, coarser in zip(grid["tileMatrices"][1:], grid["tileMatrices"], strict=False):
        assert finer["cellSize"] == coarser["cellSize"] / 2
    assert grid in [
        get(link["href"]).json()
        for one in get("/tileMatrixSets").json()["tileMatrixSets"]
        for link in one["links"]
    ]


@pytest.mark.parametrize("name", TILED)
def test_tiles_tilesets_list_and_geodata_tilesets_lead_from_the_collection_to_its_tiles(get, name):
    collection = get(f"/collections/{name}").json()
    listed = get(links(collection, f"{REL}/tilesets-vector")[0]["href"]).json()["tilesets"]
    for one in listed:
        assert {"dataType", "crs", "links"} <= set(one)
        assert get(links(one, "self")[0]["href"]).json()["dataType"] == one["dataType"]
        assert get(links(one, f"{REL}/geodata")[0]["href"]).json()["id"] == name
    assert get("/collections/point-history/tiles").status_code == 404


@pytest.mark.parametrize("name", TILED)
def test_tiles_mvt_has_a_layer_of_the_collection(get, made, tmp_path, name):
    row, column = tile_of(5.25, 43.25, 9)
    reply = get(f"/collections/{name}/tiles/WebMercatorQuad/9/{row}/{column}")
    assert reply.headers["content-type"] == MVT
    path = tmp_path / "tile.mvt"
    path.write_bytes(reply.content)
    assert len(read_features(path, layer=name)[2]) > 0


def test_common_landing_page_links_to_the_api_the_conformance_classes_and_the_data(get):
    page = get("/").json()
    assert {"title", "description", "links"} <= set(page)
    for rel in ("service-desc", "service-doc", f"{REL}/conformance", f"{REL}/data"):
        link = links(page, rel)
        assert link, rel
        reply = get(link[0]["href"])
        assert reply.status_code == 200
        assert reply.headers["content-type"].split(";")[0] == link[0]["type"].split(";")[0]


DOCUMENTS = ("/", "/conformance", "/collections", "/collections/points")


@pytest.mark.parametrize("path", DOCUMENTS)
def test_common_json_and_html_are_chosen_by_accept_and_link_to_each_other(get, path):
    document = get(path, accept="application/json")
    assert document.headers["content-type"] == "application/json"
    page = get(path, accept="text/html")
    assert page.headers["content-type"].startswith("text/html")
    assert page.text.startswith("<!doctype html>")
    alternate = links(document.json(), "alternate") if path != "/conformance" else []
    for link in alternate:
        assert get(link["href"]).headers["content-type"].startswith(link["type"])
