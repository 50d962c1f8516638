"""A rigorous model that turns while it scans shows ground where the displacement of its image says."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.moving_pushbroom import attitude_motion, moving_model
from amers.services.sensors.piecewise import PiecewisePolynomial
from amers.services.sensors.pushbroom import PushbroomModel, check_pushbroom
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array

SHAPE = (3000, 2000)
HEIGHTS_M = (0.0, 1500.0)
LINES, SAMPLES = np.linspace(0.0, SHAPE[0] - 1.0, 257), np.linspace(0.0, SHAPE[1] - 1.0, 65)
a_hundredth_of_a_pixel = 0.01


def a_model(view: tuple[float, float] = (25.0, 75.0)) -> PushbroomModel:
    rng = np.random.default_rng(4)
    target = np.array([5.4, 43.6, 250.0])
    return pushbroom_over(target, SHAPE, 2.5, view, HEIGHTS_M, jitter_px=0.5, rng=rng)


def moved(
    along_lines: Array, along_samples: Array | None = None, shift_px: float = 0.0
) -> ImageCorrection:
    """A correction of which lines (257, 2) move, and samples (65, 2)."""
    grid = along_lines[:, None, :] + np.zeros((1, len(SAMPLES), 2))
    if along_samples is not None:
        grid = grid + along_samples[None]
    correction = no_correction(SHAPE)
    correction.parameters[:, 0] = shift_px
    displacement = DisplacementGrid(LINES, SAMPLES, grid, np.zeros_like(grid))
    return replace(correction, displacement=displacement)


def waves(periods: tuple[float, float], size_px: tuple[float, float]) -> Array:
    return np.column_stack(
        [
            size * np.sin(2.0 * np.pi * LINES / period)
            for period, size in zip(periods, size_px, strict=True)
        ]
    )


def smile(size_px: float) -> Array:
    t = 2.0 * SAMPLES / SHAPE[1] - 1.0
    return size_px * np.column_stack([t**2, t**3 - 0.6 * t])


def ground_in(model: PushbroomModel) -> Array:
    rng = np.random.default_rng(11)
    inside = rng.uniform(0.05, 0.95, (400, 2)) * SHAPE
    return model.locate(inside, rng.uniform(*HEIGHTS_M, len(inside)))


@pytest.mark.parametrize("view", [(25.0, 75.0), (2.0, 250.0)])
@pytest.mark.parametrize(
    ("correction", "share"),
    [
        (moved(waves((700.0, 1100.0), (3.0, 2.0))), 0.003),
        (moved(waves((6000.0, 6000.0), (8.0, -5.0))), 0.003),
        (moved(waves((150.0, 150.0), (1.0, 1.0))), 0.003),
        (moved(np.zeros((len(LINES), 2)), smile(-2.0)), 0.003),
        # Columns that look 3 px ahead are scanned 3 lines later, when the sensor has moved on.
        (moved(waves((700.0, 900.0), (2.0, 2.0)), smile(3.0)), 0.015),
    ],
    ids=["jitter", "bow", "short", "smile", "both"],
)
def test_ground_is_shown_where_the_displacement_says(
    correction: ImageCorrection, share: float, view: tuple[float, float]
) -> None:
    model = a_model(view)
    moving = moving_model(model, correction)
    assert moving is not None
    ground = ground_in(model)
    assert correction.displacement is not None
    largest_px = np.abs(correction.displacement.displacement_px).max()
    off_px = moving.project(ground) - correction.apply(model.project(ground))
    # A turn moves ground that is higher, or beside the track, by some thousandths more or less.
    assert np.abs(off_px).max() < share * largest_px
    middle = model.locate(np.array([[1500.0, 1000.0]]), np.array([750.0]))
    off_px = moving.project(middle) - correction.apply(model.project(middle))
    assert np.abs(off_px).max() < 3e-4 * largest_px
    check_pushbroom(moving, "moving")


def test_a_displaced_image_moved_when_its_own_lines_were_scanned() -> None:
    """A model that is off by forty lines: they were scanned later than where it expects them."""
    model = a_model()
    correction = moved(waves((500.0, 500.0), (3.0, 3.0)), shift_px=40.0)
    moving = moving_model(model, correction)
    assert moving is not None
    ground = ground_in(model)
    expected = model.project(ground)
    shown = correction.apply(expected)
    assert correction.displacement is not None
    # Ground that the delivered model places in the lines that were scanned is moved by their motion.
    there = model.locate(shown - correction.displacement.at(expected), np.full(len(ground), 750.0))
    at = model.project(there)
    moved_px = moving.project(there) - at
    inside = (at[:, 0] > 100.0) & (at[:, 0] < SHAPE[0] - 100.0)
    np.testing.assert_allclose(
        moved_px[inside], correction.displacement.at(expected)[inside], atol=2.0 * a_hundredth_of_a_pixel
    )


@pytest.mark.parametrize("lines", [-20.0, 20.0])
def test_lines_that_were_lost_or_repeated_are_no_motion(lines: float) -> None:
    jump = np.where(LINES > 1500.0, lines, 0.0)
    assert moving_model(a_model(), moved(np.column_stack([jump, 0.0 * jump]))) is None


def test_the_attitude_over_time_displaces_each_line_by_what_was_found() -> None:
    model, correction = a_model(), moved(waves((700.0, 1100.0), (3.0, 2.0)), shift_px=25.0)
    motion = attitude_motion(model, correction)
    assert motion is not None
    assert correction.displacement is not None
    centre = np.column_stack([LINES, np.full(len(LINES), (SHAPE[1] - 1.0) / 2.0)])
    np.testing.assert_allclose(motion.line, correction.apply(centre)[:, 0])
    np.testing.assert_allclose(motion.time_s, model.line_time(motion.line)[:, 0])
    turned = np.zeros((len(LINES), 2))
    for k in range(0, len(LINES), 16):
        terms = np.zeros(len(TERMS))
        terms[:2] = motion.roll_pitch_rad[k]
        ground = model.locate(centre[k : k + 1], np.array([750.0]))
        turned[k] = PushbroomErrors(model).corrected(terms).project(ground)[0] - centre[k]
    along_lines = correction.displacement.displacement_px[:, 0]
    np.testing.assert_allclose(turned[::16], along_lines[::16], atol=a_hundredth_of_a_pixel)


def test_columns_that_move_turn_no_satellite() -> None:
    sideways = smile(-2.0) - smile(-2.0).mean(axis=0)
    assert attitude_motion(a_model(), moved(np.zeros((len(LINES), 2)), sideways)) is None


def backwards(part: PiecewisePolynomial) -> PiecewisePolynomial:
    """A part of the lines of an image that counts them from the other end."""
    signs = (-1.0) ** np.arange(part.coefficients.shape[2])[::-1]
    return PiecewisePolynomial(SHAPE[0] - 1.0 - part.breaks[::-1], part.coefficients[::-1] * signs)


def test_an_image_whose_last_line_is_scanned_first_moves_as_one_in_the_order_of_its_lines() -> None:
    model, correction = a_model(), moved(waves((700.0, 1100.0), (3.0, 2.0)))
    assert correction.displacement is not None
    flipped = correction.displacement.displacement_px[::-1] * [-1.0, 1.0]
    turned = replace(model, line_time=backwards(model.line_time))
    grid = replace(correction.displacement, displacement_px=flipped)
    moving = moving_model(model, correction)
    moving_turned = moving_model(turned, replace(correction, displacement=grid))
    assert moving is not None
    assert moving_turned is not None
    ground = ground_in(model)
    line, sample = moving.project(ground).T
    expected = np.column_stack([SHAPE[0] - 1.0 - line, sample])
    np.testing.assert_allclose(moving_turned.project(ground), expected, atol=a_hundredth_of_a_pixel)


def test_no_motion_changes_nothing() -> None:
    model = a_model()
    still = moving_model(model, moved(np.zeros((len(LINES), 2))))
    assert still is not None
    ground = ground_in(model)
    np.testing.assert_allclose(still.project(ground), model.project(ground), atol=1e-6)


def test_lines_that_turn_are_no_roll_or_pitch() -> None:
    """Yaw moves the ends of lines in opposite directions, which no line as a whole does."""
    across = 2.0 * SAMPLES / SHAPE[1] - 1.0
    turned = waves((900.0, 900.0), (2.0, 0.0))[:, None, :] * across[None, :, None]
    still = moved(np.zeros((len(LINES), 2)))
    assert still.displacement is not None
    correction = replace(still, displacement=replace(still.displacement, displacement_px=turned))
    assert moving_model(a_model(), correction) is None
    assert attitude_motion(a_model(), correction) is None
