"""Real pairs: blocks made from them are ingested, and the rays of their images intersect."""

from pathlib import Path

import pytest

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

a_tenth_of_a_pixel = 0.1
what_features_allow_px = 0.11


@pytest.mark.parametrize(
    ("folder", "images", "delivered_px", "least_points"),
    [
        ("phr_gizeh_pair", ("img1.tif", "img2.tif"), (0.2, 0.4), 100),
        ("phr_ventoux_pair", ("left_image.tif", "right_image.tif"), (2.0, 3.0), 30),
    ],
)
def test_a_real_pair_becomes_a_block_whose_rays_meet(
    real_data: Path, amers, tmp_path, folder, images, delivered_px, least_points
):
    block = tmp_path / folder.replace("_", "-")
    words = [word for name in images for word in ("--images", real_data / folder / name)]
    made = amers("production", "run", *words, "--gsd-m", "0.5,2", "-o", block)
    low, high = delivered_px
    assert low < made["ray_residual_delivered_px"] < high
    assert made["ray_residual_adjusted_px"] < what_features_allow_px
    assert made["ray_residual_points_px"] < a_tenth_of_a_pixel
    assert made["points"] >= least_points
    ingested = amers("block", "ingest", block, "--publish")
    assert ingested["block"]["state"] == "published"
    assert ingested["block"]["points"] == made["points"]
