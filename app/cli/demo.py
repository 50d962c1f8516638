"""`amers demo`: the whole work on a simulated world, with nothing to configure."""

import os
import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, Row, show, show_one
from amers.app.cli.progress import shown_progress
from amers.app.config import Settings
from amers.app.errors import InputError
from amers.app.usecases.demo import DemoOutcome, run_demo
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.criteria import verdict_scope
from amers.services.types import Array

MARK, STORE, ELSEWHERE = ".amers-demo", "store", "amers-demo-"
NEXT = """
Report: {report}

Next, before and after on the map:   amers serve --data {folder}/store
      the block in your own store:   amers block ingest {folder}/block --publish
      your own scenes on a base:     amers base make --help"""


def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Output folder; it is emptied first.")
    ] = Path("demo-output"),
    as_json: AsJson = False,
) -> None:
    """Run all steps on a simulated world: images, block, store, registration, report."""
    folder = _empty_folder(output)
    store = _make_store(folder)
    with shown_progress() as progress:
        outcome = run_demo(folder, Settings(database_url=None, data_folder=store), progress)
    if as_json:
        show_one(_document(outcome), as_json=True)
        return
    show(_rows(outcome), as_json=False)
    typer.echo(NEXT.format(report=outcome.report.absolute(), folder=output))


def _empty_folder(folder: Path) -> Path:
    """Empty or create a folder; only the outputs of an earlier demonstration are deleted."""
    if folder.exists() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            raise InputError(
                f"--output: {folder} contains files that `amers demo` did not write; name an empty or "
                "new folder"
            )
        # Only what a demonstration made there: the link may lead elsewhere by now.
        store = (folder / STORE).resolve()
        if store.parent == Path(tempfile.gettempdir()).resolve() and store.name.startswith(ELSEWHERE):
            shutil.rmtree(store, ignore_errors=True)
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).touch()
    return folder


def _make_store(folder: Path) -> Path:
    """The data folder of the demonstration, for it must not mix with real points.

    Started by root, the database server runs as another user, who has to enter the folder: where that
    user cannot enter the outputs, the store lies among temporary files, and a link leads to it.
    """
    store = folder.resolve() / STORE
    if os.getuid() != 0 or all(one.stat().st_mode & 0o001 for one in store.parents):
        store.mkdir(mode=0o711)
        return store
    elsewhere = Path(tempfile.mkdtemp(prefix=ELSEWHERE))
    elsewhere.chmod(0o711)
    store.symlink_to(elsewhere)
    return elsewhere


LABELS = {
    "points_produced": "points produced",
    "points_ingested": "points ingested",
    "points_served": "points served in the footprint",
    "points_visible": "points visible",
    "points_matched": "points matched",
    "points_active": "points active",
    "injected_error_east_north_m": "injected error at the centre, east, north (m)",
    "error_to_recover_east_north_m": "the same in the block's frame (m)",
    "recovered_error_east_north_m": "recovered error (m)",
    "ce90_delivered_on_the_earth_m": "CE90 as delivered, on the Earth (m)",
    "ce90_registered_in_frame_px": "CE90 registered, in the block's frame (px)",
    "ce90_registered_on_the_earth_m": "CE90 registered, on the Earth (m)",
    "frame_error_east_north_up_m": "error of the block's frame, east, north, up (m)",
    "verdict": "verdict",
    "verdict_scope": "verdict speaks of the accuracy",
}
"""The names of the figures in JSON, and for people."""


def _record(outcome: DemoOutcome) -> Row:
    qualification = outcome.registration.qualification
    counts = qualification.point_counts
    return {
        "points_produced": outcome.counts.produced,
        "points_ingested": outcome.counts.ingested,
        "points_served": outcome.counts.served,
        "points_visible": counts.visible,
        "points_matched": counts.matched,
        "points_active": counts.active,
        "injected_error_east_north_m": _rounded(outcome.injected_m),
        "error_to_recover_east_north_m": _rounded(outcome.to_recover_m),
        "recovered_error_east_north_m": _rounded(outcome.recovered_m),
        "ce90_delivered_on_the_earth_m": round(outcome.before_m.value, 2),
        "ce90_registered_in_frame_px": round(outcome.in_frame_px.value, 3),
        "ce90_registered_on_the_earth_m": round(outcome.absolute_m.value, 2),
        "frame_error_east_north_up_m": _rounded(outcome.frame_error_m),
        "verdict": qualification.verdict,
        "verdict_scope": verdict_scope(qualification.criteria),
    }


def _document(outcome: DemoOutcome) -> Row:
    accuracy = accuracy_document(outcome.registration.qualification.accuracy)
    return {**_record(outcome), **accuracy, "report": str(outcome.report.absolute())}


def _rows(outcome: DemoOutcome) -> list[Row]:
    figures = {LABELS[name]: _in_words(value) for name, value in _record(outcome).items()}
    figures |= outcome.registration.qualification.accuracy.words
    return [{"what": name, "figure": value} for name, value in figures.items()]


def _in_words(value: object) -> object:
    return ", ".join(f"{one:+.2f}" for one in value) if isinstance(value, list) else value


def _rounded(values_m: Array) -> list[float]:
    return [round(value, 2) for value in values_m.tolist()]
