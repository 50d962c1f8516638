"""The free parameters of rigorous models in a block adjustment: attitude, orbit and focal length."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amers.services.adjustment.parameters import Computed, FreeParameter
from amers.services.errors import InputError
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.moving_pushbroom import moving_model
from amers.services.sensors.parameter_sets import UNITS, ParameterSet
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.pushbroom_errors import TERMS, PushbroomErrors
from amers.services.types import Array, BoolArray, IntArray

_PER_SI = np.repeat([1e6, 1.0, 1e6], [6, 6, 2])
_LOCATING = ("roll", "pitch", "along track", "across track", "radial")
_ORBIT_SHARE = 0.9
"""Largest share of the stated variance on the ground that the orbit may have."""
_NODES = 5
"""Places a side of the image over which the largest displacement is looked for."""
_CREDIBLE_SIGMAS = 6.0


@dataclass(frozen=True)
class RigorousParameters:
    """Free terms of a rigorous model; a parameter of one displaces its image by a pixel at most.

    Attributes:
        name: of the image, for messages.
        model: as delivered.
        errors: the terms of that model, with the motion of its sensor.
        free: (k,) int64, rows of `TERMS`.
        sigma: (k,) a priori standard deviations, pixels.
        per_px: (k,) radians, metres or parts, of a parameter of one.
        displacement: what that motion does to the image; None for none.
    """

    name: str
    model: PushbroomModel
    errors: PushbroomErrors
    free: IntArray
    sigma: Array
    per_px: Array
    displacement: DisplacementGrid | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.model.image_shape

    @property
    def parameters(self) -> tuple[FreeParameter, ...]:
        """(k,) names, units, and units per pixel."""
        scale = self.per_px * _PER_SI[self.free]
        return tuple(
            FreeParameter(TERMS[row], UNITS[row], per_px)
            for row, per_px in zip(self.free.tolist(), scale.tolist(), strict=True)
        )

    @property
    def locating(self) -> BoolArray:
        """(k,) roll, pitch and the constants of the orbit: they place the image on the Earth."""
        return np.array([TERMS[row] in _LOCATING for row in self.free])

    @property
    def estimated(self) -> BoolArray:
        """(k,) none: what is stated of a satellite is known of it."""
        return np.zeros(len(self.free), dtype=np.bool_)

    @property
    def deformable(self) -> bool:
        """No: a satellite holds the shape of the ground, within what its parameters are known to."""
        return False

    @cached_property
    def credible_px(self) -> float:
        """Six standard deviations of a position as the delivered model shows it."""
        _, ground = _places(self.model)
        by_parameters = self.computed(np.zeros(len(self.free)), ground).by_parameters
        return float(_CREDIBLE_SIGMAS * np.sqrt(((by_parameters * self.sigma) ** 2).sum(axis=2).max()))

    def computed(self, values: Array, lon_lat_h: Array) -> Computed:
        """Where the corrected model shows ground points (m, 3), with parameters (k,)."""
        image, by_ground, by_terms = self.errors.projected(self._terms(values), lon_lat_h)
        return Computed(image, by_ground, by_terms[:, :, self.free] * self.per_px)

    def corrected(self, values: Array) -> PushbroomModel:
        """The model with parameters of the given values (k,)."""
        return self.errors.corrected(self._terms(values))

    def shared_direction(self) -> Array:
        """Derivative (l, 2) of the locating parameters by an error that a pass has in common.

        The error is a displacement on the ground; of all combinations of the parameters that which
        explains it best, with their a priori sigmas.
        """
        middle = (np.array([self.shape]) - 1.0) / 2.0
        ground = self.model.locate(middle, np.array([np.mean(self.model.height_range_m)]))
        computed = self.computed(np.zeros(len(self.free)), ground)
        sigma = self.sigma[self.locating]
        displaced = computed.by_parameters[0][:, self.locating] * sigma
        u, _, vt = np.linalg.svd(
            np.linalg.solve(computed.by_ground[0, :, :2], displaced), full_matrices=False
        )
        return np.asarray(sigma[:, None] * (u @ vt).T)

    def _terms(self, values: Array) -> Array:
        terms = np.zeros(len(TERMS))
        terms[self.free] = values * self.per_px
        return terms


def rigorous_parameters(
    name: str,
    model: PushbroomModel,
    parameter_set: ParameterSet,
    *,
    sigma_m: float,
    motion: ImageCorrection | None = None,
) -> RigorousParameters:
    """The parameters of a rigorous model.

    Args:
        name: of the image.
        model: as delivered.
        parameter_set: which terms are free, with their a priori standard deviations.
        sigma_m: a priori standard deviation of the image on the ground, east and north each. The orbit
            has at most nine tenths of the variance: where a set states more, its orbit's sigmas shrink.
        motion: a correction of the image whose displacement is known as a motion of the sensor, where
            one explains it; None for none.

    Raises:
        InputError: the set has a term that is not one of `TERMS`.
    """
    unknown = set(parameter_set.sigmas) - set(TERMS)
    if unknown:
        raise InputError(
            f"{parameter_set.name}: {', '.join(sorted(unknown))} given as free, some of "
            f"{', '.join(TERMS)} expected"
        )
    moving = motion and moving_model(model, motion)
    errors = PushbroomErrors(moving or model)
    _, ground = _places(model)
    _, by_ground, by_terms = errors.projected(np.zeros(len(TERMS)), ground)
    displaced_px = np.linalg.norm(by_terms, axis=1).max(axis=0)
    middle = len(ground) // 2
    displaced_m = np.linalg.norm(np.linalg.solve(by_ground[middle, :, :2], by_terms[middle]), axis=0)
    sigma = np.array([parameter_set.sigmas.get(term, 0.0) for term in TERMS]) / _PER_SI
    for turn, orbit in (("pitch", ("along track",)), ("roll", ("across track", "radial"))):
        rows = [TERMS.index(term) for term in orbit]
        of_orbit_m = np.linalg.norm(sigma[rows] * displaced_m[rows])
        shrunk = min(1.0, np.sqrt(_ORBIT_SHARE) * sigma_m / max(of_orbit_m, 1e-12))
        sigma[rows] *= shrunk
        left_m = np.sqrt(sigma_m**2 - (shrunk * of_orbit_m) ** 2)
        sigma[TERMS.index(turn)] = left_m / displaced_m[TERMS.index(turn)]
    free = np.flatnonzero(sigma).astype(np.int64)
    per_px = 1.0 / displaced_px[free]
    displacement = motion.displacement if motion and moving else None
    return RigorousParameters(name, model, errors, free, sigma[free] / per_px, per_px, displacement)


def _places(model: PushbroomModel) -> tuple[Array, Array]:
    """Positions (n, 2) all over an image, and their ground (n, 3) at the middle of its heights."""
    side = np.linspace(0.0, 1.0, _NODES)
    image = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    image = image * (np.array(model.image_shape) - 1.0)
    height_m = np.full(len(image), np.mean(model.height_range_m))
    return image, model.locate(image, height_m)
