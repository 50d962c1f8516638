"""Every place that states an accuracy states two: relative to the control points, and on the Earth."""

import json
from collections.abc import Callable
from html import unescape
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.storage import Storage
from amers.services.types import UNKNOWN_FRAME, Frame
from tests.app.callers import Bearer, Caller
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.app.worker_processes import ended, running_worker
from tests.command_line import amers_here, environment_of

pytestmark = [pytest.mark.long, pytest.mark.thorough]

RELATIVE = "Relative to the control points"
ON_THE_EARTH = "On the Earth"
SCOPE = "relative to the control points"
STATED_NAMES = ("relative", "on_the_earth")
STATED = Frame.from_sigmas(1.5, 5.0)
EARTH_LE90_M = 8.22
a_centimetre = 0.01

Document = dict[str, Any]


@pytest.fixture(scope="module", params=[STATED, UNKNOWN_FRAME], ids=["stated", "unknown"])
def world(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block that states its frame, or none, and a scene to register on it."""
    return make_flat_world(tmp_path_factory.mktemp("world"), frame=request.param)


@pytest.fixture
def is_known(request: pytest.FixtureRequest, world: FlatWorld) -> bool:
    document = json.loads((world.block / "block.json").read_text())
    return document["amers:frame"] is not None


@pytest.fixture
def published(world: FlatWorld, dsn: str, storage: Storage) -> None:
    publish_world(dsn, storage, world)


@pytest.fixture
def amers(settings: Settings) -> Callable[..., str]:
    """Runs the command `amers` on the installation of the test; returns what it prints."""
    environment = environment_of(settings)

    def run(*words: object, fails: bool = False) -> str:
        done = amers_here(words, environment)
        assert (done.returncode != 0) == fails, done.stderr
        return done.stdout + (done.stderr if fails else "")

    return run


def assert_stated(document: Document, is_known: bool, prefix: str = "") -> tuple[str, str]:
    """Check the two accuracies of a JSON document; returns their words."""
    relative = document[f"{prefix}relative_to_control_points"]
    earth = document[f"{prefix}on_the_earth"]
    assert (relative["label"], earth["label"]) == (RELATIVE, ON_THE_EARTH)
    assert f"CE90 {relative['ce90_m']:.2f} m" in relative["words"]
    if is_known:
        assert earth["ce90_m"] > 2.146 * 1.5 - a_centimetre
        assert earth["le90_m"] >= EARTH_LE90_M
        assert f"CE90 {earth['ce90_m']:.2f} m" in earth["words"]
        assert f"{earth['le90_m']:.2f} m" in earth["words"]
        assert "unknown" not in earth["words"]
    else:
        assert (earth["ce90_m"], earth["le90_m"]) == (None, None)
        assert "CE90 unknown" in earth["words"]
        assert earth["words"].endswith("the sigma of the control points' common error is not stated")
    return relative["words"], earth["words"]


def assert_shown(text: str, words: tuple[str, str]) -> None:
    """Check that a text for people has both accuracies with their labels, in their order."""
    flat = " ".join(text.split())
    places = [flat.index(part) for part in (RELATIVE, words[0], ON_THE_EARTH, words[1])]
    assert places == sorted(places), text


def test_everything_about_a_registered_scene_states_both(
    client: TestClient,
    me: Caller,
    settings: Settings,
    published: None,
    world: FlatWorld,
    is_known: bool,
    tmp_path: Path,
):
    image = world.tagged.read_bytes()
    scene = me.post(f"/scenes?name=a.tif&sigma_m={SIGMA_M}", content=image).json()["id"]
    execution = "/processes/register-scene/execution"
    reply = me.post(execution, json={"inputs": {"scene": scene}})
    with running_worker(settings, tmp_path / "log"):
        job = ended(client, reply.headers["location"], me)
    assert job["status"] == "successful", job
    results = me.get(f"/jobs/{job['jobID']}/results").json()
    words = assert_stated(results, is_known)
    assert results["verdict_scope"] == SCOPE

    texts = {
        name: me.get(results[name]["href"]).text for name in ("report.json", "report.html", "report.txt")
    }
    report = json.loads(texts["report.json"])
    assert assert_stated(report, is_known) == words
    assert report["verdict_scope"] == SCOPE
    verdict_line = f"Verdict: {report['verdict']}, {SCOPE}"
    for name in ("report.html", "report.txt"):
        text = " ".join(unescape(texts[name]).split())
        assert verdict_line in text
        headline = text[text.index(verdict_line) :]
        assert_shown(headline, words)

    item = me.get(f"/collections/scenes/items/{scene}").json()["properties"]
    assert assert_stated(item, is_known, "amers:") == words
    assert item["amers:verdict_scope"] == SCOPE
    (found,) = me.get("/search?collections=scenes").json()["features"]
    assert assert_stated(found["properties"], is_known, "amers:") == words


def test_everything_about_a_block_and_its_points_states_both(
    bearer: Bearer, published: None, is_known: bool, amers: Callable[..., str]
):
    me = bearer("read")
    words = assert_stated(me.get("/blocks/flat/quality").json(), is_known)
    for command in ("show", "quality"):
        assert assert_stated(json.loads(amers("block", command, "flat", "--json")), is_known) == words
        assert_shown(amers("block", command, "flat"), words)
    (listed,) = json.loads(amers("block", "list", "--json"))
    assert assert_stated(listed, is_known) == words
    assert all(part in amers("block", "list") for part in words)
    document = me.get("/blocks/flat/quality").json()
    (block,) = me.get("/collections/blocks/items").json()["features"]
    for name, of in (("relative", "relative_to_control_points"), ("on_the_earth", "on_the_earth")):
        for figure in ("ce90_m", "le90_m"):
            value = block["properties"][f"{name}_{figure}"]
            assert value == pytest.approx(document[of][figure], rel=1e-5) if value else not is_known
    page = me.get("/collections/blocks/items?f=html").text
    heads = [
        page.index(f">{name}_{figure}<") for name in STATED_NAMES for figure in ("ce90_m", "le90_m")
    ]
    assert heads == sorted(heads)
    assert page.count("<td>unknown</td>") == (0 if is_known else 2)
    (point,) = me.get("/collections/points/items?limit=1").json()["features"]
    item = me.get(f"/collections/points/items/{point['id']}").json()
    assert_stated(item["properties"], is_known)


def test_the_command_that_registers_states_both(
    world: FlatWorld, is_known: bool, amers: Callable[..., str], tmp_path: Path
):
    command = ("scene", "register", world.tagged, "--block", world.block, "--sigma-m", SIGMA_M)
    output = json.loads(amers(*command, "-o", tmp_path / "out", "--json"))
    words = assert_stated(output, is_known)
    text = amers(*command, "-o", tmp_path / "out")
    assert_shown(text, words)
    assert f"{output['verdict']}, {SCOPE}" in text
    report = tmp_path / "out" / "report.json"
    limited = amers(*command, "--max-ce90-on-earth-m", 10, "-o", tmp_path / "out", fails=not is_known)
    assert json.loads(report.read_text())["verdict_scope"] == f"{SCOPE} and on the Earth"
    assert ("unknown: the sigma of the control points' common error is not stated" in limited) == (
        not is_known
    )
    several = tmp_path / "several"
    several.mkdir()
    for name in ("a.tif", "b.tif"):
        (several / name).write_bytes(world.tagged.read_bytes())
    table = amers("scene", "register", several, *command[3:], "-o", tmp_path / "outs")
    assert table.count(words[0]) == table.count(words[1]) == 2
