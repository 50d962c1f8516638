"""Reports as a terminal shows them."""

import re
from dataclasses import replace

import numpy as np
import pytest

from amers.services.quality.accuracy import sample_quantile
from amers.services.reports.numbers import number, quantile
from amers.services.reports.registration_pages import REGISTRATION_PAGE
from amers.services.reports.text import format_text


def test_a_report_is_written_and_not_shown_where_the_program_is_a_notebook(report, monkeypatch, capsys):
    text = format_text(REGISTRATION_PAGE, report)
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    assert format_text(REGISTRATION_PAGE, report) == text != ""
    assert capsys.readouterr().out == ""


def test_names_with_brackets_are_shown_as_they_are(report):
    scene = replace(report.scene, name="[bold]x[/bold]")
    text = format_text(REGISTRATION_PAGE, replace(report, scene=scene))
    assert "Registration of [bold]x[/bold]\nVerdict: good, relative" in text
    assert re.search(r"│ \[bold]x\[/bold] +│ +60 ", text)


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
