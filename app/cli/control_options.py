"""The options that state the control of a new block."""

from pathlib import Path
from typing import Annotated

import typer

from services.formats.gcp.text_formats import ECEF, LAT_LON_HEIGHT
from services.quality.check_points import MARKING_SIGMA_PX

Control = Annotated[
    list[Path] | None,
    typer.Option(
        help="What places the block: folder of an older block, or file of ground points marked in the "
        "images (CSV, ASP, OPF, GeoJSON, ODM, QGIS, ENVI, PCI); repeat for several."
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
    Path | None, typer.Option(help="Grid file of the control points' geoid, GTX or GeoTIFF.")
]
Crs = Annotated[
    str | None, typer.Option(help="Reference system of x and y of a CSV, such as EPSG:32633.")
]
Columns = Annotated[
    str | None, typer.Option(help="Columns of a CSV of other names: lon=COLUMN,lat=COLUMN,…")
]
Ortho = Annotated[
    list[Path] | None,
    typer.Option(help="Ortho-image that places the block east and north; repeat for several."),
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
    Path | None, typer.Option(help="GeoTIFF with heights of the ground that places the block in height.")
]
DemVertical = Annotated[
    str | None,
    typer.Option(help="Vertical datum of --control-dem: ellipsoid, EGM96, EGM2008, EPSG:…"),
]
DemGeoid = Annotated[
    Path | None, typer.Option(help="Grid file of the geoid of --control-dem, GTX or GeoTIFF.")
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
