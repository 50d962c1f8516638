"""Catalogues as folders, files, links and search APIs; items with fields that are missing or wrong."""

import json
import threading
from contextlib import suppress
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from amers.services.errors import FormatError
from amers.services.formats.stac.catalogue import parse_mask, read_catalogue
from amers.services.formats.stac.items import parse_item
from amers.services.formats.stac.scenes import read_item_scene
from tests.services.formats.statements.catalogue_cells import written_item

SQUARE = {"type": "Polygon", "coordinates": [[[10, 0], [11, 0], [11, 1], [10, 1], [10, 0]]]}


def item(name="a", *, geometry=SQUARE, assets=None, **properties):
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "id": name,
        "geometry": geometry,
        "properties": {"datetime": "2024-05-01T10:00:00Z", **properties},
        "assets": assets or {},
        "links": [],
    }


def write(path, document):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return str(path)


def collection(*items):
    return {"type": "FeatureCollection", "features": list(items)}


def mask_asset(href, role="cloud", kind="application/geo+json"):
    return {"clouds": {"href": href, "type": kind, "roles": [role]}}


def names(read):
    return read.images.id.tolist()


# One item


def test_an_item_with_geometry_and_time_only_is_enough_and_the_rest_unknown():
    image = parse_item(item(), "x")
    assert image.acquired == datetime(2024, 5, 1, 10, tzinfo=UTC)
    numbers = [image.cloud_percent, image.snow_percent, image.incidence_deg, image.azimuth_deg]
    assert np.isnan([*numbers, image.sun_elevation_deg, image.sun_azimuth_deg]).all()
    assert (image.platform, image.orbit, image.masks) == ("", -1, ())


def test_all_fields_of_an_item_are_read():
    image = parse_item(
        item(
            platform="spot-7",
            **{
                "eo:cloud_cover": 12.5,
                "eo:snow_cover": 0,
                "view:incidence_angle": 21.0,
                "view:azimuth": 260.0,
                "view:sun_elevation": 48.0,
                "view:sun_azimuth": 130.0,
                "sat:absolute_orbit": 4711,
            },
        ),
        "x",
    )
    assert (image.cloud_percent, image.snow_percent, image.incidence_deg) == (12.5, 0.0, 21.0)
    assert image.azimuth_deg == pytest.approx(80.0)
    assert (image.sun_elevation_deg, image.sun_azimuth_deg) == (48.0, 130.0)
    assert (image.platform, image.orbit) == ("spot-7", 4711)


def test_the_azimuth_of_stac_starts_below_the_satellite():
    """A satellite west of the scene sees it eastwards (90); the scene sees the satellite at 270."""
    assert parse_item(item(**{"view:azimuth": 90.0}), "x").azimuth_deg == pytest.approx(270.0)


def test_the_angle_at_the_satellite_gives_a_larger_one_on_the_ground():
    assert parse_item(item(**{"view:off_nadir": 27.0}), "x").incidence_deg == pytest.approx(
        30.3, abs=0.1
    )


