"""What is done to each scene of a campaign: everything follows from its number and the seed."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks._distortions import (
    NOT_DISTORTED,
    Drawn,
    draw_bow,
    draw_jitter,
    draw_moved,
    draw_otherwise,
    draw_parts,
    draw_steps,
    draw_wrong_model,
)
from benchmarks._worlds import (
    FINE_GSD_M,
    NOMINAL,
    PLACES,
    Place,
    largest_incidence_deg,
    smallest_hill_m,
)

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


@dataclass(frozen=True)
class Trial:
    """What is done to one scene.

    Attributes:
        number: of the scene.
        place: its world.
        gsd_m: of the scene.
        incidence_deg, azimuth_deg: of the scene.
        day: of the year 2024.
        location_error_m, sigma_m: how far off the model is, and how far it is said to be at one sigma.
        drift_px: largest drift and skew at the edges of the image.
        conditions: haze, clouds, inversion, season, noise.
        vanished, moved: shares of the points.
        point_ce90_m: as declared.
        understated: how many times larger the errors of the points are.
        relief_m, patterned_share: of the world, for the tables.
        chip_ratio: ground sampling of the scene over that of the finest chips.

        frame_sigma_m, frame_up_m: of the offset of each block, a horizontal coordinate and the height.
        blocks: side by side in the scene, each with its own offset.
        correlated, correlation: share of the points' variance that neighbours have in common, and over
            which share of the scene's side.
        warped: distortion of the blocks, in strips of `_point_errors.STRIP_WARP_M`.
        bits, damaged, missing, patch_px, brightest: of the pixels; see `simulation.defects.Damage`.
        blur_px, smear_px: sigma of the blur along samples and along lines.
        seam_px, parts: largest displacement of the parts of the detectors, and their number.
        terrain_m: spacing of the terrain that the scene is taken of; 0 for that of the chips.
        distortion: what the sensor model of the scene does not describe.
    """

    number: int
    place: str
    gsd_m: float
    incidence_deg: float
    azimuth_deg: float
    day: int
    location_error_m: float
    sigma_m: float
    drift_px: float
    haze: float
    cloud_cover: float
    inverted: bool
    season: float
    noise: float
    vanished: float
    moved: float
    point_ce90_m: float
    understated: float
    relief_m: float
    patterned_share: float
    chip_ratio: float
    frame_sigma_m: float = 0.5
    frame_up_m: float = 0.0
    blocks: int = 1
    correlated: float = 0.0
    correlation: float = 0.0
    warped: float = 0.0
    bits: int = 12
    damaged: float = 0.0
    missing: float = 0.0
    patch_px: int = 1
    brightest: bool = False
    blur_px: float = 0.0
    smear_px: float = 0.0
    seam_px: float = 0.0
    parts: int = 1
    terrain_m: float = 0.0
    distortion: Drawn = NOT_DISTORTED


def draw_trial(seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number: a few factors over their whole range, the others mild."""
    rng = np.random.default_rng([seed, number])
    place = places[number % len(places)]

    def either(mild: tuple[float, float], hard: tuple[float, float]) -> float:
        return float(rng.uniform(*(hard if rng.uniform() < 0.2 else mild)))

    gsd_m = float(np.exp(rng.uniform(*np.log(place.gsd_m))))
    largest_m = min(2_000.0, 0.15 * gsd_m * place.lines)
    error_m = float(np.exp(rng.uniform(0.0, np.log(largest_m))))
    vanished = either((0.0, 0.1), (0.1, 0.5))
    return Trial(
        number=number,
        place=place.name,
        gsd_m=gsd_m,
        incidence_deg=float(rng.uniform(0.0, min(35.0, largest_incidence_deg(place)))),
        azimuth_deg=float(rng.uniform(0.0, 360.0)),
        day=int(rng.integers(60, 300)),
        location_error_m=error_m,
        sigma_m=error_m / float(rng.uniform(1.2, 2.6)),
        drift_px=either((0.0, 1.0), (1.0, 6.0)),
        haze=either((0.0, 0.2), (0.2, 0.85)),
        cloud_cover=either((0.0, 0.1), (0.1, 0.7)),
        inverted=bool(rng.uniform() < 0.1),
        season=either((0.0, 0.1), (0.1, 1.0)),
        noise=either((4.0, 15.0), (15.0, 120.0)),
        vanished=vanished,
        moved=either((0.0, 0.1), (0.0, 0.5 - vanished)),
        point_ce90_m=float(np.exp(rng.uniform(*np.log((0.5, 5.0))))),
        understated=either((1.0, 1.0), (1.0, 3.0)),
        relief_m=place.relief_m,
        patterned_share=place.patterned_share,
        chip_ratio=gsd_m / FINE_GSD_M,
    )


