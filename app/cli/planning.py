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
        Path, typer.Argument(exists=True, help="JSON file of the plan: images, sites, sigmas.")
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="Output folder for the report.")],
    selection: Annotated[
        str | None,
        typer.Option(help="Folder of a selection, or catalogue; its images are added to the plan."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Predict the accuracy of a block, and find the place where one more known site helps most.

    The command reads no pixels. It computes the covariance that the adjustment will state from the
    positions and directions of the images, the sigmas of measures and models, and the accuracy of the
    known sites.
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