def test_a_span_of_time_gives_its_start_and_offsets_become_utc():
    span = {"datetime": None, "start_datetime": "2024-05-01T12:00:00+02:00"}
    assert parse_item(item(**span), "x").acquired == datetime(2024, 5, 1, 10, tzinfo=UTC)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"eo:cloud_cover": 140}, "eo:cloud_cover: 140 found, a number from 0 to 100 expected"),
        ({"eo:cloud_cover": "12"}, "eo:cloud_cover: '12' found, a number from 0 to 100 expected"),
        ({"eo:snow_cover": True}, "eo:snow_cover: True found"),
        ({"view:off_nadir": -3}, "view:off_nadir: -3 found, a number from 0 to 90 expected"),
        ({"sat:absolute_orbit": 1.5}, "sat:absolute_orbit: 1.5 found"),
        ({"datetime": None}, "datetime: nothing found, a time such as"),
        ({"datetime": "last May"}, "datetime: 'last May' found"),
        ({"datetime": 7}, "datetime: 7 found"),
    ],
)
def test_a_wrong_field_is_named_with_its_value_and_what_was_expected(wrong, words):
    with pytest.raises(FormatError) as refused:
        parse_item(item(**wrong), "c.json")
    assert str(refused.value).startswith("c.json: item 'a': " + words)
    assert "expected" in str(refused.value)


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        (None, "geometry: type None found, Polygon or MultiPolygon expected"),
        ({"type": "Point", "coordinates": [1, 2]}, "geometry: type 'Point' found"),
        ({"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}, "coordinates of a Polygon expected"),
        ({"type": "Polygon"}, "coordinates of a Polygon expected"),
        ({"type": "Polygon", "coordinates": []}, "a polygon with an area expected"),
        (
            {"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]},
            "Self-intersection",
        ),
        (
            {"type": "Polygon", "coordinates": [[[5e5, 4e6], [6e5, 4e6], [6e5, 5e6], [5e5, 4e6]]]},
            "position 500000, 4e+06 found, longitude and latitude in degrees expected",
        ),
    ],
)
def test_a_footprint_that_is_none_is_refused(geometry, words):
    with pytest.raises(FormatError) as refused:
        parse_item(item(geometry=geometry), "c.json")
    assert words in str(refused.value)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-400, 400) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@given(
    st.sampled_from(["id", "geometry", "properties", "assets", "type", "collection"]),
    JSON,
    st.booleans(),
)
def test_garbled_items_are_refused_or_read_but_never_crash(field, value, inside):
    garbled = item(**{"eo:cloud_cover": 3.0})
    if inside and isinstance(garbled.get(field), dict):
        for name in list(garbled[field]):
            garbled[field] = {**garbled[field], name: value}
    else:
        garbled[field] = value
    with suppress(FormatError):
        assert not shapely.is_empty(parse_item(garbled, "x").footprint)


def test_the_scene_of_an_item_has_the_accuracy_of_its_kind_and_the_name_time_and_sun_of_the_item(
    tmp_path,
):
    sun = {"view:sun_elevation": 41.0, "view:sun_azimuth": 152.0}
    one = written_item(tmp_path, lambda item: item["properties"].update(sun))
    scene = read_item_scene(one, "x", sigma_m=5.0, ortho_sigma_m=2.0)
    assert (scene.sigma_m, read_item_scene(one, "x", sigma_m=5.0).sigma_m) == (2.0, 5.0)
    taken = scene.acquisition
    assert (taken.image_id, taken.sensor) == ("one", "sentinel-2a")
    assert taken.acquired_at == datetime(2024, 5, 1, 10, tzinfo=UTC)
    assert (taken.sun_elevation_deg, taken.sun_azimuth_deg) == (41.0, 152.0)


# Masks


