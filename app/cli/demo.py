"""`amers demo`: the whole work on a simulated world, with nothing to configure."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from app.cli.output import AsJson, Row, show, show_one
from app.cli.progress import shown_progress
from app.config import Settings
from app.errors import InputError
from app.usecases.demo import DemoOptions, DemoOutcome, run_demo
from services.quality.criteria import verdict_scope
from services.types import Array

MARK = ".amers-demo"


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder; emptied first.")] = Path(
        "demo-output"
    ),
    as_json: AsJson = False,
) -> None:
    """Run the whole work on a simulated world: images, block, store, registration, report."""
    folder = _empty_folder(output)
    with _private_store() as settings, shown_progress() as progress:
        outcome = run_demo(folder, settings, DemoOptions(), progress)
    if as_json:
        show_one(_record(outcome), as_json=True)
        return
    show(_rows(outcome), as_json=False)
    typer.echo(f"\nReport: {outcome.report.absolute()}")


def _empty_folder(folder: Path) -> Path:
    """Empty or create a folder; only the outputs of an earlier demonstration are deleted."""
    if folder.exists() and any(folder.iterdir()):
        if not (folder / MARK).is_file():
            raise InputError(
                f"--output: {folder} has files of something else than the demonstration; choose another"
            )
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARK).touch()
    return folder


@contextmanager
def _private_store() -> Iterator[Settings]:
    """Settings of a temporary store: simulated points must not mix with real ones."""
    folder = Path(tempfile.mkdtemp(prefix="amers-demo-"))
    # Started by root, the database server runs as another user, who has to enter the folder.
    folder.chmod(0o711)
    try:
        yield Settings(database_url=None, data_folder=folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _record(outcome: DemoOutcome) -> Row:
    qualification = outcome.registration.qualification
    counts = qualification.point_counts
    return {
        "points produced": outcome.counts.produced,
        "points ingested": outcome.counts.ingested,
        "points served in the footprint": outcome.counts.served,
        "points visible": counts.visible,
        "points matched": counts.matched,
        "points active": counts.active,
        "injected error at the centre, east, north (m)": _metres(outcome.injected_m),
        "the same in the block's frame (m)": _metres(outcome.to_recover_m),
        "recovered error (m)": _metres(outcome.recovered_m),
        "CE90 as delivered, on the Earth (m)": round(outcome.before_m.value, 2),
        "CE90 registered, in the block's frame (px)": round(outcome.in_frame_px.value, 3),
        "CE90 registered, on the Earth (m)": round(outcome.absolute_m.value, 2),
        "error of the block's frame, east, north, up (m)": _metres(outcome.frame_error_m),
        "verdict": qualification.verdict,
        "verdict speaks of the accuracy": verdict_scope(qualification.criteria),
        **qualification.accuracy.words,
        "report": str(outcome.report.absolute()),
    }


def _rows(outcome: DemoOutcome) -> list[Row]:
    record = {name: value for name, value in _record(outcome).items() if name != "report"}
    return [{"what": name, "figure": value} for name, value in record.items()]


def _metres(values: Array) -> str:
    return ", ".join(f"{value:+.2f}" for value in values)
