"""Every page says and draws what it did: words as they were, numbers row by row and stroke by stroke.

Other tests say what must hold of a page. A change of any word or number is noticed here, by its row;
whether it is meant, a person decides. After one that is meant,
`python -m tests.services.reports.test_all_pages` writes the pages anew; read what differs.
"""

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import shapely

from amers.services.joint.fitting import Left, SceneFit, adjust_fitting
from amers.services.joint.registration import JointRegistration
from amers.services.joint.results import RigorousScene
from amers.services.map_grid import MapGrid
from amers.services.production.image_selection import SelectionOptions, select_images
from amers.services.quality.accuracy_statement import median_accuracy
from amers.services.quality.finding import Finding
from amers.services.quality.marks import MarksReport
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.base import BaseReport
from amers.services.reports.base_pages import BASE_PAGE
from amers.services.reports.block_adjustment import points_csv as points_of_block
from amers.services.reports.block_adjustment_pages import ADJUSTMENT_PAGE, IMAGES_PAGE
from amers.services.reports.block_quality_pages import QUALITY_PAGE
from amers.services.reports.document import report_document
from amers.services.reports.failure_pages import FAILURE_PAGE
from amers.services.reports.figure_data import displacement_sections
from amers.services.reports.html import Page, format_html
from amers.services.reports.joint import JointReport, joint_report
from amers.services.reports.joint_pages import JOINT_PAGE
from amers.services.reports.plan import points_csv as points_of_plan
from amers.services.reports.plan_pages import PLAN_PAGE
from amers.services.reports.registration_pages import REGISTRATION_PAGE
from amers.services.reports.report import Check, RegistrationReport
from amers.services.reports.selection import SelectionReport, SourceFacts, overlap_csv, selection_report
from amers.services.reports.selection_pages import SELECTION_PAGE
from amers.services.reports.surface import DifferenceReport, ReducedMap, SurfaceReport
from amers.services.reports.surface_pages import DIFFERENCE_PAGE, SURFACE_PAGE
from amers.services.reports.text import format_text
from amers.services.surface.match import REASON_LABELS
from amers.services.types import Frame
from benchmarks._catalogue import simulate_catalogue
from tests.app.stand_ins import stand_in
from tests.services import judged_worlds as judged
from tests.services.conftest import FlatModel
from tests.services.figures import Figures, differing, figures
from tests.services.joint import test_joint_block as joint
from tests.services.misfit import test_displacement_components as moving
from tests.services.reports import test_block_reports as blocks
from tests.services.reports import test_failure as failures
from tests.services.reports.conftest import material_of

pytestmark = pytest.mark.long

GOLDEN = Path(__file__).parents[2] / "golden" / "all_pages.json"
_NUMBER = re.compile(r"(?<![#\w])[-\N{MINUS SIGN}]?(?:\d+(?:\.\d+)?|\.\d+)(?:e[-+]\d+)?")
_ROW = re.compile(
    r"</(?:tr|p|h\d|li|figcaption|dt|dd|section|svg|summary)>|(?=<(?:path|text|rect|image) )"
)
_DRAWN = re.compile(r"<(?:path|text|rect|image) ")
_MOST = 24
"""Numbers of rows of the same words that are kept one by one."""


def told(page: str) -> Figures:
    """The numbers of a page by the words that they stand between, or the strokes that they place."""
    page = re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)
    page = re.sub(r"data:image/png;base64,([\w+/=]+)", _pixels, page)
    page = re.sub(r' d="([^"]+)"', lambda path: f' d="{re.sub("[a-zA-Z]", " ", path[1])}"', page)
    rows: dict[str, list[float]] = {}
    for row in re.split(_ROW, page):
        words = row if _DRAWN.match(row) else re.sub("<[^>]+>", " ", row)
        words = " ".join(unescape(words).split())
        numbers = [float(one.replace("\N{MINUS SIGN}", "-")) for one in _NUMBER.findall(words)]
        key = re.sub(r"#( #)+", "##", _NUMBER.sub("#", words))
        if key:
            rows.setdefault(key, []).extend(numbers)
    return {key: _few(numbers) for key, numbers in rows.items()}


