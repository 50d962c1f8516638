"""The quality of blocks of real images, against another date and against a surface model."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from amers.app.cli.main import app as commands
from amers.app.usecases.blocks.quality import (
    HeightFiles,
    QualityReferences,
    RequiredQuality,
    SiteFile,
    assess_folder,
)
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.ortho_production import OrthoFiles, run_ortho_production
from amers.app.usecases.terrain_file import TerrainFile

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

MAY_AGAINST_JUNE_M = np.array([6.4, 18.3])
"""East and north shift of the May scene against the June scene, from SIFT features over both."""
SHIFT_ALLOWED_M = 1.0
DSM_SIGMA_M = 0.5
BIAS_ALLOWED_M = 1.0


def test_june_points_lie_as_far_off_the_may_scene_as_features_say(
    real_data: Path, tmp_path: Path
) -> None:
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    files = OrthoFiles((june,), flat_m=80.0, height_sigma_m=30.0)
    run_ortho_production(files, tmp_path / "june", BlockIdentity("june"))
    references = QualityReferences(sites=(SiteFile(may),), images=(june,))
    report = assess_folder(tmp_path / "june", references, RequiredQuality(ce90_m=25.0))
    for source in report.planimetry:
        (site,) = source.sites
        print(f"{source.source}: {site.accuracy.n} of {site.tried}, {site.accuracy.bias_m} m")
        assert_allclose(site.accuracy.bias_m, -MAY_AGAINST_JUNE_M, atol=SHIFT_ALLOWED_M)
        assert site.accuracy.n > 50
        # Without the shift, two dates of one sensor agree to a third of a pixel.
        assert source.relative.ce90_m.value < 10.0 / 3.0
    of_points = report.planimetry[0]
    assert of_points.normalised_frame.mean_square < of_points.normalised_frame.upper
    assert [criterion.outcome for criterion in report.criteria] == ["met", "met"]


@pytest.mark.endurance
def test_surfaces_of_three_views_agree_with_the_surface_model(real_data: Path, tmp_path: Path) -> None:
    triplet = real_data / "phr_calanques_triplet"
    block = tmp_path / "calanques"
    images = [w for k in (1, 2, 3) for w in ("--images", str(triplet / f"img_0{k}.tif"))]
    words = ["production", "run", *images, "--gsd-m", "0.5,2", "-o", str(block)]
    made = CliRunner().invoke(commands, words, catch_exceptions=False)
    assert made.exit_code == 0, made.output
    dsm = TerrainFile(triplet / "expected_output" / "dsm.tif", "ellipsoid")
    references = QualityReferences(heights=HeightFiles(dsm, sigma_m=DSM_SIGMA_M))
    report = assess_folder(block, references, RequiredQuality(le90_m=5.0))
    heights = report.heights
    assert heights is not None
    found = heights.on_the_earth
    print(f"{found.n} surfaces, bias {found.bias_m:.2f} m, NMAD {found.nmad_m:.2f} m, {found.le90_m}")
    assert heights.compared == "surface"
    assert heights.outside > 0  # the model has voids
    assert abs(found.median_m) < BIAS_ALLOWED_M
    assert found.le90_m.value < 2.0
    assert heights.typical_ratio < 1.5
