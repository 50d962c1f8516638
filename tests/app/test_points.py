"""Control points over HTTP and by command."""

import csv
import io
import json
import re
from html import unescape

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import Transformer
from rasterio.io import MemoryFile
from typer.testing import CliRunner

from amers.app.cli.main import app as commands
from amers.app.db.features import counts
from amers.app.db.features import pages as features
from amers.app.db.features.collection import Viewer
from amers.app.db.features.counts import Count
from amers.app.db.features.query import Selection
from amers.app.db.points import POINTS, points_of_block
from amers.app.errors import InputError
from amers.app.usecases import history
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.features import items, points
from amers.app.usecases.features import query as queries
from amers.app.usecases.features.items import COLLECTIONS, everything_in
from amers.app.usecases.features.query import FeatureQuery, condition_of
from amers.services.geodesy import east_north_up
from tests.app.served import serve_block
from tests.factories import make_block
from tests.statements import run_sql

ITEMS = "/collections/points/items"
a_tenth_of_a_millimetre_deg = 1e-9
a_millimetre = 1e-3
a_step_of_the_planner = 0.02


@pytest.fixture
def made(connection, storage, tmp_path):
    """A published block of 60 points; a staged one of 10 lies in the same place."""
    made = make_block(tmp_path / "block", count=60)
    serve_block(connection, storage, made.folder)
    lifecycle.ingest_block(
        connection, storage, make_block(tmp_path / "b", count=10, seed=5, name="staged").folder
    )
    connection.commit()
    return made


@pytest.fixture
def get(client, bearer):
    """GET with scope `read`; returns the reply."""
    caller = bearer("read")
    return lambda path: caller.get(path)


def test_points_of_a_box_are_a_valid_feature_collection(made, get):
    reply = get(f"{ITEMS}?bbox=5.2,43.2,5.25,43.3")

    assert reply.status_code == 200
    assert reply.headers["content-type"] == "application/geo+json"
    page = reply.json()
    lon = made.points.lon_lat_h[:, 0]
    expected = np.flatnonzero(lon <= 5.25)
    assert [feature["id"] for feature in page["features"]] == (2**26 + expected).tolist()
    assert page["numberReturned"] == page["numberMatched"] == len(expected)
    assert page["amers:numberMatchedIsExact"] is True
    coordinates = [feature["geometry"]["coordinates"] for feature in page["features"]]
    assert_allclose(coordinates, made.points.lon_lat_h[expected], atol=a_tenth_of_a_millimetre_deg)
    properties = page["features"][0]["properties"]
    sigma_m = np.sqrt(made.points.covariance_m2[expected[0], 2, 2])
    assert properties["sigma_up_m"] == pytest.approx(sigma_m, rel=1e-6)
    assert properties["first_view"] == "2023-03-01"
    kinds = {feature["properties"]["typology"] for feature in page["features"]}
    assert kinds == {"crossroads", "building corner", 'a "rare" kind', None}


@pytest.mark.parametrize("largest_text", [2_000, 5], ids=["one text", "streamed"])
def test_pages_follow_each_other_without_gap_or_repetition(made, get, monkeypatch, largest_text):
    """A page is one text, or streamed seven points at once; one that ends with them is the last."""
    monkeypatch.setattr(items, "LARGEST_TEXT", largest_text)
    monkeypatch.setattr(features, "ROWS_AT_ONCE", 7)
    whole = "bbox=5,43,6,44&limit=60"
    for query, expected in (
        ("limit=17", 4),
        ("limit=14", 5),
        ("limit=20", 3),
        (whole, 1),
        ("limit=60", 1),
    ):
        seen, url, pages = [], f"{ITEMS}?{query}", 0
        while url:
            page = get(url).json()
            seen += [feature["id"] for feature in page["features"]]
            url = next((link["href"] for link in page["links"] if link["rel"] == "next"), None)
            pages += 1
            assert page["numberMatched"] == 60
        assert pages == expected
        assert seen == (2**26 + np.arange(60)).tolist()