def nominal_trial(seed: int, number: int, place: Place = NOMINAL) -> Trial:
    """SRP's conditions: nothing is wrong but the location of the scene and what is declared."""
    mild = draw_trial(seed, number, (place,))
    return replace(
        mild,
        gsd_m=place.gsd_m[0],
        incidence_deg=min(mild.incidence_deg, 20.0),
        location_error_m=10.0,
        sigma_m=5.0,
        drift_px=1.0,
        haze=0.0,
        cloud_cover=0.0,
        inverted=False,
        season=0.0,
        noise=0.0,
        vanished=0.0,
        moved=0.0,
        point_ce90_m=3.0,
        understated=1.0,
        chip_ratio=place.gsd_m[0] / FINE_GSD_M,
    )


def damaged_trial(seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number on damaged pixels: few or many, single or in squares, or the brightest."""
    rng = np.random.default_rng([seed, number, 3])
    pattern = rng.choice(["single", "squares", "brightest"], p=[0.4, 0.4, 0.2])
    side_px = _log_uniform(rng, 3.0, 64.0)
    share = _log_uniform(rng, 1e-5, 0.05)
    return replace(
        draw_trial(seed, number, places),
        bits=int(rng.choice([8, 10, 11, 12, 16])),
        damaged=share,
        missing=float(rng.choice([0.0, 1.0, rng.uniform()])),
        patch_px=round(side_px) if pattern == "squares" else 1,
        brightest=bool(pattern == "brightest"),
    )


def intact_trial(seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The same scene as `damaged_trial` in the same bits, with all its pixels."""
    return replace(damaged_trial(seed, number, places), damaged=0.0)


def points_trial(seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number on points whose errors are not independent, as large as declared."""
    rng = np.random.default_rng([seed, number, 4])
    return replace(
        draw_trial(seed, number, places),
        understated=1.0,
        frame_sigma_m=_log_uniform(rng, 0.3, 3.0),
        frame_up_m=_log_uniform(rng, 0.5, 5.0),
        blocks=int(rng.choice([1, 2, 3], p=[0.4, 0.4, 0.2])),
        correlated=_perhaps(rng, 0.6, 0.3, 1.0),
        correlation=float(rng.uniform(0.05, 0.2)),
        warped=_perhaps(rng, 0.5, 0.3, 1.0),
    )


def sensor_trial(seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number with a blur, seams between detectors and another terrain."""
    rng = np.random.default_rng([seed, number, 5])
    trial = draw_trial(seed, number, places)
    place = places[number % len(places)]
    return replace(
        trial,
        blur_px=float(rng.uniform(0.3, 1.0)),
        smear_px=float(rng.uniform(0.3, 1.2)),
        seam_px=_perhaps(rng, 0.7, 0.1, 1.0),
        parts=int(rng.integers(2, 9)),
        terrain_m=_perhaps(rng, 0.7, 0.05, 0.25) * smallest_hill_m(place),
    )


def distorted_trial(family: str, seed: int, number: int, places: tuple[Place, ...] = PLACES) -> Trial:
    """The trial of a number in a family: the ordinary one without what else is hard, and distorted."""
    draw, key = DISTORTED[family]
    rng = np.random.default_rng([seed, number, key])
    drawn = draw(rng, places[number % len(places)].lines)
    trial = replace(mild_trial(seed, number, rng, places), distortion=drawn)
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


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _perhaps(rng: np.random.Generator, chance: float, low: float, high: float) -> float:
    """A uniform number with some chance, else 0."""
    value = float(rng.uniform(low, high))
    return value if rng.uniform() < chance else 0.0
