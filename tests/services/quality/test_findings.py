"""What a correction does not follow harms the stated accuracy by its size, and no verdict otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.imagery.pixel_checks import Fault, PixelFinding
from amers.services.misfit.structure import Family, Structure
from amers.services.quality.findings import _parts, shared_residual_px, with_findings
from amers.services.quality.normal_law import CIRCULAR_CE90
from amers.services.quality.points_elsewhere import Elsewhere
from amers.services.quality.qualification import Qualification, QualificationOptions, qualify
from amers.services.quality.stability import AdjustedScene
from tests.services.conftest import Make


def qualified(scene: AdjustedScene) -> Qualification:
    return qualify(scene, QualificationOptions(), np.random.default_rng(3))


def structure(family: Family, size_px: float, chance: float) -> Structure:
    return Structure(family, chance, "period", 800.0, np.full(2, size_px), size_px, np.full(2, np.nan))


@pytest.mark.parametrize("family", ["lines", "steps", "samples", "seams", "image"])
def test_what_is_significant_and_harmless_is_a_note(registered: Make, family: Family) -> None:
    """Four centimetres at 1e-23: the adjustment has stated what it may be off by."""
    scene = registered()
    told = replace(scene.adjustment, structures=(structure(family, 0.08, 1e-23),))
    result = qualified(replace(scene, adjustment=told).adjusted())
    assert result.verdict == "good"
    assert [one.name for one in result.findings] == [f"structure_{family}"]
    chance = replace(scene.adjustment, structures=(structure(family, 0.08, 1e-3),))
    assert qualified(replace(scene, adjustment=chance).adjusted()).findings == ()


def fault(kind: Fault, amount_px: float, line: int = 2000, lines: int = 5) -> PixelFinding:
    return PixelFinding(kind, line, 0, lines, 3000, amount_px, 9.0, f"{kind.value} here")


@pytest.mark.parametrize("kind", [Fault.ODD_LINES, Fault.ODD_SAMPLES, Fault.BANDS])
def test_pixels_that_are_displaced_everywhere_are_in_the_accuracy(registered: Make, kind: Fault) -> None:
    scene = registered().adjusted()
    clean = qualified(scene).predicted.overall_px
    for amount_px, verdict in ((0.1, "good"), (2.0, "usable"), (9.0, "failed")):
        result = qualified(replace(scene, pixel_findings=(fault(kind, amount_px),)))
        assert result.verdict == verdict
        assert result.predicted.overall_px == pytest.approx(np.hypot(clean, amount_px), rel=0.02)
        assert [one.words for one in result.findings] == [f"{kind.value} here"]


def test_a_fault_with_a_place_is_told_and_harms_by_what_points_show(registered: Make) -> None:
    scene = registered().adjusted()
    found = (fault(Fault.PART, 12.0), fault(Fault.REPEATED_LINES, 5.0))
    result = qualified(replace(scene, pixel_findings=found))
    assert result.verdict == "good"
    assert {one.name for one in result.findings} == {"part of another image", "repeated lines"}
    assert result.predicted.overall_px == qualified(scene).predicted.overall_px


def test_parts_of_an_image_end_where_its_breaks_and_faults_are(registered: Make) -> None:
    """Of 4000 lines of 5000 samples: some are lost behind the named one, or repeat from it on."""
    kinds = Fault.LOST_SAMPLES, Fault.REPEATED_SAMPLES, Fault.PART, Fault.BANDS
    faults = tuple(replace(fault(kind, 1.0, 700, 300), sample=2000, samples=900) for kind in kinds)
    scene = registered().adjusted()
    broken = replace(scene, breaks=np.array([1300]), pixel_findings=faults)
    of_breaks = [[0, 1299, 0, 4999], [1300, 3999, 0, 4999]]
    lost = [[0, 3999, 0, 2000], [0, 3999, 2001, 4999]]
    repeated = [[0, 3999, 0, 1999], [0, 3999, 2000, 4999]]
    assert _parts(broken).tolist() == [*of_breaks, *lost, *repeated, [700, 999, 2000, 2899]]
    assert not len(_parts(scene))


@pytest.mark.parametrize(("away_px", "pull_px"), [(0.4, 0.4), (5.0, 1.0), (40.0, 1.0)])
def test_a_second_image_pulls_matches_by_a_pixel_however_far_it_lies(
    registered: Make, away_px: float, pull_px: float
) -> None:
    scene = registered().adjusted()
    clean = qualified(scene).predicted.overall_px
    result = qualified(replace(scene, pixel_findings=(fault(Fault.SECOND_IMAGE, away_px),)))
    assert result.predicted.overall_px == pytest.approx(np.hypot(clean, pull_px), rel=0.02)


def test_a_part_behind_a_break_without_three_points_is_not_held(registered: Make) -> None:
    scene = registered(n=120).adjusted()
    lines, samples = scene.shape
    line = np.sort(scene.measures.line_sample[scene.measures.active, 0])
    behind = int(line[-3]) + 1
    result = qualified(replace(scene, breaks=np.array([behind])))
    (finding,) = result.findings
    assert f"line {behind}" in finding.words
    assert "1 of the 2 parts" in finding.words
    places = np.array([[0.5 * (behind + lines), 0.2 * samples], [lines - 2.0, 0.8 * samples]])
    assert not result.coverage.holds(places).any()
    assert result.coverage.percent < qualified(scene).coverage.percent
    held = qualified(replace(scene, breaks=np.array([int(line[-3]) - 1])))
    assert "parts" not in held.findings[0].words


def test_points_elsewhere_among_the_others_harm_by_their_share(registered: Make) -> None:
    """Detectors that alternate: neither place is that of the scene. A part by itself is not held."""
    scene = registered(n=400, lost=0, wrong=0).adjusted()
    place = scene.measures.line_sample
    clean_px = qualified(scene).predicted.overall_px
    of_detectors = (place[:, 1] // (scene.shape[1] / 40.0)) % 3 == 0
    of_a_corner = (place < 0.35 * np.array(scene.shape)).all(axis=1)
    for beside, in_accuracy in ((of_detectors, True), (of_a_corner, False)):
        active = scene.measures.active & ~beside
        measures = replace(scene.measures, active=active)
        group = Elsewhere(np.flatnonzero(beside), np.array([5.0, 0.0]), 2.5, 1e-9)
        result = qualified(replace(scene, measures=measures, elsewhere=group))
        (finding,) = (one for one in result.findings if one.name == "points_elsewhere")
        if in_accuracy:
            share = beside.sum() / (beside.sum() + active.sum())
            assert finding.harm_px.max() == pytest.approx(np.sqrt(share / 2.0) * 5.0, rel=0.35)
            assert result.predicted.overall_px > 2.5
        else:
            assert result.predicted.overall_px < clean_px + 1.5
            corner = np.array([[0.15, 0.15]]) * scene.shape
            assert not result.coverage.holds(corner).any()


@pytest.mark.parametrize("stated_px", [0.0, 5.0])
def test_what_neighbours_share_harms_whatever_points_state(registered: Make, stated_px: float) -> None:
    """A model with too few parameters leaves residuals that neighbours share; points do not."""
    scene = registered(n=300, lost=0, wrong=0)
    measures = replace(scene.measures, active=np.ones(300, dtype=bool))
    wave_px = 2.0 * np.sin(measures.line_sample / 500.0)
    scatter_px = np.random.default_rng(1).normal(0.0, 1.4, (300, 2))
    adjustment = replace(scene.adjustment, point_sigma_px=np.full(2, stated_px))
    bent = replace(scene, measures=replace(measures, residual_px=wave_px), adjustment=adjustment)
    found = with_findings(bent.adjusted())
    assert [one.name for one in found.findings] == ["neighbours"]
    assert found.adjustment.local_sigma_px == pytest.approx(wave_px.std(axis=0), rel=0.25)
    assert CIRCULAR_CE90 * found.adjustment.local_sigma_px.max() > 2.0
    scattered = replace(measures, residual_px=scatter_px)
    assert shared_residual_px(scattered) == pytest.approx(np.zeros(2), abs=0.4)
    few = replace(measures, residual_px=wave_px, active=np.arange(300) < 11)
    np.testing.assert_array_equal(shared_residual_px(few), np.zeros(2))
