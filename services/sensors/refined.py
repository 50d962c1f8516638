"""What a correction leaves to deliver: the RPC that carries it, as long as one does."""

import math
from dataclasses import dataclass

from services.errors import CoverageError
from services.sensors.correction import CorrectedModel, fold_into_rpc
from services.sensors.rpc import RpcModel
from services.sensors.rpc_fit import fit_rpc

REFIT_LIMIT_PX = 0.01
"""An RPC that differs more from the corrected model, anywhere in the image, is not delivered."""


@dataclass(frozen=True)
class RefinedRpc:
    """An RPC for a corrected model.

    Attributes:
        model: None when no RPC comes close enough.
        max_error_px: largest difference from the corrected model in the image; 0 when the RPC carries
            the correction exactly, infinite when none could be fitted.
    """

    model: RpcModel | None
    max_error_px: float


def refined_rpc(
    model: CorrectedModel, shape: tuple[int, int], limit_px: float = REFIT_LIMIT_PX
) -> RefinedRpc:
    """The RPC of a corrected model over its image and the heights the delivered one is for.

    A correction of each coordinate by itself folds into a delivered RPC exactly. One that mixes them is
    fitted anew, as is the RPC of a model of another kind, and refused beyond the limit.

    Args:
        model: the delivered model with its correction.
        shape: lines and samples of the image.
        limit_px: largest difference that is delivered.
    """
    mixed = bool(model.correction.parameters[[0, 1], [2, 1]].any())
    if isinstance(model.base, RpcModel) and not mixed:
        return RefinedRpc(fold_into_rpc(model.base, model.correction), 0.0)
    try:
        fitted = fit_rpc(model, shape, model.height_range_m)
    except CoverageError:
        return RefinedRpc(None, math.inf)
    close = fitted.max_error_px < limit_px
    return RefinedRpc(fitted.model if close else None, fitted.max_error_px)