@pytest.mark.parametrize("limit", [1, 6, 7, 8, 16, 17])
def test_pages_go_on_from_block_to_block_without_those_between(connection, storage, tmp_path, limit):
    """Of blocks of seven, four, nine and three points the second and the last one are not published."""
    expected, counts = list[int](), {"a": 7, "b": 4, "c": 9, "d": 3}
    for seed, (name, count) in enumerate(counts.items()):
        folder = make_block(tmp_path / name, count=count, seed=seed, name=name).folder
        number = lifecycle.ingest_block(connection, storage, folder).block.number
        if name in "ac":
            lifecycle.publish_block(connection, name)
            expected += range(number << 26, (number << 26) + count)
    selection, after, seen = everything_in(POINTS, None), None, []
    while True:
        page = features.page(connection, selection, "geojson", after, limit)
        found = [feature["id"] for feature in json.loads(f"[{page.body.decode()}]")]
        assert len(found) == page.returned <= limit
        seen += found
        after = page.last
        if after is None:
            break
    assert seen == expected


def test_the_points_of_a_block_are_its_own_in_any_state(connection, storage, tmp_path):
    """Staged, published and withdrawn; a suspended point is one of them."""
    counts = {"a": 7, "b": 4, "c": 9}
    numbers = {}
    for seed, (name, count) in enumerate(counts.items()):
        folder = make_block(tmp_path / name, count=count, seed=seed, name=name).folder
        numbers[name] = lifecycle.ingest_block(connection, storage, folder).block.number
    history.suspend_point(connection, (numbers["b"] << 26) + 2, "a house was built")
    for name in counts:
        for step in (lifecycle.find_block, lifecycle.publish_block, lifecycle.withdraw_block):
            step(connection, name)
            for other, count in counts.items():
                stored = points_of_block(connection, numbers[other])
                first = numbers[other] << 26
                assert stored.points.id.tolist() == list(range(first, first + count))
                assert [block.id for block in stored.blocks] == [other]


UNITS = {"m": "m", "px": "px", "deg": "deg", "km2": "km2"}


@pytest.mark.parametrize("collection", ["points", "blocks", "density", "point-history"])
def test_a_property_has_the_unit_that_its_name_ends_with_and_no_other(collection):
    for name, item in COLLECTIONS[collection].queryables.items():
        *_, last = name.split("_")
        expected = f"1/{last}" if "_per_" in name else UNITS.get(last, "")
        assert item.unit == expected, name


def test_a_limit_above_the_largest_gives_the_largest(made, get, monkeypatch):
    monkeypatch.setattr(queries, "MOST_FEATURES", 40)
    returned = [get(f"{ITEMS}?limit={limit}").json()["numberReturned"] for limit in (39, 40, 41, 10**6)]
    assert returned == [39, 40, 40, 40]


def test_a_limit_that_is_no_positive_number_is_refused(made, get):
    for limit in ["0", "-1", "many"]:
        reply = get(f"{ITEMS}?limit={limit}")
        assert reply.status_code == 400, limit
        assert "limit" in reply.json()["detail"], limit


def test_a_wrong_box_is_refused_naming_the_value(made, get):
    for bbox, named in [
        ("1,2,3", "'1,2,3'"),
        ("1,2,3,4,5", "'1,2,3,4,5'"),
        ("a,2,3,4", "'a,2,3,4'"),
        ("nan,2,3,4", "nan"),
        ("1,2,inf,4", "inf"),
        ("-181,0,3,4", "west -181"),
        ("1,2,180.5,4", "east 180.5"),
        ("1,-91,3,4", "south -91"),
        ("1,2,3,90.1", "north 90.1"),
        ("1,5,3,4", "south 5 is above north 4"),
        ("", "''"),
    ]:
        reply = get(f"{ITEMS}?bbox={bbox}")
        assert reply.status_code == 400, bbox
        assert reply.headers["content-type"] == "application/problem+json", bbox
        assert named in reply.json()["detail"], bbox


def test_a_box_across_the_antimeridian_has_both_sides_and_nothing_between(
    connection, storage, tmp_path, get
):
    made = make_block(tmp_path / "far", count=50, box=(179.9, -17.0, -179.9, -16.9))
    near = make_block(tmp_path / "near", count=9, name="near")
    for block in (made, near):
        serve_block(connection, storage, block.folder)
    connection.commit()
    page = get(f"{ITEMS}?bbox=179.95,-17,-179.95,-16.9").json()
    lon = made.points.lon_lat_h[:, 0]
    assert 0 < page["numberReturned"] == (np.abs(lon) >= 179.95).sum() < 50
    assert get(f"{ITEMS}?bbox=179.9,-20,-179.9,-10").json()["numberReturned"] == 50
    assert get(f"{ITEMS}?bbox=-179.9,-20,179.9,-10").json()["numberReturned"] == 0


