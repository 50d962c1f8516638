"""`amers block quality` and the process `assess-block`: what was put in is found and reported."""

import json
import os
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from jsonschema import Draft202012Validator
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from amers.app.cli.main import app as commands
from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.errors import InputError
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block
from amers.app.usecases.blocks.quality import (
    HeightFiles,
    QualityReferences,
    RequiredQuality,
    SiteFile,
    assess_folder,
    write_quality,
)
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.reports.block_quality import BlockQualityReport
from amers.services.reports.document import block_quality_schema, report_document
from tests.app.callers import Bearer
from tests.app.ledger import job_runner
from tests.app.quality_world import (
    HEIGHT_BIAS_M,
    HEIGHT_NOISE_M,
    SHIFT_PX,
    QualityWorld,
    make_quality_world,
)
from tests.command_line import amers_here

pytestmark = pytest.mark.long

a_decimetre = 0.1
a_tenth = 0.1
MISSED = 3


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> QualityWorld:
    return make_quality_world(tmp_path_factory.mktemp("quality"))


@pytest.fixture(scope="module")
def report(world: QualityWorld) -> BlockQualityReport:
    """The block against all references, images of the block among them."""
    heights = HeightFiles(TerrainFile(world.dem, "ellipsoid"), sigma_m=HEIGHT_NOISE_M, frame_sigma_m=0.5)
    references = QualityReferences(
        heights=heights,
        sites=(SiteFile(world.site), SiteFile(world.control_site, is_control=True)),
        site_sigma_m=0.5,
        images=(world.image,),
        excluded=(world.lake,),
    )
    required = RequiredQuality(points_per_km2=15.0, ce90_m=3.0, le90_m=5.0)
    return assess_folder(world.block, references, required)


def outcomes(report: BlockQualityReport) -> dict[str, str]:
    return {criterion.name: criterion.outcome for criterion in report.criteria}


def test_the_errors_of_the_references_are_found(report: BlockQualityReport) -> None:
    of_points, of_images = report.planimetry
    line_px, sample_px = SHIFT_PX
    expected_m = np.array([-2.0 * sample_px, 2.0 * line_px])
    for source in (of_points, of_images):
        airport, harbour = source.sites
        assert (airport.name, airport.is_control, harbour.is_control) == ("airport", False, True)
        assert_allclose(airport.accuracy.bias_m, expected_m, atol=a_decimetre)
        assert_allclose(harbour.accuracy.bias_m, [0.0, 0.0], atol=a_decimetre)
        _, check_only, control = source.groups
        assert_allclose(check_only.accuracy.ce90_m.value, np.hypot(2.0, 3.0), atol=a_decimetre)
        assert control.accuracy.ce90_m.value < a_decimetre
    assert of_images.sites[0].images[0].name == "land"
    heights = report.heights
    assert heights is not None
    assert (heights.compared, heights.outside) == ("point", 0)
    assert_allclose(heights.on_the_earth.bias_m, HEIGHT_BIAS_M, atol=2 * a_decimetre)
    assert_allclose(heights.on_the_earth.nmad_m, HEIGHT_NOISE_M, rtol=2.5 * a_tenth)
    # The heights of the points are exact, but declare 0.3 m.
    honest = HEIGHT_NOISE_M / np.hypot(HEIGHT_NOISE_M, 0.3)
    assert_allclose(heights.typical_ratio, honest, rtol=2.5 * a_tenth)
    assert_allclose(heights.normalised_frame.mean_square, 1.5**2 / (2.0**2 + 0.5**2), rtol=3 * a_tenth)


def test_the_verdict_names_what_misses_and_where(report: BlockQualityReport) -> None:
    assert outcomes(report) == {
        "density": "met",
        "images_per_point": "met",
        "ce90_m": "missed",
        "le90_m": "met",
    }
    assert report.verdict == "missed"
    places = {place.place: place.outcome for place in report.places}
    assert places["site airport"] == "missed"
    assert places["site harbour"] == "met"
    assert places["52° N 13° E"] == "met"


