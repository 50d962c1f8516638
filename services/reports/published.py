"""Published tables for scenes registered on SRP, with their columns and definitions.

Source: Space Reference Points on Africa (2021): tables 2 and 4 (equipment, here: point counts), 3 and 5
(residuals), 6 (displacement of corners and centre with 80 % of the points) and 7 (points held out).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from amers.services.reports.report import RegistrationReport

ABSENT = math.nan
GROUND_WORDS = ("Mean east", "Mean north", "Std east", "Std north", "Mean up", "Std up")
GROUND_COLUMNS = ("dx_amer", "dy_amer", "ectx_amer", "ecty_amer", "dZ_amer", "ectZ_amer")
CORNERS = ("First corner", "Second corner", "Third corner", "Fourth corner", "Centre")


@dataclass(frozen=True)
class PublishedTable:
    """A table of one row.

    Attributes:
        title: plain words for its content, with the unit.
        words: plain heads.
        columns: heads as published.
        values: NaN where a single scene gives none.
        decimals: of each value.
        note: the definitions, in plain words, and the limits of the figures.
    """

    title: str
    words: tuple[str, ...]
    columns: tuple[str, ...]
    values: tuple[float, ...]
    decimals: tuple[int, ...]
    note: str

    def heads(self, shown: Sequence[int] | None = None) -> list[str]:
        """Plain heads of all or of some columns, with those published below where they differ."""
        pairs = [(self.words[k], self.columns[k]) for k in shown or range(len(self.columns))]
        both = Markup("{}<small>{}</small>")
        return [word if word == column else both.format(word, column) for word, column in pairs]

    @property
    def known(self) -> tuple[int, ...]:
        """The columns that have a value."""
        return tuple(k for k, value in enumerate(self.values) if not math.isnan(value))


def published_tables(report: RegistrationReport) -> tuple[PublishedTable, ...]:
    """The five tables of one scene."""
    return (
        _point_counts(report),
        _image_residuals(report),
        _ground_residuals(report),
        _displacements(report),
        _held_out(report),
    )


def _point_counts(report: RegistrationReport) -> PublishedTable:
    counts = report.point_counts
    return PublishedTable(
        'Points (published as "Equipment")',
        ("Active of matched, %", "Active of visible, %", "Active", "Matched", "Visible"),
        ("Pct_app", "Pct_app-ini", "Actif_app", "Spatio_app", "Popini_app"),
        (
            100.0 * counts.active_of_matched,
            100.0 * counts.active_of_visible,
            counts.active,
            counts.matched,
            counts.visible,
        ),
        (1, 1, 0, 0, 0),
        "Popini: visible points, which the scene could show. Spatio: matched points. Actif: active "
        "points, which the final adjustment uses. Pct_app: Actif / Spatio. Pct_app-ini: Actif / Popini; "
        "Popini includes the points that were not tried.",
    )


def _image_residuals(report: RegistrationReport) -> PublishedTable:
    """Mean and spread of the image residuals in metres; lengths are of the vectors (x, y)."""
    x, y, gsd_m = report.image_residuals_px.x, report.image_residuals_px.y, report.scene.gsd_m
    return PublishedTable(
        "Image residuals, m",
        ("Mean x", "Mean y", "Mean xy", "Std x", "Std y", "Std xy"),
        ("dx_app", "dy_app", "dxy_app", "ectx_app", "ecty_app", "ectxy_app"),
        tuple(
            gsd_m * value
            for value in (x.mean, y.mean, math.hypot(x.mean, y.mean))
            + (x.std, y.std, math.hypot(x.std, y.std))
        ),
        (2,) * 6,
        "Means and standard deviations along samples (x) and lines (y), pixels times the ground "
        "sampling; xy is the length of the two.",
    )


def _ground_residuals(report: RegistrationReport) -> PublishedTable:
    east, north = report.ground_residuals_m.east, report.ground_residuals_m.north
    return PublishedTable(
        "Ground residuals, m",
        GROUND_WORDS,
        GROUND_COLUMNS,
        (east.mean, north.mean, east.std, north.std, ABSENT, ABSENT),
        (2,) * 6,
        "Image residuals converted to the ground at the height of each point, east and north. In the "
        "published tables the points move too, within a block of images. A single scene keeps them "
        "fixed and gives no figure for Z.",
    )


def _displacements(report: RegistrationReport) -> PublishedTable:
    places = report.stability.displacements
    moved = [value for place in places for value in (place.x_m, place.y_m)] or [ABSENT] * 10
    names = tuple(f"d{axis}{corner}" for corner in "0123c" for axis in "XY")
    return PublishedTable(
        f"Displacement with {100 * report.stability.kept_share:.0f} % of the points, m",
        (*(f"{place} {axis}" for place in CORNERS for axis in "XY"), "Incidence (°)"),
        (*names, "Incidence (°)"),
        (*moved, report.scene.acquisition.incidence_deg),
        (*(2,) * 10, 1),
        report.stability.note
        or "Corners clockwise from the first line and sample, then the centre, along samples (X) and "
        "lines (Y), in the first draw. The table shows stability, not absolute accuracy: an error that "
        "all points share moves nothing.",
    )


def _held_out(report: RegistrationReport) -> PublishedTable:
    x, y = report.stability.held_out_m.x, report.stability.held_out_m.y
    return PublishedTable(
        f"Points held out ({100 * (1 - report.stability.kept_share):.0f} %), m",
        ("Points", "Mean X", "Std X", "Mean Y", "Std Y", "Mean XY", "Std XY", "Incidence (°)"),
        ("POP", "dX_moy", "dX_ect", "dY_moy", "dY_ect", "dXY_moy", "dXY_ect", "Incidence (°)"),
        (report.stability.held_out_per_draw, x.mean, x.std, y.mean, y.std)
        + (math.hypot(x.mean, y.mean), math.hypot(x.std, y.std), report.scene.acquisition.incidence_deg),
        (0, *(2,) * 6, 1),
        f"POP points in each of {report.stability.draws} draws; the figures cover all draws. The points "
        "held out come from the same base as the points used, so the control is nearly independent.",
    )
