"""The RPC of a refined model, exact or fitted, if an RPC is close enough."""

import math
from dataclasses import dataclass

from amers.services.errors import CoverageError
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, fold_into_rpc, folds_into_rpc
from amers.services.sensors.rpc import RpcModel
from amers.services.sensors.rpc_fit import fit_rpc

REFIT_LIMIT_PX = 0.01
"""Largest difference, anywhere in the image, of a refitted RPC from the corrected model."""

CARRIED_PX = 0.5
"""An RPC that misses an adjusted rigorous model by more is not written, unless that is less than what is
stated; below, its error is part of the stated accuracy. A limit that people set: half a pixel."""

LOUD_PX = 0.1
"""An RPC that differs by more than this from the refined model is delivered with a warning."""


@dataclass(frozen=True)
class RefinedRpc:
    """The RPC of a refined model.

    Attributes:
        model: the RPC, None when none is close enough.
        max_error_px: largest difference from the refined model in the image; 0 when the RPC is exact,
            infinite when none could be fitted.
    """

    model: RpcModel | None
    max_error_px: float


def refined_rpc(
    model: SensorModel, shape: tuple[int, int], height_range_m: tuple[float, float] | None = None
) -> RefinedRpc:
    """The RPC of a refined model over its image.

    A correction of each coordinate separately folds into a delivered RPC exactly. For a correction that
    mixes the coordinates, a new RPC is fitted and accepted within `REFIT_LIMIT_PX`. For a rigorous model
    and for a correction on a grid the closest RPC is delivered, whatever its error is: no RPC
    follows every attitude.

    Args:
        model: refined: a delivered model with its correction, or a rigorous model.
        shape: lines and samples of the image.
        height_range_m: lowest and highest ground that an RPC is fitted over; by default those of the
            model. Those of the ground in the image give a closer RPC: rigorous models of products hold
            for all ground on the Earth.
    """
    affine = isinstance(model, CorrectedModel) and model.correction.displacement is None
    if (
        isinstance(model, CorrectedModel)
        and isinstance(model.base, RpcModel)
        and folds_into_rpc(model.correction)
    ):
        return RefinedRpc(fold_into_rpc(model.base, model.correction), 0.0)
    try:
        fitted = fit_rpc(model, shape, height_range_m or model.height_range_m)
    except CoverageError:
        return RefinedRpc(None, math.inf)
    close = fitted.max_error_px < REFIT_LIMIT_PX or not affine
    return RefinedRpc(fitted.model if close else None, fitted.max_error_px)
