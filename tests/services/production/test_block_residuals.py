"""What is wrong with an image or a point of a block is seen and named, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.parameters import image_parameters
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ArrayImage
from amers.services.production.block_residuals import FITS, ImageFit, image_fits, point_fits
from amers.services.types import Array, Observations
from tests.services.production.displaced_details import drawn_details, map_moved
from tests.services.simulated import block_views, world

STATED_M = 10.0
NOISE_PX = 0.1
COUNT = 80


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Images of the simulated block, with their true RPCs as models."""
    views = block_views()
    return [
        Scene(
            ArrayImage(view.pixels.astype(np.float32)),
            view.geometry.rpc,
            view.geometry.acquisition,
            sigma_m=STATED_M,
        )
        for view in views
    ]


def measured(scenes: list[Scene], off_m: Array) -> Observations:
    """Points that all images see, where models lie off by metres (n, 2) east, north."""
    rng = np.random.default_rng(4)
    lon, lat = world().centre_lon_lat
    degrees = np.array(metres_per_degree(lat, 180.0))
    places = np.array([lon, lat]) + rng.uniform(-250.0, 250.0, (COUNT, 2)) / degrees
    ground = np.column_stack([places, world().height_m(places)])
    position = []
    for scene, metres in zip(scenes, off_m, strict=True):
        moved = ground.copy()
        moved[:, :2] += metres / degrees
        position.append(scene.model.project(moved))
    line_sample = np.stack(position, axis=1) + rng.normal(0.0, NOISE_PX, (COUNT, len(scenes), 2))
    return Observations(
        np.repeat(np.arange(COUNT), len(scenes)),
        np.tile(np.arange(len(scenes)), COUNT),
        line_sample.reshape(-1, 2),
        np.full(COUNT * len(scenes), NOISE_PX),
    )


def adjusted(scenes: list[Scene], measures: Observations) -> BlockAdjustment:
    images = [
        image_parameters(
            scene.acquisition.image_id,
            scene.model,
            scene.image.shape,
            shift_px=STATED_M / scene_gsd_m(scene),
            slope_px=0.1,
        )
        for scene in scenes
    ]
    return adjust_block(images, measures)


def fits(scenes: list[Scene], measures: Observations) -> list[ImageFit]:
    return list(image_fits(scenes, measures, adjusted(scenes, measures)))


def test_images_that_are_as_stated_fit(scenes: list[Scene]) -> None:
    found = fits(scenes, measured(scenes, np.zeros((len(scenes), 2))))
    assert [image.verdict for image in found] == [FITS] * len(scenes)
    for image in found:
        # The adjustment leaves out what is beyond four standard deviations.
        assert image.measures == COUNT
        assert image.used >= 0.97 * COUNT
        assert np.hypot(*image.rms_px) < 2.0 * NOISE_PX


def test_a_model_that_is_off_is_measured_and_named(scenes: list[Scene]) -> None:
    off_m = np.zeros((len(scenes), 2))
    off_m[1] = 60.0, -36.0
    found = fits(scenes, measured(scenes, off_m))
    relative = np.array([image.off_m for image in found]) - np.mean(
        [image.off_m for image in found], axis=0
    )
    # All images share the error of the frame; its height, known to 10 m and more, moves those that look
    # from different sides apart by half of it.
    assert relative[1] - relative[0] == pytest.approx(off_m[1], abs=6.0)
    assert "times the accuracy stated" in found[1].verdict
    assert [image.verdict for image in found if image is not found[1]] == [FITS] * (len(scenes) - 1)


def test_an_image_whose_measures_disagree_is_named(scenes: list[Scene]) -> None:
    measures = measured(scenes, np.zeros((len(scenes), 2)))
    line_sample = measures.line_sample.copy()
    wrong = (measures.image == 2) & (measures.point % 2 == 0)
    line_sample[wrong] += np.random.default_rng(1).uniform(20.0, 60.0, (int(wrong.sum()), 2))
    found = fits(scenes, replace(measures, line_sample=line_sample))
    assert "of 80 measures disagree" in found[2].verdict
    assert 38 <= found[2].used <= 40
    assert found[0].verdict == FITS


def test_a_point_with_a_wrong_ray_loses_it_and_keeps_the_others(scenes: list[Scene]) -> None:
    measures = measured(scenes, np.zeros((len(scenes), 2)))
    line_sample = measures.line_sample.copy()
    wrong = (measures.point == 7) & (measures.image == 0)
    line_sample[wrong] += 30.0
    measures = replace(measures, line_sample=line_sample)
    rows = np.array([6, 7])
    found = point_fits(rows, measures, adjusted(scenes, measures))
    assert found.images.tolist() == [len(scenes)] * 2
    assert found.used.tolist() == [len(scenes), len(scenes) - 1]
    assert (found.largest_px < 5.0 * NOISE_PX).all()
    assert (found.rms_px <= found.largest_px).all()


def test_an_image_is_off_in_metres_and_bent_beside_the_middle_one(scenes: list[Scene]) -> None:
    """Ortho-images of 2 m: one lies off by 50 m of a stated 10 m, one has four times the residuals."""
    measures = measured(scenes, np.zeros((len(scenes), 2)))
    block = adjusted(scenes, measures)
    details, count = drawn_details(3), len(scenes)
    taken = [details.scene(f"image {k}", np.zeros((9, 2)), STATED_M) for k in range(count)]
    models = [details.model] * count
    models[0] = map_moved(details.model, np.array([0.0, -50.0]))
    rng = np.random.default_rng(5)
    residual_px = rng.normal(0.0, 1.0, (len(measures), 2))
    residual_px[measures.image == count - 1] *= 4.0
    block = replace(
        block, models=tuple(models), residual_px=residual_px, active=np.ones(len(measures), dtype=bool)
    )
    fits = image_fits(taken, measures, block)
    assert fits[0].verdict == "off by 5.0 times the accuracy stated for it"
    np.testing.assert_allclose(np.abs(fits[0].off_m), [0.0, 50.0], atol=0.1)
    assert "its model is bent" in fits[-1].verdict
    assert {one.verdict for one in fits[1:-1]} == {FITS}
    # Eleven measures are too few, whichever image has them; twelve are enough.
    for number, enough in ((1, 12), (2, 11)):
        own = np.flatnonzero(measures.image == number)
        rows = np.setdiff1d(np.arange(len(measures)), own[enough:])
        active, residuals_px = block.active[rows], block.residual_px[rows]
        few = replace(block, active=active, residual_px=0.01 * residuals_px)
        verdict = image_fits(taken, measures.take(rows), few)[number].verdict
        assert (verdict == FITS) == (enough == 12)
        assert verdict == FITS or verdict.startswith("11 measures: it needs more common ground")
