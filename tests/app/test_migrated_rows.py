"""Migrations with rows: what a step up gives them, and what a step back leaves of them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import psycopg
import pytest
import shapely
from alembic import command
from psycopg.sql import SQL, Identifier

from amers.app.db import revisions
from amers.app.db.cluster.embedded import Cluster
from amers.services.types import Array
from tests.app.catalogue import catalogue, row_counts
from tests.app.test_migrations import alembic, order_of
from tests.app.test_release_dumps import DUMPS, restored

Rows = dict[str, list[dict[str, Any]]]
OF_ROWS = {"0008", "0010"}
"""Migrations that change rows, or build an index anew, and no definition."""
FRAMES_M2 = {
    1: [[4.0, 1.5, 0.0], [1.5, 9.0, 0.0], [0.0, 0.0, 16.0]],
    2: [[25.0, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 4.0]],
}
"""Covariances of the frames that two of the blocks state, east, north and up; the third states none."""
APART_DEG = {2: 5.21, 3: 5.28}
"""Where the points of two blocks with one extent begin, degrees east."""
EDITS = (
    *(
        f"update block set metadata = jsonb_set(metadata, '{{amers:frame}}',"
        f" '{{\"covariance_m2\": {frame}}}') where number = {number}"
        for number, frame in FRAMES_M2.items()
    ),
    *(
        f"update point set geom = st_setsrid(st_makepoint({lon} + 0.001 * (id & 7), 43.22, 200), 4979)"
        f" where block_number = {number}"
        for number, lon in APART_DEG.items()
    ),
    'update scene set models = \'{"a.rpb": {"size_bytes": 17}, "b": {"size_bytes": 25}}\''
    " where name = 'scene.tif'",
)
"""What makes the rows of a dump tell one wrong step from another."""
SECOND = "01234567-89ab-4cde-8f01-23456789abcd"
SECOND_SCENE = f"""
insert into registration select (jsonb_populate_record(r, jsonb_build_object(
    'id', '{SECOND}', 'scene_id', s.id, 'scene_key', 'of another'))).*
