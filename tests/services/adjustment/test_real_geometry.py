"""Seventeen full scenes of one pass, with points and errors drawn: as precise as predicted, truly so."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.formats.sensor_models.dimap import parse_dimap_rpc
from amers.services.geodesy import move_metres
from amers.services.quality.accuracy import normalised_error
from amers.services.types import Array, Frame, Observations
from tests.services.adjustment.grounds import ground_of
from tests.services.ties import difference_m

pytestmark = pytest.mark.real_data

DRAWS = 8
POINTS = 300
SHIFT_PX, SLOPE_PX, TIE_PX = 8.0, 0.5, 0.3
SEEN = 0.4
CONTROL, CONTROL_M = 8, 0.3
BASE = Frame.from_sigmas(0.8, 1.2)
GROUND_M = (0.0, 130.0)
PASS_SHARE = 0.5


class Drawn(NamedTuple):
    """An adjusted block and its true points (p, 3)."""

    found: BlockAdjustment
    truth: Array

    def errors_m(self) -> Array:
        """(q, 3) east, north, up, of the points up to the last one seen; NaN where no rays meet."""
        return difference_m(self.found.lon_lat_h, self.truth[: len(self.found.lon_lat_h)])

    def on_earth_m2(self) -> Array:
        """(p, 3, 3) covariance of the errors."""
        return self.found.point_covariance_m2 + self.found.frames[0].covariance_m2


@pytest.fixture(scope="module")
def images(real_data: Path) -> list[ImageParameters]:
    out = []
    for path in sorted((real_data / "phr_rpc_only" / "melbourne").glob("RPC_*.XML")):
        model = parse_dimap_rpc(path.read_text(), path.name)
        lines, samples = np.ceil(2.0 * model.image_scale).astype(int).tolist()
        name = path.stem.rsplit("_", maxsplit=1)[-1]
        out.append(image_parameters(name, model, (lines, samples), shift_px=SHIFT_PX, slope_px=SLOPE_PX))
    assert len(out) == 17
    return out


@pytest.fixture(scope="module")
def drawn(images: list[ImageParameters]):
    @cache
    def blocks(control: bool) -> list[Drawn]:
        return [draw(images, seed, control) for seed in range(DRAWS)]

    return blocks


def draw(images: list[ImageParameters], seed: int, control: bool) -> Drawn:
    """The block of a seed: half of the variance of the shifts is common, as in one pass."""
    rng = np.random.default_rng([seed, 17])
    middle = images[8]
    inside = middle.zero.centre + rng.uniform(-0.8, 0.8, (POINTS, 2)) * middle.zero.half_size
    truth = middle.model.locate(inside, rng.uniform(*GROUND_M, POINTS))
    common = rng.normal(0.0, np.sqrt(PASS_SHARE), 2)
    rows = []
    for i, image in enumerate(images):
        own = rng.normal(0.0, np.sqrt(1.0 - PASS_SHARE), 2)
        values = rng.normal(0.0, SLOPE_PX, (2, 3))
        values[:, 0] = image.shared_direction() @ (common + own)
        position = image.corrected(values[image.free]).project(truth)
        t = np.abs(position - image.zero.centre) / image.zero.half_size
        seen = np.flatnonzero((t < 1.0).all(axis=1) & (rng.random(POINTS) < SEEN))
        rows.append(np.column_stack([seen, np.full(len(seen), i), position[seen]]))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    point, image_rows = table[:, :2].astype(np.int64).T
    observations = Observations(
        point,
        image_rows,
        table[:, 2:] + rng.normal(0.0, TIE_PX, (len(table), 2)),
        np.full(len(table), TIE_PX),
    )
    ground = base(truth, np.unique(point), rng) if control else NO_CONTROL
    passes = [np.ones(len(images), dtype=np.bool_)]
    return Drawn(adjust_block(images, observations, control=ground, passes=passes), truth)


def base(truth: Array, seen: Array, rng: np.random.Generator) -> ControlGround:
    """A few of the points from a base that is off by an error of its own."""
    known = rng.choice(seen, CONTROL, replace=False)
    off_m = rng.multivariate_normal(np.zeros(3), BASE.covariance_m2)
    ground = move_metres(truth[known], off_m + rng.normal(0.0, CONTROL_M, (CONTROL, 3)))
    return ground_of(known, ground, CONTROL_M**2 * np.eye(3), BASE)


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.long
def test_points_are_as_precise_as_predicted_in_their_frame(drawn, control: bool) -> None:
    errors, covariances = [], []
    for block in drawn(control):
        error_m = block.errors_m()
        errors.append(error_m - np.nanmedian(error_m, axis=0))
        covariances.append(block.found.point_covariance_m2)
    error_m, covariance_m2 = np.concatenate(errors), np.concatenate(covariances)
    found_m = np.sqrt(np.nanmean(error_m**2, axis=0))
    predicted_m = np.sqrt(np.nanmean(np.diagonal(covariance_m2, 0, 1, 2), axis=0))
    square = normalised_error(error_m, covariance_m2).mean_square
    assert np.isfinite(error_m).all(axis=1).mean() > 0.9
    np.testing.assert_allclose(found_m, predicted_m, rtol=0.25)
    assert 0.7 < square < 1.3


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.long
def test_errors_on_the_earth_are_those_declared(drawn, control: bool) -> None:
    frame = []
    for block in drawn(control):
        error_m = np.nanmedian(block.errors_m(), axis=0)
        covariance_m2 = block.found.frames[0].covariance_m2
        frame.append(error_m @ np.linalg.solve(covariance_m2, error_m) / 3.0)
    assert 0.3 < np.mean(frame) < 2.0


def test_control_places_the_block(drawn) -> None:
    by_control = np.sqrt(np.diag(drawn(True)[0].found.frames[0].covariance_m2))
    by_models = np.sqrt(np.diag(drawn(False)[0].found.frames[0].covariance_m2))
    assert (by_control < 0.6 * by_models).all()
