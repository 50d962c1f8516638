"""Ground samplings of the chips of a block, from the options or from the images."""

from collections.abc import Sequence

from amers.services.errors import InputError
from amers.services.imagery.scene import Scene, scene_gsd_m

COARSE_FACTOR = 4.0
"""Coarse chips have this many times the sampling of the fine ones, by default."""


def chip_samplings_m(
    scenes: Sequence[Scene], fine_m: float | None, coarse_m: float | None
) -> tuple[float, float]:
    """Ground samplings of fine and of coarse chips, metres.

    Args:
        scenes: from which the chips are cut.
        fine_m: given; by default the sampling of the coarsest scene, rounded to two digits, so that no
            chip shows less detail than its sampling promises.
        coarse_m: given; by default four times the fine one.

    Raises:
        InputError: the fine sampling is not above zero, or not below the coarse one.
    """
    if fine_m is None:
        fine_m = float(f"{max(map(scene_gsd_m, scenes)):.2g}")
    if coarse_m is None:
        coarse_m = COARSE_FACTOR * fine_m
    if not 0.0 < fine_m < coarse_m:
        raise InputError(
            f"ground samplings of {fine_m:g} and {coarse_m:g} m given: expected a fine one above 0 and "
            "below the coarse one (--gsd-m FINE,COARSE)"
        )
    return fine_m, coarse_m