from registration r, scene s where s.name = 'bad.tif'
"""
"""A job of the newest release registered two scenes."""
LOST = {
    "registration.job_id": "0011",
    "job.inputs": "0008",
    "audit.actor": "0006",
    "procrastinate_jobs": "0005",
    "procrastinate_events": "0005",
}
"""Tables and columns that steps back from a revision do not give what they had, as it says."""
RETIRED = {
    "options.adjustment.slope_px",
    *(
        f"options.qualification.{level}_{what}_of_points"
        for level in ("good", "usable")
        for what in ("displacement", "ce90")
    ),
}


@dataclass(frozen=True)
class Way:
    """A store on its way up to the newest revision and back.

    Attributes:
        up, down: definitions and rows at each revision.
    """

    up: dict[str, tuple[dict[str, str], Rows]]
    down: dict[str, tuple[dict[str, str], Rows]]


def rows_of(dsn: str) -> Rows:
    """All rows of each table."""
    with psycopg.connect(dsn) as connection:
        return {
            name: sorted(
                (
                    row
                    for (row,) in connection.execute(
                        SQL("select to_jsonb(t) from {} t").format(Identifier(name))
                    )
                ),
                key=str,
            )
            for name in row_counts(dsn)
            if name != "alembic_version"
        }


@pytest.fixture(scope="module")
def way(cluster: Cluster) -> Iterator[Way]:
    with restored(cluster, DUMPS[0]) as dsn:
        order = order_of(dsn)
        first = order.index(revisions.status(dsn).found or "")
        with psycopg.connect(dsn) as connection:
            for edit in EDITS:
                connection.execute(edit.encode())
        up, down = {}, {}
        for revision in order[first:]:
            command.upgrade(alembic(dsn), revision)
            up[revision] = (catalogue(dsn), rows_of(dsn))
        with psycopg.connect(dsn) as connection:
            connection.execute(SECOND_SCENE)
        for revision in order[-2 : first - 1 if first else None : -1]:
            command.downgrade(alembic(dsn), revision)
            down[revision] = (catalogue(dsn), rows_of(dsn))
        yield Way(up, down)


def test_steps_before_the_first_release_are_undone_too(empty_dsn: str) -> None:
    def ours() -> dict[str, str]:
        return {name: one for name, one in catalogue(empty_dsn).items() if "alembic_version" not in name}

    found = [ours()]
    for revision in order_of(empty_dsn)[: int(DUMPS[0].name.split(".")[0])]:
        command.upgrade(alembic(empty_dsn), revision)
        assert ours() not in found
        found.append(ours())
    for before in found[-2::-1]:
        command.downgrade(alembic(empty_dsn), "-1")
        assert ours() == before


def test_each_step_changes_definitions_or_says_that_it_does_not(way: Way) -> None:
    for before, revision in pairwise(way.up):
        assert (way.up[revision][0] != way.up[before][0]) == (revision not in OF_ROWS), revision


def test_a_step_back_leaves_what_was_there_to_the_last_default_trigger_and_right(way: Way) -> None:
    for revision in way.up.keys() & way.down.keys():
        assert way.down[revision][0] == way.up[revision][0], revision


def test_a_step_back_leaves_the_rows_and_what_both_schemas_have_of_them(way: Way) -> None:
    """But for what it says; the audit has more, of the steps themselves."""
    for revision in way.up.keys() & way.down.keys():
        lost = {name for name, since in LOST.items() if revision < since}
        before, after = way.up[revision][1], way.down[revision][1]
        for table in before.keys() - lost:
            kept = [
                [{c: value for c, value in row.items() if f"{table}.{c}" not in lost} for row in rows]
                for rows in (before[table], after[table])
            ]
            new = [row for row in kept[1] if row not in kept[0]]
            assert all(row in kept[1] for row in kept[0]), (revision, table)
            assert table == "audit" or [row["id"] for row in new] in ([], [SECOND]), (revision, table)


def test_on_the_way_back_the_registrations_of_one_job_lose_it(way: Way) -> None:
    for revision in way.down:
        of_jobs = [row["job_id"] is not None for row in way.down[revision][1]["registration"]]
        assert of_jobs == [revision >= "0011"] * 2, revision


def test_owners_take_turns_from_their_last_claim(way: Way) -> None:
    *_, (_, newest) = way.up.values()
    claims: dict[str, list[str]] = {}
    for job in newest["job"]:
        if job["claimed_at"] is not None:
            claims.setdefault(job["owner"], []).append(job["claimed_at"])
    assert max(map(len, claims.values())) > 1
    turns = {row["owner"]: row["claimed_at"] for row in newest["job_turn"]}
    assert turns == {owner: max(times) for owner, times in claims.items()}


def test_of_the_inputs_of_jobs_nothing_but_retired_options_is_gone(way: Way) -> None:
    (_, oldest), *_, (_, newest) = way.up.values()
    inputs = {row["id"]: flat(row["inputs"]) for row in newest["job"]}
    for job in oldest["job"]:
        gone = flat(job["inputs"]).items() - inputs[job["id"]].items()
        assert {name for name, _ in gone} == RETIRED
        assert inputs[job["id"]].items() <= flat(job["inputs"]).items()


def test_scenes_count_the_bytes_of_their_side_files(way: Way) -> None:
    *_, (_, newest) = way.up.values()
    counted = {row["name"]: row["side_file_bytes"] for row in newest["scene"]}
    assert {name: size for name, size in counted.items() if size} == {"scene.tif": 17 + 25}


def test_blocks_state_the_accuracy_of_their_points_and_of_their_frames(way: Way) -> None:
    *_, (_, newest) = way.up.values()
    for block in newest["block"]:
        sigma_m, sigma_up_m = (
            block["quality"][f"sigma_{axis}_m"]["median"] for axis in ("horizontal", "up")
        )
        frame_m2 = FRAMES_M2.get(block["number"])
        stated = {"relative": np.diag([sigma_m**2, sigma_m**2, sigma_up_m**2])}
        if frame_m2 is not None:
            stated["on_the_earth"] = stated["relative"] + np.array(frame_m2)
        for name, covariance_m2 in stated.items():
            ce90_m, le90_m = block[f"{name}_ce90_m"], block[f"{name}_le90_m"]
            assert share_within(ce90_m, covariance_m2[:2, :2]) == pytest.approx(0.9, abs=1e-4)
            assert math.erf(le90_m / math.sqrt(2.0 * covariance_m2[2, 2])) == pytest.approx(
                0.9, abs=1e-4
            )
        unknown = [block["on_the_earth_ce90_m"], block["on_the_earth_le90_m"]].count(None)
        assert unknown == (2 if frame_m2 is None else 0)


def test_every_block_gets_an_outline_of_its_points(way: Way) -> None:
    *_, (_, newest) = way.up.values()
    for block in newest["block"]:
        outline, extent = (shapely.geometry.shape(block[name]) for name in ("outline", "extent"))
        points = [
            shapely.geometry.shape(row["geom"])
            for row in newest["point"]
            if row["block_number"] == block["number"]
        ]
        assert shapely.distance(outline, points).max() < 1e-8, block["number"]
        assert shapely.hausdorff_distance(outline, shapely.MultiPoint(points)) < 0.01, block["number"]
        assert extent.buffer(1e-8).covers(outline)


def flat(document: dict[str, Any], path: str = "") -> dict[str, str]:
    """The values of a document by their paths, as text."""
    found: dict[str, str] = {}
    for name, value in document.items():
        inside = isinstance(value, dict)
        found |= flat(value, f"{path}{name}.") if inside else {f"{path}{name}": repr(value)}
    return found


def share_within(radius: float, covariance: Array) -> float:
    """The share of a normal law in the plane that lies within a radius, by directions."""
    angle = np.linspace(0.0, 2.0 * np.pi, 3601)[:-1]
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    rate = np.einsum("ni,ij,nj->n", direction, np.linalg.inv(covariance), direction)
    inside = (1.0 - np.exp(-0.5 * rate * radius**2)) / rate
    return float(inside.mean() / np.sqrt(np.linalg.det(covariance)))
