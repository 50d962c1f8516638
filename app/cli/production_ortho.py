"""`amers production ortho`: a block from ortho-images and the heights of their ground."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.production_rows import accuracy_row, agreement_row, sampling_pair
from amers.app.cli.progress import shown_progress
from amers.app.cli.terrain_options import TerrainOptions
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.ortho_production import OrthoFiles, run_ortho_production
from amers.services.production.ortho_production import OrthoPointOptions

Files = Annotated[
    OrthoFiles,
    Shown(
        images=typer.Argument(exists=True),
        flat_m=typer.Option("--height-m"),
        height_sigma_m=typer.Option(min=0.01),
        frame_sigma_up_m=typer.Option(min=0.01),
        sigma_m=typer.Option(min=0.01),
        bands=None,
        mask=None,
    ),
]
Points = Annotated[
    OrthoPointOptions,
    Shown(points=typer.Option(min=6), spacing_m=typer.Option(min=1.0), min_views=typer.Option(min=1)),
]


def ortho(
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    ground: TerrainOptions,
    files: Files,
    identity: BlockIdentity,
    gsd_m: Annotated[
        str | None,
        typer.Option(
            help="Ground sampling of the chips: FINE,COARSE, metres; by default the ground "
            "sampling of the image."
        ),
    ] = None,
    points: Points,
    as_json: AsJson = False,
) -> None:
    """Make control points with chips from ortho-images of one place and the heights of its ground."""
    if gsd_m is not None:
        fine_m, coarse_m = sampling_pair(gsd_m)
        points = replace(points, fine_gsd_m=fine_m, coarse_gsd_m=coarse_m)
    files = replace(files, terrain=ground.terrain)
    identity = identity.named_after(output)
    with shown_progress() as progress:
        production = run_ortho_production(files, output, identity, points, progress)
    show_one(
        {
            "block": output,
            "points": len(production.points),
            "views": int(production.points.views.start[-1]),
            "chip_gsds_m": list(production.gsds_m),
            **agreement_row(production.shift_m, production.local_sigma_m),
            **accuracy_row(production.points, as_json=as_json),
            "statements": production.statements,
        },
        as_json=as_json,
    )
