"""What may move in a block adjustment: the free parameters of images, with their a priori accuracy."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from services.adjustment.affine_fit import FREE, Order
from services.sensors.base import SensorModel
from services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from services.types import Array, BoolArray, IntArray

PASS_SHARE = 0.5
"""Share of the variance of the shifts that the images of a pass have in common, as the adjustment
weights them. Nobody states it: the frame of the block covers every share between none and all."""


@dataclass(frozen=True)
class ImageParameters:
    """The free parameters of one image: a delivered model, and what a correction may add to it.

    The adjustment reads `model`, `sigma`, `locating`, `design` and `corrected`, and nothing else: a
    rigorous model joins with parameters of its own (attitude, orbit) by the same five.

    Attributes:
        name: of the image, for messages.
        model: as delivered.
        zero: the correction whose parameters are free, all zero.
        prior_px: (2, 3) a priori standard deviation of `ImageCorrection.parameters`; 0 where fixed.
    """

    name: str
    model: SensorModel
    zero: ImageCorrection
    prior_px: Array

    @property
    def free(self) -> BoolArray:
        """(2, 3) parameters of the correction that are estimated."""
        return np.asarray(self.prior_px > 0.0)

    @property
    def sigma(self) -> Array:
        """(k,) a priori standard deviations, pixels at the edge of the image."""
        return np.asarray(self.prior_px[self.free])

    @property
    def locating(self) -> BoolArray:
        """(k,) parameters whose a priori sigma is the accuracy of the image on the Earth: the shifts."""
        constant = np.zeros((2, 3), dtype=np.bool_)
        constant[:, 0] = True
        return constant[self.free]

    @cached_property
    def _column(self) -> Array:
        return np.asarray(np.nonzero(self.free)[1])

    def design(self, line_sample: Array) -> Array:
        """Derivative (m, 2, k) of positions by the parameters, where the model has them (m, 2)."""
        t = (line_sample - self.zero.centre) / self.zero.half_size
        terms = np.column_stack([np.ones(len(t)), t])[:, self._column]
        row = np.nonzero(self.free)[0]
        design = np.zeros((len(t), 2, len(row)))
        for coordinate in range(2):
            design[:, coordinate, row == coordinate] = terms[:, row == coordinate]
        return design

    def corrected(self, values: Array) -> CorrectedModel:
        """The model with parameters of the given values (k,)."""
        parameters = np.zeros((2, 3))
        parameters[self.free] = values
        return CorrectedModel(self.model, replace(self.zero, parameters=parameters))

    def shared_direction(self) -> Array:
        """Derivative (2, 2) of the shifts by an error that a pass has in common, in its sigmas.

        The error is a displacement on the ground; the nearest rotation of its image keeps the a priori
        sigma of every shift.
        """
        middle_m = np.array([np.mean(self.model.height_range_m)])
        ground = self.model.locate(self.zero.centre[None, :], middle_m)
        u, _, vt = np.linalg.svd(self.model.project_derivative(ground)[0, :, :2])
        return np.asarray(u @ vt * self.prior_px[:, :1])


def image_parameters(
    name: str,
    model: SensorModel,
    shape: tuple[int, int],
    *,
    shift_px: float,
    slope_px: float = 0.0,
    order: Order = "affine",
) -> ImageParameters:
    """The parameters of an image correction.

    Args:
        name: of the image.
        model: as delivered.
        shape: lines and samples.
        shift_px: a priori standard deviation of the shift of each coordinate, pixels.
        slope_px: of drift and skew, pixels at the edge of the image; 0 for a shift alone.
        order: which parameters are free.
    """
    prior_px = np.full((2, 3), slope_px)
    prior_px[:, 0] = shift_px
    return ImageParameters(name, model, no_correction(shape), prior_px * FREE[order])


@dataclass(frozen=True)
class BlockPriors:
    """The a priori accuracy of all parameters of a block, in blocks of `size`; absent ones are fixed.

    Attributes:
        size: parameters of the image that has most; those that others lack have no derivative.
        locating: (K, K) sparse, inverse covariance of the parameters that tell where images lie.
        shape: (K,) inverse variances of the others: drifts and skews.
        mean: (K,) what is expected: 0, or what a neighbouring block tells.
    """

    size: int
    locating: sparse.csc_matrix
    shape: Array
    mean: Array

    def with_slopes(self, factor: float) -> "BlockPriors":
        """The same where standard deviations of drifts and skews are multiplied by a factor."""
        return replace(self, shape=self.shape / factor**2)


def block_priors(
    images: Sequence[ImageParameters], passes: Sequence[BoolArray], frames: Sequence[Array] = ()
) -> BlockPriors:
    """The priors of images and, behind them, of the frames of control points.

    Args:
        images: the n images.
        passes: masks (n,) of images of one pass: half of the variance of their shifts is in common.
        frames: (3, 3) covariances of the frames of sets of control points, m^2; NaN: unknown.
    """
    size = max([len(image.sigma) for image in images] + [3] * bool(frames))
    n = len(images) + len(frames)
    # Parameters that an image lacks keep a unit weight, so that the matrix has an inverse.
    locating, shape = sparse.lil_matrix((n * size, n * size)), np.zeros(n * size)
    for i, image in enumerate(images):
        k = len(image.sigma)
        weight = np.ones(size)
        weight[:k] = image.sigma**-2.0
        tells = np.ones(size, dtype=np.bool_)
        tells[:k] = image.locating
        rows = i * size + np.arange(size)
        locating[rows, rows] = np.where(tells, weight, 0.0)
        shape[rows] = np.where(tells, 0.0, weight)
    for members in passes:
        rows = shift_rows(images, members, size)
        covariance = sharing_covariance(images, members, PASS_SHARE)
        locating[np.ix_(rows, rows)] = np.linalg.inv(covariance)
    for i, covariance in enumerate(frames):
        rows = (len(images) + i) * size + np.arange(3)
        locating[np.ix_(rows, rows)] = frame_weight(covariance)
        rest = np.arange(rows[-1] + 1, (len(images) + i + 1) * size)
        locating[rest, rest] = 1.0
    return BlockPriors(size, locating.tocsc(), shape, np.zeros(n * size))


def frame_weight(covariance_m2: Array) -> Array:
    """Inverse (3, 3) of the covariance of a frame; 0 where it is unknown."""
    known = np.isfinite(np.diagonal(covariance_m2))
    weight = np.zeros((3, 3))
    inside = np.ix_(known, known)
    weight[inside] = np.linalg.inv(covariance_m2[inside] + _EXACT_M**2 * np.eye(int(known.sum())))
    return weight


_EXACT_M = 1e-3
"""Standard deviation of a frame that is stated to be exact."""


def shift_rows(images: Sequence[ImageParameters], members: BoolArray, size: int) -> IntArray:
    """Rows (2 s,) of the shifts of some images (n,) among the parameters of a block."""
    rows = [i * size + np.flatnonzero(images[i].locating) for i in np.flatnonzero(members).tolist()]
    return np.concatenate(rows)


def sharing_covariance(images: Sequence[ImageParameters], members: BoolArray, share: float) -> Array:
    """Covariance (2 s, 2 s) of the shifts of a pass, of which images have a share in common."""
    directions = np.concatenate([images[i].shared_direction() for i in np.flatnonzero(members).tolist()])
    covariance = share * directions @ directions.T
    for i in range(0, len(covariance), 2):
        own = np.s_[i : i + 2, i : i + 2]
        covariance[own] = directions[i : i + 2] @ directions[i : i + 2].T
    return np.asarray(covariance)
