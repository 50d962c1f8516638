"""The first search of few points far out: what it corrects, and when it is refused."""

from typing import Any

import numpy as np
import pytest

from amers.services.errors import NoConsensus
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ReducedImage
from amers.services.matching.consensus import Consensus
from amers.services.registration.coarse import _image_for, search_coarsely
from amers.services.registration.context import Prediction, SearchStage
from amers.services.registration.on_reference import _image_at
from amers.services.registration.search import first_consensus
from amers.services.types import Array
from tests.services.registration.small_ground import (
    SIDE_PX,
    point_context,
    points_at,
    predicted,
    scene,
)

GSD_M = 4.0
SIGMA_M = 25.0
OFF_M = np.array([60.0, -42.0])
MIDDLE = SIDE_PX / 2.0


def lattice(count: int, step_px: float) -> Array:
    """So many rows and columns of points around the middle of the ground."""
    axis = MIDDLE + (np.arange(count) - (count - 1) / 2.0) * step_px
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def searched(of: Scene, row_col: Array) -> tuple[Prediction, SearchStage]:
    """The prediction after the search, and its summary."""
    points, chips = points_at(row_col, GSD_M)
    context = point_context(of, points, chips, GSD_M, enough=1)
    prediction = search_coarsely(context, predicted(of, points))
    (stage,) = context.stages
    return prediction, stage


def test_points_that_agree_correct_the_model() -> None:
    of = scene(OFF_M, SIGMA_M, 700, 700)
    prediction, stage = searched(of, lattice(4, 130.0))
    assert (stage.name, stage.inliers) == ("coarse", 16)
    assert stage.needed_radius_m < stage.search_radius_m < stage.needed_radius_m + 4.0 * GSD_M
    points, _ = points_at(lattice(4, 130.0), GSD_M)
    moved_px = prediction.model.project(points.lon_lat_h) - of.model.project(points.lon_lat_h)
    np.testing.assert_allclose(moved_px, np.tile([21.0, 30.0], (16, 1)), atol=0.3)
    assert (prediction.uncertainty_m > GSD_M / 2.0).all()
    assert (prediction.uncertainty_m < GSD_M).all()


def test_points_whose_chips_show_the_same_ground_are_too_few_to_be_believed() -> None:
    """Chips of 404 m at points 60 m apart: nine agree, and are hardly more than one, halved or not."""
    of, (points, chips) = scene(OFF_M, SIGMA_M, 700, 700), points_at(lattice(3, 30.0), GSD_M)
    context = point_context(of, points, chips, GSD_M, enough=1)
    with pytest.raises(NoConsensus, match="9 of them within 12 m of each other, which chance explains"):
        search_coarsely(context, predicted(of, points))
    halved, whole = sorted(group.false_alarms for stage in context.stages for group in stage.candidates)
    assert whole > halved > context.options.coarse.max_false_alarms
    for stage in context.stages:
        (group,) = stage.candidates
        assert group.points == 9
        np.testing.assert_allclose([group.east_m, group.north_m], OFF_M, atol=GSD_M)


def test_two_tries_are_two_chances(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first is believed at half of the false alarms that are accepted; else the second is made."""
    told: list[float] = []

    def recorded(*of: Any, **how: Any) -> Consensus:
        consensus = first_consensus(*of, **how)
        told.append(consensus.false_alarms)
        return consensus

    monkeypatch.setattr("amers.services.registration.coarse.first_consensus", recorded)
    of, (points, chips) = scene(OFF_M, SIGMA_M, 700, 700), points_at(lattice(3, 30.0), GSD_M)
    with pytest.raises(NoConsensus):
        search_coarsely(point_context(of, points, chips, GSD_M, enough=1), predicted(of, points))
    for times, tries in ((2.1, 1), (1.9, 2)):
        accepted = {"enough": 1, "max_false_alarms": times * told[0]}
        context = point_context(of, points, chips, GSD_M, **accepted)
        search_coarsely(context, predicted(of, points))
        assert len(context.stages) == tries


@pytest.mark.parametrize("shape", [(1000, 900), (900, 1000)])
def test_an_image_is_reduced_where_windows_hold_more_pixels_than_it_has(shape: tuple[int, int]) -> None:
    """Of points with chips of 8 m and of 16 m, of which two pixels are left; and of places."""
    of = scene(np.zeros(2), SIGMA_M, *shape)
    pixels = shape[0] * shape[1]
    for gsd_m, radius_px in ((8.1, 10), (16.2, 0)):
        window = (100 + 2 * radius_px) * gsd_m / 2.0  # pixels of 2 m
        enough = int(pixels / window**2) + 1
        fewer, more = (_image_for(of, gsd_m, count, radius_px) for count in (enough - 1, enough))
        assert fewer is of.image
        assert isinstance(more, ReducedImage)
        assert more.factor == int(gsd_m) / 4
    assert _image_for(of, 7.9, 1_000_000, 10) is of.image, "less than two pixels would be left"
    fewer, more = (_image_at(of, 3, count, 100) for count in (10, 11))
    assert fewer is of.image
    assert isinstance(more, ReducedImage)
    assert more.factor == 3
    assert _image_at(of, 1, 1_000_000, 100) is of.image
