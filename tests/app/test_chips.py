"""Replies with the chips of many points."""

import io

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose, assert_array_equal

from amers.app.db import points as point_store
from amers.app.usecases.features import points
from amers.services.formats.chips import stacks
from tests.app.served import serve_block
from tests.factories import make_block

CHIPS = "/collections/points/chips"
FIRST = 2**26
in_single_precision = 1e-7


@pytest.fixture
def made(connection, storage, tmp_path):
    """A published block of 40 points with 6 chips each, of 16 bits."""
    made = make_block(tmp_path / "block", count=40)
    serve_block(connection, storage, made.folder)
    connection.commit()
    return made


@pytest.fixture
def get(made, client, bearer):
    caller = bearer("read")
    return lambda path, **parameters: caller.get(path, params=parameters or None)


def arrays(reply):
    assert reply.status_code == 200, reply.text
    assert reply.headers["content-type"] == "application/x-npz"
    with np.load(io.BytesIO(reply.content), allow_pickle=False) as archive:
        return dict(archive)


def test_chips_of_many_points_are_those_of_each_with_their_metadata(made, get):
    ids = [FIRST + 31, FIRST + 2, FIRST + 3]
    chip_arrays = arrays(get(CHIPS, ids=",".join(map(str, ids))))
    assert_array_equal(chip_arrays["point_id"], np.repeat(sorted(ids), 6))
    assert_array_equal(chip_arrays["view"], np.tile(np.arange(6), 3))
    assert chip_arrays["chips"].dtype == np.uint16
    for point in sorted(ids):
        alone = arrays(get(f"/collections/points/items/{point}/chips"))
        rows = chip_arrays["point_id"] == point
        for name, expected in alone.items():
            if name == "lon_lat_h":
                expected = np.tile(expected, (6, 1))
            if expected.dtype.kind == "f":
                assert_allclose(
                    chip_arrays[name][rows], expected, rtol=in_single_precision, err_msg=name
                )
            else:
                assert_array_equal(chip_arrays[name][rows], expected, err_msg=name)


def test_chips_of_a_footprint_are_those_of_the_points_in_it(made, get, bearer):
    lon, lat = made.points.lon_lat_h[:, 0], made.points.lon_lat_h[:, 1]
    in_box = (lon >= 5.22) & (lon <= 5.27) & (lat >= 43.21) & (lat <= 43.26)
    chips = arrays(get(CHIPS, bbox="5.22,43.21,5.27,43.26"))
    assert_array_equal(np.unique(chips["point_id"]), FIRST + np.flatnonzero(in_box))
    strong = arrays(get(CHIPS, bbox="5.22,43.21,5.27,43.26", filter="saliency > 0.5"))
    expected = in_box & (made.points.saliency > 0.5)
    assert_array_equal(np.unique(strong["point_id"]), FIRST + np.flatnonzero(expected))
    triangle = [[[5.2, 43.2], [5.3, 43.2], [5.2, 43.3], [5.2, 43.2]]]
    body = {"intersects": {"type": "Polygon", "coordinates": triangle}}
    below = arrays(bearer("read").post(CHIPS, json=body))
    expected = (lon - 5.2) + (lat - 43.2) < 0.1
    assert_array_equal(np.unique(below["point_id"]), FIRST + np.flatnonzero(expected))


def test_chips_come_as_pages_of_a_geotiff_too(get, tmp_path):
    parameters = {"ids": f"{FIRST + 2},{FIRST + 3}"}
    expected, path = arrays(get(CHIPS, **parameters)), tmp_path / "chips.tif"
    reply = get(CHIPS, f="tif", **parameters)
    assert reply.headers["content-type"] == "image/tiff; application=geotiff"
    path.write_bytes(reply.content)
    for page, chip in enumerate(expected["chips"], start=1):
        with rasterio.open(f"GTIFF_DIR:{page}:{path}") as found:
            assert_array_equal(found.read(1), chip)


def test_a_place_without_points_is_an_archive_without_chips(get):
    chip_arrays = arrays(get(CHIPS, bbox="0,0,1,1"))
    assert chip_arrays["chips"].shape == (0, 101, 101)
    assert {len(column) for column in chip_arrays.values()} == {0}


def test_chips_of_8_and_16_bits_come_together_with_their_values(
    made, get, connection, storage, tmp_path
):
    small = make_block(
        tmp_path / "small", count=5, seed=3, name="small", box=(6.2, 43.2, 6.3, 43.3), dtype=np.uint8
    )
    serve_block(connection, storage, small.folder)
    connection.commit()
    chip_arrays = arrays(get(CHIPS, ids=f"{FIRST},{2 * FIRST}"))
    assert chip_arrays["chips"].dtype == np.uint16
    for point in (FIRST, 2 * FIRST):
        alone = arrays(get(f"/collections/points/items/{point}/chips"))
        assert_array_equal(chip_arrays["chips"][chip_arrays["point_id"] == point], alone["chips"])


