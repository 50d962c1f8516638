"""The page over the reports of many scenes."""

import math

from amers.services.reports.overview import OverviewRow, format_overview

HOSTILE = "<script>alert(1)</script>.tif"


def test_the_page_counts_verdicts_and_links_to_the_report_of_each_scene():
    rows = [
        OverviewRow(
            "a.tif", "good", "CE90 0.11 m", "CE90 3.40 m", "40 of 41", 51.2, "", "a/report.html"
        ),
        OverviewRow(
            "b.tif", "good", "CE90 0.12 m", "CE90 3.40 m", "39 of 41", 50.2, "", "b/report.html"
        ),
        OverviewRow(HOSTILE, "not registered", "none", "none", "", math.nan, "a damaged file", ""),
    ]
    page = format_overview(rows)
    assert "<h1>3 scenes: 2 good, 1 not registered</h1>" in page
    assert '<a href="a/report.html">a.tif</a>' in page
    assert page.count("<a href") == 2
    assert "51.2 m" in page
    assert "nan" not in page
    assert "<script>" not in page
    assert "a damaged file" in page
    assert "://" not in page
