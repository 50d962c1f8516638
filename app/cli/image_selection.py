"""`amers production select`: choose the images of a block from a catalogue."""

from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, print_json
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.image_selection import CatalogueRequest, run_selection
from amers.services.production.image_selection import SelectionOptions
from amers.services.reports.document import report_document
from amers.services.reports.selection_pages import SELECTION_PAGE
from amers.services.reports.text import print_text

_DEFAULT = SelectionOptions()
_DEFAULT_LIMITS = ",".join(f"{limit:g}" for limit in _DEFAULT.cloud_limits_percent)


def select(
    catalogue: Annotated[
        str,
        typer.Argument(help="STAC catalogue: folder, file (.json, .ndjson) or address of a search API."),
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="Output folder for the selection.")],
    area: Annotated[
        Path | None,
        typer.Option(help="GeoJSON of the ground that the images must show; by default all footprints."),
    ] = None,
    since: Annotated[
        datetime | None,
        typer.Option(help="Leave out images before this day, UTC.", formats=["%Y-%m-%d"]),
    ] = None,
    min_views: Annotated[
        int, typer.Option(help="Number of clear views that every place needs.", min=1, max=100)
    ] = _DEFAULT.min_views,
    cloud_limits: Annotated[
        str,
        typer.Option(
            help="Limits of cloud cover in percent: the first limit is used everywhere, each "
            "further limit where views are missing."
        ),
    ] = _DEFAULT_LIMITS,
    max_snow: Annotated[
        float, typer.Option(help="Largest snow cover of an image, percent.", min=0.0, max=100.0)
    ] = _DEFAULT.max_snow_percent,
    cell_km: Annotated[
        float | None,
        typer.Option(
            help="Side of a ground cell, kilometres; by default a twelfth of the width of an image.",
            min=0.01,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Choose the fewest recent, clear and varied images that show all ground often enough.

    The command reads the catalogue only, no pixels. Where too few images are below the first cloud
    limit, it uses the next limit, and cloudier images count outside their cloud masks.
    """
    options = SelectionOptions(
        min_views=min_views,
        cloud_limits_percent=_limits(cloud_limits),
        max_snow_percent=max_snow,
        cell_m=None if cell_km is None else 1000.0 * cell_km,
    )
    first_day = None if since is None else since.replace(tzinfo=UTC)
    with shown_progress() as progress:
        report = run_selection(CatalogueRequest(catalogue, area, first_day), output, options, progress)
    if as_json:
        print_json(report_document(report))
        return
    print_text(SELECTION_PAGE, report)
    above = f"{100.0 * report.above_bound:.1f} %"
    typer.echo(
        f"{report.use.selected:,} images chosen, {above} above the lower bound of {report.bound:,}; "
        f"{report.mean_views:.1f} clear views on average, at most {report.largest_views}"
    )
    for problem in report.source.problems[:3]:
        typer.echo(f"left out: {problem}", err=True)
    if report.source.bad > 3:
        typer.echo(f"left out: {report.source.bad} items in all, see {output / 'report.html'}", err=True)
    typer.echo(f"{report.verdict}: {report.verdict_words}")
    typer.echo(str(output / "report.html"))


def _limits(text: str) -> tuple[float, ...]:
    """Cloud limits in percent, rising."""
    try:
        limits = tuple(float(part) for part in text.split(","))
    except ValueError:
        limits = ()
    is_rising = all(low < high for low, high in pairwise((0.0, *limits)))
    if not limits or not is_rising or not limits[-1] <= 100.0:
        raise InputError(
            f"--cloud-limits: {text!r:.80} found, rising numbers up to 100 such as 15,25,40 expected"
        )
    return limits
