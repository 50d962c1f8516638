"""`amers base`: bases of control points for a region, from open archives of ortho-images."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.image_production import WorkOptions
from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, Row, as_size, show_one
from amers.app.cli.production_rows import accuracy_row, effort_row
from amers.app.cli.progress import shown_progress
from amers.app.cli.transaction import transaction
from amers.app.config import Settings, read_settings
from amers.app.errors import InputError
from amers.app.storage import Storage, open_storage
from amers.app.usecases import storage_identity
from amers.app.usecases.base.made import MadeBase, report_folder
from amers.app.usecases.base.making import make_base, plan
from amers.app.usecases.base.request import BaseOptions, BaseRequest
from amers.app.usecases.base.search import BasePlan, Candidates
from amers.app.usecases.base.updating import update_base
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.terrain_file import TerrainFile

Publish = Annotated[
    bool, typer.Option("--publish", help="Load the block into the store and publish it.")
]
Options = Annotated[
    BaseOptions,
    Shown(
        dates=typer.Option(min=2, max=50),
        spacing_m=typer.Option(min=1.0),
        min_share=typer.Option(min=0.0, max=1.0),
        max_cloud=typer.Option(min=0.0, max=100.0),
        min_clear=typer.Option(min=0.0, max=100.0),
        height_sigma_m=typer.Option(min=0.01),
        frame_sigma_up_m=typer.Option(min=0.01),
    ),
]


def make(
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    source: Annotated[
        str,
        typer.Option("--from", help="Archive: sentinel-2, landsat, or FILE.toml that describes one."),
    ],
    catalogue: Annotated[
        list[str],
        typer.Option(
            help="STAC catalogue: address of a search API, folder or file; repeat for several."
        ),
    ],
    area: Annotated[
        Path | None, typer.Option(help="Region as a GeoJSON file with polygons.", exists=True)
    ] = None,
    bbox: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Region as a bounding box W S E N in degrees."),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(help="Region as the ground of this image and its surroundings.", exists=True),
    ] = None,
    dem: Annotated[
        Path | None,
        typer.Option(
            help="Heights of the ground; by default the Copernicus DEM of the catalogues.", exists=True
        ),
    ] = None,
    vertical: Annotated[
        str | None, typer.Option(help="Vertical datum of --dem: ellipsoid, EGM96, EGM2008, EPSG:…")
    ] = None,
    geoid: Annotated[
        Path | None,
        typer.Option(help="Grid of the geoid, GTX or GeoTIFF; also its name among PROJ's grids."),
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Leave out images before this day, UTC: YYYY-MM-DD.")
    ] = None,
    options: Options,
    identity: BlockIdentity,
    place: WorkOptions,
    publish: Publish = False,
    only_plan: Annotated[
        bool, typer.Option("--plan", help="Only print dates, bytes and time; read no image.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make a base of control points for a region from an open archive of images."""
    if vertical is not None and dem is None:
        raise InputError(
            "--vertical: given without --dem, to which it belongs; add --dem FILE, or leave it out"
        )
    terrain = None if dem is None else TerrainFile(dem, vertical, geoid)
    request = BaseRequest(source, tuple(catalogue), area, bbox, scene, terrain, geoid, since)
    if only_plan:
        with shown_progress() as progress:
            planned, candidates = plan(request, options, progress)
        show_one(_plan_row(planned, candidates, place.jobs), as_json=as_json)
        return
    put = _publication(output) if publish else None
    with shown_progress() as progress:
        made = make_base(
            request,
            output,
            identity.named_after(output),
            options,
            place=WorkPlace(place.work, ComputeOptions(place.jobs, place.cluster)),
            put=put,
            progress=progress,
        )
    show_one(_made_row(output, made, publish, as_json=as_json), as_json=as_json)


