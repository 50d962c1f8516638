"""The report of scenes registered together as tables for a terminal and as a page with figures."""

import io

import numpy as np
from markupsafe import Markup
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from amers.services.geodesy import metres_per_degree
from amers.services.reports.drawing import ACTIVE, DEACTIVATED, crowding
from amers.services.reports.html import page_template
from amers.services.reports.joint import BlockTable, JointReport, JointScene, block_tables
from amers.services.reports.maps import equal_panel
from amers.services.reports.numbers import ABSENT, number
from amers.services.reports.plot import Figure

_HEIGHT = 300.0
_WIDTH = 160


def format_joint_html(report: JointReport) -> str:
    """The report as a self-contained page for screen, phone and paper."""
    tone = report.verdict if report.verdict in ("good", "usable") else "failed"
    return page_template("joint.html").render(
        report=report,
        tone=tone,
        tables=block_tables(report),
        overview=Markup(overview(report).markup("Outlines of the scenes and control points")),
        misfits=Markup(misfit_figure(report).markup("Misfits of the control points")),
    )


def format_joint_tables(report: JointReport) -> str:
    """The report as plain text."""
    text = io.StringIO()
    Console(file=text, width=_WIDTH, no_color=True, force_terminal=False).print(joint_tables(report))
    return text.getvalue()


def joint_tables(report: JointReport) -> RenderableType:
    """All tables of the report, to print on a rich console."""
    reasons = (one.reason for one in report.left)
    words = "\n".join([report.verdict_words, *report.accuracy_lines, *reasons])
    tables = [_published(one) for one in block_tables(report)]
    rigorous = [part for scene in report.scenes if scene.rigorous for part in _rigorous(scene)]
    return Group(
        Text(f"Verdict: {report.heading}", style="bold"),
        Text(words),
        scene_table(report),
        *tables,
        *rigorous,
    )


def scene_table(report: JointReport) -> Table:
    """The scenes with their verdicts and accuracies."""
    table = Table(title="Scenes", title_justify="left")
    heads = (
        "Scene",
        "Verdict",
        "CE90 to points m",
        "CE90 on the Earth m",
        "Control",
        "Ties",
        "Residuals",
    )
    for k, head in enumerate(heads):
        table.add_column(head, justify="left" if k < 2 else "right", overflow="fold")
    for scene in report.scenes:
        counts = scene.point_counts
        table.add_row(
            escape(scene.name),
            scene.verdict,
            number(scene.relative_to_control_points.ce90_m),
            number(scene.on_the_earth.ce90_m),
            f"{counts.active} of {counts.matched}",
            f"{scene.active_tie_points} of {scene.tie_points}",
            number(scene.normalised_residual),
        )
    for one in report.left:
        table.add_row(escape(one.name), "left the block", *[ABSENT] * 5)
    return table


def _rigorous(scene: JointScene) -> tuple[RenderableType, ...]:
    """The parameters of a rigorous model, what its points do not determine, and the RPC fitted to it."""
    found = scene.rigorous
    if found is None:
        return ()
    table = Table(title=f"{escape(scene.name)}: {found.parameter_set}", title_justify="left")
    for k, head in enumerate(("Parameter", "Unit", "Found", "Sigma", "A priori", "Determined")):
        table.add_column(head, justify="left" if k < 2 else "right")
    for own in found.parameters:
        table.add_row(
            own.name,
            own.unit,
            *(number(value) for value in (own.value, own.sigma, own.a_priori_sigma)),
            "held" if own.is_held else f"{own.determined:.0%}",
        )
    words = [words for words in (found.held, found.attitude_words, found.rpc_words) if words]
    return table, Text("\n".join(words))


def _published(one: BlockTable) -> Table:
    table = Table(title=one.table.title, title_justify="left")
    for k, column in enumerate(("Scene", *one.table.columns)):
        table.add_column(column, justify="left" if k == 0 else "right")
    for name, values in one.rows:
        cells = [number(v, d) for v, d in zip(values, one.table.decimals, strict=True)]
        table.add_row(escape(name), *cells)
    return table


def overview(report: JointReport) -> Figure:
    """The outlines of the scenes and the control points that agree, kilometres."""
    figure = Figure(_HEIGHT)
    outlines = [one.scene.footprint_lon_lat for one in report.reports]
    middle = np.concatenate(outlines).mean(axis=0)
    km = np.array(metres_per_degree(float(middle[1]), 0.0)) / 1000.0

    def places(lon_lat: np.ndarray) -> np.ndarray:
        offset = lon_lat - middle
        offset[:, 0] = (offset[:, 0] + 180.0) % 360.0 - 180.0
        return np.asarray(offset * km)

    rings = [places(np.concatenate([outline, outline[:1]])) for outline in outlines]
    points = places(report.misfits[:, :2].copy())
    panel = equal_panel(figure, np.concatenate([*rings, points]))
    panel.x_axis("km east", count=8, grid=True)
    panel.y_axis("km north", grid=True)
    for scene, ring in zip(report.scenes, rings, strict=True):
        colour = DEACTIVATED if scene.verdict == "failed" else ACTIVE
        figure.area(panel.places(*ring.T), colour, 0.06)
        figure.line(panel.places(*ring.T), colour, 1.0)
    figure.discs(panel.places(*points.T), 3.2 * max(0.4, crowding(len(points))), ACTIVE)
    return figure


def misfit_figure(report: JointReport) -> Figure:
    """Known minus adjusted position of the active control points, metres."""
    figure = Figure(_HEIGHT)
    misfit_m = report.misfits[:, 2:4]
    misfit_m = misfit_m[np.isfinite(misfit_m).all(axis=1)]
    panel = equal_panel(figure, np.concatenate([misfit_m, [[-1.0, -1.0], [1.0, 1.0]]]))
    panel.x_axis("m east", count=8, grid=True)
    panel.y_axis("m north", grid=True)
    figure.discs(panel.places(*misfit_m.T), 4.0 * max(0.4, crowding(len(misfit_m))), ACTIVE)
    return figure
