"""`amers production run`: make a block from overlapping images, given or chosen from a catalogue."""

import os
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.control_options import ControlOptions
from amers.app.cli.options import FromCenti, Shown
from amers.app.cli.output import AsJson, Row, show_one
from amers.app.cli.production_rows import accuracy_row, control_row, effort_row, sampling_pair
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.ground_classes import GroundFiles
from amers.app.usecases.image_production import ProductionImages, WorkPlace, run_image_production
from amers.app.usecases.image_selection import CatalogueRequest, run_selection
from amers.app.usecases.model_choice import ModelChoice, stated_metres
from amers.app.usecases.new_block import BlockIdentity, refuse_existing
from amers.services.formats.addresses import file_place
from amers.services.production.image_production import Production, ProductionOptions
from amers.services.reports.block_adjustment import without_surface_words
from amers.services.reports.block_adjustment_pages import IMAGES_PAGE
from amers.services.reports.text import print_text
from amers.services.types import Progress, part_of

_SHARE_OF_SELECTION = 0.05


@dataclass(frozen=True)
class ImageOptions:
    """The images of a block: given, of a selection, or chosen from a catalogue.

    Attributes:
        images: image with its sensor model: a path, s3://BUCKET/KEY or https://…; repeat for every
            image.
        catalogue: STAC catalogue to choose images from, a path or an address; the selection is written
            into OUTPUT.selection.
        area: with --catalogue, GeoJSON of the ground that the images must show.
        since: with --catalogue, leave out images before this day.
        selection: output folder of `amers production select`.
        sigma_m: accuracy of the delivered sensor models, one sigma, metres; for one of --images write
            IMAGE=M, and repeat the option.
        ortho_sigma_m: accuracy of images that are ortho-images, one sigma, metres; by default --sigma-m.
    """

    images: tuple[str, ...] = ()
    catalogue: str | None = None
    area: Path | None = None
    since: Annotated[datetime | None, typer.Option(formats=["%Y-%m-%d"])] = None
    selection: Path | None = None
    sigma_m: Annotated[tuple[str, ...], typer.Option()] = ()
    ortho_sigma_m: FromCenti = None

    def check(self) -> None:
        """Refuse images of two places, of none, or that are missing.

        Raises:
            InputError: names what is wrong.
        """
        if bool(self.images) + (self.catalogue is not None) + (self.selection is not None) != 1:
            raise InputError(
                "exactly one of --images, --catalogue and --selection is expected: name images, a "
                "catalogue from which they are chosen, or the folder of a selection"
            )
        absent = [image for image in self.images if "://" not in image and not Path(image).exists()]
        if absent:
            raise InputError(
                f"--images: no file {', '.join(absent)}; expected paths, s3://BUCKET/KEY or https://…"
            )

    def selected(self, output: Path, progress: Progress) -> Path | None:
        """The folder of the selection: given, or written beside the output; None without any."""
        if self.catalogue is None:
            return self.selection
        folder = output.with_name(f"{output.name}.selection")
        first_day = None if self.since is None else self.since.replace(tzinfo=UTC)
        run_selection(CatalogueRequest(self.catalogue, self.area, first_day), folder, progress=progress)
        return folder


Points = Annotated[
    ProductionOptions,
    Shown(
        points=typer.Option(min=6),
        spacing_m=typer.Option(min=1.0),
        min_views=typer.Option(min=2),
        surface_pairs=typer.Option(min=0, max=100),
    ),
]


@dataclass(frozen=True)
class WorkOptions:
    """Where the work is done.

    Attributes:
        work: folder of intermediate results, from which an interrupted production continues. A folder
            that you name here is kept; the default, OUTPUT.work, is removed when the block is complete.
        jobs: number of processes on this machine.
        cluster: address of the scheduler of a Dask cluster: tcp://HOST:8786.
    """

    work: Annotated[Path | None, typer.Option(file_okay=False)] = None
    jobs: Annotated[int, typer.Option(min=1, max=1024, show_default="cores")] = os.cpu_count() or 1
    cluster: str | None = None


def run(
    given: Annotated[
        list[str] | None,
        typer.Argument(metavar="IMAGES", help="Images with their sensor models; the same as --images."),
    ] = None,
    *,
    images: ImageOptions,
    models: ModelChoice,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    identity: BlockIdentity,
    gsd_m: Annotated[
        str | None,
        typer.Option(
            help="Ground sampling of the chips: FINE,COARSE, metres; by default the ground sampling of "
            "the images."
        ),
    ] = None,
    points: Points,
    control: ControlOptions,
    neighbour: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Folder BLOCK.adjustment of a neighbouring block with some of the same images; "
            "the new block then agrees with it along their seam.",
        ),
    ] = None,
    ground: GroundFiles,
    place: WorkOptions,
    as_json: AsJson = False,
) -> None:
    """Make control points with chips from two or more overlapping images."""
    images = replace(images, images=(*images.images, *(given or ())))
    images.check()
    if gsd_m is not None:
        fine_m, coarse_m = sampling_pair(gsd_m)
        points = replace(points, fine_gsd_m=fine_m, coarse_gsd_m=coarse_m)
    control_files = control.files(neighbour)
    files = tuple(map(file_place, images.images))
    sigma_m, sigmas_m = stated_metres("--sigma-m", images.sigma_m, files)
    refuse_existing(output)
    with shown_progress() as progress:
        selection = images.selected(output, part_of(progress, 0.0, _SHARE_OF_SELECTION))
        production = run_image_production(
            ProductionImages(
                files,
                selection,
                sigma_m,
                images.ortho_sigma_m,
                sigmas_m,
                control_files,
                ground,
                models,
            ),
            output,
            identity.named_after(output),
            points,
            place=WorkPlace(place.work, ComputeOptions(place.jobs, place.cluster)),
            progress=part_of(progress, _SHARE_OF_SELECTION, 1.0 - _SHARE_OF_SELECTION),
        )
    if not as_json:
        print_text(IMAGES_PAGE, production.image_fits)
    show_one(_row(production, output, as_json=as_json), as_json=as_json)


def _row(production: Production, output: Path, *, as_json: bool) -> Row:
    """The figures of a production, by their names."""
    relative = production.relative_accuracy
    words = without_surface_words(production.without_surface, len(production.points)) or "none"
    return {
        "block": output,
        "report": output.with_name(f"{output.name}.adjustment") / "report.html",
        "points": len(production.points),
        "views": int(production.points.views.start[-1]),
        "chip_gsds_m": list(production.gsds_m),
        "points_without_surface": dict(production.without_surface) if as_json else words,
        "tie_points": relative.tie_points,
        "ray_residual_delivered_px": round(relative.before_px, 3),
        "ray_residual_adjusted_px": round(relative.after_px, 3),
        "ray_residual_points_px": round(relative.refined_px, 3),
        **control_row(production.control, production.adjustment),
        **effort_row(production.effort, as_json=as_json),
        **accuracy_row(production.points, as_json=as_json),
        "statements": production.statements,
    }
