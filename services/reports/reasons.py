"""Reasons why points are not active: codes of matching and adjustment, counted and explained."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from amers.services.types import Measures

Stage = Literal["not matched", "deactivated"]

NO_REASON = "no reason given"
REASON_LABELS = {
    "not_tried": "not tried: other points represent it",
    "no_chip": "no chip of this ground sampling",
    "nodata": "no data in the scene",
    "saturated": "saturated in the scene",
    "flat": "no contrast to correlate",
    "low_score": "correlation too low",
    "cloud": "under a cloud",
    "border_peak": "peak at the edge of the search",
    "ambiguous": "second peak as likely",
    "views_disagree": "views disagree",
    "deactivated": "residual beyond tolerance",
}
"""What the codes of matching and adjustment mean."""


@dataclass(frozen=True)
class ReasonCount:
    """Number of points that are not active for one reason.

    Attributes:
        stage: "not matched", or "deactivated" after a match.
        reason: code given by the matching or the adjustment.
        label: what the code means, for people.
        count: number of points.
    """

    stage: Stage
    reason: str
    label: str
    count: int


def reason_label(reason: str) -> str:
    """What a code means, for people; the code itself when it is unknown."""
    return REASON_LABELS.get(reason, reason)


def count_reasons(measures: Measures) -> tuple[ReasonCount, ...]:
    """Numbers of points by reason: first points that were not matched, the commonest reason first."""
    counts = []
    stages: tuple[tuple[Stage, np.ndarray], ...] = (
        ("not matched", ~measures.matched),
        ("deactivated", measures.matched & ~measures.active),
    )
    for stage, rows in stages:
        codes, numbers = np.unique(measures.reason[rows], return_counts=True)
        for k in np.argsort(-numbers, kind="stable"):
            code = str(codes[k]) or NO_REASON
            counts.append(ReasonCount(stage, code, reason_label(code), int(numbers[k])))
    return tuple(counts)
