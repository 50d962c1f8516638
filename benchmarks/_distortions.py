"""Distortions of scenes, drawn at random: the same for simulated and for real images."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.simulation.distortion import (
    Bend,
    Displacement,
    Distortion,
    Kink,
    MovedGround,
    Seam,
    Step,
    Turn,
    Waves,
)
from amers.services.types import Array

JITTER_PX, SHORTEST_PERIOD_PX, LONGEST_PERIOD = (0.2, 6.0), 100.0, 3.0
BOW_PX = (1.0, 8.0)
CUBIC_PX = (0.5, 8.0)
STEP_LINES = (1.0, 100.0)
MOVED_SHARE, MOVED_M = (0.05, 0.4), (2.0, 100.0)
TILT_DEG, AWAY = (3.0, 25.0), (0.2, 0.7)
CHIRP = (0.5, 2.0)
"""Growth of the frequency of a chirp over the image, as a share of its first one."""
SAMPLE_TERMS_PX = (0.3, 3.0)
SEAM_PX = (0.5, 8.0)
DETECTORS, PARTS = (4, 12), (2, 5)
BAND = 4.0
"""Longest over shortest period of a random oscillation."""
_RANDOM_WAVES = 60

JITTER = ("sines", "random")
BENT = ("bow", "smile", "bow and smile", "cubic")
TURNS: dict[str, Turn] = {"swapped": "swapped", "mirrored": "mirrored", "upside down": "upside down"}


@dataclass(frozen=True)
class Drawn:
    """What distorts a scene; what is 0 or "" does not.

    Attributes:
        kind: of the distortion.
        amplitude_px: of an oscillation the root mean square times the square root of two, both axes
            together; of a bend its displacement at the last pixel.
        period_px: shortest period of an oscillation, lines.
        steps, step_lines: number of steps, and lines lost or repeated at the largest.
        parts: of the image between seams, or with an attitude rate of their own.
        moved_share, moved_m: of the image, and how far.
        tilt_deg: between the view and that of which the model is.
        away: of the scene of which the model is, sides of the image.
    """

    kind: str = ""
    amplitude_px: float = 0.0
    period_px: float = 0.0
    steps: int = 0
    step_lines: float = 0.0
    parts: int = 0
    moved_share: float = 0.0
    moved_m: float = 0.0
    tilt_deg: float = 0.0
    away: float = 0.0

    @property
    def shortest_px(self) -> float:
        """The period that points must resolve to follow it; infinite for bends, 0 where none can be."""
        if self.kind in JITTER:
            return self.period_px
        return float("inf") if self.kind in BENT else 0.0


SEAMS = ("detectors", "alternating", "joined")

NOT_DISTORTED = Drawn()


def draw_jitter(rng: np.random.Generator, lines: int) -> Drawn:
    """Oscillations along the lines: one to three sines, or a random process."""
    kind = str(rng.choice(JITTER))
    longest_px = LONGEST_PERIOD * lines / (BAND if kind == "random" else 1.0)
    return Drawn(kind, _log_uniform(rng, *JITTER_PX), _log_uniform(rng, SHORTEST_PERIOD_PX, longest_px))


def draw_bow(rng: np.random.Generator, lines: int) -> Drawn:
    """A quadratic bow over lines, over samples or over both, or a cubic along the lines."""
    del lines
    kind = str(rng.choice(BENT, p=[0.35, 0.2, 0.15, 0.3]))
    return Drawn(kind, _log_uniform(rng, *(CUBIC_PX if kind == "cubic" else BOW_PX)))


def draw_steps(rng: np.random.Generator, lines: int) -> Drawn:
    """Up to three places where lines were lost or repeated."""
    del lines
    most = round(_log_uniform(rng, *STEP_LINES))
    return Drawn("steps", steps=int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1])), step_lines=most)


def draw_moved(rng: np.random.Generator, lines: int) -> Drawn:
    """A part of the ground that is elsewhere."""
    del lines
    share = float(rng.uniform(*MOVED_SHARE))
    return Drawn("moved", moved_share=share, moved_m=_log_uniform(rng, *MOVED_M))


def draw_wrong_model(rng: np.random.Generator, lines: int) -> Drawn:
    """The model of another view or scene, or an image stored in another order."""
    del lines
    kind = str(rng.choice(["another view", "another scene", *TURNS], p=[0.45, 0.15, 0.15, 0.15, 0.1]))
    tilt_deg = float(rng.uniform(*TILT_DEG)) if kind.startswith("another") else 0.0
    away = float(rng.uniform(*AWAY)) if kind == "another scene" else 0.0
    return Drawn(kind, tilt_deg=tilt_deg, away=away)


def draw_otherwise(rng: np.random.Generator, lines: int) -> Drawn:
    """What no correction expresses: a chirp, a kink, a mixture, and jitter of a saturated image."""
    kind = str(rng.choice(["chirp", "kink", "mixture", "saturated"]))
    if kind == "kink":
        return Drawn(kind, _log_uniform(rng, *BOW_PX))
    jitter = replace(draw_jitter(rng, lines), kind=kind)
    if kind == "chirp":
        return replace(jitter, period_px=(1.0 + CHIRP[1]) * jitter.period_px)
    if kind != "mixture":
        return jitter
    steps, moved = draw_steps(rng, lines), draw_moved(rng, lines)
    return replace(
        jitter,
        steps=int(rng.integers(0, 2)) * steps.steps,
        step_lines=steps.step_lines,
        moved_share=moved.moved_share,
        moved_m=moved.moved_m,
    )


def draw_parts(rng: np.random.Generator, lines: int) -> Drawn:
    """What no family of the tests was made for: detectors out of place, mosaics, uneven rates.

    Seams between a few detectors, or beside each other between detectors that alternate; a joint of two
    images; an attitude rate that changes several times.
    """
    del lines
    kind = str(rng.choice(["detectors", "alternating", "joined", "rates"]))
    parts = {
        "detectors": int(rng.integers(*PARTS)),
        "alternating": int(rng.integers(*DETECTORS)),
        "joined": 2,
        "rates": int(rng.integers(*PARTS)) + 1,
    }
    return Drawn(kind, _log_uniform(rng, *SEAM_PX), parts=parts[kind])


def distortion_of(
    drawn: Drawn, shape: tuple[int, int], gsd_m: float, rng: np.random.Generator
) -> Distortion:
    """The distortion of an image: what is drawn, at random places and in random directions.

    Args:
        drawn: kind and sizes.
        shape: lines and samples.
        gsd_m: of its pixels.
        rng: source of phases, places and directions.
    """
    return Distortion(
        shape,
        _smooth(drawn, shape, rng),
        _steps(drawn, shape, rng),
        _moved(drawn, shape, gsd_m, rng) if drawn.moved_share > 0.0 else None,
        TURNS.get(drawn.kind, ""),
        _seams(drawn, shape, rng) if drawn.kind in SEAMS else (),
    )


def _smooth(drawn: Drawn, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Displacement, ...]:
    if drawn.kind == "kink":
        line = float(rng.uniform(0.2, 0.8)) * shape[0]
        return (Kink(line, drawn.amplitude_px * _direction(rng) / (shape[0] - line)),)
    if drawn.kind in BENT:
        return _bends(drawn, shape, rng)
    if drawn.kind == "rates":
        return _rates(drawn, shape, rng)
    if drawn.period_px == 0.0:
        return ()
    waves = _waves(drawn, shape[0], rng)
    if drawn.kind != "mixture":
        return (waves,)
    bow_px = _log_uniform(rng, *SAMPLE_TERMS_PX) * _direction(rng)
    return waves, Bend(np.array([[0.0, 0.0], [0.0, 0.0], bow_px]), 1, shape[1])


def _waves(drawn: Drawn, lines: int, rng: np.random.Generator) -> Waves:
    """Oscillations whose mean square is that of one sine of the amplitude."""
    count = _RANDOM_WAVES if drawn.kind == "random" else int(rng.integers(1, 4))
    longest = BAND if drawn.kind == "random" else 2.0
    period_px = drawn.period_px * np.exp(rng.uniform(0.0, np.log(longest), count))
    period_px[0] = drawn.period_px
    size = np.abs(rng.normal(0.0, 1.0, (count, 2))) * np.abs(_direction(rng))
    size *= drawn.amplitude_px / np.sqrt((size**2).sum())
    chirp = 0.0
    if drawn.kind == "chirp":
        chirp = float(rng.uniform(*CHIRP)) / lines
    return Waves(size, period_px, rng.uniform(0.0, 2.0 * np.pi, (count, 2)), chirp)


def _bends(drawn: Drawn, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Displacement, ...]:
    degree = 3 if drawn.kind == "cubic" else 2
    axes = {"smile": (1,), "bow and smile": (0, 1)}.get(drawn.kind, (0,))
    bends = []
    for axis in axes:
        coefficient_px = np.zeros((degree + 1, 2))
        coefficient_px[degree] = drawn.amplitude_px * _direction(rng)
        bends.append(Bend(coefficient_px, axis, shape[axis]))
    return tuple(bends)


def _steps(drawn: Drawn, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Step, ...]:
    at = np.sort(rng.uniform(0.1, 0.9, drawn.steps)) * shape[0]
    lines = [drawn.step_lines * float(rng.uniform(0.2, 1.0)) for _ in range(drawn.steps)]
    lines[:1] = [drawn.step_lines][: drawn.steps]
    return tuple(
        Step(round(line), int(rng.choice([-1, 1])) * max(1, round(n)))
        for line, n in zip(at.tolist(), lines, strict=True)
    )


def _rates(drawn: Drawn, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Displacement, ...]:
    """Attitude rates that change between parts; each change displaces the last line by the amplitude."""
    lines = np.sort(rng.uniform(0.05, 0.95, drawn.parts - 1)) * shape[0]
    size_px = drawn.amplitude_px * rng.choice([-1.0, 1.0], len(lines))
    return tuple(
        Kink(line, size * _direction(rng) / (shape[0] - line))
        for line, size in zip(lines.tolist(), size_px.tolist(), strict=True)
    )


def _seams(drawn: Drawn, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Seam, ...]:
    """Seams between detectors, of which every other one may be out of place, or between two images."""
    if drawn.kind == "joined":
        line = round(float(rng.uniform(0.15, 0.85)) * shape[0])
        return (Seam(0, line, drawn.amplitude_px * _direction(rng)),)
    if drawn.kind == "alternating":
        between = np.arange(1, drawn.parts) / drawn.parts * shape[1]
        shift_px = drawn.amplitude_px * _direction(rng)
        return tuple(
            Seam(1, round(at), shift_px if k % 2 == 0 else -shift_px)
            for k, at in enumerate(between.tolist())
        )
    between = np.sort(rng.uniform(0.1, 0.9, drawn.parts - 1)) * shape[1]
    return tuple(Seam(1, round(at), drawn.amplitude_px * _direction(rng)) for at in between.tolist())


def _moved(drawn: Drawn, shape: tuple[int, int], gsd_m: float, rng: np.random.Generator) -> MovedGround:
    """An ellipse inside the image, that shows what lies nearer the middle."""
    stretch = float(rng.uniform(1.0, 1.8))
    area_px2 = drawn.moved_share * shape[0] * shape[1] / np.pi
    half_axes_px = np.sqrt(area_px2) * np.array([stretch, 1.0 / stretch]) ** 0.5
    middle = (np.array(shape) - 1.0) / 2.0
    centre = middle + rng.uniform(-0.6, 0.6, 2) * np.maximum(np.array(shape) / 2.0 - half_axes_px, 0.0)
    inwards = middle - centre
    towards = float(np.arctan2(inwards[1], inwards[0]) + rng.uniform(-0.5, 0.5) * np.pi)
    shift_px = drawn.moved_m / gsd_m * np.array([np.cos(towards), np.sin(towards)])
    return MovedGround(centre, half_axes_px, float(rng.uniform(0.0, np.pi)), shift_px)


def _direction(rng: np.random.Generator) -> Array:
    """A random unit vector (2,)."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
