"""`amers production select`: from a catalogue to a folder with the selection, or no folder."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely

from amers.app.cli.main import main
from amers.services.formats.stac.catalogue import read_catalogue
from benchmarks._catalogue import simulate_catalogue, write_catalogue

FILES = {"selection.json", "cells.gpkg", "overlap.csv", "report.html", "report.json", "manifest.json"}
AREA = shapely.box(14.0, -1.0, 16.0, 1.0)


@dataclass(frozen=True)
class Said:
    """The exit status and the output of a command."""

    status: int
    stdout: str
    stderr: str


Select = Callable[..., Said]


@pytest.fixture
def select(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Select:
    """Runs `amers production select` in this process."""

    def run(*words: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["amers", "production", "select", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        output = capsys.readouterr()
        return Said(int(end.value.code or 0), output.out, output.err)

    return run


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The items of a simulated catalogue with their masks, and two bad lines."""
    simulated = simulate_catalogue(700, 420.0, np.random.default_rng(2))
    path = write_catalogue(simulated, tmp_path_factory.mktemp("stac") / "catalogue")
    bad = {"type": "Feature", "stac_version": "1.0.0", "id": "bad", "geometry": None, "properties": {}}
    with path.open("a") as out:
        out.write(json.dumps({**bad, "properties": {"datetime": "2024-01-01T00:00:00Z"}}) + "\n{\n")
    return path


