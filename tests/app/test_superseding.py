"""Several blocks at one place: which point is served, independent of the order of events."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from sqlalchemy import select

from amers.app.db import engine, points, superseding
from amers.app.db.density import AREA_KM2, DENSITY, points_in_box
from amers.app.db.engine import driver
from amers.app.db.features import pages
from amers.app.db.features.bbox import Box
from amers.app.db.points import POINTS
from amers.app.db.schema import density_cell
from amers.app.db.superseding import SAME_PLACE_M, SHORTEST_DEGREE_M
from amers.app.errors import Conflict, InputError
from amers.app.usecases import history
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.listing import list_blocks
from amers.app.usecases.features.items import COLLECTIONS, everything_in
from amers.app.usecases.features.points import points_of_filter
from amers.app.usecases.features.query import FeatureQuery
from amers.services.formats.block.document import AccuracyFigure
from amers.services.formats.block.writer import write_block
from amers.services.geodesy import metres_per_degree
from amers.services.types import Array
from tests.factories import BOX, control_points, metadata, noise_chips
from tests.statements import run_sql

metre_of_latitude_deg = 1.0 / 111_000.0


def made(
    folder,
    name: str,
    lon_lat: Array,
    frame_sigma_m: float | None = None,
    version: str = "1",
    box=BOX,
    sigma_factor: float = 1.0,
):
    """A block with points at these positions."""
    contents = control_points(len(lon_lat), np.random.default_rng(5), box)
    contents = replace(
        contents,
        lon_lat_h=np.column_stack([lon_lat, contents.lon_lat_h[:, 2]]),
        covariance_m2=contents.covariance_m2 * sigma_factor**2,
    )
    block_metadata = metadata(name, version, box)
    if frame_sigma_m is not None:
        frame = AccuracyFigure("absolute", "frame_sigma_m", frame_sigma_m, 30, "survey")
        block_metadata = replace(block_metadata, accuracy=(*block_metadata.accuracy, frame))
    write_block(folder, block_metadata, contents, noise_chips(contents), {})
    return folder


@pytest.fixture
def places():
    """Positions 100 m apart from each other."""
    step = np.arange(10) * 100.0 * metre_of_latitude_deg
    grid = np.stack(np.meshgrid(5.21 + 2 * step, 43.21 + step), axis=-1).reshape(-1, 2)
    return grid[:30]


@pytest.fixture
def ingest(connection, storage, tmp_path):
    """Ingests a block with points at these positions, staged."""

    def ingest(name: str, lon_lat: Array, priority: int = 0, **changes):
        folder = made(tmp_path / f"{name}{changes.get('version', '')}", name, lon_lat, **changes)
        return lifecycle.ingest_block(connection, storage, folder, priority=priority).block.number

    return ingest


def served(connection) -> dict[str, int]:
    """How many points of each block are served."""
    rows = run_sql(
        connection,
        """select b.id || '@' || b.version as name, count(*) as n, b.n_points - b.n_unserved as told
           from point p join block b on b.number = p.block_number
           where b.state = 'published' and p.superseded_by is null group by b.number order by 1""",
    ).fetchall()
    assert all(row["n"] == row["told"] for row in rows)
    return {row["name"]: row["n"] for row in rows}


def found_by_place(connection) -> int:
    """How many points the index of places finds."""
    run_sql(connection, "set local enable_seqscan = off")
    everywhere = "st_makeenvelope(5, 43, 6, 44, 4979)"
    return run_sql(connection, f"select count(*) as n from point where geom && {everywhere}").fetchone()[
        "n"
    ]


def test_of_two_blocks_over_one_place_the_one_with_the_better_frame_is_served(
    connection, ingest, places
):
    near = places + [0.0, 5.0 * metre_of_latitude_deg]
    ingest("good", places[:20], frame_sigma_m=0.5)
    ingest("poor", near, frame_sigma_m=5.0)
    for name in ("poor", "good"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"good@1": 20, "poor@1": 10}
    named = run_sql(
        connection,
        "select count(*) as n from point l join point w on w.id = l.superseded_by"
        " where st_distancesphere(l.geom, w.geom) between 4.5 and 5.5",
    ).fetchone()
    assert named["n"] == 20


def test_points_further_apart_than_one_place_are_both_served(connection, ingest, places):
    ingest("a", places)
    ingest("b", places + [0.0, 1.1 * SAME_PLACE_M * metre_of_latitude_deg])
    ingest("c", places + [0.0, -0.9 * SAME_PLACE_M * metre_of_latitude_deg])
    for name in ("a", "b", "c"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"b@1": 30, "c@1": 30}


def test_a_priority_comes_before_every_figure_and_may_change_while_published(connection, ingest, places):
    ingest("good", places, frame_sigma_m=0.5)
    ingest("poor", places, frame_sigma_m=5.0, priority=1)
    for name in ("good", "poor"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"poor@1": 30}
    assert lifecycle.prioritise_block(connection, "good", 2).n_unserved == 0
    assert served(connection) == {"good@1": 30}
    with pytest.raises(InputError, match="priority: 1001 found"):
        lifecycle.prioritise_block(connection, "good", 1001)


def test_of_equal_frames_the_more_precise_block_is_served_and_of_equal_blocks_the_newer_one(
    connection, ingest, places
):
    for name, sigma_factor in (("fine", 0.5), ("coarse", 1.0), ("coarse too", 1.0)):
        ingest(name.replace(" ", "-"), places, sigma_factor=sigma_factor)
    for name in ("coarse", "coarse-too"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"coarse-too@1": 30}
    lifecycle.publish_block(connection, "fine")
    assert served(connection) == {"fine@1": 30}


def test_points_of_a_cell_count_in_proportion_to_the_part_of_it_in_a_box(connection, ingest, places):
    ingest("a", places)
    lifecycle.publish_block(connection, "a")
    boxes = {
        30: Box(5.2, 43.2, 5.3, 43.3),
        15: Box(5.1, 43.1, 5.25, 43.4),
        6: Box(5.22, 43.22, 5.27, 43.26),
        0: Box(5.3001, 43.2, 5.4, 43.3),
    }
    assert {number: points_in_box(connection, box) for number, box in boxes.items()} == {
        number: number for number in boxes
    }


@pytest.mark.parametrize(
    ("level", "width_deg", "south", "north"),
    [
        (0, 10.0, 39.0, 48.0),
        (0, 10.000000000000004, 38.0, 48.0),  # ten thousand to the last digit
        (1, 20.0, 34.0, 53.0),
        (2, 38.0, 23.0, 63.0),
        (3, 100.0, 13.0, 73.0),
        (4, 150.0, -40.0, 80.0),
        (5, 174.0, -90.0, 90.0),
    ],
)
def test_a_box_is_added_up_from_the_finest_cells_of_which_it_has_ten_thousand_at_most(
    connection, ingest, level, width_deg, south, north
):
    """Its edge leaves a quarter of their cell of that level aside, and cuts no finer one."""
    area_deg2, finest_deg = width_deg * (north - south), 0.1
    assert area_deg2 / (finest_deg * 2**level) ** 2 <= 10_000
    assert level == 0 or area_deg2 / (finest_deg * 2 ** (level - 1)) ** 2 > 10_000
    # Columns count from 180 degrees west: 1855 is the last of its cell at every level.
    east_deg = 1856 * finest_deg - 180.0
    box = (east_deg - finest_deg, 43.2, east_deg, 43.3)
    ingest("a", np.random.default_rng(2).uniform(box[:2], box[2:], (40, 2)), box=box)
    lifecycle.publish_block(connection, "a")
    west = east_deg - 0.75 * finest_deg * 2**level
    assert points_in_box(connection, Box(west, south, west + width_deg, north)) == 30


def test_points_on_both_sides_of_180_degrees_are_added_up_once(connection, ingest):
    box = (179.9, -17.0, -179.9, -16.9)
    ingest("a", np.array([[179.95, -16.95], [-179.95, -16.95], [-179.95, -16.96]]), box=box)
    lifecycle.publish_block(connection, "a")
    counted = {
        Box(170.0, -20.0, -170.0, -10.0): 3,
        Box(170.0, -20.0, 180.0, -10.0): 1,
        Box(-180.0, -20.0, -170.0, -10.0): 2,
        Box(-170.0, -20.0, 170.0, -10.0): 0,
        # On both sides together too many cells of a tenth of a degree.
        Box(175.0, -20.0, -175.0, 0.0): 3,
    }
    assert {one: points_in_box(connection, one) for one in counted} == counted


def test_features_have_the_geometry_that_their_collection_declares_and_cells_a_tenth_of_a_degree(
    connection, ingest, places
):
    ingest("a", places)
    lifecycle.publish_block(connection, "a")
    for name in ("points", "blocks", "density"):
        collection = COLLECTIONS[name]
        page = pages.page(connection, everything_in(collection, None), "geojson", None, 1000)
        features = json.loads(f"[{page.body.decode()}]")
        assert {one["geometry"]["type"] for one in features} == {collection.geometry_type}
    ((ring,),) = ([np.array(ring) for ring in one["geometry"]["coordinates"]] for one in features)
    np.testing.assert_allclose(np.ptp(ring, axis=0), 0.1)


def test_of_points_that_are_equally_near_the_first_one_supersedes(connection, ingest, places):
    """Wherever its row lies: the first point of the winner is written again behind the others."""
    ingest("loser", places[:3])
    winner = ingest("winner", np.repeat(places[:3], 3, axis=0), priority=1)
    stored = points.points_of_block(connection, winner).points
    first_id = dict[tuple[float, float], int]()
    for point_id, (lon, lat, _) in zip(stored.id.tolist(), stored.lon_lat_h.tolist(), strict=True):
        first_id.setdefault((lon, lat), point_id)
    for statement in (
        "create temp table moved on commit drop as select * from point where id = any(%s)",
        "delete from point where id = any(%s)",
        "insert into point select * from moved where id = any(%s)",
    ):
        run_sql(connection, statement, [[*first_id.values()]])
    for name in ("loser", "winner"):
        lifecycle.publish_block(connection, name)
    superseded = run_sql(
        connection,
        "select st_x(geom) as lon, st_y(geom) as lat, superseded_by from point"
        " where superseded_by is not null",
    ).fetchall()
    assert len(superseded) == 3
    for row in superseded:
        assert row["superseded_by"] == first_id[row["lon"], row["lat"]]


def test_a_suspended_point_is_not_counted_as_served_until_it_is_reinstated(connection, ingest, places):
    number = ingest("a", places)
    lifecycle.publish_block(connection, "a")
    box = Box(5.2, 43.2, 5.3, 43.3)
    (first, *_) = points.points_of_block(connection, number).points.id.tolist()

    def counted() -> tuple[int, int]:
        block = lifecycle.find_block(connection, "a")
        return block.n_points - block.n_unserved, points_in_box(connection, box)

    assert counted() == (30, 30)
    history.suspend_point(connection, first, "under water")
    assert counted() == (29, 29)
    history.reinstate_point(connection, first)
    assert counted() == (30, 30)


def test_nothing_is_counted_where_no_point_is_or_where_none_is_served(connection, ingest, places):
    number = ingest("a", places[:1])
    lifecycle.publish_block(connection, "a")
    (alone,) = points.points_of_block(connection, number).points.id.tolist()
    here, elsewhere = Box(5.2, 43.2, 5.3, 43.3), Box(100.0, 1.0, 101.0, 2.0)
    assert [points_in_box(connection, box) for box in (here, elsewhere)] == [1, 0]
    history.suspend_point(connection, alone, "under water")
    assert points_in_box(connection, here) == 0


def test_a_block_is_published_and_withdrawn_once(connection, ingest, places):
    ingest("a", places)
    with pytest.raises(Conflict, match="is staged"):
        lifecycle.withdraw_block(connection, "a")
    lifecycle.publish_block(connection, "a")
    with pytest.raises(Conflict, match="is published"):
        lifecycle.publish_block(connection, "a")
    lifecycle.withdraw_block(connection, "a")
    with pytest.raises(Conflict, match="is withdrawn"):
        lifecycle.withdraw_block(connection, "a")


@pytest.mark.parametrize("priority", [-1000, 1000])
def test_a_priority_has_at_most_a_thousand_steps_to_either_side(connection, ingest, places, priority):
    ingest("a", places[:1], priority=priority)
    assert lifecycle.prioritise_block(connection, "a", priority).priority == priority
    with pytest.raises(InputError, match="-1000 to 1000"):
        lifecycle.prioritise_block(connection, "a", priority + np.sign(priority))


@pytest.mark.parametrize("lat", [-80.0, 0.01, 44.0, 60.5, 72.0])
def test_one_place_is_as_long_from_west_to_east_at_every_latitude(connection, ingest, lat):
    """Cosines of degrees that are taken for radians are near one at some of them, negative at others."""
    box = (5.2, lat, 5.3, lat + 0.1)
    east_deg = 1.0 / metres_per_degree(lat, 0.0)[0]
    place = np.array([[5.25, lat + 0.05]])
    for name, east_m in (("a", 0.0), ("near", 9.5), ("far", -10.5)):
        ingest(name, place + [east_m * east_deg, 0.0], box=box)
    for name in ("a", "near", "far"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"far@1": 1, "near@1": 1}


def test_the_area_of_a_cell_is_that_inside_the_outlines_and_the_whole_one_at_most(connection, ingest):
    west, south, side = 5.2, 43.2, 0.1
    quarter = (west, south, west + side / 2, south + side / 2)
    cell = (west, south, west + side, south + side)

    def published(name: str, box: tuple[float, float, float, float]) -> float:
        centre = np.array([[(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]])
        ingest(name, centre, box=box)
        lifecycle.publish_block(connection, name)
        (area,) = connection.execute(select(AREA_KM2).where(density_cell.c.level == 0)).scalars()
        return float(area)

    metres = metres_per_degree(south + side / 2, 0.0)
    whole_km2 = float(np.prod(metres) * side**2 / 1e6)
    assert published("quarter", quarter) == pytest.approx(whole_km2 / 4, rel=0.01)
    assert published("cell", cell) == pytest.approx(whole_km2, rel=0.01)
    assert published("cell-again", cell) == pytest.approx(whole_km2, rel=0.01)


def test_a_withdrawal_gives_the_place_to_the_next_best(connection, ingest, places):
    for priority, name in enumerate(("third", "second", "first")):
        ingest(name, places, priority=priority)
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"first@1": 30}
    assert lifecycle.withdraw_block(connection, "first").n_unserved == 0
    assert served(connection) == {"second@1": 30}
    lifecycle.withdraw_block(connection, "second")
    assert served(connection) == {"third@1": 30}
    lifecycle.restore_block(connection, "first")
    assert served(connection) == {"first@1": 30}
    assert lifecycle.withdraw_block(connection, "third").n_unserved == 0


def test_what_is_served_does_not_depend_on_the_order_of_publication(connection, ingest, places):
    rng = np.random.default_rng(3)
    names = ("a", "b", "c")
    for name in names:
        jitter = rng.normal(0.0, 6.0, places.shape) * metre_of_latitude_deg
        ingest(name, places + jitter, frame_sigma_m=float(rng.uniform(0.5, 3.0)))
    served_counts = []
    for order in permutations(names):
        for name in order:
            lifecycle.publish_block(connection, name)
        rows = run_sql(connection, "select id, superseded_by from point order by id").fetchall()
        served_counts.append([tuple(row.values()) for row in rows])
        for name in order[::-1]:
            lifecycle.withdraw_block(connection, name)
        left = run_sql(connection, "select count(superseded_by) as n from point").fetchone()
        assert left["n"] == 0
    assert all(one == served_counts[0] for one in served_counts)
    assert any(superseded for _, superseded in served_counts[0])


def decided_one_by_one(connection) -> dict[int, int | None]:
    """Which point supersedes each point of published blocks: all distances, block after block."""
    rows = run_sql(
        connection,
        """select p.id, p.block_number, st_x(p.geom) as lon, st_y(p.geom) as lat, b.priority
           from point p join block b on b.number = p.block_number where b.state = 'published'""",
    ).fetchall()
    ids, blocks, priority = (
        np.array([row[n] for row in rows]) for n in ("id", "block_number", "priority")
    )
    lon, lat = (np.radians([row[n] for row in rows]) for n in ("lon", "lat"))
    decided: dict[int, int | None] = {}
    for i in range(len(rows)):
        half = np.sin((lat - lat[i]) / 2.0) ** 2
        half += np.cos(lat) * np.cos(lat[i]) * np.sin((lon - lon[i]) / 2.0) ** 2
        metres = 2.0 * 6_371_008.8 * np.arcsin(np.sqrt(half))
        others = (metres <= SAME_PLACE_M) & (priority > priority[i]) & (blocks != blocks[i])
        best = others & (priority == priority[others].max(initial=-1))
        decided[int(ids[i])] = int(ids[best][metres[best].argmin()]) if best.any() else None
    return decided


def shown_everywhere(connection) -> list[set[int]]:
    """Ids of the points that registrations, lists and filters get."""
    outline = np.array([[5.0, 43.0], [6.0, 43.0], [6.0, 44.0], [5.0, 44.0]])
    everything = everything_in(POINTS, "5,43,6,44")
    return [
        set(points.control_points(connection, outline).points.id.tolist()),
        set(points.control_points(connection, outline, limit=10_000).points.id.tolist()),
        set(pages.keys(connection, everything, 10_000)),
        set(points_of_filter(connection, FeatureQuery(bbox="5,43,6,44")).id.tolist()),
    ]


def test_every_way_to_the_points_shows_those_that_no_better_block_has(connection, ingest, places):
    """Four blocks whose points lie so close that several could win, published, withdrawn and ranked."""
    rng = np.random.default_rng(11)
    names = ("a", "b", "c", "d")
    for priority, name in enumerate(names):
        jitter = rng.uniform(-9.0, 9.0, places.shape) * metre_of_latitude_deg
        # Two points of each block at most places: the nearer one wins.
        twice = np.concatenate([places + jitter, places + jitter[::-1]])
        ingest(name, twice, priority=10 * priority)
    steps = [(lifecycle.publish_block, name) for name in ("c", "a", "d", "b")]
    steps += [(lifecycle.withdraw_block, name) for name in ("d", "b")]
    steps += [(lifecycle.publish_block, "b"), (lifecycle.publish_block, "d")]
    steps += [(lambda c, name: lifecycle.prioritise_block(c, name, 25), "a")]
    steps += [(lambda c, name: lifecycle.prioritise_block(c, name, 5), "d")]
    steps += [(lifecycle.withdraw_block, "a")]
    box, suspended = Box(5.0, 43.0, 6.0, 44.0), set()
    for number, (step, name) in enumerate(steps):
        step(connection, name)
        decided = decided_one_by_one(connection)
        rows = run_sql(
            connection,
            """select p.id, superseded_by from point p join block b on b.number = p.block_number
               where state = 'published'""",
        ).fetchall()
        assert {row["id"]: row["superseded_by"] for row in rows} == decided, (number, name)
        expected = {point for point, winner in decided.items() if winner is None}
        if number in (2, 6):
            chosen = min(expected - suspended)
            history.suspend_point(connection, chosen, "a house was built")
            suspended.add(chosen)
        expected -= suspended
        assert all(shown == expected for shown in shown_everywhere(connection)), (number, name)
        assert points_in_box(connection, box) == len(expected), (number, name)
        cells = pages.page(connection, everything_in(DENSITY, "5,43,6,44"), "geojson", None, 1000)
        counted = [one["properties"]["n_points"] for one in json.loads(f"[{cells.body.decode()}]")]
        assert sum(counted) == len(expected), (number, name)
    history.reinstate_point(connection, suspended.pop())
    assert points_in_box(connection, box) == len(shown_everywhere(connection)[0])


def test_a_new_version_takes_the_places_of_the_old_one(connection, ingest, places):
    ingest("poor", places, frame_sigma_m=5.0)
    ingest("good", places, frame_sigma_m=0.5)
    ingest("good", places[:10], frame_sigma_m=0.5, version="2")
    for name in ("poor", "good@1", "good@2"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"good@2": 10, "poor@1": 20}
    restored = lifecycle.restore_block(connection, "good@1")
    assert restored.superseded is not None
    assert restored.superseded.version == "2"
    assert served(connection) == {"good@1": 30}


def test_a_new_version_gives_up_the_places_outside_its_outline(connection, ingest, places):
    """What the version before superseded there is served again, though the new one does not reach it."""
    both = np.concatenate([places, places + [0.06, 0.0]])
    ingest("poor", both, frame_sigma_m=5.0)
    ingest("good", both, frame_sigma_m=0.5)
    ingest("good", places, frame_sigma_m=0.5, version="2", box=(BOX[0], BOX[1], 5.24, BOX[3]))
    for name in ("poor", "good@1"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"good@1": 60}
    lifecycle.publish_block(connection, "good@2")
    assert served(connection) == {"good@2": 30, "poor@1": 30}


def test_a_block_whose_frame_nobody_stated_gives_way_to_one_that_is_known(connection, ingest, places):
    ingest("known", places, frame_sigma_m=50.0)
    ingest("unknown", places)
    for name in ("known", "unknown"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"known@1": 30}


def test_points_on_both_sides_of_a_gap_between_outlines_are_one_place(connection, ingest):
    edge_deg, lat_deg = 5.25, np.array([43.22, 43.24, 43.26])
    metre_deg = 1.0 / metres_per_degree(43.24, 0.0)[0]
    for name, side, priority in (("west", -1.0, 1), ("east", 1.0, 0)):
        outline = [BOX[0], BOX[1], edge_deg - 2.0 * metre_deg, BOX[3]]
        if side > 0.0:
            outline = [edge_deg + 2.0 * metre_deg, BOX[1], BOX[2], BOX[3]]
        lon_deg = np.full(3, edge_deg + 4.0 * side * metre_deg)
        ingest(name, np.column_stack([lon_deg, lat_deg]), priority, box=tuple(outline))
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"west@1": 3}


def test_one_place_is_one_place_across_the_antimeridian(connection, ingest):
    box = (179.9, -17.0, -179.9, -16.9)
    lon_lat = np.array([[179.95, -16.95], [-179.95, -16.95]])
    ingest("a", lon_lat, box=box)
    ingest("b", lon_lat, box=box, priority=1)
    for name in ("a", "b"):
        lifecycle.publish_block(connection, name)
    assert served(connection) == {"b@1": 2}


def test_only_a_block_that_was_published_is_restored(connection, ingest, places):
    ingest("a", places)
    with pytest.raises(Conflict, match="never published"):
        lifecycle.restore_block(connection, "a")


def test_points_stay_in_the_index_that_outgrows_its_first_page(connection, ingest, places):
    for version in ("1", "2", "3"):
        ingest("a", places, version=version)
    for priority, name in enumerate(("b", "c"), start=1):
        ingest(name, places, priority=priority)
    connection.commit()
    for reference in ("a@1", "a@3", "b", "c", "a@2", "a@1", "a@3", "a@2"):
        state = lifecycle.find_block(connection, reference).state
        (lifecycle.restore_block if state == "withdrawn" else lifecycle.publish_block)(
            connection, reference
        )
        connection.commit()
        assert found_by_place(connection) == 5 * len(places), reference
    assert served(connection) == {"c@1": 30}
    pages = run_sql(connection, "select pg_relation_size('point_geom') / 8192 as n").fetchone()
    assert pages["n"] > 1


def test_administrators_who_publish_at_once_leave_one_version_and_one_point_a_place(
    connection, ingest, dsn, places
):
    for version in ("1", "2", "3"):
        ingest("a", places, version=version)
    for priority, name in enumerate(("b", "c"), start=1):
        ingest(name, places, priority=priority)
    connection.commit()

    def publish(reference: str) -> str | None:
        with engine.connect(dsn) as own:
            superseded = lifecycle.publish_block(own, reference).superseded
        return None if superseded is None else superseded.version

    wanted = ("a@1", "a@2", "a@3", "b", "c")
    with ThreadPoolExecutor(len(wanted)) as administrators:
        list(administrators.map(publish, wanted))
    assert served(connection) == {"c@1": 30}
    states = [(block.id, block.state) for block, _ in list_blocks(driver(connection))]
    assert sorted(states) == [
        ("a", "published"),
        ("a", "withdrawn"),
        ("a", "withdrawn"),
        ("b", "published"),
        ("c", "published"),
    ]
    history = run_sql(
        connection,
        "select count(*) as n from audit where kind = 'block' and action = 'changed'"
        " and before ->> 'state' = 'staged' and after ->> 'state' = 'published'",
    ).fetchone()
    assert history["n"] == len(wanted)
    connection.rollback()


def test_publications_wait_for_each_other(dsn):
    with engine.connect(dsn) as one, engine.connect(dsn) as other:
        superseding.lock_publications(one)
        run_sql(other, "set local lock_timeout = '100ms'")
        with pytest.raises(Exception, match="lock timeout"):
            superseding.lock_publications(other)
        other.rollback()


def test_a_priority_given_at_once_with_another_is_seen_by_it(connection, ingest, dsn, places):
    """Both administrators begin where the first block has 1 and the second 0."""
    for name, priority in (("first", 1), ("second", 0)):
        ingest(name, places, priority=priority)
        lifecycle.publish_block(connection, name)
    connection.commit()

    def prioritise_second() -> None:
        with engine.connect(dsn) as other:
            lifecycle.prioritise_block(other, "second", 3)

    waiting = "select count(*) as n from pg_stat_activity where wait_event_type = 'Lock'"
    waiting += " and datname = current_database()"
    with engine.connect(dsn) as one, ThreadPoolExecutor(1) as administrators:
        lifecycle.prioritise_block(one, "first", 5)
        later = administrators.submit(prioritise_second)
        while not later.done() and not run_sql(connection, waiting).fetchone()["n"]:
            connection.rollback()
        one.commit()
        later.result()
    assert served(connection) == {"first@1": 30}


def test_no_degree_of_latitude_is_shorter_than_the_one_of_the_search():
    """So the box around a point has all places that are within the distance."""
    lengths_m = [metres_per_degree(lat_deg, 0.0)[1] for lat_deg in range(-90, 91)]
    assert SHORTEST_DEGREE_M <= min(lengths_m) < SHORTEST_DEGREE_M + 1.0
