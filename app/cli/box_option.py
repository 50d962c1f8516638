"""The option `--bbox`: a box on the map."""

from typing import Annotated

import typer

from amers.app.db.features.bbox import Box
from amers.app.errors import InputError, InvalidParameter
from amers.app.usecases.features.query import parse_bbox

EXPECTED = "give W,S,E,N in degrees, such as 5.39,43.59,5.41,43.61"
HALF_THE_EARTH = 180.0

BoxText = Annotated[
    str,
    typer.Option(
        "--bbox",
        help="Bounding box W,S,E,N in degrees; a box with W greater than E crosses the antimeridian.",
    ),
]


def box_of(text: str) -> Box:
    """The box of an option.

    Raises:
        InputError: it cannot be used: the numbers are out of range or in another order, or it is empty.
    """
    try:
        box = parse_bbox(text)
    except InvalidParameter as error:
        raise InputError(f"--{error}; {EXPECTED}") from None
    if box.west == box.east or box.south == box.north:
        raise InputError(f"--bbox: {text!r:.100} found, a box without area; {EXPECTED}")
    if box.west - box.east > 0.0 and 360.0 - (box.west - box.east) > HALF_THE_EARTH:
        raise InputError(
            f"--bbox: west {box.west:g} is east of east {box.east:g}, a box around the other "
            f"{360.0 - (box.west - box.east):g} degrees of the Earth; {EXPECTED}, or ask for such a box "
            "in two halves"
        )
    return box
