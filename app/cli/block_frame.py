"""`amers block frame`: a block on control that came later."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.control_options import ControlOptions
from amers.app.cli.output import AsJson, Row, show_one
from amers.app.cli.production_rows import accuracy_row
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.blocks.frame import PlacedBlock, place_block
from amers.app.usecases.control_files import ControlFiles
from amers.app.usecases.model_choice import ModelChoice


def frame(
    block: Annotated[Path, typer.Argument(exists=True, help="Folder of the block.")],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the moved block.")],
    images: Annotated[
        list[Path],
        typer.Option(
            "--images",
            exists=True,
            help="Image of the block in which control is searched; repeat for several.",
        ),
    ],
    models: ModelChoice,
    version: Annotated[
        str, typer.Option(help="Version of the moved block; by default the next whole number.")
    ] = "",
    options: ControlOptions,
    check: Annotated[
        list[Path] | None,
        typer.Option(
            exists=True,
            help="Check that takes no part in the adjustment and measures the result: block "
            "folders, or files of points with the accuracy that --control-sigma-m and the other "
            "control options state; repeat for several.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Move a block onto control that became available later; its points and chips stay unchanged.

    The command estimates the position of the block on the Earth again, with its covariance. It stores
    nothing: load the new folder with `amers block ingest`.
    """
    control = options.files()
    if not (control.paths or control.orthos or control.heights):
        raise InputError("no control given: add --control, --control-ortho or --control-dem")
    with shown_progress() as progress:
        placed = place_block(
            block,
            images,
            control,
            output,
            check=None if not check else ControlFiles(tuple(check), control.points),
            version=version,
            models=models,
            progress=progress,
        )
    show_one(
        {
            "block": output,
            "points": len(placed.points),
            **_placed_row(placed),
            **accuracy_row(placed.points, as_json=as_json),
            "statements": placed.statements,
        },
        as_json=as_json,
    )


def _placed_row(placed: PlacedBlock) -> Row:
    fit = placed.fit
    row: dict[str, object] = {
        "control_points": len(placed.control),
        "control_points_used": int(fit.active.sum()),
        "control_points_left_out": [
            name for name, used in zip(placed.control, fit.active.tolist(), strict=True) if not used
        ],
        "moved_east_north_up_m": [round(value, 2) for value in fit.translation_m.tolist()],
        "frame_sigma_before_m": _metres(placed.before.sigma_m, placed.before.sigma_up_m),
        "frame_sigma_m": _metres(fit.frame.sigma_m, fit.frame.sigma_up_m),
    }
    if placed.check is not None and placed.normalised is not None:
        row["check_points"] = placed.check.n
        row["check_ce90_m"] = round(placed.check.ce90_m.value, 2)
        if placed.check.le90_m is not None:
            row["check_le90_m"] = round(placed.check.le90_m.value, 2)
        row["check_normalised"] = round(placed.normalised.mean_square, 2)
    return row


def _metres(horizontal: float, up: float) -> list[float | None]:
    """Horizontal and up, rounded; None where unknown."""
    return [None if value != value else round(value, 3) for value in (horizontal, up)]
