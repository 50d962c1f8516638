"""`amers scene register`: on a block folder, on the store, and by a remote service."""

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from jsonschema import validate

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.registration.result_folder import MANIFEST
from amers.app.usecases.report_files import REPORT_FILES
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.reports.document import failure_schema, report_schema
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.app.registration_outputs import (
    A_TENTH_OF_A_PIXEL,
    CHECK_POINTS,
    COMMON_FILES,
    assert_masked,
    assert_registered,
    largest_error_px,
    write_check_points,
    write_mask,
)
from tests.app.running_service import running_service
from tests.command_line import Done, amers_here, amers_process, environment_of
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

Amers = Callable[..., Done]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block and a scene whose model is wrong by a known shift."""
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def published(world: FlatWorld, dsn: str, storage: Storage) -> None:
    """The points of the world, in the store and visible."""
    publish_world(dsn, storage, world)


@pytest.fixture
def environment(settings: Settings) -> dict[str, str]:
    """Variables that name the installation of the test."""
    return environment_of(settings)


@pytest.fixture
def amers(environment: dict[str, str]) -> Amers:
    """Runs the command `amers` on the installation of the test."""
    return lambda *words: amers_here(words, environment)


def test_the_command_registers_straight_from_a_block_folder(
    environment: dict[str, str], world: FlatWorld, tmp_path: Path
):
    folder = tmp_path / "out"
    control = ("--block", world.block, "--sigma-m", SIGMA_M)
    words = ("scene", "register", world.tagged, *control, "-o", folder, "--json")
    result = amers_process(words, environment)
    assert result.returncode == 0, result.stderr
    output = json.loads(result.stdout)
    assert output["verdict"] in ("good", "usable")
    assert np.allclose(output["shift_px"], [14.0, -9.0], atol=A_TENTH_OF_A_PIXEL)
    assert (output["exit_status"], output["reason"] != "") == (0, True)
    assert {path.name for path in folder.iterdir()} == COMMON_FILES | {"tagged_RPC.TXT", MANIFEST}
    assert_registered(folder, world)
    beside = read_rpc(world.tagged, folder / "tagged_RPC.TXT").model
    assert largest_error_px(beside, world.true_model) < A_TENTH_OF_A_PIXEL


def test_an_error_that_should_not_happen_leaves_its_report(
    amers: Amers, world: FlatWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def broken(*_: object, **__: object) -> None:
        raise TypeError("len() of unsized object")

    monkeypatch.setattr("amers.app.usecases.registration.register.register_scene", broken)
    folder = tmp_path / "out"
    result = amers("scene", "register", world.tagged, "--block", world.block, "-o", folder)
    assert result.returncode == 1
    assert "an error that should not happen: TypeError: len() of unsized object" in result.stderr
    report = json.loads((folder / "report.json").read_text())
    validate(report, failure_schema())
    assert report["reason"] == "an error that should not happen: TypeError: len() of unsized object"
    (step,) = report["next_steps"]
    assert step["command"].startswith("AMERS_LOG_LEVEL=debug amers scene register")
    again = amers("scene", "register", world.tagged, "--block", world.block, "-o", folder)
    assert "replaces the result of tagged" in again.stderr


def test_check_points_are_reported_and_can_take_a_good_verdict_away(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    def register(moved_px: float) -> dict:
        write_check_points(tmp_path / "checks.geojson", world, moved_px)
        command = ("scene", "register", world.tagged, "--block", world.block, "--sigma-m", SIGMA_M)
        result = amers(
            *command, "--check-points", tmp_path / "checks.geojson", "-o", tmp_path / "out", "--json"
        )
        assert result.returncode == 0, result.stderr
        assert json.loads(result.stdout)["check_points"] == CHECK_POINTS
        report: dict = json.loads((tmp_path / "out" / "report.json").read_text())
        validate(report, report_schema())
        return report

    report = register(moved_px=0.0)
    (check,) = report["checks"]
    half_a_pixel_m = 0.25
    assert check["accuracy"]["n"] == CHECK_POINTS
    assert 0.0 < check["accuracy"]["ce90_m"]["value"] < half_a_pixel_m
    assert check["image_residuals_px"]["xy"]["rms"] < A_TENTH_OF_A_PIXEL
    (criterion,) = [one for one in report["criteria"] if one["name"] == "check_points"]
    assert criterion["met"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "independent check points of checks.geojson" in page
    (criterion,) = [one for one in register(5.0)["criteria"] if one["name"] == "check_points"]
    assert not criterion["met"]
    assert criterion["value"] > criterion["limit"]


def test_check_points_of_another_image_are_refused_by_name(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    write_check_points(tmp_path / "checks.geojson", world)
    document = json.loads((tmp_path / "checks.geojson").read_text())
    (tmp_path / "checks.geojson").write_text(json.dumps({**document, "image": "other.tif"}))
    result = amers(
        "scene",
        "register",
        world.tagged,
        "--block",
        world.block,
        "-o",
        tmp_path / "out",
        "--check-points",
        tmp_path / "checks.geojson",
    )
    assert result.returncode == 2
    assert "checks.geojson: expected marks in tagged.tif, found marks in other.tif" in result.stderr


def test_the_command_registers_with_the_store_and_records_the_measures(
    amers: Amers, world: FlatWorld, published: None, tmp_path: Path, dsn: str
):
    folder = tmp_path / "out"
    command = ("scene", "register", world.image, "--sigma-m", SIGMA_M, "-o", folder)
    result = amers(*command, "--model", world.rpc_text)
    assert result.returncode == 0, result.stderr
    assert "verdict" in result.stdout
    assert_registered(folder, world)
    with engine.connect(dsn) as connection:
        rows = run_sql(
            connection,
            "select count(*) as n from registration join measure on registration_id = registration.id",
        ).fetchone()
    assert rows == {"n": 40}


def test_a_folder_of_scenes_is_registered_by_two_processes_and_a_bad_scene_stops_none(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    scenes, folder = tmp_path / "scenes", tmp_path / "out"
    scenes.mkdir()
    content = world.tagged.read_bytes()
    (scenes / "b.tif").write_bytes(content[:100_000])
    (scenes / "a.tif").write_bytes(content)
    (scenes / "notes.txt").write_text("no image")
    (tmp_path / "c.tif").write_bytes(content)
    command = ("scene", "register", scenes, tmp_path / "c.tif", "--block", world.block)
    options = ("--sigma-m", SIGMA_M, "--jobs", 2, "-o", folder)
    result = amers(*command, *options, "--json")
    assert result.returncode == 2
    assert "b.tif" in result.stderr
    assert "Traceback" not in result.stderr
    first, bad, last = json.loads(result.stdout)
    assert [Path(record["scene"]).name for record in (first, bad, last)] == ["a.tif", "b.tif", "c.tif"]
    assert "truncated or damaged" in bad["reason"]
    assert (bad["verdict"], bad["exit_status"]) == ("not registered", 2)
    for record, name in ((first, "a"), (last, "c")):
        assert record["verdict"] in ("good", "usable")
        assert record["seconds"] > 0.0
        assert record["exit_status"] == 0
        assert Path(record["output"]) == folder / name
        assert_registered(folder / name, world)
    overview = (folder / "overview.html").read_text()
    assert re.findall(r'<a href="([^"]*)">', overview) == [f"{name}/report.html" for name in "abc"]
    assert all((folder / name / "report.html").is_file() for name in "abc")
    assert "truncated or damaged" in overview
    table = amers(*command[:2], tmp_path / "c.tif", scenes / "a.tif", *command[4:], *options)
    assert table.returncode == 0, table.stderr
    header, *rows = [line.split("\t") for line in table.stdout.splitlines()]
    assert header[:2] == ["scene", "verdict"]
    assert [(Path(row[0]).name, row[1]) for row in rows] == [
        ("c.tif", f"{last['verdict']}, relative to the control points"),
        ("a.tif", f"{first['verdict']}, relative to the control points"),
    ]


def test_many_scenes_are_registered_with_the_store_and_recorded(
    amers: Amers, world: FlatWorld, published: None, tmp_path: Path, dsn: str
):
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    for name in ("a.tif", "b.tif"):
        (scenes / name).write_bytes(world.tagged.read_bytes())
    options = ("--sigma-m", SIGMA_M, "--jobs", 2, "-o", tmp_path / "out")
    result = amers("scene", "register", scenes, *options)
    assert result.returncode == 0, result.stderr
    with engine.connect(dsn) as connection:
        rows = run_sql(connection, "select count(*) as n from registration").fetchone()
    assert rows == {"n": 2}


def test_a_folder_without_an_image_and_jobs_for_a_service_are_refused(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    (tmp_path / "empty").mkdir()
    refused = amers("scene", "register", tmp_path / "empty", "--block", world.block)
    assert (refused.returncode, "no image" in refused.stderr) == (2, True), refused.stderr
    refused = amers("scene", "register", world.tagged, "--server", "http://127.0.0.1:1", "--jobs", 2)
    assert (refused.returncode, "--jobs: the workers" in refused.stderr) == (2, True), refused.stderr


def test_the_exit_code_of_the_command_shows_the_kind_of_error(
    amers: Amers, environment: dict[str, str], world: FlatWorld, tmp_path: Path
):
    def register(*arguments: object) -> tuple[int, str]:
        result = amers("scene", "register", *arguments, "--block", world.block, "-o", tmp_path / "out")
        assert "Traceback" not in result.stderr
        return result.returncode, result.stderr

    half = tmp_path / "half.tif"
    half.write_bytes(world.tagged.read_bytes()[:100_000])
    assert register(half)[0] == 2
    assert register(tmp_path / "missing.tif")[0] == 2
    bare = tmp_path / "bare.tif"
    bare.write_bytes(world.image.read_bytes())
    code, message = register(bare)
    assert code == 2
    assert "no sensor model" in message
    # The points lie 8 m from where a model with a stated accuracy of 0.1 m expects them.
    hopeless = ("scene", "register", world.tagged, "--sigma-m", 0.1, "--block", world.block)
    failed = amers_process((*hopeless, "-o", tmp_path / "out"), environment)
    assert (failed.returncode, "found" in failed.stderr) == (3, True), failed.stderr


def test_the_command_lets_a_service_register(
    amers: Amers,
    token: Callable[[str], str],
    world: FlatWorld,
    published: None,
    settings: Settings,
    tmp_path: Path,
):
    log, folder = tmp_path / "serve.log", tmp_path / "out"
    scene = ("scene", "register", world.image, "--sigma-m", SIGMA_M, "-o", folder)
    write_mask(tmp_path / "mask.tif")
    write_check_points(tmp_path / "checks.geojson", world)
    beside = ("--mask", tmp_path / "mask.tif", "--check-points", tmp_path / "checks.geojson")
    with running_service(settings, log) as url:
        refused = amers(*scene, "--server", url, "--token", "wrong")
        assert (refused.returncode, "token" in refused.stderr) == (2, True), refused.stderr
        result = amers(*scene, *beside, "--server", url, "--token", token("register"), "--json")
        assert result.returncode == 0, result.stderr + log.read_text()
        assert json.loads(result.stdout)["check_points"] == CHECK_POINTS
        assert_registered(folder, world)
        assert_masked(folder)
        (check,) = json.loads((folder / "report.json").read_text())["checks"]
        assert check["image_residuals_px"]["xy"]["rms"] < A_TENTH_OF_A_PIXEL
        on_earth = ("--max-ce90-on-earth-m", 10, "--server", url, "--token", token("register"))
        limited = amers(*scene, *on_earth)
        assert limited.returncode == 3, limited.stderr + log.read_text()
        assert "unknown: the sigma of the control points' common error is not stated" in limited.stderr
        older = (folder / "report.json").read_bytes()
        refused = amers(*scene, "--server", url, "--token", "wrong")
        assert (refused.returncode, (folder / "report.json").read_bytes()) == (2, older)
        assert "the older result stays in its folder as it was" in refused.stderr
        hopeless = ("scene", "register", world.tagged, "--sigma-m", 0.1, "-o", folder, "--json")
        failed = amers(*hopeless, "--server", url, "--token", token("register"))
        record = json.loads(failed.stdout)
        assert (failed.returncode, record["exit_status"]) == (3, 3), failed.stderr + log.read_text()
        for stated in ("relative_to_control_points", "on_the_earth"):
            assert record[stated]["words"] == "none: the scene is not registered"
        report = json.loads((folder / "report.json").read_text())
        validate(report, failure_schema())
        assert report["search_stages"][0]["tried"] == 40
        garbled = tmp_path / "garbled.geojson"
        garbled.write_text("{")
        wrong = (*scene, "--check-points", garbled, "--server", url, "--token", token("register"))
        refused = amers(*wrong)
        assert (refused.returncode, "garbled.geojson" in refused.stderr) == (2, True), refused.stderr
    gone = amers(*scene, "--server", url, "--token", "any")
    assert (gone.returncode, "Traceback" in gone.stderr) == (1, False)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--reference", "land.tif"), "--server: the service uses its own"),
        (("--block", "folder"), "--server: the service uses its own"),
        (("--dem", "heights.tif"), "--dem: given without --reference, to which it belongs"),
    ],
)
def test_a_service_uses_its_own_points_and_references(
    amers: Amers, world: FlatWorld, tmp_path: Path, words: tuple[str, str], message: str
):
    scene = ("scene", "register", world.tagged, "--server", "http://127.0.0.1:1", "-o", tmp_path / "out")
    option, name = words
    (tmp_path / name).touch()
    refused = amers(*scene, option, tmp_path / name)
    assert (refused.returncode, message in refused.stderr) == (2, True), refused.stderr
    assert not (tmp_path / "out").exists()


def test_an_older_result_is_named_and_replaced_as_a_whole(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    folder = tmp_path / "out"
    control = ("--block", world.block, "--sigma-m", SIGMA_M, "-o", folder)
    first = amers("scene", "register", world.tagged, *control, "--copy-image")
    assert first.returncode == 0, first.stderr
    assert "replaces" not in first.stderr
    assert (folder / "tagged.tif").exists()
    verdict = json.loads((folder / "report.json").read_text())["verdict"]
    second = amers("scene", "register", world.image, "--model", world.rpc_text, *control)
    assert second.returncode == 0, second.stderr
    assert f"{folder}: replaces the result of tagged of 20" in second.stderr
    named, worked = second.stderr.split(f"verdict {verdict}", 1)
    assert "%" not in named, second.stderr
    assert "%" in worked, second.stderr
    assert {path.name for path in folder.iterdir()} == COMMON_FILES | {"scene_RPC.TXT", MANIFEST}
    assert_registered(folder, world)


def test_an_unusable_output_folder_is_refused_before_the_work_and_listed(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tagged").write_text("a file of the user")
    (tmp_path / "other.tif").write_bytes(world.tagged.read_bytes())
    control = ("--block", world.block, "--sigma-m", SIGMA_M, "--json")
    refused = amers("scene", "register", world.tagged, *control, "-o", tmp_path / "out" / "tagged")
    record = json.loads(refused.stdout)
    assert (refused.returncode, record["exit_status"]) == (2, 2)
    assert "is a file, a folder expected; name another folder with -o" in record["reason"]
    assert record["reason"] in refused.stderr
    assert "%" not in refused.stderr
    scenes = (world.tagged, tmp_path / "other.tif")
    both = amers("scene", "register", *scenes, *control, "-o", tmp_path / "out")
    bad, good = json.loads(both.stdout)
    assert (both.returncode, bad["exit_status"], good["exit_status"]) == (2, 2, 0)
    assert (bad["verdict"], Path(bad["scene"])) == ("not registered", world.tagged)
    assert (tmp_path / "out" / "tagged").read_text() == "a file of the user"
    assert_registered(tmp_path / "out" / "other", world)


def test_every_scene_is_listed_in_the_order_given_and_failures_are_printed(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    content = world.tagged.read_bytes()
    scenes = [tmp_path / f"{name}.tif" for name in ("z", "half", "bare", "a")]
    scenes[0].write_bytes(content)
    scenes[1].write_bytes(content[:100_000])
    scenes[2].write_bytes(world.image.read_bytes())
    scenes[3].write_bytes(content)
    control = ("--block", world.block, "--sigma-m", SIGMA_M, "-o", tmp_path / "out", "--jobs", 2)
    listed = amers("scene", "register", *scenes, *control, "--json")
    records = json.loads(listed.stdout)
    assert [Path(record["scene"]) for record in records] == scenes
    assert [record["exit_status"] for record in records] == [0, 2, 2, 0]
    assert all(record["reason"] and record["verdict"] for record in records)
    # Without the first: it takes as long as the last.
    printed = amers("scene", "register", *scenes[1:], *control)
    _, *rows = [line.split("\t") for line in printed.stdout.splitlines()]
    assert [row[0] for row in rows] == [str(scene) for scene in scenes[1:]]
    assert "no sensor model" in rows[1][-1]
    assert "no sensor model" in printed.stderr
    assert printed.returncode == listed.returncode == 2


def test_a_single_scene_that_fails_is_listed_with_its_reason(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    failing = ("scene", "register", world.tagged, "--sigma-m", 0.1, "--block", world.block)
    listed = amers(*failing, "-o", tmp_path / "out", "--json")
    record = json.loads(listed.stdout)
    assert (record["verdict"], record["exit_status"], listed.returncode) == ("not registered", 3, 3)
    assert "found" in record["reason"]
    assert Path(record["output"]) == tmp_path / "out"
    printed = amers(*failing, "-o", tmp_path / "out")
    assert "not registered" in printed.stdout
    assert record["reason"] in printed.stderr
    assert "replaces the result of tagged of 20" in printed.stderr
    unreachable = ("--server", "http://127.0.0.1:1", "-o", tmp_path / "other", "--json")
    gone = amers("scene", "register", world.tagged, *unreachable)
    record = json.loads(gone.stdout)
    assert (record["verdict"], record["exit_status"], gone.returncode) == ("not registered", 1, 1)
    assert "127.0.0.1:1" in record["reason"]
    assert not (tmp_path / "other").exists()


def test_a_registration_that_fails_leaves_its_own_report_and_no_older_one(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    folder = tmp_path / "out"
    scene = ("scene", "register", world.tagged, "--block", world.block, "-o", folder)
    good = amers(*scene, "--sigma-m", SIGMA_M)
    assert good.returncode == 0, good.stderr
    failed = amers(*scene, "--sigma-m", 0.1)
    assert failed.returncode == 3, failed.stderr
    assert {path.name for path in folder.iterdir()} == {*REPORT_FILES, MANIFEST}
    report = json.loads((folder / "report.json").read_text())
    validate(report, failure_schema())
    assert (report["verdict"], report["error"], report["visible"]) == (
        "not registered",
        "NotEnoughPoints",
        40,
    )
    (stage,) = report["search_stages"]
    assert sum(one["count"] for one in stage["not_found"]) + stage["matched"] == stage["tried"] == 40
    assert str(folder) not in report["reason"]
    # The command of the first step is complete: it registers the scene.
    program, *words = shlex.split(report["next_steps"][0]["command"])
    assert program == "amers"
    assert words[-2] == "--sigma-m"
    larger = amers(*words[:-1], SIGMA_M)
    assert larger.returncode == 0, larger.stderr
    assert f"verdict {report['verdict']}" in larger.stderr
    assert_registered(folder, world)
    damaged = tmp_path / "half.tif"
    damaged.write_bytes(world.tagged.read_bytes()[:100_000])
    assert amers("scene", "register", damaged, *scene[3:]).returncode == 2
    report = json.loads((folder / "report.json").read_text())
    validate(report, failure_schema())
    assert (report["scene"], report["verdict"]) == ({"name": "half"}, "not registered")
    assert "truncated or damaged" in report["reason"]
