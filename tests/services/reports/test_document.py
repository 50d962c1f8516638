"""`report.json` says what the registration found, and its schema says what it may hold."""

import json
from dataclasses import replace

import numpy as np
import pytest
from jsonschema import Draft202012Validator, ValidationError

from amers.services.reports.build import with_shares
from amers.services.reports.document import format_report, report_document, report_schema
from amers.services.reports.html import format_html
from amers.services.reports.reasons import count_reasons
from amers.services.reports.registration_pages import REGISTRATION_PAGE
from amers.services.reports.report import BlockUsed
from tests.factories import control_points


def refuse(constant):
    raise AssertionError(f"{constant} is not JSON")


def parsed(report):
    return json.loads(format_report(report), parse_constant=refuse)


def validate(document):
    Draft202012Validator(report_schema()).validate(document)


@pytest.mark.parametrize(
    "of_registration", [{}, {"n": 120, "extent": 0.5}, {"n": 5, "lost": 1, "wrong": 0}, {"compared": 0}]
)
def test_a_report_follows_its_schema(material, of_registration):
    validate(parsed(material(**of_registration).report()))


def test_the_schema_is_a_schema():
    Draft202012Validator.check_schema(report_schema())


def test_the_schema_describes_every_member_of_the_report():
    described = report_schema()["properties"]
    assert [name for name, member in described.items() if "description" not in member] == []
    assert described["verdict"]["enum"] == ["good", "usable", "failed"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.pop("verdict"),
        lambda d: d.update(verdict="excellent"),
        lambda d: d.update(extra=1),
        lambda d: d["point_counts"].update(active="47"),
        lambda d: d["criteria"][0].update(met="yes"),
        lambda d: d["correction"].update(parameters_px=None),
    ],
)
def test_the_schema_refuses_what_a_report_cannot_say(report, spoil):
    document = parsed(report)
    spoil(document)
    with pytest.raises(ValidationError):
        validate(document)


def test_the_figures_are_those_of_the_registration(material):
    made = material()
    document = parsed(made.report())
    measures, qualification = made.measures, made.registration.qualification
    assert document["point_counts"]["active"] == int(measures.active.sum())
    assert document["image_residuals_px"]["x"]["std"] == qualification.image_residuals_px.x.std
    assert (
        document["correction"]["parameters_px"]
        == made.registration.adjustment.correction.parameters.tolist()
    )
    assert document["correction"]["std_px"][0][1] == pytest.approx(
        np.sqrt(made.registration.adjustment.covariance[1, 1])
    )
    assert document["correction"]["shift_m"] == pytest.approx(0.5 * np.hypot(12.0, 7.0), rel=0.02)
    assert document["verdict"] == "good"
    assert document["run"]["started_at"] == "2026-01-02T03:04:05+00:00"
    assert document["run"]["options"]["qualification"]["good_active_points"] == 20
    assert "z" not in document["image_residuals_px"]
    assert set(document["ground_residuals_m"]) == {"east", "north", "horizontal"}


def test_what_could_not_be_computed_is_null(material):
    made = material(n=5, lost=1, wrong=0)
    refined_model = replace(made.refined_model, max_error_px=float("nan"))
    run = replace(made.run, started_at=None)
    document = parsed(replace(made, refined_model=refined_model, run=run).report())
    assert document["refined_model"]["max_error_px"] is None
    assert document["stability"]["held_out_px"]["x"]["mean"] is None
    assert document["run"]["started_at"] is None
    validate(document)


def test_every_point_that_is_not_active_is_counted_under_one_reason(material):
    made = material()
    reasons = count_reasons(made.measures)
    unmatched = sum(r.count for r in reasons if r.stage == "not matched")
    deactivated = sum(r.count for r in reasons if r.stage == "deactivated")
    assert unmatched == (~made.measures.matched).sum() == 8
    assert deactivated == (made.measures.matched & ~made.measures.active).sum() >= 4
    assert {r.reason for r in reasons} == {
        "score under 0.8",
        "second peak too close",
        "beyond 2.7 sigma",
    }


def test_a_missing_reason_is_reported_as_missing(material):
    measures = material().measures
    nameless = replace(measures, reason=np.full(len(measures.reason), ""))
    assert {r.reason for r in count_reasons(nameless)} == {"no reason given"}


@pytest.mark.parametrize(
    ("order", "sentences"),
    [
        ("shift", ["shift: +12.00 px in line, -7.00 px in sample (6.95 m)"]),
        (
            "drift",
            [
                "shift: +12.00 px in line, -7.00 px in sample (6.95 m)",
                "drift at the last line and sample: +1.50 px in line, +0.50 px in sample (0.79 m)",
            ],
        ),
        (
            "affine",
            [
                "shift: +12.00 px in line, -7.00 px in sample (6.95 m)",
                "drift along the lines, at the last line: +1.50 px in line, +0.20 px in sample (0.76 m)",
                "drift along the samples, at the last sample: -0.30 px in line, +0.50 px in sample"
                " (0.29 m)",
            ],
        ),
    ],
)
def test_the_correction_is_stated_in_sentences(material, order, sentences):
    made = material()
    before = made.registration.adjustment
    correction = replace(before.correction, parameters=np.array([[12.0, 1.5, -0.3], [-7.0, 0.2, 0.5]]))
    adjustment = replace(before, correction=correction, order=order)
    registration = replace(made.registration, adjustment=adjustment)
    words = replace(made, registration=registration).report().correction.words
    assert list(words) == sentences


def test_a_value_that_no_reader_would_understand_is_refused(material):
    made = material()
    unknown = replace(made, run=replace(made.run, blocks=(object(),)))
    with pytest.raises(TypeError, match="cannot hold a object"):
        report_document(unknown.report())


def test_a_reader_needs_no_other_source_for_words(report):
    document = parsed(report)
    for criterion in document["criteria"]:
        assert criterion["label"]
        assert criterion["calculation"].endswith(".")
        assert {"unit", "decimals", "met"} <= set(criterion)
    assert all(reason["label"] for reason in document["reasons"])
    assert document["verdict_explanation"] == "Every criterion is met."


def test_what_only_the_figures_draw_is_not_part_of_the_document(report):
    assert "figure_data" not in parsed(report)
    assert "figure_data" not in report_schema()["properties"]


def test_a_report_says_which_block_gave_which_points(material):
    made = material()
    measures = made.registration.measures
    points = control_points(len(measures.point_id), np.random.default_rng(2))
    coarse = np.arange(len(points)) % 3 == 0
    covariance_m2 = np.where(coarse, 9.0, 0.04)[:, None, None] * np.eye(3)
    points = replace(
        points,
        id=measures.point_id,
        block=coarse.astype(np.int64),
        covariance_m2=covariance_m2,
        frames=points.frames * 2,
    )
    blocks = with_shares((BlockUsed("fine", "1"), BlockUsed("coarse", "2")), points, measures)
    assert [(one.id, one.sigma_m) for one in blocks] == [
        ("fine", pytest.approx(0.2)),
        ("coarse", pytest.approx(3.0)),
    ]
    assert [one.visible for one in blocks] == [(~coarse).sum(), coarse.sum()]
    assert sum(one.active for one in blocks) == measures.active.sum()
    shown = made.report()
    shown = replace(shown, run=replace(shown.run, blocks=blocks))
    validate(parsed(shown))
    page = format_html(REGISTRATION_PAGE, shown)
    assert f"coarse, version 2 ({blocks[1].active} of {blocks[1].visible} points used, sigma 3.0" in page
