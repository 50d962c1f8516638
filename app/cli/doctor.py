"""`amers doctor`: what of this installation works."""

from dataclasses import asdict

import typer

from amers.app.cli.exit_status import REFUSED
from amers.app.cli.output import AsJson, show
from amers.app.config import read_settings
from amers.app.usecases.doctor import examine


def doctor(as_json: AsJson = False) -> None:
    """Check this installation: versions, database, storage, map page, geoid grids, disk space."""
    found = list(examine(read_settings()))
    show([asdict(one) for one in found], as_json=as_json)
    if any(one.status == "failed" for one in found):
        raise typer.Exit(REFUSED)