def test_a_page_token_that_the_service_did_not_issue_is_refused(made, get):
    for page_token in ["", "x", "AAAA", "a" * 32, "é" * 8, "AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"]:
        reply = get(f"{ITEMS}?token={page_token}")
        assert reply.status_code == 400, page_token
        assert "token" in reply.json()["detail"], page_token


def test_a_page_token_of_another_query_is_refused(made, get):
    page = get(f"{ITEMS}?bbox=5,43,6,44&limit=10").json()
    link = next(link["href"] for link in page["links"] if link["rel"] == "next")
    assert get(link).status_code == 200
    for other in (link.replace("44", "45"), link.replace("bbox=5%2C43%2C6%2C44&", "")):
        assert other != link
        reply = get(other)
        assert reply.status_code == 400
        assert "does not belong to this query" in reply.json()["detail"]


def test_as_many_points_as_are_counted_exactly_are_and_of_one_more_the_number_is_estimated(
    made, get, monkeypatch
):
    monkeypatch.setattr(counts, "EXACT_COUNT", 40)
    pages = [get(f"{ITEMS}?limit=1&filter=id < {2**26 + number}").json() for number in (39, 40, 41)]
    assert [page["numberMatched"] for page in pages[:2]] == [39, 40]
    assert [page["amers:numberMatchedIsExact"] for page in pages] == [True, True, False]


@pytest.mark.thorough
def test_the_number_of_points_is_exact_to_ten_thousand_and_estimated_beyond(
    connection, storage, tmp_path
):
    # Over 16 cells of the density; another block is not published.
    many = make_block(
        tmp_path / "many",
        count=12_500,
        box=(5.0, 43.0, 5.4, 43.4),
        n_images=2,
        gsds_m=(2.0,),
        dtype=np.uint8,
    )
    serve_block(connection, storage, many.folder)
    hidden = make_block(tmp_path / "hidden", count=3_000, n_images=2, gsds_m=(2.0,), name="hidden")
    lifecycle.ingest_block(connection, storage, hidden.folder)
    run_sql(connection, "analyze point")
    lon = many.points.lon_lat_h[:, 0]
    ordered = np.sort(lon)
    middle = (ordered[9_999] + ordered[10_000]) / 2

    def count(bbox):
        return counts.count(connection, everything_in(POINTS, bbox))

    assert count(f"4,42,{middle},44") == Count(10_000, exact=True)
    assert count(None) == Count(12_500, exact=True)
    # Points of cells inside the box are counted exactly.
    assert count("4,42,6,44") == Count(12_500, exact=False)
    assert count("170,42,5.4,44") == Count(12_500, exact=False)
    # Of a cell that the box cuts at 5.36, points are estimated by the share of its area inside.
    estimate, true = count("4,42,5.36,44"), (lon <= 5.36).sum()
    assert not estimate.exact
    assert 10_000 < true != estimate.number
    assert abs(estimate.number - true) <= (lon > 5.3).sum()

    query = FeatureQuery(bbox="4,42,6,44", filter="saliency > 0.1 and n_views = 2")
    condition = condition_of(POINTS, query)
    estimate = counts.count(connection, Selection(POINTS, Viewer(), POINTS.storage_crs, (), condition))
    true = (many.points.saliency > 0.1).sum()
    assert not estimate.exact
    assert true > 10_000
    # The statistics of the planner are of all points, served or not, in a hundred steps.
    assert estimate.number == pytest.approx(true, rel=a_step_of_the_planner)


@pytest.mark.parametrize("link", [" + ", " % "])
def test_a_filter_of_operators_too_deep_in_each_other_is_refused(made, get, link):
    within = f"{ITEMS}?filter=saliency > {link.join(['saliency'] * 31)}"
    assert get(within.replace("+", "%2B").replace(" % ", " %25 ")).status_code == 200
    beyond = f"{ITEMS}?filter=saliency > {link.join(['saliency'] * 40)}"
    reply = get(beyond.replace("+", "%2B").replace(" % ", " %25 "))
    assert reply.status_code == 400
    assert "after 32 operators" in reply.json()["detail"]


