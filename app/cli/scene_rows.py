"""What the registrations of one scene and of many refuse and print alike."""

import math
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import quote

import typer

from amers.app.cli.arguments import by_options
from amers.app.cli.exit_status import SUCCESS
from amers.app.cli.output import print_json, show, show_one, show_statements
from amers.app.cli.scene_registration import Outcome
from amers.app.errors import InputError
from amers.app.printable import printable
from amers.services.formats.images.scenes import scene_name
from amers.services.quality.accuracy_statement import ON_THE_EARTH, RELATIVE
from amers.services.reports.overview import OverviewRow, format_overview

OVERVIEW = "overview.html"
"""File of the page over the reports of several scenes."""
_TABLE = (
    "active",
    "held_percent",
    "shift_m",
    "residual_rms_px",
    "refined_model_error_px",
    "check_ce90_m",
    "seconds",
)
"""Figures of a scene in the table of many scenes."""
_LABELS = {
    "visible": "points visible",
    "matched": "points matched",
    "active": "points active",
    "held_percent": "image that points support (%)",
    "shift_px": "shift in line, sample (px)",
    "shift_m": "shift on the ground (m)",
    "residual_rms_px": "residual in the image, rms (px)",
    "refined_model_error_px": "error of the refined model, largest (px)",
    "check_ce90_m": "CE90 of the check points (m)",
    "seconds": "time (s)",
}
"""Figures of one scene for people, with their axes and units."""
_STATED = ("relative_to_control_points", "on_the_earth")
"""The two accuracies of an outcome."""


def refuse_shared_files(scenes: list[Path], files_of_one: list[str]) -> None:
    """Refuse files of one scene with several scenes, and scenes that would share an output folder."""
    if files_of_one and len(scenes) > 1:
        raise InputError(
            f"{', '.join(files_of_one)}: belongs to one scene, but {len(scenes)} scenes are given"
        )
    names = [scene_name(scene) for scene in scenes]
    if len(set(names)) < len(names):
        raise InputError(
            "several scenes of the same name would write into the same folder; register them separately"
        )


def show_failures(outcomes: list[Outcome], context: typer.Context) -> None:
    """Print why scenes failed; the reasons get the names of options in place of those of inputs."""
    for outcome in outcomes:
        outcome["reason"] = reason = by_options(outcome["reason"], context)
        if outcome["exit_status"] != SUCCESS:
            image = str(outcome["scene"])
            typer.echo(f"amers: {reason if image in reason else f'{image}: {reason}'}", err=True)


def show_outcome(outcome: Outcome, *, as_json: bool) -> None:
    """Print the outcome of one scene."""
    if as_json:
        print_json(outcome)
    else:
        show_statements(outcome.get("statements", []))
        _show_findings([outcome])
        others = _other_rows(outcome, tuple(outcome))
        labelled = {_LABELS.get(name, name): value for name, value in others.items()}
        show_one(_verdict_rows(outcome) | labelled, as_json=False)
        if "marks" in outcome:
            typer.echo()
            show([_mark_row(mark) for mark in outcome["marks"]["marks"]], as_json=False)
            typer.echo()
            for sentence in outcome["marks"]["words"]:
                typer.echo(printable(sentence))


def show_outcomes(outcomes: list[Outcome], *, as_json: bool) -> None:
    """Print the outcome of every scene, or a table of the figures that compare scenes."""
    if as_json:
        print_json(outcomes)
        return
    show_statements(chain(*(outcome.get("statements", []) for outcome in outcomes)))
    _show_findings(outcomes)
    rows = []
    for outcome in outcomes:
        row = _verdict_rows(outcome) | _other_rows(outcome, _TABLE)
        rows.append(row | {"reason": outcome["reason"] if outcome["exit_status"] else None})
    show(rows, as_json=False)


def _show_findings(outcomes: list[Outcome]) -> None:
    """Print on standard error what was found in pixels, and what no correction follows."""
    for outcome in outcomes:
        found = [*outcome.get("pixel_findings", []), *outcome.get("findings", [])]
        for words in dict.fromkeys(finding["words"] for finding in found):
            typer.echo(f"amers: {printable(str(outcome['scene']))}: {words}", err=True)


def write_overview(outcomes: list[Outcome], folder: Path) -> None:
    """Write a page over the reports of all scenes into their folder, if any has one."""
    if not any("output" in outcome for outcome in outcomes):
        return
    page = format_overview([_overview_row(outcome, folder) for outcome in outcomes])
    (folder / OVERVIEW).write_text(page, encoding="utf-8")


def _overview_row(outcome: Outcome, folder: Path) -> OverviewRow:
    stated = [(outcome.get(name) or {}).get("words", "") for name in _STATED]
    report = None if "output" not in outcome else Path(outcome["output"]) / "report.html"
    is_there = report is not None and report.is_file()
    return OverviewRow(
        scene=Path(outcome["scene"]).name,
        verdict=outcome["verdict"],
        relative=stated[0],
        on_the_earth=stated[1],
        points=f"{outcome['active']} of {outcome['visible']}" if "active" in outcome else "",
        shift_m=outcome.get("shift_m", math.nan),
        reason=str(outcome["reason"]) if outcome["exit_status"] else "",
        report=quote(report.relative_to(folder).as_posix()) if report and is_there else "",
    )


def _verdict_rows(outcome: Outcome) -> dict[str, Any]:
    """Scene, verdict and the accuracy it speaks of, and the two accuracies, for people."""
    scope = outcome.get("verdict_scope")
    verdict = f"{outcome['verdict']}, {scope}" if scope else outcome["verdict"]
    rows = {"scene": outcome["scene"], "verdict": verdict, RELATIVE: None, ON_THE_EARTH: None}
    stated = (outcome.get(name) for name in _STATED)
    return rows | {one["label"]: one["words"] for one in stated if one}


def _other_rows(outcome: Outcome, names: tuple[str, ...]) -> dict[str, Any]:
    """The other figures of an outcome, for people."""
    shown = {
        "scene",
        "verdict",
        "verdict_scope",
        "statements",
        "pixel_findings",
        "findings",
        "marks",
        "exit_status",
        *_STATED,
    }
    return {name: _signed(outcome.get(name)) for name in names if name not in shown}


def _mark_row(mark: dict[str, Any]) -> dict[str, Any]:
    """A mark in the table for people."""
    return {
        "mark": mark["name"],
        "line": f"{mark['line']:.1f}",
        "sample": f"{mark['sample']:.1f}",
        "residual px": _pair(mark["residual_px"]),
        "left out px": _pair(mark["left_out_px"]),
        "its sigma px": _pair(mark["left_out_sigma_px"]),
        "status": f"{mark['status']}{', ' if mark['note'] else ''}{mark['note']}",
    }


def _pair(values: list[float | None]) -> str:
    return ", ".join("-" if value is None else f"{value:.2f}" for value in values)


def _signed(value: Any) -> Any:
    """Lists of numbers with their signs, which are directions; other values as they are."""
    if isinstance(value, list):
        return ", ".join(f"{number:+.3f}" for number in value)
    return value
