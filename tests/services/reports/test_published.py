"""The published tables: their columns, and their definitions held against the published figures."""

import math
from dataclasses import replace

import pytest

from amers.services.reports.published import published_tables


def test_a_published_row_comes_out_of_its_own_counts_and_components(material):
    """S7PX--2017021834832683CP: 494 of 526 of 997; P1BPX-2019080641037699CP: -2.9, 1.3, 3.4, 2.0."""
    report = material().report()
    counts = replace(
        report.point_counts,
        visible=997,
        matched=526,
        active=494,
        active_of_matched=494 / 526,
        active_of_visible=494 / 997,
    )
    residuals = report.image_residuals_px
    residuals = replace(
        residuals, x=replace(residuals.x, mean=-5.8, std=6.8), y=replace(residuals.y, mean=2.6, std=4.0)
    )
    point_counts, image, *_ = published_tables(
        replace(report, point_counts=counts, image_residuals_px=residuals)
    )
    published_percent = (93.9, 49.5)
    assert point_counts.values[:2] == pytest.approx(published_percent, abs=0.05)
    assert report.scene.gsd_m == 0.5
    published_m = (-2.9, 1.3, 3.2, 3.4, 2.0, 3.9)
    assert image.values == pytest.approx(published_m, abs=0.05)


def test_a_scene_without_draws_has_dashes_and_the_reason(material):
    report = material(n=5, lost=1, wrong=0).report()
    table = published_tables(report)[3]
    assert all(math.isnan(value) for value in table.values[:10])
    assert table.note == report.stability.note != ""
