"""What a scene shows of its control points, before it is adjusted with others."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np

from amers.services.imagery.scene import scene_gsd_m
from amers.services.joint.measured import MeasuredScene
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array
from tests.services.joint.test_joint_block import SHAPE, observed, truth_of

PERIOD_PX = 300.0
WAVE_PX = np.array([6.0, -4.0])
CHIP_PX = 100.0


@cache
def still() -> MeasuredScene:
    rng = np.random.default_rng(6)
    return observed(truth_of(rng), rng)[0][0]


def oscillating(displacement_px: Array, line: Array, variance_px2: float = 0.0) -> MeasuredScene:
    """The scene with chips of 100 px, and lines that are displaced (k, 2) as its points show."""
    measured, samples = still(), np.array([0.0, SHAPE[1] - 1.0])
    assert measured.alone is not None
    nodes = np.repeat(displacement_px[:, None], 2, axis=1)
    grid = DisplacementGrid(line, samples, nodes, np.full(nodes.shape, variance_px2))
    correction = replace(measured.alone.correction, displacement=grid)
    search = replace(measured.search, chip_side_m=CHIP_PX * scene_gsd_m(measured.scene))
    return replace(measured, search=search, alone=replace(measured.alone, correction=correction))


def test_a_point_lies_where_its_line_was_and_not_where_its_chip_was_on_average() -> None:
    """Over a chip, a wave is smaller by the sine cardinal of its share of the period."""
    line = np.arange(0.0, SHAPE[0], 3.0)
    wave = np.sin(2.0 * np.pi * line / PERIOD_PX)[:, None] * WAVE_PX
    measured = oscillating(wave, line)
    seen = measured.observations()
    place = measured.scene.model.project(seen.lon_lat_h)
    inside = (place[:, 0] > CHIP_PX) & (place[:, 0] < SHAPE[0] - CHIP_PX) & measured.usable
    taken_back = (measured.line_sample() - seen.line_sample)[inside]
    of_line = np.sin(2.0 * np.pi * place[inside, :1] / PERIOD_PX) * WAVE_PX
    lost = 1.0 - np.sinc(CHIP_PX / PERIOD_PX)
    assert inside.sum() > 20
    np.testing.assert_allclose(taken_back, lost * of_line, atol=0.1)
    assert np.abs(taken_back).max() > 0.5


def test_points_on_ground_that_moved_are_not_used() -> None:
    measured = still()
    assert measured.alone is not None
    moved = np.arange(len(measured.usable)) % 5 == 0
    alone = replace(measured.alone, moved=SimpleNamespace(measures=moved))  # type: ignore[arg-type]
    usable = replace(measured, alone=alone).usable
    np.testing.assert_array_equal(usable, measured.usable & ~moved)
    assert (measured.usable & moved).sum() > 3