def test_one_point_comes_with_its_views_and_their_images(made, get):
    reply = get(f"{ITEMS}/{2**26 + 7}")
    feature = reply.json()
    assert reply.headers["content-type"] == "application/geo+json"
    assert_allclose(feature["geometry"]["coordinates"], made.points.lon_lat_h[7], rtol=0)
    assert feature["properties"]["block"] == "calanques"
    views = feature["properties"]["views"]
    assert [view["gsd_m"] for view in views] == [0.5] * 3 + [2.0] * 3
    assert [view["image_id"] for view in views] == ["IMG_00", "IMG_01", "IMG_02"] * 2
    assert views[0]["acquired_at"].startswith("2023-03-01T10:30:00")
    assert views[2]["acquired_at"] is None
    assert views[2]["sun_elevation_deg"] is None
    assert "chip_key" not in feature["properties"]


def test_a_point_that_is_not_there_or_not_published_is_not_found(made, get):
    for point_id in [0, 2**26 + 60, 2 * 2**26, -1, 2**63, 10**30]:
        for path in ("", "/chips", "/chips/0"):
            assert get(f"{ITEMS}/{point_id}{path}").status_code == 404, point_id


def test_chips_as_npz_are_the_raw_values_with_their_metadata(made, get):
    with np.load(io.BytesIO(get(f"{ITEMS}/{2**26 + 7}/chips").content), allow_pickle=False) as archive:
        assert (archive["chips"] == made.chips(7)).all()
        assert archive["gsd_m"].tolist() == [0.5] * 3 + [2.0] * 3
        assert archive["image_id"].tolist() == ["IMG_00", "IMG_01", "IMG_02"] * 2
        assert archive["acquired_at"][0] == np.datetime64("2023-03-01T10:30:00")
        assert np.isnat(archive["acquired_at"][2])
        assert_allclose(archive["lon_lat_h"], made.points.lon_lat_h[7], rtol=0)


def test_a_chip_as_png_is_the_same_picture_stretched_to_8_bits(made, get):
    reply = get(f"{ITEMS}/{2**26 + 7}/chips/4")
    assert reply.headers["content-type"] == "image/png"
    picture = cv2.imdecode(np.frombuffer(reply.content, np.uint8), cv2.IMREAD_UNCHANGED)
    raw = made.chips(7)[4].astype(float)
    assert picture.shape == (101, 101)
    assert np.corrcoef(picture.ravel(), raw.ravel())[0, 1] > 0.999
    assert (picture.min(), picture.max()) == (1, 255)


def test_all_chips_as_png_are_one_sheet_with_a_row_for_each_ground_sampling(made, get):
    reply = get(f"{ITEMS}/{2**26 + 7}/chips?f=png")
    sheet = cv2.imdecode(np.frombuffer(reply.content, np.uint8), cv2.IMREAD_UNCHANGED)
    one = get(f"{ITEMS}/{2**26 + 7}/chips/4?f=png").content
    picture = cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_UNCHANGED)
    assert sheet.shape == (202, 303)
    assert (sheet[101:, 101:202] == picture).all()


def test_a_chip_as_geotiff_lies_where_the_conventions_put_its_pixels(made, get):
    point = made.points.lon_lat_h[7]
    reply = get(f"{ITEMS}/{2**26 + 7}/chips/4?f=tif")
    assert reply.headers["content-type"].startswith("image/tiff")
    with MemoryFile(reply.content) as memory, memory.open() as file:
        assert (file.read(1) == made.chips(7)[4]).all()
        assert file.nodata == 0
        to_lon_lat = Transformer.from_crs(file.crs, "EPSG:4326", always_xy=True)
        for row, column in ((50, 50), (0, 0), (100, 20)):
            lon, lat = to_lon_lat.transform(*file.xy(row, column))
            enu = east_north_up(np.array([[lon, lat, point[2]]]), point)[0]
            assert_allclose(enu[:2], [(column - 50) * 2.0, (50 - row) * 2.0], atol=a_millimetre)


def test_an_unknown_view_and_an_unknown_format_are_refused(made, get):
    reply = get(f"{ITEMS}/{2**26 + 7}/chips/6")
    assert reply.status_code == 404
    assert "0 to 5" in reply.json()["detail"]
    assert get(f"{ITEMS}/{2**26 + 7}/chips/-1").status_code == 404
    assert get(f"{ITEMS}/{2**26 + 7}/chips?f=gif").status_code == 400
    assert get(f"{ITEMS}/{2**26 + 7}/chips/0?f=gif").status_code == 400


