"""Rigorous models with displaced lines and samples: attitude over time, look directions.

A scanner that shakes displaces whole lines, and optics that are bent displace columns. In the image both
are a displacement; in a rigorous model the first is a turn of the satellite while it scans, the second
another direction in which a detector looks.
"""

from dataclasses import dataclass

import numpy as np

from amers.services.sensors.attitude import turned_over_time
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.piecewise import PiecewisePolynomial, from_function
from amers.services.sensors.pushbroom import PushbroomModel, used_times
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.types import Array

_SLOPES = 0.5, 2.0
"""Lines that are scanned for a line of the model without motion: what turns and bends do, and lines that
were lost somewhere in a gap. Faster jumps would show a line twice, or not at all."""
_LEAST_PX = 1e-9
"""What is left of a sum of numbers below it is no motion."""
_BESIDE_PX = 0.05
"""Displacement that is neither one of lines nor one of samples, which turns and looks do not follow."""
_ROLL_PITCH = [TERMS.index(name) for name in ("roll", "pitch")]


@dataclass(frozen=True)
class AttitudeMotion:
    """How a satellite turns while it scans, beyond the attitude of its model.

    Attributes:
        line: (k,) scanned, ascending.
        time_s: (k,) at which they are, seconds of the model.
        roll_pitch_rad: (k, 2) about the axes forwards and to the right of the line of sight of the
            central detector; straight lines between them.
    """

    line: Array
    time_s: Array
    roll_pitch_rad: Array


def attitude_motion(model: PushbroomModel, correction: ImageCorrection) -> AttitudeMotion | None:
    """The turns that move the lines of an image as the displacement of a correction does.

    Args:
        model: as delivered.
        correction: of its image, see `moving_model`.

    Returns:
        None where the lines stay, or where no turn by roll and pitch explains how they move.
    """
    along_lines, _ = _separated(correction)
    grid = correction.displacement
    if grid is None or not along_lines.any() or not _is_sum(correction):
        return None
    centre = np.full(len(grid.line), (model.image_shape[1] - 1.0) / 2.0)
    expected = np.column_stack([grid.line, centre])
    scanned = correction.apply(expected)[:, 0]
    if not _goes_on(grid.line, scanned):
        return None
    by_terms = PushbroomErrors(model).projected(np.zeros(len(TERMS)), _ground(model, expected))[2]
    turns = np.linalg.solve(by_terms[:, :, _ROLL_PITCH], along_lines[:, :, None])[:, :, 0]
    return AttitudeMotion(scanned, model.line_time(scanned)[:, 0], np.asarray(turns))


def moving_model(model: PushbroomModel, correction: ImageCorrection) -> PushbroomModel | None:
    """The model that shows ground where the displacement of a correction says, without its affine part.

    It is followed where the sensor looks in the middle, at the middle of the heights; beside it a turn
    moves an image of 5 km by up to 0.3 % more or less.

    Args:
        model: as delivered.
        correction: of its image, with a displacement along lines, along samples or their sum. The affine
            part determines the lines, and so the times, at which the sensor moved.

    Returns:
        None where the image jumps, or lines turn, so that no such motion of the sensor explains it.
    """
    if not _is_sum(correction):
        return None
    along_lines, along_samples = _separated(correction)
    attitude, look = model.attitude, model.look
    if along_lines.any():
        motion = attitude_motion(model, correction)
        if motion is None:
            return None
        order = np.argsort(motion.time_s)
        turns = motion.roll_pitch_rad[order] @ PushbroomErrors(model).view_axes[:, :2].T
        used = used_times(model.line_time, model.image_shape[0])
        attitude = turned_over_time(attitude, motion.time_s[order], turns, used)
    if along_samples.any():
        grid = correction.displacement
        assert grid is not None
        centre = np.full(len(grid.sample), (model.image_shape[0] - 1.0) / 2.0)
        expected = np.column_stack([centre, grid.sample])
        seen = correction.apply(expected)[:, 1]
        if not _goes_on(grid.sample, seen):
            return None
        by_tangents = model.project_with_derivatives(_ground(model, expected))[2]
        changes = -np.linalg.solve(by_tangents, along_samples[:, :, None])[:, :, 0]
        look = _with_changes(look, seen, np.asarray(changes))
    return model.with_parts(model.orbit, attitude, look)


def _separated(correction: ImageCorrection) -> tuple[Array, Array]:
    """The displacement of lines (k, 2) and that of samples (m, 2), of which it is the sum."""
    grid = correction.displacement
    if grid is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    along_lines = grid.displacement_px.mean(axis=1)
    along_samples = (grid.displacement_px - along_lines[:, None]).mean(axis=0)
    along_lines[np.abs(along_lines) < _LEAST_PX] = 0.0
    along_samples[np.abs(along_samples) < _LEAST_PX] = 0.0
    return along_lines, along_samples


def _is_sum(correction: ImageCorrection) -> bool:
    """Whether lines move as wholes, and samples: lines that turn, as by yaw, do not."""
    grid = correction.displacement
    if grid is None:
        return True
    along_lines, along_samples = _separated(correction)
    beside_px = grid.displacement_px - along_lines[:, None] - along_samples[None]
    return bool(np.abs(beside_px).max() <= _BESIDE_PX)


def _goes_on(nodes: Array, moved: Array) -> bool:
    """Whether positions follow each other as their nodes do, without a jump."""
    slope = np.diff(moved) / np.diff(nodes)
    return bool((slope > _SLOPES[0]).all() and (slope < _SLOPES[1]).all())


def _ground(model: PushbroomModel, line_sample: Array) -> Array:
    """Ground (n, 3) that the model shows at positions (n, 2), at the middle of its heights."""
    return model.locate(line_sample, np.full(len(line_sample), np.mean(model.height_range_m)))


def _with_changes(look: PiecewisePolynomial, samples: Array, changes: Array) -> PiecewisePolynomial:
    """Looks with changes (m, 2) at samples (m,), straight lines between them, constant beyond."""

    def changed(sample: Array) -> Array:
        added = [np.interp(sample, samples, changes[:, k]) for k in range(2)]
        return np.asarray(look(sample) + np.column_stack(added))

    breaks = np.unique(np.concatenate([look.breaks, samples]))
    return from_function(breaks, changed, max(look.coefficients.shape[2] - 1, 1))
