"""The order of an image correction, by cross-validation."""

from collections.abc import Sequence

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.misfit.affine_fit import FREE, AffineFit, Order
from amers.services.types import BoolArray


def choose_order(
    fit: AffineFit, usable: BoolArray, orders: Sequence[Order], min_gain: float, folds: int
) -> tuple[Order, tuple[tuple[Order, float], ...]]:
    """Simplest order that predicts held-out measures as well as any, and the score of each order.

    Args:
        fit: of the measures.
        usable: (n,) measures that may be used.
        orders: that are considered, the simplest first.
        min_gain: an order replaces a simpler one when it reduces the score by this fraction.
        folds: of the cross-validation.
    """
    # All orders are compared on the same measures: those that fit the order with most parameters.
    fullest = fit.robust_solution(usable, FREE[orders[-1]])
    scale = fit.raw_scale(fullest, usable)
    judges = usable & (fit.magnitude(fullest) <= MAX_ERROR_SIGMAS * scale)
    validation = tuple((order, _validation_px(fit, usable, judges, order, folds)) for order in orders)
    best, best_px = validation[0]
    for order, value_px in validation[1:]:
        if value_px < best_px * (1.0 - min_gain):
            best, best_px = order, value_px
    return best, validation


def _validation_px(
    fit: AffineFit, usable: BoolArray, judges: BoolArray, order: Order, folds: int
) -> float:
    """Distance (rms, pixels) of the judging measures from the prediction of a fit without them."""
    rows = np.flatnonzero(usable)
    folds = min(folds, len(rows))
    # Neighbours in the image go into different folds.
    rank = np.empty(len(rows), dtype=np.int64)
    rank[np.lexsort((fit.t[rows, 1], fit.t[rows, 0]))] = np.arange(len(rows))
    held_out = np.empty((len(rows), 2))
    for fold in range(folds):
        out = rank % folds == fold
        active = usable.copy()
        active[rows[out]] = False
        parameters = fit.robust_solution(active, FREE[order])
        held_out[out] = fit.residual(parameters)[rows[out]]
    return float(np.sqrt((held_out[judges[rows]] ** 2).sum(axis=1).mean()))
