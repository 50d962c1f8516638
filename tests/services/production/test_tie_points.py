"""Tie points of reduced images, of large ones in patches, and finer ones where these are too few."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from amers.services.formats.images.raster import open_raster
from amers.services.imagery.scene import Scene
from amers.services.matching.ground_features import FeatureOptions
from amers.services.production.image_production import ProductionOptions, produce_points
from amers.services.production.tie_patches import sparse_patches
from amers.services.production.tie_points import feature_reduction, find_tie_points
from amers.services.tasks import Work
from amers.services.types import FloatImage, no_progress
from benchmarks.production_cost import GSD_M, image_scene, largest_disagreement_px, write_images
from tests.services.simulated import BLOCK_SIGMA_M, block_views

REDUCTION = 4.0
a_tenth_of_a_pixel = 0.1


@dataclass(frozen=True)
class Unread:
    """An image of which only the size is asked."""

    shape: tuple[int, int]

    def read(self, window: object) -> FloatImage:
        raise AssertionError("no pixels expected to be read")


def scenes() -> list[Scene]:
    return [view.as_scene(BLOCK_SIGMA_M) for view in block_views()]


def large_scenes(folder: Path, side_px: int) -> list[Scene]:
    paths = write_images(folder, side_px)
    return [
        replace(image_scene(number, side_px), image=open_raster(path))
        for number, path in enumerate(paths)
    ]


def stages(work: Work) -> set[str]:
    """The searches for features that were made."""
    return {name.split("/")[1].split("-")[0] for name in work.kept if name.startswith("features/")}


@pytest.mark.parametrize("side_px", [10_000, 20_000, 40_000])
def test_the_pixels_searched_do_not_grow_with_the_image(side_px: int) -> None:
    blank = [image_scene(number, side_px) for number in range(3)]
    blank = [replace(scene, image=Unread(scene.image.shape)) for scene in blank]
    assert feature_reduction(blank, FeatureOptions()) == REDUCTION
    patches = sparse_patches(blank, REDUCTION * GSD_M)
    for own in patches:
        assert own is not None
        assert 20 <= len(own.centres) <= 50
    centres = [set(map(tuple, own.centres[:, :2].tolist())) for own in patches if own is not None]
    assert len(set.intersection(*centres)) >= 20


def test_images_with_too_few_tie_points_are_searched_at_a_finer_sampling() -> None:
    coarse = FeatureOptions(reduced_px=1_000, most_reduced=16.0)
    work, fine = Work(), Work()
    ties = find_tie_points(scenes(), [], coarse, work, no_progress)
    whole = find_tie_points(scenes(), [], FeatureOptions(), fine, no_progress)
    assert len(stages(work)) > 1
    assert stages(fine) == {"0"}
    assert np.bincount(ties.image).min() >= 200
    assert np.bincount(whole.image).min() >= 200
    assert (np.diff(ties.point) >= 0).all()


@pytest.mark.thorough
@pytest.mark.long
def test_a_large_image_gets_points_between_the_patches(tmp_path: Path) -> None:
    side_px = 8200
    work = Work()
    wanted = ProductionOptions(spacing_m=1500.0, surface_pairs=0)
    made = produce_points(large_scenes(tmp_path, side_px), wanted, work=work)
    assert stages(work) == {"0", "squares"}
    assert made.gsds_m == (1.5, 6.0)
    assert len(made.points) >= 0.9 * (side_px * GSD_M / 1500.0) ** 2
    assert largest_disagreement_px(made.adjustment.models, side_px) < a_tenth_of_a_pixel
