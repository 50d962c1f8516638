"""Drawing of the figures of a report: one style, one palette, and SVG markup for the page."""

import io
import re
from collections.abc import Callable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from services.reports.figure_data import Quicklook
from services.reports.report import RegistrationReport

INK, QUIET = "#0a0b0c", "#0a0b0d"
_PAGE_COLOURS = {INK: "var(--ink)", QUIET: "var(--quiet)"}
"""Colours that the style sheet of the page sets, so that figures follow its light or dark scheme."""

ACTIVE, DEACTIVATED, NOT_MATCHED = "#2f7ed8", "#e8862e", "#8b939c"
MATCHED = "#8db7ea"
ARROW = "#ffb000"
WIDTH_IN = 5.0
TEXT_PT = 10.0
MANY_POINTS = 1500
_UNCROWDED = 300
_LABEL_LENGTH = 34


def svg(draw: Callable[[RegistrationReport], Figure], report: RegistrationReport) -> str:
    """A figure as SVG markup without addresses or fixed size, in the colours and fonts of the page.

    Args:
        draw: one of `services.reports.figures.FIGURES`.
        report: gives what is drawn.
    """
    name = draw.__name__
    text = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure = draw(report)
        figure.patch.set_alpha(0.0)
        figure.savefig(
            text, format="svg", dpi=120, metadata=nothing, bbox_inches="tight", pad_inches=0.03
        )
    markup = text.getvalue()
    markup = markup[markup.index("<svg") :]
    label = (draw.__doc__ or name).splitlines()[0]
    markup = re.sub(
        r'<svg [^>]*viewBox="([^"]*)"[^>]*>',
        rf'<svg viewBox="\1" role="img" aria-label="{label}">',
        markup,
        count=1,
    )
    markup = re.sub(r' id="[A-Za-z][A-Za-z0-9.]*_\d+"', "", markup)
    for drawn, of_the_page in _PAGE_COLOURS.items():
        markup = markup.replace(drawn, of_the_page)
    return markup


def plain_axes(height_in: float) -> tuple[Figure, Axes]:
    """A figure with one plain pair of axes."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots()
    style(axes)
    return figure, axes


def style(axes: Axes) -> None:
    """Set thin lines, small text and no box."""
    axes.patch.set_alpha(0.0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.spines[["left", "bottom"]].set_linewidth(0.6)
    axes.tick_params(colors=QUIET, labelcolor=INK, labelsize=TEXT_PT - 1, width=0.6, length=3)
    axes.xaxis.label.set(color=INK, fontsize=TEXT_PT)
    axes.yaxis.label.set(color=INK, fontsize=TEXT_PT)


def image_height_in(shape: tuple[int, int]) -> float:
    """Height of a figure that shows an image of that shape over its whole width."""
    return float(np.clip(WIDTH_IN * shape[0] / shape[1], 1.5, 7.5)) + 0.5


def image_axes(report: RegistrationReport, darkness: float) -> tuple[Figure, Axes]:
    """Axes in pixels of the image, over its quicklook."""
    figure, axes = plain_axes(image_height_in(report.scene.shape))
    lines, samples = report.scene.shape
    axes.set_xlim(-0.5, samples - 0.5)
    axes.set_ylim(lines - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(True)
    axes.spines[:].set_color(QUIET)
    if report.figure_data.quicklook is not None:
        _show_quicklook(axes, report.figure_data.quicklook, darkness)
    return figure, axes


def _show_quicklook(axes: Axes, quicklook: Quicklook, darkness: float) -> None:
    """Draw the reduced scene, stretched and darkened so that marks on it stand out."""
    pixels = np.where(quicklook.pixels == 0.0, np.nan, quicklook.pixels)
    finite = pixels[np.isfinite(pixels)]
    if not len(finite):
        return
    low, high = np.percentile(finite, [1.0, 99.0])
    high = low + max(float(high - low), 1e-6) / darkness
    height, width = pixels.shape
    axes.imshow(
        np.ma.masked_invalid(pixels),
        cmap="gray",
        vmin=low,
        vmax=high,
        extent=(
            -0.5,
            width * quicklook.reduction - 0.5,
            height * quicklook.reduction - 0.5,
            -0.5,
        ),
        aspect="equal",
    )


def crowding(n: int) -> float:
    """Factor, at most 1, by which the size of n marks is reduced so that they do not overlap much."""
    return float(np.sqrt(min(1.0, _UNCROWDED / max(n, 1))))


def round_number(value: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten; 1 for values that are not positive."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda step: abs(step - value / power)))


def shortened(text: str) -> str:
    """Text that fits a label, with the signs escaped that matplotlib reads as formulas."""
    short = text if len(text) <= _LABEL_LENGTH else text[: _LABEL_LENGTH - 1] + "…"
    return short.replace("$", r"\$")