def test_the_collections_say_what_they_hold_and_where(made, get):
    listed = get("/collections").json()["collections"]
    assert [collection["id"] for collection in listed] == [
        "points",
        "blocks",
        "density",
        "point-history",
    ]
    for collection in listed:
        assert_allclose(collection["extent"]["spatial"]["bbox"], [[5.2, 43.2, 5.3, 43.3]])
        for link in collection["links"]:
            assert get(link["href"]).status_code == 200
    assert get("/collections/roads").status_code == 404


def test_points_come_in_the_format_that_the_caller_likes_best(client, bearer):
    for accept, kind in [
        ("", "application/geo+json"),
        ("image/png", "application/geo+json"),
        ("text/csv", "text/csv"),
        ("text/csv, application/geo+json", "text/csv"),
        ("text/csv;q=0.5, application/geo+json;q=0.9", "application/geo+json"),
        ("application/geo+json;q=0.1, text/csv;q=0.2", "text/csv"),
        ("text/csv;q=0, */*", "application/geo+json"),
        ("text/csv;q=many", "application/geo+json"),
    ]:
        headers = bearer("read") | {"Accept": accept}
        reply = client.get("/collections/points/items", headers=headers)
        assert reply.headers["content-type"].partition(";")[0] == kind, accept


def test_collections_of_an_empty_store_state_the_whole_world_since_stac_asks_for_an_extent(get):
    extent = get("/collections/points").json()["extent"]
    assert extent["spatial"]["bbox"] == [[-180, -90, 180, 90]]
    empty = get(ITEMS).json()
    assert (empty["features"], empty["numberMatched"], empty["numberReturned"]) == ([], 0, 0)


@pytest.fixture
def run(settings, monkeypatch, made):
    """Runs `amers points query` on the test's database; returns its output."""
    monkeypatch.setenv("AMERS_DATABASE_URL", settings.database_url.get_secret_value())
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))

    def run(*arguments: str) -> str:
        result = CliRunner().invoke(commands, ["points", "query", *arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.stdout

    return run


def test_the_command_writes_geojson_or_csv_to_a_file_or_standard_output(
    run, made, tmp_path, monkeypatch
):
    monkeypatch.setattr(features, "ROWS_AT_ONCE", 7)
    monkeypatch.setattr(points, "MOST_FEATURES", 7)
    collection = json.loads(run("--bbox", "5,43,6,44"))
    assert len(collection["features"]) == 60
    file = tmp_path / "points.geojson"
    run("--bbox", "5,43,6,44", "-o", str(file))
    assert json.loads(file.read_text()) == collection

    rows = list(csv.DictReader(io.StringIO(run("--bbox", "5,43,6,44", "--format", "csv"))))
    assert [int(row["id"]) for row in rows] == [feature["id"] for feature in collection["features"]]
    lon_lat_h = [[float(row[name]) for name in ("lon_deg", "lat_deg", "height_m")] for row in rows]
    assert_allclose(lon_lat_h, made.points.lon_lat_h, rtol=0)
    assert {row["block_number"] for row in rows} == {"1"}


def test_the_command_reports_the_number_of_points_as_json(run):
    assert json.loads(run("--bbox", "5,43,6,44", "--json")) == {
        "points": 60,
        "exact": True,
        "file": None,
    }


def test_the_command_on_an_empty_box_writes_an_empty_collection(run):
    assert json.loads(run("--bbox", "0,0,1,1"))["features"] == []
    assert run("--bbox", "0,0,1,1", "--format", "csv").startswith("id,lon_deg")


def test_the_command_refuses_a_wrong_box_and_names_it(run):
    result = CliRunner().invoke(commands, ["points", "query", "--bbox", "1,2,3"])
    assert isinstance(result.exception, InputError)
    assert "'1,2,3'" in str(result.exception)


def test_the_page_of_a_point_shows_place_accuracy_and_chips(made, get):
    point = get(f"{ITEMS}?limit=1").json()["features"][0]
    item = get(f"{ITEMS}/{point['id']}").json()
    page = get(f"{ITEMS}/{point['id']}?f=html").text

    lon, lat, height_m = item["geometry"]["coordinates"]
    for place in (f"{lat:.8f}° N", f"{lon:.8f}° E", f"{height_m:.2f} m above"):
        assert place in page
    for against in ("relative_to_control_points", "on_the_earth"):
        assert item["properties"][against]["words"] in unescape(page)
    pictures = re.findall(r'<img src="([^"]*)"', page)
    assert len(pictures) == len(item["properties"]["views"]) > 0
    for picture in pictures:
        assert get(picture).headers["content-type"] == "image/png"
    assert "no scene has tried it yet" in page
