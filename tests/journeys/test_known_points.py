"""Points of a base without chips, on real images: chips from two views, a third registered on them."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio

from tests.command_line import amers_here

pytestmark = [pytest.mark.long, pytest.mark.real_data, pytest.mark.thorough]

SPACING_M = 30.0
BIAS_PX = 1.2
"""Between the first and the third view as delivered, from tie points."""


def amers(*words: object) -> dict:
    """What a command that needs no service prints."""
    done = amers_here((*words, "--json"), os.environ)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.endurance
def test_a_lattice_with_heights_of_a_surface_model_gets_chips_that_register_another_view(
    real_data: Path, tmp_path: Path
) -> None:
    folder = real_data / "phr_calanques_triplet"
    dsm = folder / "expected_output" / "dsm.tif"
    with rasterio.open(dsm) as file:
        left, bottom, right, top = file.bounds
    x, y = np.meshgrid(np.arange(left, right, SPACING_M), np.arange(bottom, top, SPACING_M))
    base = tmp_path / "base.csv"
    base.write_text(
        "# crs=EPSG:32631\nx,y\n" + "".join(f"{e},{n}\n" for e, n in zip(x.flat, y.flat, strict=True))
    )
    block = tmp_path / "calanques"
    images = ("--images", folder / "img_01.tif", "--images", folder / "img_02.tif")
    heights = ("--dem", dsm, "--dem-vertical", "ellipsoid", "--height-sigma-m", "1")
    sigmas = ("--point-sigma-m", "0.1,1", "--gsd-m", "0.5,2")
    made = amers("production", "points", base, *images, "-o", block, *heights, *sigmas)
    print(json.dumps(made, indent=1))
    assert made["points"] > 60
    assert made["points"] + sum(made["left_out"].values()) == x.size
    assert made["left_out"]["no height"] > 0  # the surface model has voids
    assert made["local_sigma_m"] < 0.5
    out = tmp_path / "third"
    result = amers("scene", "register", folder / "img_03.tif", "--block", block, "-o", out)
    print(result["verdict"], result["active"], result["visible"], result["shift_px"])
    assert result["verdict"] in ("good", "usable")
    assert result["active"] > 30
    assert np.hypot(*result["shift_px"]) == pytest.approx(BIAS_PX, abs=0.3)
