"""What hold-outs show, in words: the same in every report."""

from amers.services.quality.cell_stability import CellStability
from amers.services.quality.stability import GroupMeans
from amers.services.reports.numbers import number

CELLS_EXPLANATION = (
    "Points held out at random leave their neighbours in, so that an error which neighbours share stays "
    "hidden; without a whole cell it shows. More than about 1.5 times means that points share errors, "
    "and that more of them promise less than their number. An error that all points share, or that "
    "reaches over the whole image, shows in neither table. No verdict depends on this."
)


def cells_left_out_text(stability: CellStability) -> str:
    """How many cells were left out, as sentences."""
    text = (
        f"{stability.left_out} adjustments, each without the active points of one of "
        f"{stability.cells} x {stability.cells} cells of their area."
    )
    if stability.failed:
        text += f" Without {stability.failed} more cells there was no solution."
    return text


def group_means_text(means: GroupMeans) -> str:
    """The mean residuals of points held out together, as a sentence."""
    return (
        f"Mean residuals of the points held out together: rms {number(means.rms_px)} px, "
        f"{number(means.over_independent, 1)} times what independent errors give and "
        f"{number(means.over_stated, 1)} times what the stated accuracy gives."
    )
