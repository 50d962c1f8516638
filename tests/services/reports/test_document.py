"""`report.json` says what the registration found, and its schema says what it may hold."""

import json
from dataclasses import replace

import numpy as np
import pytest
from jsonschema import Draft202012Validator, ValidationError

from services.reports.document import format_report, report_document, report_schema
from services.reports.report import build_report, count_reasons


def refuse(constant):
    raise AssertionError(f"{constant} is not JSON")


def parsed(report):
    return json.loads(format_report(report), parse_constant=refuse)


def validate(document):
    Draft202012Validator(report_schema()).validate(document)


@pytest.mark.parametrize(
    "of_registration",
    [{}, {"n": 120, "extent": 0.5}, {"n": 5, "lost": 1, "wrong": 0}, {"pairs": 0}],
)
def test_a_report_follows_its_schema(summarised, of_registration):
    validate(parsed(build_report(summarised(**of_registration))))


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
        lambda d: d["equipment"].update(active="47"),
        lambda d: d["criteria"][0].update(passed="yes"),
        lambda d: d["correction"].update(parameters_px=None),
    ],
)
def test_the_schema_refuses_what_a_report_cannot_say(report, spoil):
    document = parsed(report)
    spoil(document)
    with pytest.raises(ValidationError):
        validate(document)


def test_the_figures_are_those_of_the_registration(summarised):
    summary = summarised()
    document = parsed(build_report(summary))
    measures, found = summary.measures, summary.qualification
    assert document["equipment"]["active"] == int(measures.active.sum())
    assert document["image_residuals_px"]["x"]["std"] == found.image_residuals_px.x.std
    assert document["correction"]["parameters_px"] == summary.adjustment.correction.parameters.tolist()
    assert document["correction"]["std_px"][0][1] == pytest.approx(
        np.sqrt(summary.adjustment.covariance[1, 1])
    )
    assert document["correction"]["shift_m"] == pytest.approx(0.5 * np.hypot(12.0, 7.0), rel=0.02)
    assert document["verdict"] == "good"
    assert document["started_at"] == "2026-01-02T03:04:05+00:00"
    assert document["options"]["qualification"]["good_active_points"] == 20
    assert "z" not in document["image_residuals_px"]
    assert set(document["ground_residuals_m"]) == {"east", "north", "horizontal"}


def test_what_could_not_be_computed_is_null(summarised):
    summary = summarised(n=5, lost=1, wrong=0)
    document = parsed(build_report(replace(summary, refit_error_px=float("nan"), started_at=None)))
    assert document["correction"]["refit_error_px"] is None
    assert document["stability"]["held_out_px"]["x"]["mean"] is None
    assert document["started_at"] is None
    validate(document)


def test_every_point_that_is_not_active_is_counted_under_one_reason(summarised):
    summary = summarised()
    reasons = count_reasons(summary.measures)
    unmatched = sum(r.count for r in reasons if r.stage == "not matched")
    deactivated = sum(r.count for r in reasons if r.stage == "deactivated")
    assert unmatched == (~summary.measures.matched).sum() == 8
    assert deactivated == (summary.measures.matched & ~summary.measures.active).sum() >= 4
    assert {r.reason for r in reasons} == {
        "score under 0.8",
        "second peak too close",
        "beyond 2.7 sigma",
    }


def test_a_missing_reason_is_said_to_be_missing(summarised):
    measures = summarised().measures
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
def test_the_correction_is_told_in_words(summarised, order, sentences):
    summary = summarised()
    correction = replace(
        summary.adjustment.correction, parameters=np.array([[12.0, 1.5, -0.3], [-7.0, 0.2, 0.5]])
    )
    adjustment = replace(summary.adjustment, correction=correction, order=order)
    words = build_report(replace(summary, adjustment=adjustment)).correction.words
    assert list(words) == sentences


def test_a_value_that_no_reader_would_understand_is_refused(summarised):
    summary = replace(summarised(), blocks=(object(),))
    with pytest.raises(TypeError, match="cannot hold a object"):
        report_document(build_report(summary))
