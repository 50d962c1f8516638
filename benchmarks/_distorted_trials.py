"""Scenes of the campaign that are distorted, and otherwise mild."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks._distortions import (
    Drawn,
    draw_bow,
    draw_jitter,
    draw_moved,
    draw_otherwise,
    draw_parts,
    draw_steps,
    draw_wrong_model,
)
from benchmarks._trials import Trial, draw_trial
from benchmarks._worlds import PLACES, Place

Draw = Callable[[np.random.Generator, int], Drawn]
DISTORTED: dict[str, tuple[Draw, int]] = {
    "jitter": (draw_jitter, 7),
    "bow": (draw_bow, 8),
    "steps": (draw_steps, 9),
    "moved": (draw_moved, 10),
    "wrong_model": (draw_wrong_model, 11),
    "otherwise": (draw_otherwise, 12),
    "parts": (draw_parts, 13),
}
"""What draws the distortions of each family, and a number of its own that seeds it."""
_SATURATED = (0.02, 0.15)
_SATURATED_PX = 64


def distorted_trial(family: str, seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number in a family: the ordinary one without what else is hard, and distorted."""
    draw, key = DISTORTED[family]
    rng = np.random.default_rng([seed, number, key])
    drawn = draw(rng, places[number % len(places)].lines)
    trial = replace(
        mild_trial(seed, number, rng, places),
        distortion=drawn,
    )
    if drawn.kind != "saturated":
        return trial
    return replace(trial, damaged=float(rng.uniform(*_SATURATED)), patch_px=_SATURATED_PX)


def mild_trial(
    seed: int, number: int, rng: np.random.Generator, places: tuple[Place, ...] = PLACES
) -> Trial:
    """The ordinary trial of a number with each factor in its mild part.

    Ground sampling, location error, incidence and the accuracy of the points keep their whole range.
    """
    vanished, moved, haze, cloud_cover, season, drift = rng.uniform(0.0, 1.0, 6).tolist()
    return replace(
        draw_trial(seed, number, places),
        drift_px=drift,
        haze=0.2 * haze,
        cloud_cover=0.1 * cloud_cover,
        inverted=False,
        season=0.1 * season,
        noise=float(rng.uniform(4.0, 15.0)),
        vanished=0.1 * vanished,
        moved=0.1 * moved,
        understated=1.0,
    )
