"""The options that state the control of a block."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, TypedDict, Unpack

import typer

from amers.app.cli.point_statements import sigma_pair, stated_by_caller
from amers.app.errors import InputError
from amers.app.usecases.control_files import ControlFiles, HeightFile
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.gcp.text_formats import ECEF, LAT_LON_HEIGHT
from amers.services.quality.check_points import MARKING_SIGMA_PX

Control = Annotated[
    list[Path] | None,
    typer.Option(
        exists=True,
        help="What places the block: folder of an older block, or file of ground points marked in the "
        "images (CSV, ASP, OPF, GeoJSON, ODM, QGIS, ENVI, PCI); repeat for several.",
    ),
]
SigmaM = Annotated[
    str | None,
    typer.Option(
        help="Accuracy of control points whose file states none: HORIZONTAL,UP, one sigma, metres."
    ),
]
FrameSigmaM = Annotated[
    str | None,
    typer.Option(
        help="Error on the Earth that all control points share: HORIZONTAL,UP, one sigma, metres."
    ),
]
MarkSigmaPx = Annotated[
    float | None,
    typer.Option(
        help=f"Sigma of marks whose file states none, pixels; by default {MARKING_SIGMA_PX:g}.",
        min=0.001,
    ),
]
Vertical = Annotated[
    str | None,
    typer.Option(help="Vertical datum of control points: ellipsoid, EGM96, EGM2008, EPSG:…"),
]
Geoid = Annotated[
    Path | None,
    typer.Option(exists=True, help="Grid file of the control points' geoid, GTX or GeoTIFF."),
]
Crs = Annotated[
    str | None, typer.Option(help="Reference system of x and y of a CSV, such as EPSG:32633.")
]
Columns = Annotated[
    str | None, typer.Option(help="Columns of a CSV of other names: lon=COLUMN,lat=COLUMN,…")
]
Neighbour = Annotated[
    Path | None,
    typer.Option(
        exists=True,
        help="Folder BLOCK.adjustment of a block that was made from some of the same images: both "
        "agree along their seam.",
    ),
]
Ortho = Annotated[
    list[Path] | None,
    typer.Option(
        exists=True, help="Ortho-image that places the block east and north; repeat for several."
    ),
]
OrthoSigmaM = Annotated[
    float | None,
    typer.Option(
        help="Accuracy of --control-ortho on the Earth, one sigma a coordinate, metres; by default that "
        "of the product.",
        min=0.001,
    ),
]
Dem = Annotated[
    Path | None,
    typer.Option(
        exists=True, help="GeoTIFF with heights of the ground that places the block in height."
    ),
]
DemVertical = Annotated[
    str | None,
    typer.Option(help="Vertical datum of --control-dem: ellipsoid, EGM96, EGM2008, EPSG:…"),
]
DemGeoid = Annotated[
    Path | None,
    typer.Option(exists=True, help="Grid file of the geoid of --control-dem, GTX or GeoTIFF."),
]
DemSigmaM = Annotated[
    float | None,
    typer.Option(help="Sigma of single heights of --control-dem, metres.", min=0.001),
]
DemFrameSigmaM = Annotated[
    str | None,
    typer.Option(help="Error that all of --control-dem has: HORIZONTAL,UP, one sigma, metres."),
]
SigmaAxes = Annotated[
    str | None,
    typer.Option(help=f"Axes of the sigmas of an ASP file: {ECEF} or {LAT_LON_HEIGHT}."),
]


class GivenControl(TypedDict):
    """The values of the options, by the names of the types above."""

    control: list[Path] | None
    sigma_m: str | None
    frame_sigma_m: str | None
    mark_sigma_px: float | None
    vertical: str | None
    geoid: Path | None
    crs: str | None
    columns: str | None
    sigma_axes: str | None
    ortho: list[Path] | None
    ortho_sigma_m: float | None
    dem: Path | None
    dem_vertical: str | None
    dem_geoid: Path | None
    dem_sigma_m: float | None
    dem_frame_sigma_m: str | None


def control_files(**given: Unpack[GivenControl]) -> ControlFiles:
    """The control that the options of a command state.

    Raises:
        InputError: a value is wrong, or states something of a file that is not given.
    """
    dem = given["dem"]
    of_dem = {
        "--control-dem-vertical": given["dem_vertical"],
        "--control-dem-geoid": given["dem_geoid"],
        "--control-dem-sigma-m": given["dem_sigma_m"],
        "--control-dem-frame-sigma-m": given["dem_frame_sigma_m"],
    }
    _refuse_alone(of_dem, "--control-dem", dem)
    _refuse_alone({"--control-ortho-sigma-m": given["ortho_sigma_m"]}, "--control-ortho", given["ortho"])
    heights = None
    if dem is not None:
        terrain = TerrainFile(
            dem, given["dem_vertical"], given["dem_geoid"], geoid_option="--control-dem-geoid"
        )
        frame_sigma_m = sigma_pair(given["dem_frame_sigma_m"], "--control-dem-frame-sigma-m")
        heights = HeightFile(terrain, given["dem_sigma_m"], frame_sigma_m)
    stated = stated_by_caller(
        given["geoid"] or given["vertical"], given["crs"], given["columns"], given["sigma_axes"]
    )
    points = PointStatements(
        stated,
        sigma_pair(given["sigma_m"], "--control-sigma-m"),
        sigma_pair(given["frame_sigma_m"], "--control-frame-sigma-m"),
        given["mark_sigma_px"],
    )
    return ControlFiles(
        tuple(given["control"] or ()),
        points,
        orthos=tuple(given["ortho"] or ()),
        ortho_sigma_m=given["ortho_sigma_m"],
        heights=heights,
    )


def _refuse_alone(options: Mapping[str, object], of_option: str, given: object) -> None:
    """Refuse options that state something of a file which is not given."""
    alone = [name for name, value in options.items() if value is not None]
    if alone and not given:
        raise InputError(f"{', '.join(alone)}: of {of_option}, which is missing; add it")