def test_an_archive_is_made_in_pieces_however_many_chips_it_has(made, get, monkeypatch):
    whole = get(CHIPS, bbox="5,43,6,44").content
    monkeypatch.setattr(stacks, "CHIPS_PER_PIECE", 12)
    in_pieces = arrays(get(CHIPS, bbox="5,43,6,44"))
    with np.load(io.BytesIO(whole)) as expected:
        for name, column in expected.items():
            assert_array_equal(in_pieces[name], column)


def test_a_wrong_request_for_chips_is_refused(get):
    for parameters, status, named in [
        ({}, 400, "ids"),
        ({"ids": "1,x"}, 400, "1,x"),
        ({"ids": ""}, 400, "ids"),
        ({"ids": f"{FIRST}", "bbox": "5,43,6,44"}, 400, "ids"),
        ({"ids": f"{FIRST},7,8"}, 404, "7, 8"),
        ({"ids": "9" * 19}, 404, "9" * 19),
        ({"ids": "9" * 30}, 400, "ids"),
        ({"bbox": "1,2,3"}, 400, "bbox"),
        ({"filter": "colour = 1"}, 400, "colour"),
        ({"bbox": "5,43,6,44", "f": "png"}, 400, "f"),
        ({"bbox": "0,0,1,1", "f": "tif"}, 404, "npz"),
        ({"bbox": "5,43,6,44", "limit": "3"}, 400, "limit"),
    ]:
        reply = get(CHIPS, **parameters)
        assert reply.status_code == status, parameters
        assert named in reply.json()["detail"], parameters


def test_more_points_than_are_sent_at_once_are_refused(get, monkeypatch):
    monkeypatch.setattr(points, "MOST_POINTS_WITH_CHIPS", 39)
    for parameters in (
        {"bbox": "5,43,6,44"},
        {"ids": ",".join(str(FIRST + i) for i in range(40))},
    ):
        reply = get(CHIPS, **parameters)
        assert reply.status_code == 400
        assert "39" in reply.json()["detail"]


def test_as_many_points_as_are_sent_at_once_are_sent(get, monkeypatch):
    monkeypatch.setattr(points, "MOST_POINTS_WITH_CHIPS", 40)
    ids = [FIRST + i for i in range(40)]
    for parameters in ({"bbox": "5,43,6,44"}, {"ids": ",".join(map(str, [*ids, FIRST]))}):
        assert_array_equal(np.unique(arrays(get(CHIPS, **parameters))["point_id"]), ids)


def test_of_points_that_are_missing_the_first_ten_are_named(get):
    for count, end in ((10, "10"), (11, "10 …")):
        detail = get(CHIPS, ids=",".join(map(str, [FIRST, *range(1, count + 1)]))).json()["detail"]
        assert detail.endswith(f"no point {', '.join(map(str, range(1, 10)))}, {end}")


def test_the_directions_of_views_are_those_that_the_producer_states(made, get, connection):
    """By the archive of chips, as a registration reads them, and of one point."""
    row, views = 7, made.points.views
    of_point = slice(int(views.start[row]), int(views.start[row + 1]))
    stated = np.stack([views.incidence_deg[of_point], views.azimuth_deg[of_point]])
    archive = arrays(get(CHIPS, ids=str(FIRST + row)))
    stored = point_store.points_of_ids(connection, [FIRST + row, FIRST - 1]).points.views
    one = get(f"/collections/points/items/{FIRST + row}").json()["properties"]["views"]
    for found in (
        [archive["incidence_deg"], archive["azimuth_deg"]],
        [stored.incidence_deg, stored.azimuth_deg],
        [[view["incidence_deg"] for view in one], [view["azimuth_deg"] for view in one]],
    ):
        assert_allclose(found, stated, rtol=in_single_precision)


def test_chips_are_for_those_who_may_read_points(made, client):
    assert client.get(CHIPS, params={"ids": str(FIRST)}).status_code == 401
    assert client.post(CHIPS, json={"ids": [FIRST]}).status_code == 401


def test_chips_that_are_not_where_the_store_says_are_an_error_before_the_reply_begins(
    made, get, storage
):
    for file in storage.folder.rglob("*.npy"):
        file.unlink()
    reply = get(CHIPS, ids=str(FIRST))
    assert reply.status_code == 500
    assert "missing from the storage" in reply.json()["detail"]
