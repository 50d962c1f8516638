"""Three real views, each with an injected error, registered together on points made from two of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.source import Window
from amers.services.joint.registration import register_together
from amers.services.production.image_production import ProductionOptions, produce_points
from amers.services.sensors.correction import CorrectedModel, no_correction
from tests.journeys.ties import independent_tracks
from tests.services.simulated import MemoryChips

pytestmark = [pytest.mark.endurance, pytest.mark.real_data, pytest.mark.thorough]

NAMES = ("img_01", "img_02", "img_03")
INJECTED_PX = ((30.0, -20.0, 1.0), (-25.0, 40.0, -1.0), (45.0, 35.0, 0.7))
"""Shifts in line and sample, and a drift, of the models that are registered."""
SIGMA_M = 15.0
three_tenths_of_a_pixel = 0.3
half_metre_chips = ProductionOptions(fine_gsd_m=0.5, coarse_gsd_m=2.0)


def test_three_views_registered_together_agree_with_each_other_and_with_the_points(real_data: Path):
    scenes = [read_scene(real_data / "phr_calanques_triplet" / f"{name}.tif") for name in NAMES]
    made = produce_points(scenes[:2], half_metre_chips)
    chips = np.concatenate([made.chips(row) for row in range(len(made.points))])
    spoiled = []
    for scene, (line_px, sample_px, drift_px) in zip(scenes, INJECTED_PX, strict=True):
        parameters = np.array([[line_px, drift_px, 0.0], [sample_px, 0.0, -drift_px]])
        error = replace(no_correction(scene.image.shape), parameters=parameters)
        spoiled.append(replace(scene, model=CorrectedModel(scene.model, error), sigma_m=SIGMA_M))
    result = register_together(spoiled, made.points, MemoryChips(chips))
    assert not result.left
    assert [one.qualification.verdict for one in result.registrations] == ["good"] * 3
    tracks = independent_tracks([one.image.read(Window(0, 0, *one.image.shape)) for one in scenes])
    models = [one.model for one in result.registrations]
    after = intersect(models, tracks, int(tracks.point[-1]) + 1)
    assert np.median(np.linalg.norm(after.residual_px, axis=1)) < three_tenths_of_a_pixel
    ground = made.points.lon_lat_h
    for number in range(2):
        moved_px = models[number].project(ground) - made.adjustment.models[number].project(ground)
        assert np.median(np.hypot(*moved_px.T)) < three_tenths_of_a_pixel
