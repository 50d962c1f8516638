"""The published sets of free terms of rigorous models, with the a priori sigma of each term."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from amers.services.errors import InputError

UNITS = ("μrad",) * 6 + ("m",) * 6 + ("ppm",) * 2
"""In which people state the terms of a rigorous model, in the order of `pushbroom_errors.TERMS`."""


@dataclass(frozen=True)
class ParameterSet:
    """Terms that are free, with their a priori standard deviations.

    Roll and pitch have none of their own: with the orbit they make up the accuracy on the ground that is
    stated of a scene.

    Attributes:
        name: of the system that published the set.
        sigmas: of the other terms, in `UNITS`.
    """

    name: str
    sigmas: Mapping[str, float]


SRP = ParameterSet(
    "SRP",
    {
        "yaw": 20.0,
        "roll drift": 2.0,
        "pitch drift": 2.0,
        "yaw drift": 20.0,
        "focal length": 20.0,
    },
)
"""Attitude biases and drifts on three axes and the focal length: 7 parameters.

Source of the set: Chandelier and others (2020), SRP. Sigmas: a satellite with star trackers whose images
of 30 km are off by about half a pixel of 1.5 m at the edge by each."""

TOUTIN = ParameterSet(
    "Toutin",
    {
        "yaw": 400.0,
        "roll drift": 10.0,
        "pitch drift": 10.0,
        "along track": 200.0,
        "across track": 200.0,
        "focal length": 100.0,
    },
)
"""The eight independent parameters of an image of Toutin and Carbonneau.

Two translations and a rotation to map coordinates (pitch, roll, yaw), scales along and across (pitch
drift, focal length), the effect of heights along and across (position), and the skew (roll drift).
Sigmas for SPOT 1 to 3: ephemerides of some hundred metres, a yaw known as well as roll and pitch are
where scenes lie within 350 m, and drifts that rates measured every 125 ms leave, below 10 m at the last
line. Of drifts that of the pitch matters (Westin, 1990)."""

SPOT_HRV = ParameterSet(
    "SPOT-HRV in a GIS",
    {
        "yaw": 400.0,
        "along track": 200.0,
        "across track": 200.0,
        "radial": 200.0,
        "anisotropy": 100.0,
    },
)
"""Position, constants of the attitude and anisotropy of the focal length: 7 parameters.

Sigmas as in `TOUTIN`."""

ParameterSetName = Literal["srp", "toutin", "spot-hrv"]
PARAMETER_SETS = {"srp": SRP, "toutin": TOUTIN, "spot-hrv": SPOT_HRV}
"""The published sets, by the names that options have for them."""


def with_every_term(parameter_set: ParameterSet) -> ParameterSet:
    """The set with the terms of all others free as well, with the largest sigma that any has."""
    sigmas: dict[str, float] = {}
    for one in PARAMETER_SETS.values():
        for term, sigma in one.sigmas.items():
            sigmas[term] = max(sigma, sigmas.get(term, 0.0))
    return ParameterSet(f"{parameter_set.name}, every term", sigmas | dict(parameter_set.sigmas))


def left_out_of(parameter_set: ParameterSet) -> tuple[str, ...]:
    """Terms of other sets that a set holds."""
    return tuple(
        term for term in with_every_term(parameter_set).sigmas if term not in parameter_set.sigmas
    )


def parameter_set_named(name: str) -> ParameterSet:
    """The set of this name among `PARAMETER_SETS`.

    Raises:
        InputError: there is none.
    """
    if name not in PARAMETER_SETS:
        raise InputError(
            f"rigorous: {name[:40]!r} found, one of {', '.join(PARAMETER_SETS)} expected: the set of "
            "free parameters of rigorous models"
        )
    return PARAMETER_SETS[name]
