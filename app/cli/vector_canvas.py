"""`amers vectors canvas`: a raw scene to draw on."""

from pathlib import Path
from typing import Annotated

import typer

from amers.services.formats.images.canvas import write_canvas


def canvas(
    scene: Annotated[Path, typer.Argument(exists=True, help="Raw image: GeoTIFF, JPEG 2000 or NITF.")],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="Virtual raster to write, .vrt.")],
) -> None:
    """Write a view of a raw scene without georeferencing, for drawing on its pixels in QGIS."""
    write_canvas(scene, output)
