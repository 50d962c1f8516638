"""Positions of control points in a scene, and the misfits of the model there."""

from dataclasses import dataclass

import numpy as np

from amers.services.misfit.affine_fit import AffineFit
from amers.services.misfit.broken_image import MOST_BEYOND, on_one_side
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import no_correction
from amers.services.types import Array, BoolArray, IntArray

_LOOSE_PX = 1000.0
"""A priori standard deviation of the offset of a block before anything is known of it."""


@dataclass(frozen=True)
class ControlObservations:
    """Where n control points were seen in a scene, and the precision of points and measures.

    Attributes:
        lon_lat_h: (n, 3) the points.
        line_sample: (n, 2) the measures; NaN where a point was not found.
        sigma_px: (n,) of the measures.
        covariance_m2: (n, 3, 3) of the points, east, north, up.
        usable: (n,) measures that may be used; all finite measures when None.
        stated: (n,) measures whose sigma a person states, marks: they are not wrong where others are
            more precise than declared. None for none.
        common_covariance_px2: (2, 2) line, sample, of an error that all measures share; it adds to the
            covariance of the shift. None when there is no such error.
        deformation_px2: (2, 2) line, sample, of what the blocks of the points are deformed by. None when
            they are not.
        block: (n,) block that each point comes from; None when all come from one.
        frame_covariance_m2: (b, 3, 3) of the frames of the blocks, east, north, up, NaN where unknown;
            `block` counts its rows. None when all are unknown.
        chip_side_px: side of the chips in the scene: nearer measures share pixels. 0 when none do.
        breaks: (k,) first lines behind breaks of the image, where lines are missing or repeated; None
            for none.
    """

    lon_lat_h: Array
    line_sample: Array
    sigma_px: Array
    covariance_m2: Array
    usable: BoolArray | None = None
    stated: BoolArray | None = None
    common_covariance_px2: Array | None = None
    deformation_px2: Array | None = None
    block: IntArray | None = None
    frame_covariance_m2: Array | None = None
    chip_side_px: float = 0.0
    breaks: IntArray | None = None


def declared_fit(
    model: SensorModel, shape: tuple[int, int], observations: ControlObservations
) -> tuple[AffineFit, BoolArray, Array]:
    """The misfits with their declared variances, which of them there are, and their points' part."""
    line_sample, sigma_px = observations.line_sample, observations.sigma_px
    misfit = line_sample - model.project(observations.lon_lat_h)
    seen = np.isfinite(misfit).all(axis=1) & np.isfinite(sigma_px)
    if observations.breaks is not None:
        side_px = observations.chip_side_px
        seen &= on_one_side(observations.breaks, line_sample[:, 0], side_px, MOST_BEYOND)
    usable = seen if observations.usable is None else seen & observations.usable
    derivative = np.nan_to_num(model.project_derivative(observations.lon_lat_h))
    covariance_px2 = derivative @ observations.covariance_m2 @ derivative.transpose(0, 2, 1)
    own = np.nan_to_num(sigma_px, nan=1.0)[:, None] ** 2
    of_points = np.diagonal(covariance_px2, 0, 1, 2)
    frame = no_correction(shape)
    t = np.nan_to_num((line_sample - misfit - frame.centre) / frame.half_size)
    member = np.zeros((len(misfit), 0))
    if observations.block is not None:
        blocks = np.unique(observations.block[usable])
        if len(blocks) > 1:
            member = (observations.block[:, None] == blocks).astype(np.float64)
    offset_px = np.full((2, member.shape[1]), _LOOSE_PX)
    misfit = np.where(seen[:, None], misfit, 0.0)
    return AffineFit(t, misfit, own + of_points, member, offset_px), seen, of_points


def frame_sigma_px(model: SensorModel, observations: ControlObservations, member: Array) -> Array:
    """Standard deviation (2, b) of the frames of the blocks in the image; NaN where unknown."""
    if observations.frame_covariance_m2 is None or observations.block is None:
        return np.full((2, member.shape[1]), np.nan)
    sigma_px = []
    for of_block in member.T.astype(bool):
        derivative = np.nanmean(model.project_derivative(observations.lon_lat_h[of_block]), axis=0)
        frame_m2 = observations.frame_covariance_m2[observations.block[of_block][0]]
        sigma_px.append(np.sqrt(np.diagonal(derivative @ frame_m2 @ derivative.T)))
    return np.array(sigma_px).T
