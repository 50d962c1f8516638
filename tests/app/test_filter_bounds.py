"""Filters within bounds, read as the library reads them, and parsed where nothing else can be harmed."""

import json
import math
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import shapely

from amers.app.db.features import cql2_process
from amers.app.db.features.cql2 import translate
from amers.app.db.features.cql2_bounds import parse_geometry, parse_json, parse_text
from amers.app.db.features.cql2_tokens import LONGEST_TEXT, check_text
from amers.app.db.features.crs import CRS84, EPSG_3857, EVERY
from amers.app.db.points import POINTS
from amers.app.errors import InvalidParameter
from tests.app.filter_attacks import NAMED

pytestmark = pytest.mark.security

OVERFLOW = "-" * 3900 + "1"
ENDLESS = "(" * 40 + "1" + ",2)" * 40


@pytest.mark.parametrize("text", NAMED.values(), ids=NAMED.keys())
def test_an_attack_is_refused(text: str) -> None:
    with pytest.raises(InvalidParameter, match=r"^filter: "):
        translate(parse_text(text), POINTS, CRS84)


@pytest.mark.parametrize(
    "text",
    [
        "saliency > 0.5",
        "a <> 'it''s' and b >= -1.5e-3 or not (c is not null)",
        r"typology like 'a\%b' and typology = 'a\b'",
        '"saliency" = 1',
        "a not in (1, 2, 3) and b not like 'x%' and c not between -1 and +2",
        "a BETWEEN 1 AND 2 AND b = 3",
        "s_within(g, MULTIPOLYGON Z (((0 0 1, 1 0 1, 1 1 1, 0 0 1)), ((5 5 1, 6 5 1, 6 6 1, 5 5 1))))",
        "s_intersects(geom, GEOMETRYCOLLECTION(POINT(1 2), LINESTRING(-1 -2, +3 4)))",
        "s_intersects(geom, POLYGON EMPTY)",
        "s_within(geometry, BBOX(1, 2, 3, 4))",
        "t_during(first_view, INTERVAL('2020-01-01', '..'))",
        "casei(typology) like casei('A%')",
        "a = 7 div 2 and b = 2 ^ -3 and c = - -1",
        "notes = 1 and order.by:x = 2",
        "(((((((((saliency > 1)))))))))",
    ],
)
def test_a_filter_of_the_standard_passes(text: str) -> None:
    check_text(text)
    assert parse_text(text)


def test_the_largest_filters_of_each_kind_end_no_process() -> None:
    pids = _pids()
    for text in (
        "saliency in (" + "1," * 990 + "1)",
        "1 or " * 799 + "1",
        "(" * 10 + "1" + ",2)" * 10,
        "typology='" + "''" * 1990 + "'",
        "s_intersects(geometry,MULTIPOLYGON(((" + ",".join(["1 2"] * 980) + "))))",
        "saliency=" + "-" * 31 + "1",
        "(" * 5 + "saliency=1" + " and saliency=1" * 90 + " and" + ")" * 5,
    ):
        assert len(text) <= LONGEST_TEXT
        _answer(text)
    assert _pids() == pids


def test_a_filter_that_ends_its_parser_is_refused_and_the_next_one_answered() -> None:
    with pytest.raises(InvalidParameter, match="cannot be parsed"):
        cql2_process.parse("text", OVERFLOW)
    assert cql2_process.parse("text", "a = 1") == {"op": "=", "args": [{"property": "a"}, 1.0]}


@pytest.mark.thorough
def test_a_filter_that_never_ends_is_refused_while_others_are_answered() -> None:
    refusals: list[str] = []

    def hang() -> None:
        with pytest.raises(InvalidParameter) as error:
            cql2_process.parse("text", ENDLESS)
        refusals.append(str(error.value))

    thread = threading.Thread(target=hang)
    thread.start()
    time.sleep(0.2)
    answers = 0
    while thread.is_alive() and answers < 5:
        assert cql2_process.parse("text", "true") is True
        answers += 1
    assert not refusals, "the others have not waited for the endless one"
    thread.join()
    assert answers == 5
    assert "more than 1 s" in refusals[0]


def test_a_parser_has_no_file_no_secret_and_little_memory_of_the_service() -> None:
    cql2_process.parse("text", "true")
    (pid, *_) = _pids()
    assert {link.name for link in Path(f"/proc/{pid}/fd").iterdir()} == {"0", "1", "2"}
    assert Path(f"/proc/{pid}/environ").read_bytes() == b""
    limits = Path(f"/proc/{pid}/limits").read_text()
    assert str(256 << 20) in next(line for line in limits.splitlines() if "address space" in line)


