"""The free parameters of images in a block adjustment, with their a priori accuracy."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy import sparse

from amers.services.misfit.affine_fit import FREE, Order
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, BoolArray, IntArray

PASS_SHARE = 0.5
"""Share of the variance of the shifts that the images of a pass have in common, as the adjustment
weights them. The true share is unknown: the frame of the block covers every share between none and
all."""


_NAMES = (
    ("line shift", "line drift", "line skew"),
    ("sample shift", "sample skew", "sample drift"),
)
"""Of the parameters of an image correction."""


class Computed(NamedTuple):
    """Positions in an image and their derivatives; NaN where there is no position.

    Attributes:
        line_sample: (m, 2) pixels.
        by_ground: (m, 2, 3) by metres east, north, up.
        by_parameters: (m, 2, k).
    """

    line_sample: Array
    by_ground: Array
    by_parameters: Array


class FreeParameter(NamedTuple):
    """What a parameter is.

    Attributes:
        name: for people.
        unit: in which people state it.
        per_px: units of a parameter of one.
    """

    name: str
    unit: str
    per_px: float


class AdjustableImage(Protocol):
    """An image of a block with its k free parameters; all that the adjustment asks of it.

    A parameter of one displaces some position in the image by a pixel, and none by much more. All are
    zero for the model as delivered.
    """

    @property
    def name(self) -> str:
        """Of the image, for messages."""
        ...

    @property
    def model(self) -> SensorModel:
        """As delivered."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        ...

    @property
    def parameters(self) -> tuple[FreeParameter, ...]:
        """(k,) what they are."""
        ...

    @property
    def sigma(self) -> Array:
        """(k,) a priori standard deviations, pixels."""
        ...

    @property
    def locating(self) -> BoolArray:
        """(k,) parameters whose a priori sigma is the accuracy of the image on the Earth."""
        ...

    @property
    def estimated(self) -> BoolArray:
        """(k,) parameters, none of them locating, whose sigmas the block multiplies by one factor."""
        ...

    @property
    def deformable(self) -> bool:
        """Whether only tie points support the linear shape of the ground: parameters follow any."""
        ...

    @property
    def displacement(self) -> DisplacementGrid | None:
        """Of positions beyond the parameters, known; None for none."""
        ...

    @property
    def credible_px(self) -> float:
        """How far positions may be off, at most; infinite where what is stated is a guess."""
        ...

    def computed(self, values: Array, lon_lat_h: Array) -> Computed:
        """Where the model with parameters (k,) shows ground points (m, 3)."""
        ...

    def corrected(self, values: Array) -> SensorModel:
        """The model with parameters (k,)."""
        ...

    def shared_direction(self) -> Array:
        """Derivative (l, 2) of the locating parameters by an error of unit variance on the ground.

        The images of a pass may have that error in common. It takes at most the a priori variance.
        """
        ...


