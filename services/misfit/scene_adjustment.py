"""Options of the adjustment of one scene, and its result with the stated accuracy."""

from dataclasses import dataclass

from amers.services.misfit.affine_fit import Order
from amers.services.misfit.displacement_components import Component
from amers.services.misfit.moved_ground import MovedGround
from amers.services.misfit.shared_errors import SharedErrors
from amers.services.misfit.structure import Structure
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import Array, BoolArray


@dataclass(frozen=True)
class AdjustmentOptions:
    """How a scene is adjusted.

    Attributes:
        order: of the correction; None selects it by cross-validation. Drift and skew are then estimated
            whatever the order, as far as the measures determine them.
        tolerance: a measure is deactivated when its residual exceeds this many standard deviations.
        min_points: smallest number of active measures.
        points_per_parameter: measures for each parameter that an order needs to be considered.
        min_spread: spread of the measures that an order beyond the shift needs: standard deviation along
            each axis, in half sizes of the image (an even spread has 0.58).
        min_gain: an order replaces a simpler one when it reduces the cross-validated residual by this
            fraction.
        folds: of the cross-validation.
        prior_slope_sigma_px: a priori standard deviation of drift and skew at the edge of the image,
            pixels; the measures may raise it, never lower it.
        profile: whether motion along lines and samples that the measures show is followed, where no
            order is given; what is not followed is tested in any case.
        bends: whether bends that the measures leave open are followed beside it, as far as they show
            them. Other images may tell of them.
    """

    order: Order | None = None
    tolerance: float = 2.7
    min_points: int = 4
    points_per_parameter: float = 2.0
    min_spread: float = 0.1
    min_gain: float = 0.03
    folds: int = 5
    prior_slope_sigma_px: float = 1.0
    profile: bool = True
    bends: bool = True


@dataclass(frozen=True)
class SceneAdjustment:
    """A correction and its precision.

    Attributes:
        correction: of the scene's model.
        order: the simplest order that predicts held-out measures as well as any, or the order given.
        validation_px: every order tried, with its cross-validated residual (rms distance, pixels).
        slope_px: a priori standard deviation of drift and skew at the edge of the image, as used.
        covariance: (6, 6) of `correction.parameters.ravel()`, px^2; zero for parameters that a given
            order leaves out. It is relative to the frame that the blocks of the points scatter about.
        deformation: (6, 6) part of it by what the points share, as they are deformed.
        local_sigma_px: (2,) standard deviation, line and sample, of what parts of the image are off by
            and no correction follows: seams between detectors, terrain.
        shared: what the residuals tell of errors that the points share.
        apart_px: standard deviation of the offsets of the points' blocks, beyond chance; 0 for one.
        residual_px: (n, 2) observed minus computed, line and sample, of all measures.
        active: (n,) measures that were not deactivated.
        sigma0: a posteriori standard deviation of unit weight.
        point_sigma_px: (2,) contribution of the points' own accuracy to the active residuals, one
            standard deviation of line and sample.
        components: of the displacement beyond the affine correction that residuals show.
        left_open: components of it that the points leave open, where they do not reach: bends, seams.
        structures: what the residuals of the correction still depend on, by family; none where it was
            not tested.
        moved: ground that moved, of which no measure is active; None where none is seen.
    """

    correction: ImageCorrection
    order: Order
    validation_px: tuple[tuple[Order, float], ...]
    slope_px: float
    covariance: Array
    deformation: Array
    local_sigma_px: Array
    shared: SharedErrors
    apart_px: float
    residual_px: Array
    active: BoolArray
    sigma0: float
    point_sigma_px: Array
    components: tuple[Component, ...] = ()
    left_open: tuple[Component, ...] = ()
    structures: tuple[Structure, ...] = ()
    moved: MovedGround | None = None

    def covariance_at(self, line_sample: Array) -> Array:
        """Covariance (n, 2, 2) of the corrected model at image positions (n, 2), px^2."""
        return self.correction.covariance_at(line_sample, self.covariance, self.local_sigma_px)
