"""What hold-outs show, in words: the same in every report."""

from amers.services.quality.cell_stability import CellStability
from amers.services.quality.stability import GroupMeans
from amers.services.reports.numbers import number

CELLS_EXPLANATION = (
    "When points are held out at random, their neighbours remain, and a common error of neighbours "
    "stays hidden. It appears when a whole cell is held out. A factor above about 1.5 means that points "
    "have common errors, so that more points add less accuracy than their number suggests. An error of "
    "all points, or over the whole image, appears in neither table. No verdict depends on this."
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
