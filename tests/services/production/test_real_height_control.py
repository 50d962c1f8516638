"""Real pairs whose heights are biased by metres take those of an elevation model as control."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from amers.services.adjustment.intersection import intersect
from amers.services.formats.elevation.dem import read_dem
from amers.services.imagery.scene import Scene
from amers.services.matching.ground_features import FeatureOptions
from amers.services.production.control import Control
from amers.services.production.height_control import ControlHeights
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.production.tie_points import find_tie_points
from amers.services.tasks import Work
from amers.services.types import Frame, no_progress
from tests.services.production.test_surface_heights import ElevationModel, read_triplet

pytestmark = [pytest.mark.long, pytest.mark.real_data]

OPTIONS = ProductionOptions(fine_gsd_m=0.5, coarse_gsd_m=2.0, surface_pairs=0)
PLEIADES_SIGMA_M = 4.0
DSM_SIGMA_M = 1.0
DSM_FRAME_M = (2.0, 0.3)


def height_bias_m(made: Production, scenes: list[Scene], dsm: Path) -> float:
    """By how much thousands of tie points lie above the model, where they fit it best."""
    with rasterio.open(dsm) as raster:
        model = ElevationModel(
            raster.read(1, masked=True).astype(np.float64).filled(np.nan),
            raster.transform,
            Transformer.from_crs(4326, 32631, always_xy=True),
        )
    ties = find_tie_points(scenes, [], FeatureOptions(), Work(), no_progress)
    tied = intersect(made.adjustment.models, ties, int(ties.point[-1]) + 1).lon_lat_h
    tied = tied[np.isfinite(tied[:, 0])]
    return float(model.translation(tied, tied[:, 2])[2])


@pytest.mark.endurance
@pytest.mark.parametrize("pair", [("img_01", "img_02"), ("img_02", "img_03")])
def test_the_heights_of_a_pair_become_those_of_the_model(real_data: Path, pair) -> None:
    folder = real_data / "phr_calanques_triplet"
    dsm = folder / "expected_output" / "dsm.tif"
    scenes = [replace(scene, sigma_m=PLEIADES_SIGMA_M) for scene in read_triplet(folder, pair)]
    terrain = replace(read_dem(dsm, "ellipsoid"), sigmas=DSM_SIGMA_M)
    heights = ControlHeights("dsm.tif", terrain, Frame.from_sigmas(*DSM_FRAME_M))
    free = produce_points(scenes, OPTIONS)
    placed = produce_points(scenes, OPTIONS, control=Control(heights=(heights,)))
    before_m, after_m = (height_bias_m(made, scenes, dsm) for made in (free, placed))
    frame, used = placed.points.frames[0], placed.adjustment.control_active
    print(
        f"{pair}: {before_m:.2f} m of {free.points.frames[0].sigma_up_m:.1f} above the model, with "
        f"control {after_m:.2f} m of {frame.sigma_up_m:.2f}, {used.sum()} of {len(used)} used"
    )
    assert abs(before_m) > 1.5
    assert abs(after_m) < 1.0
    assert abs(after_m) < 3.0 * frame.sigma_up_m
    assert frame.sigma_up_m < 1.5
