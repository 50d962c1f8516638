"""Sentences about the results of hold-outs, the same in every report."""

from amers.services.quality.cell_stability import CellStability
from amers.services.quality.stability import GroupMeans, Stability
from amers.services.reports.numbers import number, percent


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


def held_out_text(stability: Stability) -> str:
    """How adjustments with fewer points were drawn, and what they show, as sentences."""
    held_px, held_m = stability.held_out_px.xy, stability.held_out_m.xy
    return (
        f"{stability.draws} adjustments with {percent(stability.kept_share)} of the active points. "
        f"Residuals of the {stability.held_out_per_draw} points held out each time: mean "
        f"{number(held_px.mean)} px ({number(held_m.mean)} m), std {number(held_px.std)} px "
        f"({number(held_m.std)} m), n = {held_px.n}. {group_means_text(stability.group_means)} Shows "
        "stability, not absolute accuracy."
    )