@dataclass(frozen=True)
class ImageParameters:
    """The free parameters of a correction in image space, which follows a delivered model.

    Attributes:
        name: of the image, for messages.
        model: as delivered.
        zero: the correction whose parameters are free, all zero; its displacement is known.
        prior_px: (2, 3) a priori standard deviation of `ImageCorrection.parameters`; 0 where fixed.
    """

    name: str
    model: SensorModel
    zero: ImageCorrection
    prior_px: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        lines, samples = np.round(2.0 * self.zero.half_size).astype(np.int64).tolist()
        return lines, samples

    @property
    def parameters(self) -> tuple[FreeParameter, ...]:
        """(k,) names, all in pixels."""
        named = np.array(_NAMES)[self.free]
        return tuple(FreeParameter(str(name), "px", 1.0) for name in named)

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

    @property
    def estimated(self) -> BoolArray:
        """(k,) drifts and skews: what is stated of their size is a guess."""
        return ~self.locating

    @property
    def deformable(self) -> bool:
        """Whether the correction is affine."""
        return bool(self.free.all())

    @property
    def displacement(self) -> DisplacementGrid | None:
        """What moves lines and samples, as it was found before; None for nothing."""
        return self.zero.displacement

    @property
    def credible_px(self) -> float:
        """Infinite: users state the accuracy of RPCs as they guess it."""
        return np.inf

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

    def computed(self, values: Array, lon_lat_h: Array) -> Computed:
        """Where the corrected model shows ground points (m, 3), with parameters (k,)."""
        delivered = self.model.project(lon_lat_h)
        design, by_ground = self.design(delivered), self.model.project_derivative(lon_lat_h)
        if self.zero.displacement is not None:
            by_ground = self.zero.derivative_at(delivered) @ by_ground
        return Computed(self.zero.apply(delivered) + design @ values, by_ground, design)

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
    displacement: DisplacementGrid | None = None,
) -> ImageParameters:
    """The parameters of an image correction.

    Args:
        name: of the image.
        model: as delivered.
        shape: lines and samples.
        shift_px: a priori standard deviation of the shift of each coordinate, pixels.
        slope_px: of drift and skew, pixels at the edge of the image; 0 for a shift alone.
        order: which parameters are free.
        displacement: beyond them, known; None for none.
    """
    prior_px = np.full((2, 3), slope_px)
    prior_px[:, 0] = shift_px
    zero = replace(no_correction(shape), displacement=displacement)
    return ImageParameters(name, model, zero, prior_px * FREE[order])


@dataclass(frozen=True)
class BlockPriors:
    """The a priori accuracy of all parameters of a block, in blocks of `size`; absent ones are fixed.

    Attributes:
        size: largest number of parameters of an image; one that an image lacks has no derivative.
        apart: (K, K) sparse, `locating` plus the squares of the columns `shared`: no pass ties images.
        shared: (K, q) sparse, the errors that the images of a pass share, in blocks of `size` columns
            for every pass.
        shape: (K,) inverse variances of the others: drifts and skews.
        estimated: (K,) parameters that the block determines.
        mean: (K,) what is expected: 0, or what a neighbouring block tells.
    """

    size: int
    apart: sparse.csc_matrix
    shared: sparse.csc_matrix
    shape: Array
    estimated: BoolArray
    mean: Array

    @cached_property
    def locating(self) -> sparse.csc_matrix:
        """(K, K) sparse, inverse covariance of the parameters that tell where images lie."""
        return (self.apart - self.shared @ self.shared.T).tocsc()

    def located(self, columns: Array) -> Array:
        """The product (K, ...) of `locating` with columns, without the pairs of images of passes."""
        return np.asarray(self.apart @ columns - self.shared @ (self.shared.T @ columns))

    def weight(self) -> Array:
        """(K,) inverse a priori variances, for known values of all other parameters."""
        square = np.asarray(self.shared.power(2).sum(axis=1)).ravel()
        return np.asarray(self.apart.diagonal() - square + self.shape)

    def with_slopes(self, factor: float) -> "BlockPriors":
        """The same where the standard deviations that are estimated are multiplied by a factor."""
        return replace(self, shape=np.where(self.estimated, self.shape / factor**2, self.shape))


