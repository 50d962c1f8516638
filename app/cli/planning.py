"""`amers production plan`: the accuracy of a block before any image exists."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, print_json
from amers.app.cli.progress import shown_progress
from amers.app.usecases.planning import run_plan
from amers.services.reports.document import report_document
from amers.services.reports.plan_pages import PLAN_PAGE
from amers.services.reports.text import print_text


def plan(
    configuration: Annotated[
        Path, typer.Argument(exists=True, help="The plan: images, sites, sigmas, JSON.")
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the report.")],
    selection: Annotated[
        str | None,
        typer.Option(help="Folder of a selection, or catalogue, whose images are planned too."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Predict the accuracy of a block, and find where one more known site helps most.

    No pixel is read: places and directions of the images, sigmas of measures and models, and the
    accuracy of known sites give the covariance that the adjustment will declare.
    """
    with shown_progress() as progress:
        report = run_plan(configuration, output, selection, progress)
    if as_json:
        print_json(report_document(report))
        return
    print_text(PLAN_PAGE, report)
    for line in report.words:
        typer.echo(line)
    typer.echo(str(output / "report.html"))