def _pixels(encoded: re.Match[str]) -> str:
    """The mean of an image, of its left half and of its upper half, and what it is of a ramp."""
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(encoded[1]), np.uint8), cv2.IMREAD_UNCHANGED)
    channels = np.atleast_3d(pixels).astype(np.float64)
    half = np.maximum(np.array(channels.shape) // 2, 1)
    parts = channels, channels[:, : half[1]], channels[: half[0]]
    return " ".join(f"{mean:.3f}" for part in parts for mean in part.mean(axis=(0, 1)))


def _few(numbers: list[float]) -> list[float | str]:
    """All of few numbers; of many their count, their mean and how it changes along them."""
    if len(numbers) <= _MOST:
        return list(numbers)
    values, along = np.array(numbers), np.linspace(-1.0, 1.0, len(numbers))
    return [float(len(values)), float(values.mean()), float((values * along).mean()), *numbers[:4]]


def _map(bands: int) -> ReducedMap:
    """Bumps on a slope in more samples than lines, some cells without a height."""
    line, sample = np.mgrid[:30, :50]
    heights_m = 100.0 + 0.4 * line - 0.9 * sample + 6.0 * np.sin(line / 4.0) * np.cos(sample / 7.0)
    others = [0.2 + 0.02 * sample, 2.0 + 0.0 * line, np.where(line < 4, 3.0, 1.0)]
    grid = MapGrid("EPSG:32633", np.array([4e5, 58e5]), np.array([[0.0, 20.0], [-20.0, 0.0]]), (30, 50))
    return ReducedMap(
        "a map", (300, 500), 2.0, np.stack([heights_m, *others])[:bands].astype("f4"), grid
    )


def _surface() -> SurfaceReport:
    cells = {words: 7 * number + 5 for number, words in enumerate(REASON_LABELS.values())}
    return replace(stand_in(SurfaceReport, "surface"), map=_map(4), cells=cells)


def _difference() -> DifferenceReport:
    shown = _map(3)
    shown.bands[:] = (shown.bands[:1] - 90.0) / np.array([1.0, 5.0, 8.0])[:, None, None]
    shifts = {"shift_m": (1.25, -2.5, 3.75), "shift_sigma_m": (0.125, 0.25, 0.5)}
    return replace(stand_in(DifferenceReport, "difference"), map=shown, **shifts)


def _with_everything() -> RegistrationReport:
    """With findings, a check of heights, marks, and lines that move."""
    observed, _ = moving.draw(moving.MOTIONS["jitter"], np.random.default_rng(3))
    motion, made = moving.adjust_scene(FlatModel(), moving.SHAPE, observed), material_of()
    drawn = {"displacement": motion.correction.displacement, "sections": displacement_sections(motion)}
    report = replace(made, figure_data=replace(made.figure_data, **drawn)).report()
    told = stand_in(tuple[Finding, ...], "findings"), stand_in(tuple[Check, ...], "checks")
    marks = stand_in(MarksReport, "marks")
    return replace(report, findings=told[0], checks=(*report.checks, *told[1]), marks=marks)


def _together() -> JointReport:
    """Two scenes beside one that was adjusted before, and one that left."""
    rng, made = np.random.default_rng(7), []
    block, _ = adjust_fitting(*joint.observed(joint.truth_of(rng), rng), RegistrationOptions())
    for seed, name in enumerate(("one", "two")):
        report = material_of(name, seed=seed).report()
        ring = report.scene.footprint_lon_lat * (1 + seed) + block.control.lon_lat_h[0, :2]
        made.append(replace(report, scene=replace(report.scene, footprint_lon_lat=ring)))
    fits = stand_in(SceneFit, "first"), stand_in(SceneFit, "second")
    found = None, stand_in(RigorousScene, "rigorous")
    result = JointRegistration(block, (1, 2), (), fits, found, (stand_in(Left, "left"),))
    return joint_report(result, made, ["three"], name="a block", finished_at=judged.WHEN)


def _selection() -> SelectionReport:
    catalogue = simulate_catalogue(400, 300.0, np.random.default_rng(5))
    options = SelectionOptions(cell_m=20_000.0, min_views=4)
    return selection_report(
        catalogue,
        select_images(catalogue, options, shapely.box(14.0, -1.0, 15.5, 0.5)),
        stand_in(SourceFacts, "source"),
        seconds=1.5,
        finished_at=judged.WHEN,
        software_version="0.1.0",
    )


def _base() -> BaseReport:
    made, rng = stand_in(BaseReport, "base"), np.random.default_rng(3)
    lon_lat_h = np.array([5.0, 43.0, 100.0]) + rng.uniform(0.0, 1.0, (40, 3)) * [0.2, 0.1, 300.0]
    ring = np.array([[5.0, 43.0], [5.2, 43.0], [5.2, 43.1], [5.0, 43.1]])
    names = tuple(f"2024-0{month}-11 orbit" for month in (3, 5))
    images = tuple(
        replace(one, date=date, error_m=np.array(error_m), stated_m=2.0)
        for one, date, error_m in zip(made.images, names, ([0.5, 1.0], [4.0, -6.0]), strict=True)
    )
    frames = replace(made.frames, error_m=np.array([[0.5, 1.0], [4.0, -6.0]]))
    return replace(
        made,
        lon_lat_h=lon_lat_h,
        outlines=(ring,),
        dates_of_points=rng.integers(3, 30, 40),
        images=images,
        frames=frames,
        date_names=names,
        accuracy=median_accuracy(1.0, 2.0, Frame.from_sigmas(3.0, 4.0)),
    )


PAGES: dict[str, tuple[Page, Callable[[], Any]]] = {
    "registration": (REGISTRATION_PAGE, lambda: material_of().report()),
    "poor registration": (REGISTRATION_PAGE, lambda: material_of(n=200, bend_px=1.5, wrong=9).report()),
    "registration with everything": (REGISTRATION_PAGE, _with_everything),
    "failure": (FAILURE_PAGE, lambda: failures.failure(material_of().report())),
    "together": (JOINT_PAGE, _together),
    "plan": (PLAN_PAGE, blocks.plan_report),
    "adjustment": (ADJUSTMENT_PAGE, lambda: blocks.adjusted(1, 2)),
    "images": (IMAGES_PAGE, lambda: blocks.adjusted(1, 2).images),
    "quality of a block": (QUALITY_PAGE, judged.quality_of_a_block),
    "base": (BASE_PAGE, _base),
    "selection": (SELECTION_PAGE, _selection),
    "surface": (SURFACE_PAGE, _surface),
    "difference of surfaces": (DIFFERENCE_PAGE, _difference),
}
"""The template of a page, and what makes its report, by its name."""
TABLES: dict[str, Callable[[Any], str]] = {
    "plan": points_of_plan,
    "adjustment": points_of_block,
    "selection": overlap_csv,
}
"""What makes a table beside a page."""


def found(name: str) -> Figures:
    """What a page tells, as a text too, and what its document and the table beside it do."""
    page, make = PAGES[name]
    report = make()
    more = told(re.sub("(?<=\n)", "</p>", format_text(page, report))) if page.has_text else {}
    if name in TABLES:
        more |= told(TABLES[name](report).replace("\n", "</p>"))
    document = figures({"document": report_document(report)}) if hasattr(report, "document") else {}
    return (
        {f"text: {words}": values for words, values in more.items()}
        | told(format_html(page, report))
        | document
    )


@pytest.mark.parametrize("name", PAGES)
def test_every_page_is_what_it_was(name: str) -> None:
    now, expected = found(name), json.loads(GOLDEN.read_text())[name]
    assert not differing(now, expected)
    assert list(now) == list(expected), "what comes first"


def _written(name: str) -> str:
    """What a page tells, a row each."""
    rows = [f" {json.dumps(words)}: {json.dumps(values)}" for words, values in found(name).items()]
    return json.dumps(name) + ": {\n" + ",\n".join(rows) + "\n}"


if __name__ == "__main__":
    GOLDEN.write_text("{\n" + ",\n".join(map(_written, PAGES)) + "\n}\n")
