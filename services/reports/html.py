"""The report as one HTML file that needs no network."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from amers.services.reports.criteria_rows import criterion_rows, unmet_criteria
from amers.services.reports.figure_data import ChipComparison
from amers.services.reports.figures import FIGURES, figure_markup
from amers.services.reports.numbers import (
    ABSENT,
    criterion_limit,
    criterion_value,
    metres,
    number,
    percent,
    quantile,
)
from amers.services.reports.published import published_tables
from amers.services.reports.reasons import reason_label
from amers.services.reports.report import RegistrationReport
from amers.services.reports.stability_words import (
    CELLS_EXPLANATION,
    cells_left_out_text,
    group_means_text,
)
from amers.services.types import Array, ChipArray

COMPARED_PER_GROUP = 4


@dataclass(frozen=True)
class GalleryGroup:
    """Comparisons that are shown together.

    Attributes:
        title: of the group.
        comparisons: in order of falling score.
    """

    title: str
    comparisons: tuple[ChipComparison, ...]


def format_html(report: RegistrationReport) -> str:
    """The report as a self-contained page for screen, phone and paper."""
    return page_template("registration.html").render(
        report=report,
        unmet=unmet_criteria(report.criteria),
        criteria=criterion_rows(report.criteria),
        figures={draw.__name__: Markup(figure_markup(draw, report)) for draw in FIGURES},
        gallery=choose_comparisons(report.figure_data.gallery),
        published=published_tables(report),
        options=list(flat_options(report.run.options)),
        centre=centre_words(report.scene.footprint_lon_lat),
        cells_explanation=CELLS_EXPLANATION,
    )


@cache
def page_template(name: str) -> Template:
    """A compiled template of a page; it escapes all values and raises an error for unknown names."""
    environment = Environment(
        loader=PackageLoader("amers.services.reports", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number,
        angle=lambda value: ABSENT if value != value else f"{value:.1f}°",
        metres=metres,
        percent=percent,
        quantile=quantile,
        criterion_value=criterion_value,
        criterion_limit=criterion_limit,
        chip=chip_uri,
        reason_label=reason_label,
        group_means_text=group_means_text,
        cells_left_out_text=cells_left_out_text,
        time=lambda moment: f"{moment:%Y-%m-%d %H:%M} UTC" if moment else ABSENT,
    )
    return environment.get_template(name)


def choose_comparisons(gallery: tuple[ChipComparison, ...]) -> tuple[GalleryGroup, ...]:
    """The comparisons of the best, middle and worst scores of a gallery, none twice.

    Args:
        gallery: any order; comparisons without a score are the worst.
    """
    count = COMPARED_PER_GROUP
    ordered = sorted(gallery, key=lambda one: -np.nan_to_num(one.score, nan=-2.0))
    if len(ordered) <= 3 * count:
        return (GalleryGroup("All points, best score first", tuple(ordered)),) if ordered else ()
    middle = (len(ordered) - count) // 2
    return (
        GalleryGroup("Best scores", tuple(ordered[:count])),
        GalleryGroup("Middle scores", tuple(ordered[middle : middle + count])),
        GalleryGroup("Worst scores", tuple(ordered[-count:])),
    )


def chip_uri(chip: ChipArray) -> str:
    """A chip as an image inside the page, stretched from its 1st to its 99th percentile.

    Nodata is black and saturated pixels are white.
    """
    values = chip.astype(np.float32)
    valid = np.isfinite(values) & (values != 0.0)
    grey = np.where(np.isposinf(values), 255, 0).astype(np.uint8)
    if valid.any():
        low, high = np.percentile(values[valid], [1.0, 99.0])
        stretched = (values[valid] - low) / max(float(high - low), 1e-6) * 255.0
        grey[valid] = np.clip(stretched, 0.0, 255.0).astype(np.uint8)
    _, encoded = cv2.imencode(".png", grey)
    return "data:image/png;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def flat_options(options: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Options and the options inside them, with dotted names."""
    for field in fields(options) if is_dataclass(options) else ():
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from flat_options(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", str(value)


def centre_words(footprint: Array) -> str:
    """Latitude and longitude of the middle of the scene."""
    if not len(footprint):
        return ABSENT
    lon, lat = footprint.mean(axis=0)
    lon = (lon + 180.0) % 360.0 - 180.0
    return f"{abs(lat):.4f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.4f}° {'E' if lon >= 0 else 'W'}"
