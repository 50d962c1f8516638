"""A store of 67 million points as the benchmarks lay it out, and one of as many, but small, blocks."""

import numpy as np
import pytest
from psycopg.conninfo import make_conninfo

from amers.app.db.cluster.embedded import SUPERUSER
from benchmarks._filled import ROW_BLOCKS, fill, lay_out
from tests.app.served import serve_block
from tests.factories import make_block

POINTS, BLOCK_POINTS, FOOTPRINT_POINTS = 70_000, 1_000, 100
ITEMS = "/collections/points/items"
a_nanodegree = 1e-9


def test_67_million_points_lie_on_the_earth_and_their_blocks_beside_each_other():
    ground = lay_out(67_000_000)

    low, high = ground.west_south_deg, ground.west_south_deg + ground.side_deg
    assert (low >= [-180.0, -90.0]).all()
    assert (high <= [180.0, 90.0]).all()
    overlap = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    assert np.array_equal((overlap > a_nanodegree).all(axis=2), np.eye(67, dtype=bool))


def test_points_that_would_leave_the_earth_are_refused():
    with pytest.raises(ValueError, match="leave the Earth"):
        lay_out(500_000_000)


@pytest.mark.thorough
def test_seventy_blocks_are_served_as_one_is(dsn, connection, storage, bearer, tmp_path):
    # The filling switches triggers off, which only a superuser may.
    ground = fill(make_conninfo(dsn, user=SUPERUSER), POINTS, block_points=BLOCK_POINTS)
    chips = make_block(tmp_path / "block", count=10, name="chips", box=(5.0, 80.0, 5.4, 80.08))
    serve_block(connection, storage, chips.folder)
    connection.commit()
    caller, rng = bearer("read"), np.random.default_rng(1)

    def get(path):
        reply = caller.get(path)
        assert reply.status_code == 200, reply.text
        return reply

    assert len(ground.west_south_deg) == POINTS // BLOCK_POINTS > 3 * ROW_BLOCKS
    counts = []
    for _ in range(20):
        box = ",".join(repr(side) for side in ground.box(rng, FOOTPRINT_POINTS))
        counts.append(len(get(f"{ITEMS}?bbox={box}&limit=1000").json()["features"]))
    assert np.mean(counts) == pytest.approx(FOOTPRINT_POINTS, rel=0.15)
    ids = {ground.point_id(rng) for _ in range(20)}
    assert {get(f"{ITEMS}/{number}").json()["id"] for number in ids} == ids
    assert get("/collections/points/tiles/WebMercatorQuad/8/93/4").content
    page = get(f"{ITEMS}?limit=10000").json()
    assert page["numberMatched"] == pytest.approx(POINTS + 10, rel=0.05)
    assert len({feature["id"] for feature in page["features"]}) == 10_000
