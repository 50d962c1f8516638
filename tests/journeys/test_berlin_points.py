"""Points made from one Sentinel-2 image, and a scene of another day registered on them."""

from pathlib import Path

import numpy as np
import pytest

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

SHIFT_M = np.array([6.4, 18.3])
"""East and north shift of the May scene against the June scene, from SIFT features over both."""
SHIFT_ALLOWED_M = 1.0
GSD_M = 10.0


@pytest.mark.endurance
def test_both_dates_of_berlin_make_one_block_that_registers_the_may_scene_too(
    real_data: Path, amers, tmp_path
) -> None:
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    block = tmp_path / "berlin-both"
    heights = ("--height-m", "80", "--height-sigma-m", "30")
    made = amers("production", "ortho", june, may, *heights, "-o", block)
    print(f"{made['points']} points, {made['views']} chips, local sigma {made['local_sigma_m']} m")
    (_, shift_m) = made["image_shifts_east_north_m"]
    assert np.abs(np.array(shift_m) - SHIFT_M).max() < SHIFT_ALLOWED_M
    assert made["points"] > 100  # those under the clouds of May are not found in both
    assert made["views"] > 2 * made["points"]  # coarse chips are not whole everywhere
    result = amers("scene", "register", may, "--block", block, "-o", tmp_path / "may")
    line_px, sample_px = result["shift_px"]
    found_m = np.array([sample_px, -line_px]) * GSD_M
    print(f"{found_m} m, {result['active']} of {result['visible']} points, {result['verdict']}")
    assert np.abs(found_m - SHIFT_M).max() < SHIFT_ALLOWED_M
    assert result["verdict"] == "good"
    assert result["matched"] > 0.9 * result["visible"]


@pytest.mark.endurance
def test_the_may_scene_of_berlin_is_registered_on_points_of_the_june_one(
    real_data: Path, amers, tmp_path
) -> None:
    (june,) = (real_data / "s2a_berlin_pair").glob("ref_*.tif")
    (may,) = (real_data / "s2a_berlin_pair").glob("tgt_*.tif")
    block = tmp_path / "berlin-june"
    heights = ("--height-m", "80", "--height-sigma-m", "30")
    made = amers("production", "ortho", june, *heights, "-o", block)
    assert made["points"] > 150
    assert made["chip_gsds_m"] == [10.0, 40.0]
    ingested = amers("block", "ingest", block, "--publish")["block"]
    assert (ingested["state"], ingested["points"]) == ("published", made["points"])

    out = tmp_path / "may"
    result = amers("scene", "register", may, "-o", out)
    line_px, sample_px = result["shift_px"]
    found_m = np.array([sample_px, -line_px]) * GSD_M
    counts = f"{result['active']} of {result['visible']} points"
    print(f"{found_m} m east and north, {counts}, {result['verdict']}")
    assert np.abs(found_m - SHIFT_M).max() < SHIFT_ALLOWED_M
    assert result["verdict"] == "good"
    assert result["matched"] < 0.8 * result["visible"]  # The other points lie under the clouds of May.