@pytest.fixture(scope="module")
def area(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("area") / "area.geojson"
    path.write_text(shapely.to_geojson(AREA))
    return path


@pytest.mark.long
def test_a_selection_is_written_with_cells_tables_and_report(select, catalogue, area, tmp_path):
    out = tmp_path / "out"
    said = select(catalogue, "-o", out, "--area", area, "--json")
    assert said.status == 0, said.stderr
    assert {path.name for path in out.iterdir()} == FILES
    report = json.loads(said.stdout)
    assert report == json.loads((out / "report.json").read_text())
    chosen = json.loads((out / "selection.json").read_text())
    assert len(chosen["features"]) == report["use"]["selected"] > 50
    assert report["bound"] <= report["use"]["selected"] <= 1.15 * report["bound"]
    assert report["source"]["bad"] == 2
    assert "items.ndjson: line 701: item 'bad': geometry" in report["source"]["problems"][0]
    for item in chosen["features"]:
        stated = item["properties"].get("eo:cloud_cover", 0.0)
        assert stated < item["properties"]["amers:cloud_limit_percent"]
    cells = pyogrio.raw.read(out / "cells.gpkg")
    fields = dict(zip(cells[0]["fields"], cells[3], strict=True))
    outlines = shapely.union_all(shapely.from_wkb(cells[2]))
    assert outlines.bounds == pytest.approx(AREA.bounds, abs=0.3)
    assert outlines.intersection(AREA).area > 0.97 * AREA.area
    assert len(fields["clear_views"]) == report["cells"]
    missing = np.maximum(0, 6 - fields["clear_views"])
    assert (missing == fields["missing_views"]).all()
    area_km2 = sum(row["area_km2"] for row in report["overlap"])
    assert area_km2 == pytest.approx(report["area_km2"])
    assert report["area_km2"] == pytest.approx((2 * 111.3) * (2 * 110.6), rel=0.03)
    short = sum(row["share"] for row in report["short"])
    assert short == pytest.approx((missing > 0).mean(), abs=0.01)


@pytest.mark.thorough
def test_the_written_selection_is_a_catalogue_again(select, catalogue, area, tmp_path):
    """With its masks: hardly an image of a selection is unnecessary, and no more ground is short."""
    select(catalogue, "-o", tmp_path / "one", "--area", area)
    read = read_catalogue(str(tmp_path / "one" / "selection.json"))
    assert read.bad == 0
    assert read.images.has_mask.any()
    again = select(tmp_path / "one" / "selection.json", "-o", tmp_path / "two", "--area", area, "--json")
    assert again.status == 0
    first = json.loads((tmp_path / "one" / "report.json").read_text())
    second = json.loads(again.stdout)
    assert 0.93 * first["use"]["selected"] <= second["use"]["selected"] <= first["use"]["selected"]
    shares = [sum(row["share"] for row in report["short"]) for report in (first, second)]
    assert shares[1] == pytest.approx(shares[0], abs=0.01)


@pytest.mark.long
def test_the_terminal_gets_tables_and_the_verdict(select, catalogue, area, tmp_path):
    said = select(catalogue, "-o", tmp_path / "out", "--area", area)
    assert said.status == 0
    for words in ("Cloud limits", "Overlap", "above the lower bound of", "left out: "):
        assert words in said.stdout + said.stderr
    assert said.stdout.splitlines()[-1] == str(tmp_path / "out" / "report.html")
    assert "nan" not in said.stdout


@pytest.mark.long
def test_the_page_needs_no_network_and_shows_both_maps(select, catalogue, area, tmp_path):
    select(catalogue, "-o", tmp_path / "out", "--area", area)
    page = (tmp_path / "out" / "report.html").read_text()
    tags = []

    class Tags(HTMLParser):
        def handle_starttag(self, tag, attrs):
            tags.append((tag, dict(attrs)))

    Tags().feed(page)
    assert sum(tag == "svg" and "viewbox" in attrs for tag, attrs in tags) >= 2
    pictures = [attrs["href"] for tag, attrs in tags if tag == "image"]
    assert len(pictures) == 2
    assert all(address.startswith("data:image/png;base64,") for address in pictures)
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.long
def test_options_change_what_is_asked(select, catalogue, area, tmp_path):
    words = ("--area", area, "--min-views", 2, "--cloud-limits", "10,30", "--since", "2024-01-01")
    said = select(catalogue, "-o", tmp_path / "out", *words, "--cell-km", 20, "--max-snow", 0, "--json")
    report = json.loads(said.stdout)
    assert report["options"]["cloud_limits_percent"] == [10.0, 30.0]
    assert report["options"]["min_views"] == 2
    assert report["source"]["older"] > 200
    assert report["acquired"]["first"] >= "2024"
    assert report["cell_km"] == pytest.approx(20.0, rel=0.05)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--cloud-limits", "30,10"), "--cloud-limits: '30,10' found, rising numbers up to 100"),
        (("--cloud-limits", "15,120"), "rising numbers up to 100"),
        (("--cloud-limits", "much"), "rising numbers up to 100"),
        (("--cell-km", "0.01"), "state larger cells (--cell-km)"),
        (("--since", "2100-01-01"), "before the first time asked for, 2 cannot be used"),
    ],
)
@pytest.mark.long
def test_what_cannot_be_done_is_refused_and_nothing_written(select, catalogue, tmp_path, words, message):
    said = select(catalogue, "-o", tmp_path / "out", *words)
    assert said.status == 2
    assert message in said.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_an_older_selection_is_replaced_as_a_whole_and_kept_when_the_new_one_fails(
    select, catalogue, area, tmp_path
):
    out = tmp_path / "out"
    select(catalogue, "-o", out, "--area", area)
    before = (out / "report.json").read_text()
    assert select(tmp_path / "none.json", "-o", out).status == 2
    assert (out / "report.json").read_text() == before
    assert select(catalogue, "-o", out, "--area", area, "--min-views", 3).status == 0
    assert (out / "report.json").read_text() != before


def test_files_of_others_in_the_folder_are_refused(select, catalogue, area, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    said = select(catalogue, "-o", tmp_path, "--area", area)
    assert said.status == 2
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_an_area_that_is_no_polygon_is_refused(select, catalogue, tmp_path):
    (tmp_path / "area.json").write_text('{"type": "Point", "coordinates": [1, 2]}')
    said = select(catalogue, "-o", tmp_path / "out", "--area", tmp_path / "area.json")
    assert said.status == 2
    assert "type 'Point' found, Polygon or MultiPolygon expected" in said.stderr
