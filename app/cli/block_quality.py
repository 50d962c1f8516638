"""`amers block quality`: the quality of a block of the store, or of a folder, against references."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.exit_status import NO_RESULT
from amers.app.cli.options import FromMilli, Shown, refuse_alone
from amers.app.cli.output import AsJson, Row, print_json, show_one, show_statements
from amers.app.cli.progress import shown_progress
from amers.app.cli.terrain_options import TerrainOptions
from amers.app.cli.transaction import transaction
from amers.app.config import read_settings
from amers.app.db.engine import opened
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.quality import (
    HeightFiles,
    QualityReferences,
    RequiredQuality,
    SiteFile,
    assess_folder,
    write_quality,
)
from amers.app.usecases.blocks.stored_quality import assess_stored
from amers.app.usecases.registration.result_folder import older_result
from amers.services.formats.block.document_json import BLOCK_JSON
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.block import BlockQuality, Distribution, quality_document
from amers.services.reports.block_quality import BlockQualityReport
from amers.services.reports.block_quality_pages import QUALITY_PAGE
from amers.services.reports.document import report_document
from amers.services.reports.text import print_text

_Files = list[Path] | None
References = Annotated[
    QualityReferences,
    Shown(
        site_sigma_m=typer.Option(min=0.001),
        reach_m=typer.Option("--search-m", min=0.01),
        images=None,
        excluded=typer.Option("--exclude", exists=True),
    ),
]
Required = Annotated[
    RequiredQuality,
    Shown(
        points_per_km2=typer.Option(min=1e-6),
        min_views=typer.Option(min=1),
        ce90_m=typer.Option(min=0.001),
        le90_m=typer.Option(min=0.001),
    ),
]


@dataclass(frozen=True)
class HeightOptions(TerrainOptions):
    """Heights that those of a block are compared with.

    Attributes:
        dem: heights to compare with: files, folders, archives, .txt lists or STAC catalogues of tiles.
        vertical: vertical datum of --dem: ellipsoid, EGM96, EGM2008, EPSG:…
        dem_sigma_m: sigma of single heights of --dem, metres; by default the sigma of each cell of a
            surface, otherwise 0.1 of the grid spacing.
        dem_frame_sigma_m: sigma of the common error of all heights of --dem, metres.
        exclude_heights: ground where --dem must not be used: GeoJSON, or an image that is not 0 there;
            repeat for several.
        land_cover: image of land cover classes; errors of heights are also reported by class.
    """

    dem_sigma_m: FromMilli = None
    dem_frame_sigma_m: FromMilli = None
    exclude_heights: tuple[Path, ...] = ()
    land_cover: Path | None = None

    def files(self) -> HeightFiles | None:
        """The heights; None without --dem.

        Raises:
            InputError: an option belongs to --dem, which is not given.
        """
        refuse_alone("dem", self, *(one.name for one in fields(self) if one.name != "dem"))
        if self.terrain is None:
            return None
        return HeightFiles(
            self.terrain,
            self.dem_sigma_m,
            self.dem_frame_sigma_m,
            self.exclude_heights,
            self.land_cover,
        )


def quality(
    block: Annotated[
        str, typer.Argument(help="Block folder, or number, ID or ID@VERSION of a stored block.")
    ],
    *,
    site: Annotated[
        _Files,
        typer.Option(
            exists=True,
            help="Reference ortho-image that the production did not use; repeat for several.",
        ),
    ] = None,
    control_site: Annotated[
        _Files,
        typer.Option(
            exists=True,
            help="Reference ortho-image of a place that the production used as control; repeat "
            "for several.",
        ),
    ] = None,
    references: References,
    heights: HeightOptions,
    required: Required,
    min_share: Annotated[
        float,
        typer.Option(
            help="Percentage of the ground that must have the required density.", min=0.0, max=100.0
        ),
    ] = 100.0 * RequiredQuality.min_share,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Output folder for the report in JSON and HTML."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the quality of a block: density, and accuracy against ortho-images and heights.

    For a stored block without any option, the command prints the figures that were computed when the
    block was ingested. The exit code is 3 if the block misses its specification.
    """
    required = replace(required, min_share=min_share / 100.0)
    sites = (
        *map(SiteFile, site or ()),
        *(SiteFile(path, is_control=True) for path in control_site or ()),
    )
    references = replace(references, sites=sites, heights=heights.files())
    is_folder = (Path(block) / BLOCK_JSON).is_file()
    if output is not None:
        older_result(output)
    is_asked = output is not None or (references, required) != (QualityReferences(), RequiredQuality())
    if not (is_folder or is_asked):
        _show_kept(block, as_json=as_json)
        return
    with shown_progress() as progress:
        if is_folder:
            report = assess_folder(Path(block), references, required, progress)
        else:
            settings = read_settings()
            with opened(settings) as database:
                storage = storage_identity.opened(database, settings)
                report = assess_stored(database, storage, block, references, required, progress=progress)
    if output is not None:
        write_quality(report, output)
    _show_report(report, output, as_json=as_json)
    if report.verdict == "missed":
        raise typer.Exit(NO_RESULT)


def _show_report(report: BlockQualityReport, output: Path | None, *, as_json: bool) -> None:
    if as_json:
        print_json(report_document(report))
        return
    show_statements(report.statements)
    print_text(QUALITY_PAGE, report)
    typer.echo(f"{report.verdict}: {report.verdict_words}")
    if output is not None:
        typer.echo(str(output / "block_quality.html"))


def _show_kept(reference: str, *, as_json: bool) -> None:
    """Show the figures of a stored block that were computed when it was ingested."""
    with transaction() as connection:
        report = lifecycle.block_report(connection, lifecycle.find_shown_block(connection, reference))
    if as_json:
        accuracy = [vars(figure) for figure in report.accuracy]
        stated = accuracy_document(report.stated)
        print_json({**stated, **quality_document(report.quality), "accuracy": accuracy})
        return
    accuracy_lines = {
        f"{figure.kind} {figure.name}": f"{figure.value:g} ({figure.count} against {figure.against})"
        for figure in report.accuracy
    }
    show_one({**report.stated.words, **quality_row(report.quality), **accuracy_lines}, as_json=False)


def quality_row(quality: BlockQuality) -> Row:
    """The figures of a block from its own points, by their names."""
    return {
        "area": f"{quality.area_km2:,.1f} km2",
        "density": f"{quality.points_per_km2:.3f} points/km2",
        "cells with 1 / 2 km2": f"{100.0 * quality.share_reaching_half:.1f} %",
        "cells with 1 / 4 km2": f"{100.0 * quality.share_reaching_quarter:.1f} %",
        "images per point": _distribution(quality.images_per_point, ".1f"),
        "chips per point": _distribution(quality.views_per_point, ".1f"),
        "sigma horizontal, m": _distribution(quality.sigma_horizontal_m, ".2f"),
        "sigma up, m": _distribution(quality.sigma_up_m, ".2f"),
    }


def _distribution(values: Distribution, form: str) -> str:
    return (
        f"median {values.median:{form}}, mean {values.mean:{form}}, 90 % below {values.p90:{form}}, "
        f"from {values.minimum:{form}} to {values.maximum:{form}}"
    )
