"""Sentences that describe structures of residuals and their possible causes."""

import numpy as np

from amers.services.misfit.structure import Structure


def structure_words(structure: Structure, shape: tuple[int, int]) -> str:
    """A sentence on a structure of the residuals; the accuracy that is stated includes it.

    Args:
        structure: of any family but heights.
        shape: lines and samples of the image.
    """
    line_px, sample_px = (structure.size_px * np.sqrt(2.0)).tolist()
    size = f"{line_px:.2f} px in line and {sample_px:.2f} px in sample"
    if structure.shape == "step":
        where, cause = "line", "lines that were lost or repeated"
        if structure.family == "seams":
            where, cause = "sample", "a seam between detectors"
        return (
            f"the residuals have a step of {size} at {where} {structure.at:.0f}. Possible cause: {cause}"
        )
    if structure.family == "image":
        return (
            f"neighbouring points are displaced together by {size}. Possible cause: errors of the "
            "terrain, or relief that the model does not have"
        )
    return _along(structure, size, shape)


def _along(structure: Structure, size: str, shape: tuple[int, int]) -> str:
    """A sentence on a bend or an oscillation along lines or samples."""
    lines = structure.family == "lines"
    along, length = ("lines", shape[0]) if lines else ("samples", shape[1])
    if structure.shape != "period":
        cause = "a bow of the attitude" if lines else "a bent detector line"
        return f"a bend of {size} along the {along} remains in the residuals. Possible cause: {cause}"
    cause = "seams between detectors, or a distortion of the optics"
    if lines:
        cause = "a bow of the attitude" if structure.at > length else "attitude jitter"
    return (
        f"an oscillation of {size} along the {along}, with a period of {structure.at:.0f} {along}, "
        f"remains in the residuals. Possible cause: {cause}"
    )
