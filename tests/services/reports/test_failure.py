"""The report of a registration that failed: valid, honest about what was tried, with the next step."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from amers.services.errors import (
    BrokenImage,
    CoverageError,
    FormatError,
    NoConsensus,
    NotEnoughPoints,
    OtherGround,
    RescaledImage,
    TurnedImage,
)
from amers.services.registration.context import Candidate, NotFound, SearchStage
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.document import failure_schema, report_document
from amers.services.reports.failure import (
    EXPLANATION,
    FAILURE_FORMAT,
    NO_ACCURACY,
    NOT_REGISTERED,
    FailureReport,
    UnreadScene,
    next_steps,
    significance_words,
)
from amers.services.reports.failure_pages import FAILURE_PAGE
from amers.services.reports.html import format_html
from amers.services.reports.report import RunRecord
from amers.services.reports.text import format_text
from tests.services.reports.test_html import HOSTILE, Page

COMMAND = "amers scene register scene.tif --block points -o out"
STAGE = SearchStage(
    name="coarse",
    chip_gsd_m=2.0,
    search_radius_m=150.0,
    needed_radius_m=150.0,
    tried=60,
    matched=12,
    at_border=4,
    inliers=3,
    displacement_rms_m=40.0,
    not_found=(NotFound("low_score", 44), NotFound("border_peak", 4)),
    candidates=(Candidate(3, 31.0, -25.5, 2.5), Candidate(2, -80.0, 3.0, 40.0)),
)


def failure(report, stages=(STAGE,), error=None, scene=None) -> FailureReport:
    """A failure with the scene of the sample report."""
    error = NoConsensus("no agreement") if error is None else error
    scene = report.scene if scene is None else scene
    return FailureReport(
        format=FAILURE_FORMAT,
        run=RunRecord("1", datetime.now(UTC), None, "control points", (), RegistrationOptions()),
        verdict=NOT_REGISTERED,
        verdict_explanation=EXPLANATION,
        relative_to_control_points=NO_ACCURACY.relative_to_control_points,
        on_the_earth=NO_ACCURACY.on_the_earth,
        error=type(error).__name__,
        reason=str(error),
        scene=scene,
        visible=60,
        search_stages=stages,
        next_steps=next_steps(error, scene, stages, COMMAND),
        ground=np.zeros((0, 2)),
    )


def commands(report, stages, error) -> list[str]:
    """The commands of the next steps."""
    return [step.command for step in next_steps(error, report.scene, stages, COMMAND)]


def test_the_document_follows_its_schema_and_has_no_figure_of_a_result(report):
    document = report_document(failure(report))
    Draft202012Validator.check_schema(failure_schema())
    Draft202012Validator(failure_schema()).validate(document)
    unread = failure(report, (), FormatError("damaged"), UnreadScene("half"))
    Draft202012Validator(failure_schema()).validate(report_document(unread))
    assert document["verdict"] == "not registered"
    assert not {"criteria", "correction", "predicted", "refined_model", "checks"} & set(document)
    candidate = document["search_stages"][0]["candidates"][0]
    assert (candidate["points"], candidate["east_m"], candidate["north_m"]) == (3, 31.0, -25.5)


def test_hostile_names_stay_text(report):
    scene = replace(report.scene, name=HOSTILE)
    hostile = failure(report, scene=scene, error=NoConsensus(HOSTILE))
    page = Page(format_html(FAILURE_PAGE, hostile))
    assert "script" not in page.tags
    assert HOSTILE in page.texts
    assert not [value for _, value in page.attributes if value and value.startswith("http")]
    unread = failure(report, scene=UnreadScene(HOSTILE), stages=())
    assert HOSTILE in format_text(FAILURE_PAGE, unread)


def test_a_larger_sigma_comes_first_when_the_peaks_lie_at_the_border(report):
    radius_m = 3.0 * report.scene.sigma_m
    at_border = replace(STAGE, at_border=40, search_radius_m=radius_m, needed_radius_m=radius_m)
    first = next_steps(NoConsensus(""), report.scene, (at_border,), COMMAND)[0]
    assert first.command == f"{COMMAND} --sigma-m {2.0 * report.scene.sigma_m:g}"
    assert "40 of 60 best peaks lie at the border" in first.text


def test_a_limited_search_proposes_the_accuracy_that_it_reaches(report):
    limited = replace(STAGE, needed_radius_m=3000.0)
    assert commands(report, (limited,), NoConsensus(""))[0] == f"{COMMAND} --sigma-m 50"


def test_a_search_of_the_middle_of_a_scene_says_so(report):
    middle = replace(STAGE, middle_m=20_008.0)
    steps = next_steps(NoConsensus(""), report.scene, (middle,), COMMAND)
    assert "Only the middle 20.0 km of the scene" in steps[0].text
    assert steps[0].command == COMMAND
    assert "middle" not in " ".join(
        step.text for step in next_steps(NoConsensus(""), report.scene, (STAGE,), COMMAND)
    )


@pytest.mark.parametrize(
    ("error", "begin", "more"),
    [
        (TurnedImage("upside down"), "Turn the image or its model", ""),
        (RescaledImage("2 times finer"), "Give the model of this image", " --model FILE"),
    ],
)
def test_an_image_unlike_its_model_is_not_searched_farther(report, error, begin: str, more: str):
    (step,) = next_steps(error, report.scene, (STAGE,), COMMAND)
    assert step.text.startswith(begin)
    assert step.command == COMMAND + more


def test_an_image_with_lost_lines_is_to_be_cut_before_it_is_searched_otherwise(report):
    """The lines may be lost and the model far off, both."""
    cut, *others = next_steps(BrokenImage("at line 356"), report.scene, (STAGE,), COMMAND)
    assert "cut it at the lines" in cut.text
    assert cut.command == ""
    assert tuple(others) == next_steps(NoConsensus(""), report.scene, (STAGE,), COMMAND)


def test_without_a_visible_point_the_ground_is_looked_up(report):
    lookup, reference, larger = commands(report, (), CoverageError(""))
    west, south = report.scene.footprint_lon_lat.min(axis=0)
    assert lookup.startswith(f"amers points query --bbox {west:.4f},{south:.4f},")
    assert "--reference" in reference
    assert "--sigma-m" in larger


def test_points_of_other_ground_are_looked_for_elsewhere_and_not_farther_out(report):
    command = "amers scene register a.tif --block 'of another country' -o out"
    steps = [one.command for one in next_steps(OtherGround(""), report.scene, (), command)]
    assert len(steps) == 2
    assert not any("--sigma-m" in one or "--block" in one for one in steps)
    assert steps[1].startswith("amers scene register a.tif -o out --reference")


def test_a_stated_accuracy_below_the_smallest_radius_is_raised_beyond_it(report):
    scene = replace(report.scene, sigma_m=0.1)
    nothing = replace(
        STAGE, search_radius_m=6.0, needed_radius_m=0.3, matched=0, at_border=0, candidates=()
    )
    steps = next_steps(NotEnoughPoints(0, 6), scene, (nothing,), COMMAND)
    assert steps[0].command == f"{COMMAND} --sigma-m 4"


def test_an_input_that_cannot_be_used_is_to_be_corrected(report):
    (step,) = next_steps(FormatError("damaged"), UnreadScene("half"), (), COMMAND)
    assert step.command == COMMAND


@pytest.mark.parametrize(
    ("false_alarms", "words"),
    [(3.0, "no more than chance"), (0.01, "one in 100 searches"), (1e-9, "beyond chance")],
)
def test_significance_is_said_in_words(false_alarms: float, words: str):
    assert words in significance_words(false_alarms)
