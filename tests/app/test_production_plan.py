"""`amers production plan`: from a small file to tables, maps and the place of one more site."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from amers.app.cli.main import main
from amers.app.usecases.planning import read_plan
from amers.services.formats.stac.catalogue import read_catalogue
from amers.services.geodesy import metres_per_degree
from benchmarks._catalogue import simulate_catalogue, write_catalogue

FILES = {"points.csv", "report.html", "report.json", "manifest.json"}
DEFAULTS = {
    "along_km": 10.0,
    "across_km": 10.0,
    "gsd_m": 2.0,
    "incidence_deg": 15.0,
    "azimuth_deg": 280.0,
    "sigma_m": 6.0,
}
PLAN: dict[str, Any] = {
    "image_defaults": DEFAULTS,
    "images": [
        {"name": "west", "lon": 5.4, "lat": 43.3},
        {"name": "middle", "lon": 5.46, "lat": 43.3, "azimuth_deg": 100.0},
        {"name": "east", "lon": 5.52, "lat": 43.3},
    ],
    "spacing_km": 1.0,
    "sites": [{"name": "harbour", "lon": 5.4, "lat": 43.31}],
    "candidates": {"spacing_km": 6.0},
}

Plan = Callable[..., tuple[int, str, str]]


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Plan:
    """Runs `amers production plan` with a plan in this process; the report goes to `out`."""

    def run(document: Any, *words: object) -> tuple[int, str, str]:
        path = tmp_path / "islands.json"
        path.write_text(json.dumps(document))
        command = ["amers", "production", "plan", path, "-o", tmp_path / "out", *words]
        monkeypatch.setattr(sys, "argv", [str(word) for word in command])
        with pytest.raises(SystemExit) as end:
            main()
        output = capsys.readouterr()
        return int(end.value.code or 0), output.out, output.err

    return run


def test_a_plan_gives_tables_maps_and_a_proposal(plan: Plan, tmp_path: Path) -> None:
    status, printed, said = plan(PLAN, "--json")
    assert status == 0, said
    report = json.loads(printed)
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == FILES
    assert report == json.loads((out / "report.json").read_text())
    assert [image["name"] for image in report["images"]] == ["west", "middle", "east"]
    (proposal,) = report["proposed"]
    # The known site is in the west.
    assert proposal["lon_lat"][0] > 5.46
    assert proposal["on_the_earth"]["ce90_m"] < report["on_the_earth"]["ce90_m"]
    best = max(proposal["gain_m"], key=lambda name: proposal["gain_m"][name] or 0.0)
    assert best == proposal["name"]
    rows = (out / "points.csv").read_text().splitlines()
    assert len(rows) == report["points"] + 1
    mean_m = np.mean([float(row.split(",")[2]) for row in rows[1:]])
    assert mean_m == pytest.approx(report["on_the_earth"]["ce90_m"], abs=1e-3)
    page = (out / "report.html").read_text()
    assert page.count("<svg") == 2
    assert "Where one more site helps most" in page


def test_the_words_of_a_plan_name_the_place_that_helps(plan: Plan) -> None:
    status, printed, _ = plan(PLAN)
    assert status == 0
    assert "On the Earth: CE90" in printed
    assert "Most help: 43." in printed


def test_images_of_a_catalogue_are_planned_with_its_directions(tmp_path: Path) -> None:
    simulated = simulate_catalogue(60, 100.0, np.random.default_rng(2))
    catalogue = write_catalogue(simulated, tmp_path / "catalogue")
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({**PLAN, "images": [], "candidates": None, "spacing_km": 5.0}))
    images = read_plan(path, str(catalogue)).images
    assert len(images) > 30
    assert len({image.incidence_deg for image in images}) > 10
    areas_m2 = np.array([image.size_m[0] * image.size_m[1] for image in images])
    footprints = read_catalogue(str(catalogue)).images.footprint
    degrees2_m2 = [np.prod(metres_per_degree(image.lon_lat[1], 0.0)) for image in images]
    np.testing.assert_allclose(areas_m2, shapely.area(footprints) * degrees2_m2, rtol=0.05)
    assert len({image.pass_name for image in images if image.pass_name}) > 1
    # The sides of their boxes differ as their own do, for none is turned by 45 degrees.
    box_m = np.diff(shapely.bounds(footprints).reshape(-1, 2, 2), axis=1)[:, 0] * [
        metres_per_degree(image.lon_lat[1], 0.0) for image in images
    ]
    longer_m = np.array([image.size_m[0] - image.size_m[1] for image in images])
    assert (np.sign(box_m[:, 1] - box_m[:, 0]) == np.sign(longer_m)).all()


@pytest.mark.parametrize("sides_km", [(24.0, 12.0), (12.0, 24.0)])
def test_candidates_lie_as_far_apart_as_stated_along_and_across_an_image(
    tmp_path: Path, sides_km: tuple[float, float]
) -> None:
    path = tmp_path / "plan.json"
    sides = dict(zip(("along_km", "across_km"), sides_km, strict=True))
    image = {**PLAN["images"][0], **sides}
    path.write_text(json.dumps({**PLAN, "images": [image], "candidates": {"spacing_km": 4.0}}))
    places = np.array([site.lon_lat for site in read_plan(path).candidates])
    from_image_km = (places - [image["lon"], image["lat"]]) * metres_per_degree(43.3, 0.0) / 1000.0
    for positions_km, side_km in zip(from_image_km.T, sides_km[::-1], strict=True):
        lattice = np.arange(2.0 - side_km / 2.0, side_km / 2.0, 4.0)
        np.testing.assert_allclose(np.unique(positions_km.round(6)), lattice, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"spacing_km": -1.0}, "spacing_km: Input should be greater than 0"),
        ({"spacing_m": 3.0}, "spacing_m: Extra inputs"),
        ({"images": [{"name": "one"}]}, "images/0: lon: Field required"),
        ({"candidates": {"spacing_km": 0.1}}, "state another spacing"),
        ({"images": PLAN["images"][:1]}, "1 images with 1 names"),
    ],
)
def test_a_wrong_plan_is_refused_by_its_member(
    plan: Plan, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    status, _, said = plan({**PLAN, **change})
    assert status != 0
    assert words in said.replace("\n", " ")
    assert not (tmp_path / "out").exists()
