"""The observation equations of a block: tie points and control, at given parameters and points."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.known_images import Tie
from amers.services.adjustment.normal_equations import Equations, Pairs, seen_pairs
from amers.services.adjustment.parameters import AdjustableImage
from amers.services.geodesy import metres_per_degree_at, wrapped_degrees
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, BoolArray, IntArray, Observations

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class BlockOptions:
    """How a block is adjusted.

    Attributes:
        tolerance: an observation is deactivated at the end when its residual exceeds this many standard
            deviations.
        max_iterations: the adjustment fails when it has not converged after this many iterations.
        converged_px: the adjustment has converged when no parameter changes by more than this.
        min_points: smallest number of tie points.
    """

    tolerance: float = 4.0
    max_iterations: int = 100
    converged_px: float = 1e-3
    min_points: int = 6


@dataclass(frozen=True)
class BlockProblem:
    """What is observed, in one list of rows by point: image positions, and two rows a control point.

    Attributes:
        images: the n images.
        observations: m image positions of points.
        control: known ground positions; may be empty.
        options: thresholds.
        n_points: number of points.
        size: number of parameters in a block.
        tie: images in common with an adjusted block.
    """

    images: Sequence[AdjustableImage]
    observations: Observations
    control: ControlGround
    options: BlockOptions
    n_points: int
    size: int
    tie: Tie | None = None

    @property
    def n_blocks(self) -> int:
        """Images, and behind them the frames of the control."""
        return len(self.images) + len(self.control.frames)

    @cached_property
    def sigma(self) -> Array:
        """(n, k) a priori standard deviations; 1 for the parameters of frames, and absent ones."""
        sigma = np.ones((self.n_blocks, self.size))
        for i, image in enumerate(self.images):
            sigma[i, : len(image.sigma)] = image.sigma
        return sigma

    @cached_property
    def common(self) -> BoolArray:
        """Blocks of parameters (n,) that are those of images in common with an adjusted block."""
        none = np.zeros(self.n_blocks, dtype=np.bool_)
        return none if self.tie is None else self.tie.members(self.n_blocks)

    @cached_property
    def _order(self) -> IntArray:
        rows = np.concatenate([self.observations.point, np.repeat(self.control.point, 2)])
        return np.argsort(rows, kind="stable").astype(np.int64)

    @cached_property
    def place(self) -> IntArray:
        """Rows (m + 2 c,) of the list: where each image position, then each half of a control is."""
        place = np.empty_like(self._order)
        place[self._order] = np.arange(len(self._order))
        return place

    @cached_property
    def point(self) -> IntArray:
        """Point of each row."""
        rows = np.concatenate([self.observations.point, np.repeat(self.control.point, 2)])
        return np.asarray(rows[self._order])

    @cached_property
    def block(self) -> IntArray:
        """Block of parameters of each row."""
        frames = len(self.images) + np.repeat(self.control.source, 2)
        return np.asarray(np.concatenate([self.observations.image, frames])[self._order])

    @cached_property
    def rows_of_images(self) -> list[IntArray]:
        """Rows of the observations of every image."""
        order = np.argsort(self.observations.image, kind="stable")
        ends = np.cumsum(np.bincount(self.observations.image, minlength=len(self.images)))
        return np.split(order, ends[:-1])

    @cached_property
    def single_rays(self) -> tuple[IntArray, IntArray]:
        """Rows (s,) of the only ray of a known point, and rows of these points in the control.

        Points that are not known in all three coordinates are left out.
        """
        rays = np.bincount(self.observations.point, minlength=self.n_points)
        alone = (rays[self.control.point] == 1) & self.control.known.all(axis=1)
        known = np.flatnonzero(alone)
        return np.searchsorted(self.observations.point, self.control.point[known]), known

    @cached_property
    def flat(self) -> BoolArray:
        """Points (p,) that ortho-images alone show: their rays tell no height."""
        ortho = np.array([isinstance(image.model, OrthoModel) for image in self.images], dtype=np.bool_)
        others = np.bincount(
            self.observations.point[~ortho[self.observations.image]], minlength=self.n_points
        )
        return np.asarray(others == 0)

    @cached_property
    def known_heights(self) -> tuple[Array, Array]:
        """Height (p,) known of every point, and its variance (p,) with that of its frame; else NaN.

        Of several, the most precise; a frame whose height is unknown adds nothing.
        """
        height_m, variance_m2 = np.full(self.n_points, np.nan), np.full(self.n_points, np.inf)
        frame_m2 = np.array([frame.covariance_m2[2, 2] for frame in self.control.frames])
        own_m2 = self.control.covariance_m2[:, 2, 2]
        own_m2 = own_m2 + (np.nan_to_num(frame_m2)[self.control.source] if len(own_m2) else 0.0)
        for row in np.argsort(-own_m2, kind="stable"):
            if np.isfinite(own_m2[row]):
                point = self.control.point[row]
                height_m[point], variance_m2[point] = self.control.lon_lat_h[row, 2], own_m2[row]
        return height_m, np.where(np.isfinite(height_m), variance_m2, np.nan)

    @cached_property
    def ray_coordinates(self) -> Array:
        """Coordinates (p,) of every point that its rays determine: two where they tell no height."""
        return np.where(self.flat, 2.0, 3.0)

    @cached_property
    def by_hand(self) -> BoolArray:
        """Observations (m,) that people made."""
        return self.control.marks(self.observations.point)

    def scales(self, scale: float) -> Array:
        """Scale (m,) of the sigmas of the observations: 1 for those that people made."""
        return np.where(self.by_hand, 1.0, scale)

    @cached_property
    def pairs(self) -> Pairs:
        """The blocks of parameters that have a point in common."""
        return seen_pairs(self.point, self.block, self.n_blocks)

    def start_values(self) -> Array:
        """Parameters (n, k) to begin with: 0, or those of the adjusted block."""
        values = np.zeros((self.n_blocks, self.size))
        if self.tie is not None:
            known = self.tie.known.values
            values[self.tie.rows, : known.shape[1]] = known
        return values

    def start(self) -> Array:
        """Points (p, 3) on the first ray of each, or where known.

        They lie at the middle height of its model, or the nearest that the models of all rays hold for.
        """
        lon_lat_h = np.full((self.n_points, 3), np.nan)
        known_m = self.known_heights[0]
        first = np.unique(self.observations.point, return_index=True)[1]
        first = first[np.argsort(self.observations.image[first], kind="stable")]
        ends = np.searchsorted(self.observations.image[first], np.arange(len(self.images) + 1))
        low, high = self._common_heights
        for i, image in enumerate(self.images):
            rows = first[ends[i] : ends[i + 1]]
            point = self.observations.point[rows]
            middle_m = np.clip(np.mean(image.model.height_range_m), low[point], high[point])
            height_m = np.where(np.isfinite(known_m[point]), known_m[point], middle_m)
            lon_lat_h[point] = image.model.locate(self.observations.line_sample[rows], height_m)
        known = np.isfinite(np.diagonal(self.control.covariance_m2, 0, 1, 2)) & np.isfinite(
            self.control.lon_lat_h
        )
        started = lon_lat_h[self.control.point]
        lon_lat_h[self.control.point] = np.where(known, self.control.lon_lat_h, started)
        return lon_lat_h

    @property
    def _common_heights(self) -> tuple[Array, Array]:
        """Lowest and highest ground (p,) of each point that the models of all its rays hold for."""
        ranges = np.array([image.model.height_range_m for image in self.images], dtype=np.float64)
        low, high = np.full(self.n_points, -np.inf), np.full(self.n_points, np.inf)
        np.maximum.at(low, self.observations.point, ranges[self.observations.image, 0])
        np.minimum.at(high, self.observations.point, ranges[self.observations.image, 1])
        return low, np.maximum(low, high)

    def equations(self, values: Array, lon_lat_h: Array, weight: Array | None = None) -> Equations:
        """The rows at parameters (n, k) and points (p, 3); weights (m + 2 c,) of the list, 1 by default.

        Rows that cannot be computed get no weight.
        """
        m, c = len(self.observations), len(self.control)
        residual, by_ground = np.empty((m + 2 * c, 2)), np.zeros((m + 2 * c, 2, 3))
        by_parameters = np.zeros((m + 2 * c, 2, self.size))
        for i, (image, rows) in enumerate(zip(self.images, self.rows_of_images, strict=True)):
            k, sigma = len(image.sigma), self.observations.sigma_px[rows, None]
            computed = image.computed(values[i, :k], lon_lat_h[self.observations.point[rows]])
            residual[rows] = (self.observations.line_sample[rows] - computed.line_sample) / sigma
            by_ground[rows] = computed.by_ground / sigma[:, :, None]
            by_parameters[rows, :, :k] = computed.by_parameters / sigma[:, :, None]
        if c:
            whitening = self.control.whitening
            misfit = self.control_misfit_m(values, lon_lat_h)
            misfit = np.where(whitening.any(axis=1), misfit, 0.0)
            halves = np.zeros((c, 4, 3))
            halves[:, :3] = whitening
            residual[m:] = (halves @ misfit[:, :, None])[:, :, 0].reshape(-1, 2)
            by_ground[m:] = halves.reshape(-1, 2, 3)
            by_parameters[m:, :, :3] = halves.reshape(-1, 2, 3)
        residual, by_ground = residual[self._order], by_ground[self._order]
        by_parameters = by_parameters[self._order]
        weight = np.ones(m + 2 * c) if weight is None else weight
        usable = np.isfinite(residual).all(axis=1) & np.isfinite(by_ground[:, 0, 0])
        usable &= np.isfinite(by_parameters).all(axis=(1, 2))
        if not usable.all():
            weight = np.where(usable, weight, 0.0)
            residual, by_ground, by_parameters = (
                np.nan_to_num(part) for part in (residual, by_ground, by_parameters)
            )
        return Equations(self.point, self.block, residual, by_ground, by_parameters, weight)

    def squares(self, values: Array, lon_lat_h: Array) -> Array:
        """Squared lengths (m,) of residuals in units of their stated sigmas; NaN where unknown."""
        equations = self.equations(values, lon_lat_h)
        square = (equations.residual**2).sum(axis=1)
        return self.image_rows(np.where(equations.weight > 0.0, square, np.nan))

    def control_misfit_m(self, values: Array, lon_lat_h: Array) -> Array:
        """Known minus computed ground (c, 3), metres east, north, up, with the errors of the frames."""
        if not len(self.control):
            return np.empty((0, 3))
        computed = lon_lat_h[self.control.point]
        difference = self.control.lon_lat_h - computed
        difference[:, 0] = wrapped_degrees(difference[:, 0])
        difference[:, :2] *= metres_per_degree_at(np.nan_to_num(computed))
        return np.asarray(difference - values[len(self.images) + self.control.source, :3])

    def image_rows(self, per_row: npt.NDArray[T]) -> npt.NDArray[T]:
        """What belongs to the m image positions, of values of the list."""
        return np.asarray(per_row[self.place[: len(self.observations)]])

    def control_rows(self, per_row: npt.NDArray[T]) -> npt.NDArray[T]:
        """What belongs to the c control points, (c, 2, ...), of values of the list."""
        rows = self.place[len(self.observations) :]
        return np.asarray(per_row[rows].reshape(len(self.control), 2, *per_row.shape[1:]))

    def weights(self, of_observations: Array | BoolArray, of_control: Array | BoolArray) -> Array:
        """Weights of the list, of weights (m,) of image positions and (c,) of control points."""
        together = np.concatenate([of_observations, np.repeat(of_control, 2)]).astype(np.float64)
        return np.asarray(together[self._order])
