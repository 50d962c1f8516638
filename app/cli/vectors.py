"""`amers vectors correct` and `project`: vectors digitised on raw scenes, onto the map and back."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.errors import InputError
from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.terrain_file import TerrainFile
from amers.app.usecases.vector_files import CorrectionOptions, ProjectionOptions, VectorFile
from amers.app.usecases.vectors import correct_file, project_file
from amers.services.formats.vector.pixel_coordinates import PIXEL_ORIGINS, PixelOrigin

Vectors = Annotated[
    Path, typer.Argument(exists=True, help="GeoPackage, GeoJSON, shapefile or FlatGeobuf.")
]
SceneImage = Annotated[Path, typer.Option(exists=True, help="Raw image: GeoTIFF, JPEG 2000 or NITF.")]
Dem = Annotated[Path, typer.Option(exists=True, help="GeoTIFF with the heights of the ground.")]
Output = Annotated[Path, typer.Option("-o", "--output", help="File to write; its suffix is the format.")]
Layer = Annotated[str | None, typer.Option(help="Layer of the file; by default its only one.")]
Registration = Annotated[
    Path | None,
    typer.Option(exists=True, help="Folder of the scene's registration (`amers scene register -o`)."),
]
Model = Annotated[
    Path | None,
    typer.Option(exists=True, help="File of the delivered model; by default found by its name."),
]
Vertical = Annotated[
    str | None, typer.Option(help="Vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…")
]
GeoidGrid = Annotated[
    Path | None, typer.Option(exists=True, help="Grid file of the geoid, GTX or GeoTIFF.")
]
FillPx = Annotated[
    int, typer.Option(help="Fill voids of the terrain from this many nodes away.", min=0, max=50)
]
Pixels = Annotated[
    str,
    typer.Option(
        help="Pixel coordinates: qgis (x column, y minus row, from the corner), corner or centre of the "
        "first pixel (y down)."
    ),
]
TolerancePx = Annotated[
    float, typer.Option(help="Add vertices where an edge bends by more, pixels.", min=0.001)
]
SkipMissed = Annotated[
    bool, typer.Option("--skip-missed", help="Leave out features that meet no ground.")
]
VertexFile = Annotated[
    Path | None, typer.Option(help="Also write every vertex as a point, with its accuracy.")
]


def correct(
    vectors: Vectors,
    *,
    scene: SceneImage,
    dem: Dem,
    output: Output,
    registration: Registration = None,
    model: Model = None,
    sigma_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of a model that is not registered, one sigma, metres.", min=0.01),
    ] = None,
    to: Annotated[
        str | None, typer.Option(help="Reference system of the map; by default the UTM zone.")
    ] = None,
    vertical: Vertical = None,
    geoid: GeoidGrid = None,
    fill_px: FillPx = 0,
    dem_sigma_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of the heights, one sigma; by default 0.1 postings.", min=0.0),
    ] = None,
    layer: Layer = None,
    pixels: Pixels = "qgis",
    margin_px: Annotated[
        float, typer.Option(help="Vertices may lie this far outside the image, pixels.", min=0.0)
    ] = 5.0,
    sigma_px: Annotated[
        float, typer.Option(help="Precision of the digitised vertices, one sigma, pixels.", min=0.0)
    ] = 0.5,
    tolerance_px: TolerancePx = 0.5,
    skip_missed: SkipMissed = False,
    vertices: VertexFile = None,
    as_json: AsJson = False,
) -> None:
    """Bring vectors that were digitised on a raw scene onto the map, with their predicted accuracy."""
    corrected = correct_file(
        VectorFile(vectors, layer),
        SceneModel(scene, model, registration, sigma_m),
        TerrainFile(dem, vertical, geoid, fill_px),
        output,
        crs=to,
        vertices=vertices,
        options=CorrectionOptions(
            _origin(pixels), tolerance_px, skip_missed, margin_px, sigma_px, dem_sigma_m
        ),
    )
    record = asdict(corrected)
    if as_json:
        print_json(_without_nan(record))
        return
    stated = (record.pop("relative_to_control_points"), record.pop("on_the_earth"))
    show_one(record | {one["label"]: one["words"] for one in stated}, as_json=False)


def project(
    vectors: Vectors,
    *,
    scene: SceneImage,
    dem: Dem,
    output: Output,
    registration: Registration = None,
    model: Model = None,
    vertical: Vertical = None,
    geoid: GeoidGrid = None,
    fill_px: FillPx = 0,
    layer: Layer = None,
    pixels: Pixels = "qgis",
    tolerance_px: TolerancePx = 0.5,
    clip: Annotated[bool, typer.Option("--clip", help="Cut at the border of the image.")] = False,
    skip_missed: SkipMissed = False,
    vertices: VertexFile = None,
    as_json: AsJson = False,
) -> None:
    """Bring vectors of the map into the pixel coordinates of a raw scene."""
    projected = project_file(
        VectorFile(vectors, layer),
        SceneModel(scene, model, registration),
        TerrainFile(dem, vertical, geoid, fill_px),
        output,
        vertices=vertices,
        options=ProjectionOptions(_origin(pixels), tolerance_px, skip_missed, clip),
    )
    show_one(asdict(projected), as_json=as_json)


def _origin(pixels: str) -> PixelOrigin:
    for origin in PIXEL_ORIGINS:
        if pixels == origin:
            return origin
    raise InputError(f"--pixels: {pixels} found, one of {', '.join(PIXEL_ORIGINS)} expected")


def _without_nan(record: dict[str, Any]) -> dict[str, Any]:
    """A record with null for figures that are unknown."""
    return {
        name: _without_nan(value) if isinstance(value, dict) else None if value != value else value
        for name, value in record.items()
    }