def test_ground_without_texture_misses_its_density_unless_it_is_excluded(
    world: QualityWorld, report: BlockQualityReport
) -> None:
    required = RequiredQuality(points_per_km2=15.0)
    whole = assess_folder(world.block, QualityReferences(), required)
    by_south = {round(cell.south, 1): cell for cell in whole.density.cells}
    assert (by_south[52.4].outcome, by_south[52.3].outcome) == ("met", "missed")
    assert by_south[52.3].points < 10
    assert by_south[52.3].missing_points > 10
    assert outcomes(whole)["density"] == "missed"
    assert [round(cell.south, 1) for cell in report.density.cells] == [52.4]
    assert report.block.excluded_km2 > 0.3 * report.block.area_km2


def test_document_and_page_follow_their_contracts(report: BlockQualityReport, tmp_path: Path) -> None:
    schema = block_quality_schema()
    Draft202012Validator.check_schema(schema)
    Draft202012Validator(schema).validate(report_document(report))
    out = tmp_path / "out"
    write_quality(report, out)
    write_quality(report, out)  # an older result is replaced
    assert {path.name for path in out.iterdir()} == {
        "block_quality.json",
        "block_quality.html",
        "manifest.json",
    }
    document = json.loads((out / "block_quality.json").read_text())
    Draft202012Validator(schema).validate(document)
    page = (out / "block_quality.html").read_text()
    tags: list[str] = []
    texts: list[str] = []

    class Read(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            tags.append(tag + " " + (dict(attrs).get("role") or ""))

        def handle_data(self, data: str) -> None:
            texts.append(data)

    Read().feed(page)
    assert tags.count("svg img") == 6
    assert not [tag for tag in tags if tag.startswith("script")]
    shown = " ".join(" ".join(texts).split())
    for words in ("specification missed", "CE90 on the Earth, check-only sites", "airport", "harbour"):
        assert words in shown, words
    assert "nan" not in shown.lower().split()
    assert "http://" not in page.replace("http://www.w3.org", "")


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(commands, ["block", "quality", *map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


def test_the_command_prints_tables_or_json_and_its_status_tells_a_miss(
    world: QualityWorld, tmp_path: Path
) -> None:
    dem = ("--dem", world.dem, "--vertical", "ellipsoid", "--dem-sigma-m", HEIGHT_NOISE_M)
    status, text = run(world.block, *dem, "--le90-m", 5, "--exclude", world.lake, "--points-per-km2", 15)
    assert status == 0
    assert "met: The block meets its specification." in text
    assert "Heights against dem.tif" in text
    status, text = run(world.block, *dem, "--le90-m", 0.5, "--json", "-o", tmp_path / "out")
    assert status == MISSED
    document = json.loads(text)
    Draft202012Validator(block_quality_schema()).validate(document)
    assert document["verdict"] == "missed"
    assert (tmp_path / "out" / "block_quality.html").is_file()


def test_a_specification_that_nothing_was_measured_for_is_not_shown(world: QualityWorld) -> None:
    status, text = run(world.block, "--ce90-m", 3, "--exclude", world.lake, "--points-per-km2", 15)
    assert status == 0
    assert "not shown:" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--vertical", "EGM96"), "--dem"),
        (("--images", "{image}"), "--site"),
        (("--site", "{site}", "--images", "{site}"), "airport is no image of the block"),
        (("--site", "{site}", "--control-site", "{site}"), "two files are named airport"),
        (("--exclude", "{block}/block.json"), "Polygon or MultiPolygon expected"),
        (("--site", "{far}", "--images", "{image}"), "none of 1 shows the middle of a site"),
    ],
)
def test_references_that_cannot_be_used_are_refused(
    world: QualityWorld, words: tuple[str, ...], message: str
) -> None:
    given = [word.format(**vars(world)) for word in words]
    with pytest.raises(InputError, match=message):
        run(world.block, *given)


def test_references_that_do_not_exist_are_all_named(world: QualityWorld) -> None:
    words = ("block", "quality", world.block, "--site", f"{world.dem}x", "--dem", f"{world.site}x")
    done = amers_here(words, os.environ)
    assert done.returncode == 2
    assert f"--site: path '{world.dem}x' does not exist" in done.stderr
    assert f"--dem: path '{world.site}x' does not exist" in done.stderr


def test_a_site_elsewhere_is_told_to_show_nothing(world: QualityWorld, tmp_path: Path) -> None:
    words = ("--site", world.far, "--ce90-m", 3, "--exclude", world.lake, "--points-per-km2", 15)
    status, text = run(world.block, *words, "-o", tmp_path / "out", "--json")
    assert status == 0
    document = json.loads(text)
    (site,) = document["planimetry"][0]["sites"]
    assert (site["tried"], site["accuracy"]["n"], site["lon"]) == (0, 0, None)
    assert document["verdict"] == "not shown"
    assert "nothing was measured" in (tmp_path / "out" / "block_quality.html").read_text()


def test_control_sites_alone_do_not_show_that_an_accuracy_is_met(world: QualityWorld) -> None:
    required = RequiredQuality(ce90_m=3.0)
    at_control = QualityReferences(sites=(SiteFile(world.control_site, is_control=True),))
    report = assess_folder(world.block, at_control, required)
    judged = report.criteria[-1]
    assert (judged.label, judged.outcome) == ("CE90 on the Earth, control sites", "not shown")
    assert "--site" in judged.note
    checked = assess_folder(
        world.block, QualityReferences(sites=(SiteFile(world.control_site),)), required
    )
    assert checked.criteria[-1].outcome == "met"
    assert (
        assess_folder(
            world.block, QualityReferences(sites=(SiteFile(world.site, is_control=True),)), required
        )
        .criteria[-1]
        .outcome
        == "missed"
    )


@pytest.mark.parametrize(
    ("required", "message"),
    [({"ce90_m": -1.0}, "ce90_m"), ({"min_share": 2.0}, "min_share"), ({"min_views": 0}, "min_views")],
)
def test_requirements_that_mean_nothing_are_refused(required: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RequiredQuality(**required)  # type: ignore[arg-type]


@pytest.mark.thorough
def test_a_stored_block_is_assessed_by_a_job_on_files_of_the_server(
    world: QualityWorld,
    client: TestClient,
    database: Database,
    settings: Settings,
    storage: Storage,
    bearer: Bearer,
    report: BlockQualityReport,
) -> None:
    with database.transaction() as connection:
        number = ingest_block(connection, storage, world.block).block.number
    admin = bearer("admin")
    on_server = settings.model_copy(update={"reference_folder": world.block.parent})
    assess = job_runner(client, database, on_server, admin)
    job = assess(
        "assess-block",
        block=str(number),
        sites=["airport.tif"],
        control_sites=["harbour.tif"],
        site_sigma_m=0.5,
        dem="dem.tif",
        vertical="ellipsoid",
        dem_sigma_m=HEIGHT_NOISE_M,
        dem_frame_sigma_m=0.5,
        exclude=["lake.geojson"],
        required={"points_per_km2": 15.0, "ce90_m": 3.0, "le90_m": 5.0},
    )
    assert job["status"] == "successful", job
    results = admin.get(f"/jobs/{job['jobID']}/results").json()
    assert results["specification"] == "missed"
    document = admin.get(results["block_quality.json"]["href"]).json()
    schema = client.get("/schemas/block_quality.json").json()
    Draft202012Validator(schema).validate(document)
    assert document["verdict"] == report.verdict
    of_folder = report.planimetry[0].sites[0].accuracy
    site = document["planimetry"][0]["sites"][0]
    assert_allclose(site["accuracy"]["bias_m"], of_folder.bias_m, atol=1e-3)
    assert document["heights"]["on_the_earth"]["n"] == report.heights.on_the_earth.n  # type: ignore[union-attr]
    page = admin.get(results["block_quality.html"]["href"])
    assert page.headers["content-type"].startswith("text/html")
    missing = assess("assess-block", block=str(number), dem="../dem.tif", vertical="ellipsoid")
    assert missing["status"] == "failed"
    refused = admin.execute("assess-block", {"block": "none"})
    assert refused.status_code == 404
    not_allowed = bearer("register").execute("assess-block", {"block": str(number)})
    assert not_allowed.status_code == 403