def update(
    work: Annotated[Path, typer.Argument(help="Work folder of the base (--work).", exists=True)],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    catalogue: Annotated[
        list[str] | None,
        typer.Option(help="STAC catalogue in place of the catalogues of the base; repeat for several."),
    ] = None,
    new_dates: Annotated[
        int, typer.Option(help="Number of new clear dates that every place gets.", min=1, max=20)
    ] = 2,
    version: Annotated[
        str | None, typer.Option(help="Version of the block; by default the next number.")
    ] = None,
    compute: Annotated[WorkOptions, Shown(jobs=None, cluster=None)],
    publish: Publish = False,
    as_json: AsJson = False,
) -> None:
    """Make the next version of a base: add views of new dates, remove vanished points, fill gaps."""
    put = _publication(output) if publish else None
    with shown_progress() as progress:
        made = update_base(
            work,
            output,
            catalogues=tuple(catalogue or ()),
            new_dates=new_dates,
            version=version,
            compute=ComputeOptions(compute.jobs, compute.cluster),
            put=put,
            progress=progress,
        )
    show_one(_made_row(output, made, publish, as_json=as_json), as_json=as_json)


@dataclass(frozen=True)
class _Publication:
    """Loads a whole block into the store, publishes it, and moves it into its folder."""

    folder: Path
    settings: Settings
    storage: Storage

    def __call__(self, whole: Path) -> None:
        with transaction(self.settings) as connection:
            block = lifecycle.ingest_block(connection, self.storage, whole).block
            lifecycle.publish_block(connection, str(block.number))
            # Before the end of the transaction: a command that is interrupted here can be given again.
            whole.rename(self.folder)


def _publication(folder: Path) -> _Publication:
    """What publishes a block of this folder; the store is checked before the work."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings):
        storage_identity.announce(partial(transaction, settings), storage)
        storage.prove()
    return _Publication(folder, settings, storage)


def _plan_row(planned: BasePlan, candidates: Candidates, jobs: int) -> Row:
    images = [candidates.images[date.image] for date in planned.dates]
    pixels = sum(date.pixels for date in planned.dates)
    return {
        "area_km2": round(planned.area_km2, 1),
        "tiles": [tile.tile for tile in planned.tiles],
        "dates": sorted({image.date for image in images}),
        "images": [image.id for image in images],
        "points": planned.points,
        "bytes": planned.bytes,
        "size": as_size(planned.bytes),
        "bytes_per_km2": round(planned.bytes / planned.area_km2),
        "share_of_full_tiles": round(pixels / max(1, planned.full_pixels), 4),
        "minutes": round((planned.read_s + planned.cpu_s / jobs) / 60.0, 1),
        "items_left_out": len(candidates.problems),
    }


def _made_row(output: Path, made: MadeBase, published: bool, *, as_json: bool) -> Row:
    frames = made.placed.frames
    return {
        "block": output,
        **({"state": "published"} if published else {}),
        "report": report_folder(output) / "report.html",
        "points": len(made.points),
        "views": int(made.points.views.start[-1]),
        "points_per_km2": round(len(made.points) / made.area_km2, 2),
        "tiles": [tile.area.tile for tile in made.placed.tiles],
        "images": made.images,
        "dates": made.placed.dates,
        "orbits": frames.orbits,
        "date_errors_east_north_m": [
            [round(value, 2) for value in error] for error in frames.error_m.tolist()
        ],
        "dates_apart_m": round(frames.apart_m, 2),
        "orbits_apart_m": round(frames.orbits_apart_m, 2),
        "sigma_stated_m": round(frames.stated_m, 2),
        "sigma_m": round(frames.sigma_m, 2),
        "local_sigma_m": None if math.isnan(made.local_sigma_m) else round(made.local_sigma_m, 2),
        "bytes_read": made.bytes,
        "bytes_per_km2": round(made.bytes / made.area_km2),
        "share_of_full_tiles": round(made.pixels / max(1, made.full_pixels), 4),
        "cpu_s_per_point": round(made.cpu_s / len(made.points), 3),
        **effort_row(made.effort, as_json=as_json),
        **accuracy_row(made.points, as_json=as_json),
        "left_out": made.left_out,
        "attribution": made.attribution,
    }