ORPHANS = """
import os, signal, sys, threading, time
from amers.app.db.features import cql2_process
cql2_process.parse("text", "true")
threading.Thread(target=cql2_process.parse, args=("text", sys.argv[1]), daemon=True).start()
time.sleep(0.3)
cql2_process.parse("text", "true")
processes = [entry.process for entry in cql2_process._processes]
print(*(process.pid for process in processes if process), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.thorough
def test_parsers_end_when_the_process_that_started_them_is_killed() -> None:
    run = subprocess.run([sys.executable, "-c", ORPHANS, ENDLESS], capture_output=True, text=True)
    assert run.returncode == -signal.SIGKILL, run.stderr
    pids = run.stdout.split()
    assert len(pids) == 2
    deadline = time.monotonic() + 30
    while any(_is_parser(pid) for pid in pids):
        assert time.monotonic() < deadline, "one of them lives on"
        time.sleep(0.1)


FORKED = """
import os
from amers.app.db.features import cql2_process
def pids():
    cql2_process.parse("text", "true")
    return {entry.process.pid for entry in cql2_process._processes if entry.process}
before = pids()
child = os.fork()
if child == 0:
    os._exit(bool(pids() & before))
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0, "shared with the parent"
assert pids() == before
"""


def test_a_forked_process_has_parsers_of_its_own() -> None:
    run = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"op": "=", "args": [{"property": "saliency"}, NaN]}', "NaN"),
        ('{"op": "=", "args": [{"property": "saliency"}, -Infinity]}', "Infinity"),
        ('{"op": "=", "op": "<", "args": [{"property": "saliency"}, 1]}', "twice"),
        ('{"op": "=", "args": [{"property": "typology"}, "\\ud800"]}', "surrogate"),
        ('{"op": "=", "args": [{"property": "saliency"}, 1' + "0" * 400 + "]}", "filter"),
        ('{"op": "=", "args": [{"property": "saliency"}, 1' + "0" * 9000 + "]}", "filter"),
        ('{"op": "not", "args": [' * 40 + "true" + "]}" * 40, "deeper"),
        ("[" * 100_000, "JSON"),
        ('{"op": "in", "args": [{"property": "saliency"}, [' + "1," * 15_000 + "1]]}", "more than"),
        ('"true"', "filter"),
    ],
)
def test_a_json_filter_that_cannot_be_used_is_refused(text: str, reason: str) -> None:
    with pytest.raises(InvalidParameter, match=reason):
        translate(parse_json(text), POINTS, CRS84)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "\ud800"])
def test_a_document_with_a_value_that_json_does_not_have_is_refused(value: object) -> None:
    with pytest.raises(InvalidParameter, match=r"^filter: "):
        parse_json({"op": "=", "args": [{"property": "saliency"}, value]})


def as_mercator(lon_lat: list[tuple[float, float]]) -> dict[str, object]:
    """A polygon in metres of the map projection, by its own formula (Snyder 1987, equation 7-1)."""
    ring = [
        (6378137.0 * math.radians(lon), 6378137.0 * math.asinh(math.tan(math.radians(lat))))
        for lon, lat in lon_lat
    ]
    return {"type": "Polygon", "coordinates": [ring]}


def test_a_polygon_means_the_same_in_every_reference_system() -> None:
    corners = [(5.2, 43.2), (5.3, 43.2), (5.3, 43.4), (5.2, 43.2)]
    swapped = [(lat, lon) for lon, lat in corners]
    (lat_first,) = (crs for crs in EVERY.values() if crs.lat_first and not crs.has_height)
    given = (
        ({"type": "Polygon", "coordinates": [corners]}, CRS84),
        ({"type": "Polygon", "coordinates": [swapped]}, lat_first),
        (as_mercator(corners), EPSG_3857),
    )
    for geometry, crs in given:
        shape = shapely.from_wkb(parse_geometry(geometry, crs, "filter"))
        assert shapely.get_coordinates(shape) == pytest.approx(np.array(corners), abs=1e-9), crs.uri


def test_a_box_across_180_degrees_is_the_small_part_of_the_earth() -> None:
    shape = shapely.from_wkb(parse_geometry({"bbox": [170.0, -5.0, -160.0, 5.0]}, CRS84, "filter"))
    inside, outside = ([(175, 0), (-170, 0), (180, 0)], [(0, 0), (165, 0), (-155, 0), (175, 6)])
    assert shapely.intersects(shape, shapely.points(inside)).all()
    assert not shapely.intersects(shape, shapely.points(outside)).any()
    assert shape.area == pytest.approx(30.0 * 10.0)


def test_a_large_polygon_in_json_passes() -> None:
    ring = [[5.0 + number * 1e-6, 43.0] for number in range(9_000)] + [[5.0, 44.0], [5.0, 43.0]]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    document = {"op": "s_intersects", "args": [{"property": "geometry"}, polygon]}
    assert translate(parse_json(json.dumps(document)), POINTS, CRS84).has_spatial_predicate


def _answer(text: str) -> None:
    try:
        translate(parse_text(text), POINTS, CRS84)
    except InvalidParameter:
        return


def _pids() -> set[int]:
    """The processes that parse for this one, both of them started."""
    for entry in cql2_process._processes:
        entry.parse("text", "true")
    return {entry.process.pid for entry in cql2_process._processes if entry.process}


def _is_parser(pid: str) -> bool:
    try:
        return b"cql2_parser" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
