"""`amers block frame`: a block on control that came later."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli import control_options
from amers.app.cli.output import AsJson, Row, show_one
from amers.app.cli.production_rows import accuracy_row
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.blocks.frame import PlacedBlock, place_block
from amers.app.usecases.control_files import ControlFiles


def frame(
    block: Annotated[Path, typer.Argument(exists=True, help="Folder of the block.")],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the moved block.")],
    images: Annotated[
        list[Path],
        typer.Option(
            "--images", exists=True, help="Image of the block, in which control is found; repeat."
        ),
    ],
    version: Annotated[
        str, typer.Option(help="Version of the moved block; by default the next whole number.")
    ] = "",
    control: control_options.Control = None,
    control_sigma_m: control_options.SigmaM = None,
    control_frame_sigma_m: control_options.FrameSigmaM = None,
    control_mark_sigma_px: control_options.MarkSigmaPx = None,
    control_vertical: control_options.Vertical = None,
    control_geoid: control_options.Geoid = None,
    control_crs: control_options.Crs = None,
    control_columns: control_options.Columns = None,
    control_sigma_axes: control_options.SigmaAxes = None,
    control_ortho: control_options.Ortho = None,
    control_ortho_sigma_m: control_options.OrthoSigmaM = None,
    control_dem: control_options.Dem = None,
    control_dem_vertical: control_options.DemVertical = None,
    control_dem_geoid: control_options.DemGeoid = None,
    control_dem_sigma_m: control_options.DemSigmaM = None,
    control_dem_frame_sigma_m: control_options.DemFrameSigmaM = None,
    check: Annotated[
        list[Path] | None,
        typer.Option(
            exists=True,
            help="Control that takes no part and tells how good the result is: blocks, or files of "
            "points with the accuracy that --control-sigma-m and the others state; repeat for several.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Move a block onto control that came later; its points and chips stay as they are.

    The frame on the Earth is estimated again, with its covariance. Nothing is stored: `amers block
    ingest` stages the new folder.
    """
    control_files = control_options.control_files(
        control=control,
        sigma_m=control_sigma_m,
        frame_sigma_m=control_frame_sigma_m,
        mark_sigma_px=control_mark_sigma_px,
        vertical=control_vertical,
        geoid=control_geoid,
        crs=control_crs,
        columns=control_columns,
        sigma_axes=control_sigma_axes,
        ortho=control_ortho,
        ortho_sigma_m=control_ortho_sigma_m,
        dem=control_dem,
        dem_vertical=control_dem_vertical,
        dem_geoid=control_dem_geoid,
        dem_sigma_m=control_dem_sigma_m,
        dem_frame_sigma_m=control_dem_frame_sigma_m,
    )
    if not (control or control_ortho or control_dem):
        raise InputError("no control given: add --control, --control-ortho or --control-dem")
    with shown_progress() as progress:
        placed = place_block(
            block,
            images,
            control_files,
            output,
            check=None if not check else ControlFiles(tuple(check), control_files.points),
            version=version,
            progress=progress,
        )
    show_one(
        {
            "block": output,
            "points": len(placed.points),
            **_placed_row(placed),
            **accuracy_row(placed.points, as_json=as_json),
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
