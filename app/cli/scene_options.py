"""Options that the commands of scenes share."""

from pathlib import Path
from typing import Annotated

import typer

Scenes = Annotated[
    list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF, or folders of such images.")
]
Blocks = Annotated[
    list[Path] | None,
    typer.Option(help="Use the points of this block folder instead of the store; repeat for several."),
]
SigmaM = Annotated[
    float | None, typer.Option(help="Accuracy of the models, one sigma, metres.", min=0.01)
]
Bands = Annotated[
    str | None, typer.Option(help="Bands to use: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.")
]
CheckPoints = Annotated[
    Path | None,
    typer.Option(help="Points held out: ASP, QGIS, ENVI, ODM, PCI, GeoJSON or OPF."),
]
CheckHeights = Annotated[
    str | None,
    typer.Option(help="Vertical datum of the check points, if not in the file: ellipsoid, EPSG:…"),
]
MaxCe90OnEarthM = Annotated[
    float | None,
    typer.Option(help="Largest CE90 on the Earth, metres: with the frame of the points.", min=0.001),
]
CopyImage = Annotated[
    bool, typer.Option("--copy-image", help="Copy GeoTIFFs with the refined model in their tags.")
]
Output = Annotated[
    Path, typer.Option("-o", "--output", help="Folder; each of several scenes gets one inside it.")
]
Vertical = Annotated[
    str | None,
    typer.Option(help="Vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…"),
]
GeoidGrid = Annotated[Path | None, typer.Option(help="Grid file of the geoid, GTX or GeoTIFF.")]