def test_the_masks_of_clouds_shadows_and_snow_are_merged(tmp_path):
    for name, west in (("clouds", 10.0), ("shadows", 10.1), ("snow", 10.8)):
        box = shapely.box(west, 0.0, west + 0.2, 0.5)
        feature = {"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(box)}
        write(tmp_path / "masks" / f"{name}.geojson", collection(feature))
    assets = {
        "clouds": {"href": "masks/clouds.geojson", "roles": ["cloud", "metadata"]},
        "shadows": {"href": "./masks/shadows.geojson", "roles": ["cloud-shadow"]},
        "snow": {"href": "masks/snow.geojson", "roles": ["snow-ice"], "type": "application/geo+json"},
        "raster": {"href": "masks/clouds.tif", "roles": ["cloud"], "type": "image/tiff"},
        "image": {"href": "image.tif", "roles": ["data"]},
    }
    read = read_catalogue(write(tmp_path / "one.json", item(assets=assets)))
    assert shapely.union_all(shapely.get_parts(read.images.mask[0])).area == pytest.approx(0.25)
    assert read.other_masks == 1


def test_an_empty_mask_is_known_to_hide_nothing_and_no_mask_is_unknown(tmp_path):
    write(tmp_path / "empty.geojson", collection())
    items = collection(item("a", assets=mask_asset("empty.geojson")), item("b"))
    read = read_catalogue(write(tmp_path / "items.json", items))
    assert read.images.has_mask.tolist() == [True, False]
    assert read.images.mask[0].is_empty


def test_an_item_whose_mask_cannot_be_read_is_left_out(tmp_path):
    items = collection(item("a", assets=mask_asset("lost.geojson")), item("b"))
    read = read_catalogue(write(tmp_path / "items.json", items))
    assert names(read) == ["b"]
    assert "lost.geojson" in read.problems[0]


def test_a_mask_on_another_map_is_refused():
    utm = {
        **collection(),
        "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}},
    }
    with pytest.raises(FormatError, match=r"crs: .*32633.* found, longitude and latitude"):
        parse_mask(utm, "m.geojson")
    far = shapely.geometry.mapping(shapely.box(4e5, 5e6, 5e5, 6e6))
    with pytest.raises(FormatError, match="longitude and latitude in degrees expected"):
        parse_mask(far, "m.geojson")


def test_a_mask_that_crosses_itself_hides_both_loops():
    bow = {"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]}
    assert shapely.union_all(parse_mask(bow, "m")).area == pytest.approx(0.5)


# Catalogues in files


def test_a_folder_of_items_is_read_without_its_masks_and_other_files(tmp_path):
    write(tmp_path / "b" / "two.json", item("two", assets=mask_asset("two_clouds.geojson")))
    feature = {"type": "Feature", "properties": {}, "geometry": SQUARE}
    write(tmp_path / "b" / "two_clouds.geojson", collection(feature))
    write(tmp_path / "one.geojson", collection(item("one"), item("three")))
    write(tmp_path / "package.json", {"name": "something else"})
    (tmp_path / "lines.ndjson").write_text(
        "\n".join(json.dumps(item(f"l{k}")) for k in range(3)) + "\n\n"
    )
    read = read_catalogue(str(tmp_path))
    assert sorted(names(read)) == ["l0", "l1", "l2", "one", "three", "two"]
    assert (read.bad, read.problems) == (0, ())
    assert read.images.has_mask.sum() == 1


def link(rel, href):
    return {"rel": rel, "href": href, "type": "application/json"}


def test_a_catalogue_of_links_is_followed_and_each_document_read_once(tmp_path):
    base = {"stac_version": "1.0.0", "id": "c", "description": "d"}
    root = {**base, "type": "Catalog", "links": [link("child", "./sub/collection.json")]}
    items = [link("item", "i1.json"), link("item", "../i2.json"), link("root", "../catalog.json")]
    again = [
        link("item", "i1.json"),
        link("child", "../catalog.json"),
        link("parent", "../catalog.json"),
    ]
    write(tmp_path / "catalog.json", root)
    write(tmp_path / "sub" / "collection.json", {**base, "type": "Collection", "links": items + again})
    write(tmp_path / "sub" / "i1.json", item("i1"))
    write(tmp_path / "i2.json", item("i2"))
    assert names(read_catalogue(str(tmp_path))) == ["i1", "i2"]
    assert names(read_catalogue(str(tmp_path / "catalog.json"))) == ["i1", "i2"]


def test_links_that_lead_out_of_the_files_or_nowhere_are_counted_and_not_followed(tmp_path):
    links = [link("item", "http://elsewhere.example/i.json"), link("item", "gone.json")]
    links.append(link("item", "here.json"))
    write(tmp_path / "catalog.json", {"type": "Catalog", "stac_version": "1.0.0", "links": links})
    write(tmp_path / "here.json", item("here"))
    read = read_catalogue(str(tmp_path))
    assert names(read) == ["here"]
    assert read.bad == 2
    assert "http://elsewhere.example/i.json leads away from the catalogue" in read.problems[0]


def test_a_few_bad_items_are_counted_and_the_rest_is_read(tmp_path):
    bad = [item(f"bad{k}", **{"eo:cloud_cover": 300}) for k in range(30)]
    read = read_catalogue(write(tmp_path / "c.json", collection(item("good"), *bad)))
    assert names(read) == ["good"]
    assert read.bad == 30
    assert len(read.problems) == 20
    assert "c.json: features[1]: item 'bad0': eo:cloud_cover: 300 found" in read.problems[0]


def test_a_catalogue_of_bad_items_only_fails_with_the_first_reason(tmp_path):
    path = write(tmp_path / "c.json", collection(item("a", datetime="?"), item("b", datetime="?")))
    with pytest.raises(
        FormatError, match=r"none of 2 items can be used; the first: .*item 'a': datetime"
    ):
        read_catalogue(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a JSON document"),
        ('{"type": "Feature", "id"', "expected a JSON document"),
        ("[1, 2]", "a STAC item, item collection, catalog or collection expected"),
        ('{"type": "Topology"}', "type 'Topology' found"),
        ('{"type": "FeatureCollection", "features": []}', "no STAC item found"),
        ('{"type": "FeatureCollection", "features": 7}', "features: 7 found, a list expected"),
    ],
)
def test_a_file_that_is_no_catalogue_is_refused(tmp_path, text, words):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(FormatError) as refused:
        read_catalogue(str(tmp_path / "c.json"))
    assert words in str(refused.value)


def test_a_source_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(FormatError, match="expected an existing file"):
        read_catalogue(str(tmp_path / "none.json"))


def test_an_id_that_comes_twice_counts_once_and_in_another_collection_again(tmp_path):
    other = {**item("a"), "collection": "other"}
    read = read_catalogue(write(tmp_path / "c.json", collection(item("a"), item("a"), other)))
    assert names(read) == ["a", "a"]
    assert "found twice" in read.problems[0]


def test_items_before_a_time_are_left_out(tmp_path):
    items = collection(item("new"), item("old", datetime="2009-01-01T00:00:00Z"))
    read = read_catalogue(write(tmp_path / "c.json", items), since=datetime(2020, 1, 1, tzinfo=UTC))
    assert (names(read), read.older) == (["new"], 1)


def test_the_stored_items_are_those_of_the_rows_with_absolute_addresses(tmp_path):
    assets = {"image": {"href": "images/a.tif"}, "far": {"href": "s3://bucket/a.tif"}}
    last_item = {**item("é", assets=assets), "links": None}
    items = collection(item("a", assets=assets), item("bad", datetime=""), last_item)
    read = read_catalogue(write(tmp_path / "c.json", items))
    last, first = read.items.read([1, 0])
    assert (first["id"], last["id"]) == ("a", "é")
    assert first["assets"]["image"]["href"] == str(tmp_path / "images" / "a.tif")
    assert last["assets"]["far"]["href"] == "s3://bucket/a.tif"


# Catalogues on a server


class Server(BaseHTTPRequestHandler):
    """Replies with what `pages` has for a path and its parameters; keeps what was asked."""

    pages: dict
    asked: list

    def do_GET(self):
        parts = urlsplit(self.path)
        self.reply(parts.path, {name: values[0] for name, values in parse_qs(parts.query).items()})

    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.reply(self.path, body)

    def reply(self, path, parameters):
        self.asked.append((self.command, path, parameters))
        page = self.pages.get((path, parameters.get("token")))
        if page is None or isinstance(page, str):
            self.send_response(404 if page is None else 302)
            self.send_header("Location", page or "")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        content = json.dumps(page).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_):
        """Keep quiet."""


