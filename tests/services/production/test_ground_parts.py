"""Points are measured and cut in parts; each has the images and the chips of its own."""

from dataclasses import replace

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.matching.multi_image import RefinementOptions
from amers.services.production.ground_parts import cut_points, measure_points
from amers.services.tasks import Work
from amers.services.types import Array, Observations, no_progress
from tests.services.production.test_renewed_views import CENTRE, GSDS_M, scene

EAST_DEG = 0.02
"""Farther than an image is wide."""
IN_PART = 64
GREYS = np.array([1000, 2000, 3000])
IMAGES_OF_PARTS = [1], [0, 2], [1]
"""The first image and the last one show the points in the east."""


def scenes() -> list[Scene]:
    made = [scene(f"image {number}", GSDS_M[0], int(grey)) for number, grey in enumerate(GREYS)]
    for number in (0, 2):
        model = made[number].model
        shift = [EAST_DEG, 0.0, 0.0]
        east = replace(model, ground_offset=model.ground_offset + shift)  # type: ignore[attr-defined]
        made[number] = replace(made[number], model=east)
    return made


def places() -> Array:
    """A part in the west, one in the east, and three more points in the west."""
    lon = CENTRE[0] + np.repeat([0.0, EAST_DEG, 0.0], [IN_PART, IN_PART, 3])
    near = np.random.default_rng(1).uniform(-1e-4, 1e-4, (len(lon), 2))
    return np.column_stack([lon + near[:, 0], CENTRE[1] + near[:, 1], np.full(len(lon), 200.0)])


def test_points_of_every_part_have_the_views_and_chips_of_their_own_images() -> None:
    n = len(places())
    pairs = [(row, image) for row in range(n) for image in IMAGES_OF_PARTS[row // IN_PART]]
    point, image = np.array(pairs).T
    shown = Observations(point, image, np.zeros((len(point), 2)), np.full(len(point), 0.1))
    cut = cut_points(scenes(), places(), shown, GSDS_M, work=Work(), progress=no_progress)
    for row in range(n):
        views = slice(*cut.views.start[row : row + 2])
        images = cut.views.image[views]
        assert images.tolist() == IMAGES_OF_PARTS[row // IN_PART] * len(GSDS_M)
        chips = cut.chips(row)
        np.testing.assert_array_equal(np.median(chips, axis=(1, 2)), GREYS[images])
        assert (np.diff(cut.views.gsd_m[views]) >= 0.0).all()


def test_measures_of_every_part_are_those_of_its_own_points_and_images() -> None:
    """Parts that are measured already: rows of points and of images count within the part."""
    rows = [(3, 0), (0, 1), (63, 0), (2, 0)]
    kept = {}
    for part, own in enumerate((rows[:1], rows[1:3], rows[3:])):
        point, image = np.array(own, dtype=np.int64).T
        line_sample, saliency = np.column_stack([point, image + part]), np.full(IN_PART, float(part))
        sigma_px = np.full(len(own), 0.1 * (part + 1))
        kept[f"measures/{part:06d}"] = {
            "point": point,
            "image": image,
            "line_sample": line_sample.astype(np.float64),
            "sigma_px": sigma_px,
            "saliency": saliency[: len(places()) - IN_PART * part],
        }
    found, saliency = measure_points(
        scenes(), places(), GSDS_M[0], RefinementOptions(), work=Work(kept=kept), progress=no_progress
    )
    assert found.point.tolist() == [3, IN_PART, IN_PART + 63, 2 * IN_PART + 2]
    assert found.image.tolist() == [1, 2, 0, 1]
    np.testing.assert_array_equal(found.line_sample[:, 0], [3.0, 0.0, 63.0, 2.0])
    np.testing.assert_allclose(found.sigma_px, [0.1, 0.2, 0.2, 0.3])
    np.testing.assert_array_equal(saliency, np.repeat([0.0, 1.0, 2.0], [IN_PART, IN_PART, 3]))
