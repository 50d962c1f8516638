"""Corrections of sensor models in image space."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.sensors.base import SensorModel
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array

_MOST_ITERATIONS = 40
_INVERTED_PX = 1e-9
"""An iteration that moves no position by more is the last."""


@dataclass(frozen=True)
class ImageCorrection:
    """A displacement of image positions, from those of a model to the true ones: affine, and on a grid.

    With `t = (line_sample - centre) / half_size`, a position moves by
    `parameters @ (1, t_line, t_sample)`. A shift has nonzero parameters in the first column only, a
    drift also on the diagonal (line by line, sample by sample), an affine everywhere. Where residuals
    show that lines or samples move against each other, a displacement on a grid is added.

    Attributes:
        parameters: (2, 3) pixels; rows line and sample; columns constant, along lines, along samples.
            The last two are displacements at the edge of the image.
        centre, half_size: (2,) pixels.
        displacement: beyond it; None for an affine correction.
    """

    parameters: Array
    centre: Array
    half_size: Array
    displacement: DisplacementGrid | None = None

    def apply(self, line_sample: Array) -> Array:
        """Corrected positions (n, 2) of positions given by the model (n, 2)."""
        t = (line_sample - self.centre) / self.half_size
        moved = line_sample + self.parameters[:, 0] + t @ self.parameters[:, 1:].T
        if self.displacement is not None:
            moved = moved + self.displacement.at(line_sample)
        return np.asarray(moved)

    def invert(self, line_sample: Array) -> Array:
        """Positions (n, 2) of the uncorrected model for corrected positions (n, 2).

        A displacement on a grid is followed by iteration, which converges where lines and samples keep
        their order.
        """
        affine = np.linalg.inv(self.jacobian).T
        moved = line_sample - self.centre - self.parameters[:, 0]
        before = self.centre + moved @ affine
        if self.displacement is None:
            return np.asarray(before)
        position = before
        for _ in range(_MOST_ITERATIONS):
            last, position = position, before - self.displacement.at(position) @ affine
            if not len(position) or np.nanmax(np.abs(position - last), initial=0.0) < _INVERTED_PX:
                break
        return np.asarray(position)

    def covariance_at(self, line_sample: Array, covariance_px2: Array, local_sigma_px: Array) -> Array:
        """Covariance (n, 2, 2) of corrected positions (n, 2), px^2.

        Args:
            line_sample: corrected positions.
            covariance_px2: (6, 6) of `parameters`, row by row.
            local_sigma_px: (2,) line and sample, of what parts of the image are off by beyond them.
        """
        before = self.invert(line_sample)
        t = np.column_stack([np.ones(len(before)), (before - self.centre) / self.half_size])
        design = np.zeros((len(t), 2, 6))
        design[:, 0, :3] = design[:, 1, 3:] = t
        covariance = design @ covariance_px2 @ design.transpose(0, 2, 1)
        if self.displacement is not None:
            # Between nodes, what is taken from a variance may be a little more than there is.
            own = np.diagonal(covariance, axis1=1, axis2=2)
            added = np.maximum(self.displacement.variance_at(before), -own)
            covariance = covariance + added[:, :, None] * np.eye(2)
        return np.asarray(covariance + np.diag(local_sigma_px**2))

    @property
    def jacobian(self) -> Array:
        """Derivative (2, 2) of the affine part of `apply`."""
        return np.asarray(np.eye(2) + self.parameters[:, 1:] / self.half_size)

    def derivative_at(self, line_sample: Array) -> Array:
        """Derivative of `apply` at positions (n, 2) of the model: (n, 2, 2), or (2, 2) for all."""
        if self.displacement is None:
            return self.jacobian
        return np.asarray(self.jacobian + self.displacement.derivative(line_sample))


def no_correction(shape: tuple[int, int]) -> ImageCorrection:
    """The zero correction of an image with the given lines and samples."""
    size = np.array(shape, dtype=np.float64)
    return ImageCorrection(np.zeros((2, 3)), (size - 1.0) / 2.0, size / 2.0)


@dataclass(frozen=True)
class CorrectedModel:
    """A sensor model followed by a correction in image space.

    Attributes:
        base: the delivered model.
        correction: from image positions of the delivered model to the true ones.
    """

    base: SensorModel
    correction: ImageCorrection

    @property
    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest ground the model is meant for, metres above the ellipsoid."""
        return self.base.height_range_m

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points: (n, 3) to (n, 2)."""
        return self.correction.apply(self.base.project(lon_lat_h))

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative of `project`: (n, 2, 3), pixels per metre east, north, up."""
        derivative = self.base.project_derivative(lon_lat_h)
        if self.correction.displacement is None:
            return np.asarray(self.correction.jacobian @ derivative)
        return np.asarray(self.correction.derivative_at(self.base.project(lon_lat_h)) @ derivative)

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights: (n, 2) and (n,) to (n, 3)."""
        return self.base.locate(self.correction.invert(line_sample), height_m)

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """Origin (n, 3) and unit direction (n, 3) in ECEF, from the sensor towards the ground."""
        return self.base.line_of_sight(self.correction.invert(line_sample))


def folds_into_rpc(correction: ImageCorrection) -> bool:
    """Whether an RPC includes a correction exactly: each coordinate moves along itself, linearly."""
    mixed_px = correction.parameters[[0, 1], [2, 1]]
    return correction.displacement is None and not mixed_px.any()


def fold_into_rpc(model: RpcModel, correction: ImageCorrection) -> RpcModel:
    """The RPC that includes a shift or a drift exactly.

    A displacement of each coordinate separately changes its offset and scale, hence its numerator:
    `num' = m num + c den`.

    Raises:
        ValueError: the correction mixes lines and samples or has a displacement beyond them;
            `refined_rpc` fits an RPC.
    """
    if not folds_into_rpc(correction):
        raise ValueError(
            "a correction on a grid, or one that mixes lines and samples does not fold into an RPC"
        )
    gain = np.diag(correction.jacobian)
    constant = correction.apply(model.image_offset[None, :])[0] - model.image_offset
    numerators = [
        gain[k] * num + constant[k] / model.image_scale[k] * den
        for k, (num, den) in enumerate(
            ((model.line_num, model.line_den), (model.sample_num, model.sample_den))
        )
    ]
    return replace(model, line_num=numerators[0], sample_num=numerators[1])