@pytest.fixture
def server():
    handler = type("Handler", (Server,), {"pages": {}, "asked": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as service:
        threading.Thread(target=service.serve_forever, daemon=True).start()
        handler.address = f"http://127.0.0.1:{service.server_port}"
        yield handler
        service.shutdown()


BOX = (10.0, -1.0, 12.0, 2.0)


def test_keys_in_addresses_are_in_no_message(server):
    """A search with a key: a page with a broken item and a signed mask elsewhere, then no page."""
    key = "a-key-of-mine"
    signed = f"https://elsewhere.example/mask.json?sig={key}"
    server.pages["/search", None] = collection(
        item("a"), item("b", assets=mask_asset(signed)), {"type": "Feature", "id": "c"}
    )
    address = f"{server.address}/search?api_key={key}"
    read = read_catalogue(address, BOX)
    assert (names(read), read.bad) == (["a"], 2)
    assert server.asked[0][2]["api_key"] == key
    for words in read.problems:
        assert key not in words
    for path in ("none", "search?token=2&x=1"):
        with pytest.raises(FormatError) as caught:
            read_catalogue(f"{server.address}/{path}{'&' if '?' in path else '?'}api_key={key}", BOX)
        assert key not in str(caught.value)


def test_the_pages_of_a_search_are_read_to_the_end(server):
    landing = {"type": "Catalog", "links": [link("search", f"{server.address}/api/search")]}
    second = {**link("next", f"{server.address}/api/search?token=t2")}
    third = {**link("next", f"{server.address}/api/search"), "method": "POST", "body": {"token": "t3"}}
    fourth = {**third, "body": {"token": "t4"}, "merge": True}
    server.pages = {
        ("/api", None): landing,
        ("/api/search", None): {**collection(item("a")), "links": [second]},
        ("/api/search", "t2"): {**collection(item("b")), "links": [third]},
        ("/api/search", "t3"): {**collection(item("c")), "links": [fourth]},
        ("/api/search", "t4"): collection(item("d")),
    }
    since = datetime(2021, 2, 3, tzinfo=UTC)
    read = read_catalogue(f"{server.address}/api", BOX, since)
    assert names(read) == ["a", "b", "c", "d"]
    first = server.asked[1][2]
    assert first["bbox"] == "10.000000,-1.000000,12.000000,2.000000"
    assert first["datetime"] == "2021-02-03T00:00:00Z/.."
    assert [method for method, *_ in server.asked] == ["GET", "GET", "GET", "POST", "POST"]


def test_a_search_without_an_area_is_refused(server):
    with pytest.raises(FormatError, match=r"a search of all the Earth; state an area \(--area\)"):
        read_catalogue(f"{server.address}/search")
    assert server.asked == []


def test_pages_that_go_round_in_circles_are_stopped(server):
    again = link("next", f"{server.address}/search?token=t1")
    server.pages = {
        ("/search", None): {**collection(item("a")), "links": [again]},
        ("/search", "t1"): {**collection(item("b")), "links": [again]},
    }
    with pytest.raises(FormatError, match="the next page is one that was already read"):
        read_catalogue(f"{server.address}/search", BOX)


def test_a_search_does_not_lead_to_another_server(server):
    away = link("next", "http://other.example/search")
    server.pages = {("/search", None): {**collection(item("a")), "links": [away]}}
    with pytest.raises(FormatError, match="leads away from the catalogue"):
        read_catalogue(f"{server.address}/search", BOX)
    server.pages = {("/search", None): "http://other.example/search"}
    with pytest.raises(FormatError, match="leads away from the catalogue"):
        read_catalogue(f"{server.address}/search", BOX)


def test_a_linked_catalogue_and_its_masks_are_read_from_a_server(server):
    catalog = {"type": "Catalog", "stac_version": "1.0.0", "links": [link("item", "items/a.json")]}
    mask = {"type": "Feature", "properties": {}, "geometry": SQUARE}
    server.pages = {
        ("/catalog.json", None): catalog,
        ("/items/a.json", None): item("a", assets=mask_asset("a_clouds.geojson")),
        ("/items/a_clouds.geojson", None): "/moved.geojson",
        ("/moved.geojson", None): mask,
    }
    read = read_catalogue(f"{server.address}/catalog.json")
    assert names(read) == ["a"]
    assert shapely.area(read.images.mask[0]) == pytest.approx(1.0)


def test_a_server_that_does_not_answer_is_named(server):
    with pytest.raises(FormatError, match="status 404 found, 200 expected"):
        read_catalogue(f"{server.address}/nothing.json")
    with pytest.raises(FormatError, match=r"http://127\.0\.0\.1:9/c\.json: no reply"):
        read_catalogue("http://127.0.0.1:9/c.json")
