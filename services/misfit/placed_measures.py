"""The measures of a scene with their positions: input of the tests of residuals and of the profile."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from amers.services.misfit.affine_fit import AffineFit
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.displacement_components import Component, beyond, likeliest_components
from amers.services.misfit.displacement_solution import agreeing_with
from amers.services.misfit.shared_errors import SharedErrors, overlap_correlation
from amers.services.misfit.structure import ALONG_AXES, OTHERWISE, Residuals, Structure, structures
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, BoolArray

_OF_ITS_OWN = 1e-6
"""Share of its variance that each measure has for itself: chips that are the same have the same errors,
and no covariance of them could be inverted."""


@dataclass(frozen=True)
class PlacedMeasures:
    """The n measures of a scene.

    Attributes:
        position_px: (n, 2) by the model.
        height_m: (n,) of the points.
        height_pull: (2,) see `Residuals`.
        points_px2: median variance of a measure by its point, of the worse coordinate.
        overlapping: (n, n) correlation by overlapping chips.
        chip_side_px: of a chip in the scene.
        shape: lines and samples of the image.
        scanned: whether the image was scanned line by line.
    """

    position_px: Array
    height_m: Array
    height_pull: Array
    points_px2: float
    overlapping: Array
    chip_side_px: float
    shape: tuple[int, int]
    scanned: bool

    @classmethod
    def of(
        cls,
        model: SensorModel,
        shape: tuple[int, int],
        observations: ControlObservations,
        *,
        fit: AffineFit,
        of_points: Array,
    ) -> Self:
        """The measures of points; `of_points` (n, 2) is their part of the variances of a fit of them."""
        lon_lat_h, chip_side_px = observations.lon_lat_h, observations.chip_side_px
        frame = no_correction(shape)
        position_px = frame.centre + fit.t * frame.half_size
        own_share = (1.0 - of_points / fit.variance).mean(axis=1)
        derivative = model.project_derivative(lon_lat_h)
        return cls(
            position_px,
            lon_lat_h[:, 2],
            np.nanmean(derivative @ observations.covariance_m2[:, :, 2:], axis=0)[:, 0],
            float(np.median(of_points, axis=0).max()),
            overlap_correlation(position_px, chip_side_px, own_share),
            chip_side_px,
            shape,
            not isinstance(model, OrthoModel),
        )

    @property
    def size_px(self) -> float:
        """Side of a square image of as many pixels."""
        return float(np.sqrt(self.shape[0] * self.shape[1]))

    @property
    def position(self) -> Array:
        """(n, 2) sides of the image."""
        return self.position_px / self.size_px

    def residuals(
        self, fit: AffineFit, rows: BoolArray, shared: SharedErrors | None = None
    ) -> Residuals:
        """The measures of a mask (n,), with the errors that they share."""
        correlation = self.overlapping[np.ix_(rows, rows)]
        if shared is not None:
            correlation = shared.covariance(self.position[rows], correlation)
        correlation = correlation + _OF_ITS_OWN * np.eye(len(correlation))
        sigma = fit.sigma[rows].T
        return Residuals(
            self.position_px[rows],
            self.height_m[rows],
            self.height_pull,
            fit.misfit[rows],
            sigma[:, :, None] * correlation * sigma[:, None, :],
            fit.design[rows],
            self.chip_side_px,
        )

    def components(
        self,
        fit: AffineFit,
        rows: BoolArray,
        known: tuple[Component, ...] = (),
        *,
        wanted: bool = True,
    ) -> tuple[tuple[Component, ...], tuple[Structure, ...]]:
        """What no affine correction follows, and what is left along lines and samples.

        Args:
            fit: of the measures.
            rows: (n,) those that are used.
            known: steps at breaks, which are followed in any case.
            wanted: whether it may be followed; else all is left.
        """
        residuals = self.residuals(fit, rows)
        if not wanted:
            return (), structures(residuals, ALONG_AXES)
        return likeliest_components(
            residuals, self.size_px, known, scanned=self.scanned, points_px2=self.points_px2
        )

    def agreeing(
        self,
        fit: AffineFit,
        rows: BoolArray,
        components: tuple[Component, ...],
        expected: Array,
        tolerance: float,
    ) -> BoolArray:
        """Measures (n,) of a mask that agree with a profile, see `agreeing_with`."""
        out = np.zeros_like(rows)
        out[rows] = agreeing_with(self.residuals(fit, rows), components, expected, tolerance)
        return out

    def without(self, displacement: DisplacementGrid, fit: AffineFit) -> AffineFit:
        """A fit of what a displacement leaves, as chips show it."""
        shown = displacement.averaged(self.position_px, self.chip_side_px)
        return replace(fit, misfit=fit.misfit - shown)

    def structures(
        self,
        fit: AffineFit,
        active: BoolArray,
        components: tuple[Component, ...],
        shared: SharedErrors,
        along_axes: tuple[Structure, ...] = (),
    ) -> tuple[Structure, ...]:
        """What the residuals still depend on, beside errors that neighbours clearly share.

        Args:
            fit: of the measures.
            active: (n,) those that are used.
            components: of the profile.
            shared: errors that neighbours share.
            along_axes: what the components leave, where neighbours share nothing; it is tested here
                where it is not given.
        """
        clear = shared.clear_share > 0.0
        residuals = beyond(self.residuals(fit, active, shared if clear else None), components)
        if clear or components or not along_axes:
            along_axes = structures(residuals, ALONG_AXES)
        return along_axes + structures(residuals, OTHERWISE)
