"""`amers vectors correct` and `project`: vectors digitised on raw scenes, onto the map and back."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.terrain_options import NeededTerrain
from amers.app.errors import InputError
from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.vector_files import CorrectionOptions, ProjectionOptions, VectorFile
from amers.app.usecases.vectors import correct_file, project_file
from amers.services.formats.vector.pixel_coordinates import PIXEL_ORIGINS, PixelOrigin

Vectors = Annotated[
    Path, typer.Argument(exists=True, help="GeoPackage, GeoJSON, shapefile or FlatGeobuf.")
]
Output = Annotated[
    Path, typer.Option("-o", "--output", help="Output file; its suffix selects the format.")
]


Layer = Annotated[str | None, typer.Option(help="Layer of the file; by default the only layer.")]
Pixels = Annotated[
    str,
    typer.Option(
        help="Pixel coordinates: qgis (x is column, y is minus row, from the corner of the "
        "first pixel), or corner or centre (from this place of the first pixel, y downwards)."
    ),
]
VertexFile = Annotated[
    Path | None, typer.Option(help="Also write every vertex as a point, with its accuracy.")
]
_SCENE = {"image": typer.Option("--scene", exists=True), "registration": None, "model": None}
_SCENE["crop_origin"] = None
_OPTIONS = {"tolerance_px": typer.Option(min=0.001), "skip_missed": None}
_POSITIVE = typer.Option(min=0.0)


def correct(
    vectors: Vectors,
    *,
    scene: Annotated[SceneModel, Shown(**_SCENE, sigma_m=typer.Option(min=0.01))],
    ground: NeededTerrain,
    output: Output,
    to: Annotated[
        str | None, typer.Option(help="Reference system of the map; by default the UTM zone.")
    ] = None,
    layer: Layer = None,
    pixels: Pixels = "qgis",
    options: Annotated[
        CorrectionOptions,
        Shown(
            **_OPTIONS,
            margin_px=_POSITIVE,
            sigma_px=_POSITIVE,
            height_sigma_m=typer.Option("--dem-sigma-m", min=0.0),
        ),
    ],
    vertices: VertexFile = None,
    as_json: AsJson = False,
) -> None:
    """Transform vectors drawn on a raw scene to the map, with their predicted accuracy."""
    corrected = correct_file(
        VectorFile(vectors, layer),
        scene,
        ground.terrain,
        output,
        crs=to,
        vertices=vertices,
        options=replace(options, pixels=_origin(pixels)),
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
    scene: Annotated[SceneModel, Shown(**_SCENE)],
    ground: NeededTerrain,
    output: Output,
    layer: Layer = None,
    pixels: Pixels = "qgis",
    options: Annotated[ProjectionOptions, Shown(**_OPTIONS, clip=None)],
    vertices: VertexFile = None,
    as_json: AsJson = False,
) -> None:
    """Transform vectors of the map to pixel coordinates of a raw scene."""
    projected = project_file(
        VectorFile(vectors, layer),
        scene,
        ground.terrain,
        output,
        vertices=vertices,
        options=replace(options, pixels=_origin(pixels)),
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