def block_priors(
    images: Sequence[AdjustableImage], passes: Sequence[BoolArray], frames: Sequence[Array] = ()
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
    apart, shape = np.zeros((n, size, size)), np.zeros((n, size))
    estimated = np.zeros((n, size), dtype=np.bool_)
    for i, image in enumerate(images):
        k = len(image.sigma)
        weight = np.ones(size)
        weight[:k] = image.sigma**-2.0
        tells = np.ones(size, dtype=np.bool_)
        tells[:k] = image.locating
        apart[i] = np.diag(np.where(tells, weight, 0.0))
        shape[i] = np.where(tells, 0.0, weight)
        estimated[i, :k] = image.estimated
    shared = [np.empty((0, 3))]
    width = 0
    for members in passes:
        chosen = np.flatnonzero(members).tolist()
        own, columns = _shared_columns([images[i] for i in chosen])
        for i, alone in zip(chosen, own, strict=True):
            apart[i][np.ix_(images[i].locating, images[i].locating)] = alone
        rows, count = shift_rows(images, members, size), columns.shape[1]
        place = np.repeat(rows, count), width + np.tile(np.arange(count), len(rows))
        shared.append(np.column_stack([*place, columns.ravel()]))
        # Blocks of columns, as others are of parameters.
        width += size * -(-count // size)
    for i, covariance in enumerate(frames):
        apart[len(images) + i] = np.eye(size)
        apart[len(images) + i, :3, :3] = frame_weight(covariance)
    row, column, value = np.concatenate(shared).T
    return BlockPriors(
        size,
        _block_diagonal(apart),
        sparse.coo_matrix((value, (row.astype(int), column.astype(int))), (n * size, width)).tocsc(),
        shape.ravel(),
        estimated.ravel(),
        np.zeros(n * size),
    )


def _block_diagonal(blocks: Array) -> sparse.csc_matrix:
    """The sparse matrix of blocks (n, k, k) on its diagonal."""
    n, k, _ = blocks.shape
    matrix = sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(n * k, n * k)).tocsc()
    matrix.eliminate_zeros()
    return matrix


def _shared_columns(images: Sequence[AdjustableImage]) -> tuple[list[Array], Array]:
    """Weights B^-1 of every image, and columns C (s, q) of a pass.

    The inverse covariance of its parameters is B^-1 - C C^T; their covariance is that of each image
    alone, B, plus D D^T / 2 of the errors D that all share.
    """
    own: list[Array] = []
    weighted: list[Array] = []
    told: Array = np.zeros((1, 1))
    for image in images:
        direction = image.shared_direction()
        alone = np.diag(image.sigma[image.locating] ** 2) - PASS_SHARE * direction @ direction.T
        own.append(np.asarray(np.linalg.inv(alone), dtype=np.float64))
        weighted.append(own[-1] @ direction)
        told = told + direction.T @ weighted[-1]
    inner = np.linalg.cholesky(np.eye(len(told)) / PASS_SHARE + told)
    columns = np.linalg.solve(inner, np.concatenate(weighted).T).T
    return own, np.asarray(columns, dtype=np.float64)


def frame_weight(covariance_m2: Array) -> Array:
    """Inverse (3, 3) of the covariance of a frame; 0 where it is unknown."""
    known = np.isfinite(np.diagonal(covariance_m2))
    weight = np.zeros((3, 3))
    inside = np.ix_(known, known)
    weight[inside] = np.linalg.inv(covariance_m2[inside] + _EXACT_M**2 * np.eye(int(known.sum())))
    return weight


_EXACT_M = 1e-3
"""Standard deviation of a frame that is stated to be exact."""


def shift_rows(images: Sequence[AdjustableImage], members: BoolArray, size: int) -> IntArray:
    """Rows (s,) of the locating parameters of some images (n,) among the parameters of a block."""
    rows = [i * size + np.flatnonzero(images[i].locating) for i in np.flatnonzero(members).tolist()]
    return np.concatenate(rows)


def shared_part(images: Sequence[AdjustableImage], members: BoolArray, gain: Array) -> Array:
    """What the errors that a pass may share add to the covariance of a frame, if all are shared: (g, g).

    The covariance of the locating parameters of its images is diagonal, plus the share times the
    products of the shared errors of every two of them.

    Args:
        images: of the block.
        members: (n,) images of the pass.
        gain: (g, s) of the frame, by the locating parameters of its images in their order.
    """
    total, own, first = np.zeros((len(gain), 1)), np.zeros((len(gain), len(gain))), 0
    for i in np.flatnonzero(members).tolist():
        direction = images[i].shared_direction()
        moved = gain[:, first : first + len(direction)] @ direction
        total, own, first = total + moved, own + moved @ moved.T, first + len(direction)
    return np.asarray(total @ total.T - own)


def own_part(images: Sequence[AdjustableImage], members: BoolArray, gain: Array) -> Array:
    """What the errors of the images of a pass add to the covariance of a frame where none is shared."""
    chosen = [images[i] for i in np.flatnonzero(members).tolist()]
    sigma = np.concatenate([image.sigma[image.locating] for image in chosen])
    return np.asarray((gain * sigma**2) @ gain.T)
