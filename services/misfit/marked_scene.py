"""The correction of one scene from a few marks: every parameter has an a priori standard deviation.

One mark determines a shift, and nothing else. All six parameters of an affine correction are estimated
all the same: what the marks do not determine stays at its a priori value, zero, and its a priori
standard deviation stays in the covariance, so that the stated accuracy grows away from the marks. The
marks may raise the a priori standard deviations (empirical Bayes), never lower them.

A mark is tested against the solution of all others (data snooping; Baarda, 1968, A testing procedure for
use in geodetic networks). The worst leaves, one at a time, as long as most of the marks agree.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from amers.services.errors import CoverageError
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.robust import MAD_TO_STD
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.misfit.shared_errors import SharedErrors
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import no_correction
from amers.services.types import Array, BoolArray, IntArray

_FALSE_ALARM = 1e-3
"""Chance that correct marks have one that is rejected, as reports of networks have it (Baarda)."""
_LIKELY = 6.0
"""Difference of two test values, or of twice the logarithm of evidence, below which either may be right:
odds of 20 to 1."""
_FEWEST_SCALED = 5
"""Marks from which the scale of their errors is estimated: fewer may all be wrong."""
_FEWEST_RAISED = 4
"""Marks from which drift and skew may be larger than expected: three fit any without residual."""
_LARGEST_RAISE = 1000.0
_RAISES = np.geomspace(1.0, _LARGEST_RAISE, 31)
_HELD = 0.5
"""Share of its a priori variance from which on a parameter is held by that, not by the marks."""


@dataclass(frozen=True)
class MarkPriors:
    """A priori standard deviations of a correction.

    Attributes:
        shift_px: of the shift, each coordinate.
        slope_px: of drift and skew at the edge of the image.
    """

    shift_px: float
    slope_px: float

    @property
    def sigma_px(self) -> Array:
        """(6,) of the parameters of a correction, row by row."""
        return np.tile([self.shift_px, self.slope_px, self.slope_px], 2)


@dataclass(frozen=True)
class MarkedScene:
    """The adjustment of a scene on n marks.

    Attributes:
        adjustment: the correction, its covariance, and the residuals.
        priors: as used, raised where the marks ask for it.
        held: (2, 3) parameters that their a priori standard deviation determines, not the marks.
        left_out_px: (n, 2) misfit of each mark against the solution of the others; NaN for a single one.
        left_out_sigma_px: (n, 2) its standard deviation, by what is stated of the marks; NaN likewise.
        noise_px2: (n, 2, 2) covariance of the marks, of pick and ground, as the residuals show it.
        alternative: (n,) int64, for a rejected mark: another one that may be wrong in its place; -1 for
            none.
        disagree: marks disagree, and nothing shows which ones are wrong; none was rejected.
    """

    adjustment: SceneAdjustment
    priors: MarkPriors
    held: BoolArray
    left_out_px: Array
    left_out_sigma_px: Array
    noise_px2: Array
    alternative: IntArray
    disagree: bool


def adjust_marks(
    model: SensorModel,
    shape: tuple[int, int],
    marks: ControlObservations,
    priors: MarkPriors,
    like: MarkedScene | None = None,
) -> MarkedScene:
    """The affine correction of a model that best explains some marks and its a priori accuracy.

    Args:
        model: as delivered.
        shape: lines and samples of the image.
        marks: one or more, with the sigmas of their picks and the covariance of their ground.
        priors: what the marks may raise.
        like: an adjustment of these marks and others, whose priors and scale hold; no mark leaves.

    Raises:
        CoverageError: no mark has a position by the model.
    """
    system = _System.of(model, shape, marks)
    usable = system.seen if marks.usable is None else system.seen & marks.usable
    if not usable.any():
        raise CoverageError(
            f"none of {len(system.seen)} marks lies on ground where the model of the scene is valid: "
            "check that they belong to this scene, and their reference system"
        )
    if like is not None:
        found = _Agreement(usable, like.priors, np.full(len(usable), -1), False)
        return _marked(system, found, like.adjustment.sigma0)
    found = _agreement(system, usable, priors)
    return _marked(system, found, system.sigma0(found.active, found.priors))


@dataclass(frozen=True)
class _Agreement:
    """Which marks (n,) agree, by which priors; see `MarkedScene`."""

    active: BoolArray
    priors: MarkPriors
    alternative: IntArray
    disagree: bool


def _agreement(system: "_System", usable: BoolArray, priors: MarkPriors) -> _Agreement:
    """The marks that agree: first with as much drift as models have, then with what they show of it."""
    found = _snooped(system, usable, priors)
    raised = system.raised(usable if found.disagree else found.active, priors)
    if raised == priors:
        return found
    again = _snooped(system, usable, raised)
    if found.disagree and (again.disagree or usable.sum() < _FEWEST_RAISED):
        return found
    return again if again.active.sum() >= found.active.sum() else replace(found, priors=raised)


def _snooped(system: "_System", usable: BoolArray, priors: MarkPriors) -> _Agreement:
    """The marks without those that disagree with the others, the worst first."""
    alternative = np.full(len(usable), -1, dtype=np.int64)
    count = int(usable.sum())
    active, limit = usable.copy(), system.scale2(usable) * float(chdtri(2, _FALSE_ALARM / count))
    while active.sum() > 1:
        test = np.where(active, system.test(active, priors), -np.inf)
        worst, second = np.argsort(test)[:-3:-1]
        if test[worst] <= limit:
            break
        if active.sum() == 2:
            active[:] = False
            break
        if test[worst] - test[second] < _LIKELY:
            alternative[worst] = second
        active[worst] = False
    if 2 * active.sum() <= count:
        return _Agreement(usable, priors, np.full(len(usable), -1, dtype=np.int64), count > 1)
    return _Agreement(active, priors, alternative, False)


@dataclass(frozen=True)
class _System:
    """n marks as observations of the six parameters of a correction, row by row.

    Attributes:
        design: (n, 2, 6) derivatives.
        misfit: (n, 2) mark minus position by the model.
        noise: (n, 2, 2) covariance of the misfits.
        of_ground: (n, 2, 2) part of it by the ground.
        seen: (n,) whether the model has a position.
        shape: lines and samples of the image.
    """

    design: Array
    misfit: Array
    noise: Array
    of_ground: Array
    seen: BoolArray
    shape: tuple[int, int]

    @classmethod
    def of(cls, model: SensorModel, shape: tuple[int, int], marks: ControlObservations) -> "_System":
        """The system of marks on a model."""
        computed = model.project(marks.lon_lat_h)
        misfit = marks.line_sample - computed
        seen = np.asarray(np.isfinite(misfit).all(axis=1))
        frame = no_correction(shape)
        t = np.nan_to_num((computed - frame.centre) / frame.half_size)
        design = np.zeros((len(t), 2, 6))
        design[:, 0, :3] = design[:, 1, 3:] = np.column_stack([np.ones(len(t)), t])
        derivative = np.nan_to_num(model.project_derivative(marks.lon_lat_h))
        of_ground = derivative @ marks.covariance_m2 @ derivative.transpose(0, 2, 1)
        noise = of_ground + marks.sigma_px[:, None, None] ** 2 * np.eye(2)
        return cls(design, np.where(seen[:, None], misfit, 0.0), noise, of_ground, seen, shape)

    @property
    def weighted(self) -> Array:
        """(n, 6, 2) transposed design times the weights."""
        return np.asarray(np.linalg.solve(self.noise, self.design).transpose(0, 2, 1))

    def normal(self, active: BoolArray, priors: MarkPriors) -> tuple[Array, Array]:
        """Matrix (6, 6) and right side (6,) of the normal equations."""
        weighted = self.weighted[active]
        matrix = np.einsum("nik,nkj->ij", weighted, self.design[active])
        right = np.einsum("nik,nk->i", weighted, self.misfit[active])
        return matrix + np.diag(priors.sigma_px**-2.0), right

    def left_out(self, active: BoolArray, priors: MarkPriors) -> tuple[Array, Array]:
        """Misfit (n, 2) of each mark against the others that are active, with covariance (n, 2, 2)."""
        matrix, right = self.normal(active, priors)
        own = active[:, None, None]
        without = matrix - np.where(own, self.weighted @ self.design, 0.0)
        right = right - np.where(own[:, 0], np.einsum("nik,nk->ni", self.weighted, self.misfit), 0.0)
        covariance = np.linalg.inv(without)
        computed = np.einsum("nki,nij,nj->nk", self.design, covariance, right)
        spread = self.design @ covariance @ self.design.transpose(0, 2, 1)
        return self.misfit - computed, spread + self.noise

    def test(self, active: BoolArray, priors: MarkPriors) -> Array:
        """Squares (n,) of the misfits against the others, in units of their covariances."""
        misfit, covariance = self.left_out(active, priors)
        return np.asarray(
            (misfit * np.linalg.solve(covariance, misfit[:, :, None])[:, :, 0]).sum(axis=1)
        )

    def scale2(self, usable: BoolArray) -> float:
        """Variance of the misfits about their median over the stated one, at least 1."""
        count = int(usable.sum())
        if count < _FEWEST_SCALED:
            return 1.0
        misfit = self.misfit[usable]
        sigma = np.sqrt(np.diagonal(self.noise[usable], 0, 1, 2))
        off = np.abs(misfit - np.median(misfit, axis=0)) / sigma
        return max(1.0, (MAD_TO_STD * float(np.median(off))) ** 2 * count / (count - 1))

    def raised(self, active: BoolArray, priors: MarkPriors) -> MarkPriors:
        """The priors, at least those given, that make the misfits of some marks most likely."""
        matrix, right = self.normal(active, MarkPriors(np.inf, np.inf))
        slopes = _RAISES if active.sum() >= _FEWEST_RAISED else _RAISES[:1]
        shift_px, slope_px = np.meshgrid(
            priors.shift_px * _RAISES, priors.slope_px * slopes, indexing="ij"
        )
        sigma_px = np.stack([shift_px, slope_px, slope_px] * 2, axis=-1)
        whole = matrix + sigma_px[..., None] ** -2.0 * np.eye(6)
        explained = np.einsum("i,...ij,j->...", right, np.linalg.inv(whole), right)
        spread = np.linalg.slogdet(whole)[1] + 2.0 * np.log(sigma_px).sum(axis=-1)
        evidence = explained - spread
        # Drift and skew are raised where marks ask for it clearly: noise, too, looks like a little.
        evidence[:, 1:] -= _LIKELY
        best = np.unravel_index(np.argmax(evidence), shift_px.shape)
        return MarkPriors(float(shift_px[best]), float(slope_px[best]))

    def sigma0(self, active: BoolArray, priors: MarkPriors) -> float:
        """Standard deviation of unit weight; 1 without redundancy."""
        matrix, right = self.normal(active, priors)
        covariance = np.linalg.inv(matrix)
        residual = self.misfit[active] - self.design[active] @ (covariance @ right)
        square = (residual * np.linalg.solve(self.noise[active], residual[:, :, None])[:, :, 0]).sum()
        by_priors = float((np.diagonal(covariance) * priors.sigma_px**-2.0).sum())
        freedom = 2.0 * int(active.sum()) - 6.0 + by_priors
        return float(np.sqrt(square / freedom)) if freedom > 0.5 else 1.0


def _marked(stated: _System, found: _Agreement, sigma0: float) -> MarkedScene:
    """The solution of marks that agree, with the noise that they show, and what it states."""
    active, priors = found.active, found.priors
    system = replace(stated, noise=stated.noise * max(sigma0, 1.0) ** 2)
    matrix, right = system.normal(active, priors)
    covariance = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    parameters = (covariance @ right).reshape(2, 3)
    held = (np.diagonal(covariance) > _HELD * priors.sigma_px**2).reshape(2, 3)
    left_out_px, spread = stated.left_out(active, priors)
    left_out_sigma_px = np.sqrt(np.diagonal(spread, 0, 1, 2))
    without = (active & (active.sum() < 2)) | ~system.seen
    left_out_px[without] = left_out_sigma_px[without] = np.nan
    residual = system.misfit - (system.design @ (covariance @ right))
    of_ground = np.diagonal(system.of_ground[active], 0, 1, 2)
    adjustment = SceneAdjustment(
        correction=replace(no_correction(system.shape), parameters=parameters),
        order="shift" if held[:, 1:].all() else "affine",
        validation_px=(),
        slope_px=priors.slope_px,
        covariance=covariance,
        deformation=np.zeros((6, 6)),
        local_sigma_px=np.zeros(2),
        shared=SharedErrors(max(sigma0, 1.0) ** 2, np.zeros(3), 0.0),
        apart_px=0.0,
        residual_px=np.where(system.seen[:, None], residual, np.nan),
        active=active,
        sigma0=sigma0,
        point_sigma_px=np.sqrt(of_ground.mean(axis=0)),
    )
    return MarkedScene(
        adjustment=adjustment,
        priors=priors,
        held=held,
        left_out_px=left_out_px,
        left_out_sigma_px=left_out_sigma_px,
        noise_px2=system.noise,
        alternative=found.alternative,
        disagree=found.disagree,
    )
