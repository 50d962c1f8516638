"""The published tables, as a terminal shows them."""

import re
from dataclasses import asdict, replace
from html import unescape

import numpy as np
import pytest

from amers.services.quality.accuracy import sample_quantile
from amers.services.reports.document import report_document
from amers.services.reports.html import format_html
from amers.services.reports.numbers import number, quantile
from amers.services.reports.registration_pages import REGISTRATION_PAGE
from amers.services.reports.text import format_text


def row(text, start):
    """The cells of the first table row whose first cell is `start`."""
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("│┃").replace("┃", "│").split("│")]
        if cells[0] == start:
            return cells
    raise AssertionError(f"no row {start!r} in\n{text}")


def test_the_table_of_point_counts_has_the_published_columns_and_the_counts(material):
    made = material(name="scene A")
    active = int(made.measures.active.sum())
    text = format_text(REGISTRATION_PAGE, made.report())
    assert row(text, "Scene")[1:] == ["Popini", "Spatio", "Actif", "Actif/Spatio", "Actif/Popini"]
    assert row(text, "scene A")[1:] == [
        "60",
        "52",
        str(active),
        f"{100 * active / 52:.0f} %",
        f"{100 * active / 60:.0f} %",
    ]


def test_a_report_is_written_and_not_shown_where_the_program_is_a_notebook(report, monkeypatch, capsys):
    text = format_text(REGISTRATION_PAGE, report)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert format_text(REGISTRATION_PAGE, report) == text != ""
    assert capsys.readouterr().out == ""


def test_the_residual_table_says_mean_and_deviation_of_each_coordinate(material):
    made = material()
    residual = made.measures.residual_px[made.measures.active]
    text = format_text(REGISTRATION_PAGE, made.report())
    assert row(text, "x (sample)")[1] == str(len(residual))
    assert row(text, "x (sample)")[3] == f"{residual[:, 1].std(ddof=1):.3f}"
    assert row(text, "y (line)")[3] == f"{residual[:, 0].std(ddof=1):.3f}"
    assert row(text, "xy")[2] == f"{np.hypot(*residual.T).mean():.3f}"
    assert row(text, "east")[5] == "m"
    assert "Z" not in text


def test_the_stability_table_says_what_it_does_not_show(report):
    text = " ".join(format_text(REGISTRATION_PAGE, report).split())
    assert "Shows stability, not absolute accuracy." in text
    assert "top left" in text


def test_hold_outs_by_cells_stand_beside_those_at_random_with_what_they_show(material):
    report = material(n=200).report()
    means = report.cell_stability.group_means
    pages = (
        format_text(REGISTRATION_PAGE, report),
        re.sub("<[^>]+>", "", unescape(format_html(REGISTRATION_PAGE, report))),
    )
    for text in (" ".join(page.split()) for page in pages):
        assert text.index("Shows stability" if "Shows" in text else "shows stability") < text.index(
            "Stability by cells"
        )
        assert f"{report.cell_stability.left_out} adjustments, each without the active points" in text
        assert text.count("times what independent errors give") == 2
        assert f"{means.over_independent:.1f} times what independent errors give" in text
        assert f"{means.over_stated:.1f} times what the stated accuracy gives" in text
        assert "a common error of neighbours stays hidden" in text
        assert "An error of all points" in text
        assert "No verdict depends on this" in text
    assert report_document(report)["cell_stability"]["group_means"] == asdict(means)


def test_an_unmet_criterion_stands_out_with_its_value_and_limit(material):
    text = format_text(REGISTRATION_PAGE, material(n=12, lost=0, wrong=0).report())
    assert row(text, "Active points")[2:] == ["at least 20", "good", "NO"]
    assert int(row(text, "Active points")[1]) <= 12
    assert "Verdict: usable" in text or "Verdict: failed" in text


def test_names_with_brackets_are_shown_as_they_are(report):
    scene = replace(report.scene, name="[bold]x[/bold]")
    text = format_text(REGISTRATION_PAGE, replace(report, scene=scene))
    assert "Registration of [bold]x[/bold]\nVerdict: good, relative" in text
    assert row(text, "[bold]x[/bold]")[1] == "60"


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1.234, "1.23 m"), (-0.001, "0.00 m"), (float("nan"), "–")],  # noqa: RUF001
)
def test_numbers_are_written_for_people(value, shown):
    assert number(value, 2, "m") == shown


def test_a_quantile_is_written_with_what_its_sample_allows_to_say():
    values = np.arange(1.0, 101.0)
    assert quantile(sample_quantile(values)) == "90.63 m (90 % interval: 85.00 to 96.00 m, n = 100)"
    assert quantile(sample_quantile(values[:20])).endswith("interval: at least 16.00 m, n = 20)")
    assert quantile(sample_quantile(values[:1])).endswith("interval: not bounded, n = 1)")
