"""Files that place a new block on the Earth: blocks, marked points, ortho-images, elevation models."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from amers.app.errors import InputError
from amers.app.usecases.marked_files import PointStatements, read_marked
from amers.app.usecases.registration.reference_source import COMMON_SIGMA_PX, LOCAL_SIGMA_PX
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import VerticalDatumError
from amers.services.formats.addresses import FilePlace, file_bytes
from amers.services.formats.adjusted_images import read_adjusted_images
from amers.services.formats.block.document_json import BLOCK_JSON
from amers.services.formats.block.reader import FolderChips, file_sha256, read_block
from amers.services.formats.images.mosaic import open_mosaic
from amers.services.formats.images.scenes import product_sigma_m, read_scene
from amers.services.formats.pieces import IMAGES, Source, pieces_of
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource
from amers.services.matching.reference_image import Reference
from amers.services.production.control import Control
from amers.services.production.control_points import ControlBlock
from amers.services.production.height_control import ControlHeights
from amers.services.production.ortho_control import ControlOrtho
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Frame

IMAGES_NPZ = "images.npz"
"""The adjusted images of a block in its folder BLOCK.adjustment."""


@dataclass(frozen=True)
class HeightFile:
    """An elevation model that gives a block its heights.

    Attributes:
        terrain: the file, with its vertical datum.
        sigma_m: of its heights, one standard deviation, independent from place to place; by default
            that of each cell of a surface.
        frame_sigma_m: horizontal and up, of the error that the whole model has.
    """

    terrain: TerrainFile
    sigma_m: float | None = None
    frame_sigma_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class ControlFiles:
    """Files that place a new block on the Earth.

    Attributes:
        paths: folders of older blocks, and files of ground points marked in the images.
        points: what the files of points do not state.
        orthos: ortho-images, which tell positions: files, or what has their pieces.
        ortho_sigma_m: accuracy of them on the Earth, one standard deviation a coordinate; by default
            that of their product.
        heights: an elevation model, which tells heights.
        neighbour: folder BLOCK.adjustment of a block that was made from some of the same images.
    """

    paths: tuple[Path, ...] = ()
    points: PointStatements = field(default_factory=PointStatements)
    orthos: tuple[Source, ...] = ()
    ortho_sigma_m: float | None = None
    heights: HeightFile | None = None
    neighbour: Path | None = None


def read_control(
    files: ControlFiles, scenes: Sequence[Scene], images: Sequence[FilePlace], stack: ExitStack
) -> Control:
    """The control of a production; chips stay open until the stack closes.

    Args:
        files: of the control.
        scenes: that it places.
        images: files of the scenes, by whose names marks refer to them.
        stack: closes what is opened.

    Raises:
        InputError: a file cannot be used, or does not state what it must.
    """
    of_points = [path for path in files.paths if path.is_file()]
    missing = [path for path in files.paths if not path.exists()]
    if missing:
        raise InputError(
            f"--control: {missing[0]} does not exist; expected the folder of a block, or a file of "
            "points"
        )
    if not of_points and files.points != PointStatements():
        raise InputError(
            "accuracy, datum or columns of control points stated (--control-…), but no --control is a "
            "file of points; add it, or leave them out"
        )
    marked = (read_marked(of_points, files.points, scenes, images),) if of_points else ()
    blocks = tuple(_block(path, stack) for path in files.paths if path.is_dir())
    return Control(
        blocks=blocks,
        marked=marked,
        orthos=tuple(_ortho(path, files.ortho_sigma_m, stack) for path in files.orthos),
        heights=() if files.heights is None else (_heights(files.heights),),
        neighbour=None if files.neighbour is None else _neighbour(files.neighbour, blocks),
    )


def control_inputs(files: ControlFiles) -> dict[str, Any]:
    """What results depend on, as far as control goes."""
    return {
        "paths": [
            {
                "path": str(path.resolve()),
                "sha256": file_sha256(path / BLOCK_JSON if path.is_dir() else path),
            }
            for path in files.paths
        ],
        "points": asdict(files.points),
        "orthos": [_pieces_facts(source) for source in files.orthos],
        "ortho_sigma_m": files.ortho_sigma_m,
        "heights": None if files.heights is None else asdict(files.heights),
        "neighbour": None if files.neighbour is None else file_sha256(files.neighbour / IMAGES_NPZ),
    }


def _pieces_facts(source: Source) -> dict[str, Any]:
    """What identifies an ortho-image: the content of its file, or the pieces that have it."""
    if isinstance(source, Path) and source.is_file():
        return {"path": str(source.resolve()), "sha256": file_sha256(source)}
    pieces = [(str(place), file_bytes(place)) for place in pieces_of(source, IMAGES)]
    return {"path": str(source), "pieces": pieces}


def _neighbour(folder: Path, blocks: Sequence[ControlBlock]) -> KnownImages:
    block, known = read_adjusted_images(folder / IMAGES_NPZ)
    if block in (one.name for one in blocks):
        raise InputError(
            f"{block}: given as control and as neighbour, which would count it twice; give it with "
            "--neighbour only: its images contain all the information of its points"
        )
    return known


def _block(folder: Path, stack: ExitStack) -> ControlBlock:
    contents = read_block(folder)
    chips = stack.enter_context(FolderChips(folder))
    return ControlBlock(contents.document.metadata.id, contents.points, chips)


def _ortho(source: Source, sigma_m: float | None, stack: ExitStack) -> ControlOrtho:
    pieces = pieces_of(source, IMAGES)
    scene = read_scene(pieces[0], sigma_m=math.nan)
    stack.callback(scene.image.close)  # type: ignore[attr-defined]
    if not isinstance(scene.model, OrthoModel):
        raise InputError(
            f"{pieces[0]}: expected an ortho-image on a map (--control-ortho), found an image with a "
            "sensor model; give it with --images"
        )
    stated_m = sigma_m or product_sigma_m(scene.acquisition.sensor)
    if stated_m is None:
        raise InputError(
            f"{source}: the accuracy of this ortho-image on the Earth is not stated: give it with "
            "--control-ortho-sigma-m, one standard deviation of each coordinate in metres"
        )
    image: ImageSource = scene.image
    grid, statements = scene.model.grid, scene.statements
    if len(pieces) > 1:
        mosaic = open_mosaic(pieces)
        stack.callback(mosaic.close)
        image, grid, statements = mosaic, mosaic.grid, mosaic.statements
    reference = Reference(
        image=image,
        model=OrthoModel(grid),
        terrain=None,
        sigma_m=LOCAL_SIGMA_PX * grid.gsd_m,
        common_sigma_m=COMMON_SIGMA_PX * grid.gsd_m,
        frame=Frame.from_sigmas(stated_m, math.nan),
        statements=statements,
    )
    return ControlOrtho(source.name, reference)


def _heights(heights: HeightFile) -> ControlHeights:
    name = heights.terrain.dem.name
    try:
        terrain = read_terrain(heights.terrain, heights.sigma_m)
    except VerticalDatumError as error:
        raise InputError(f"{error} (--control-dem-vertical, --control-dem-geoid)") from None
    if terrain.sigmas is None or heights.frame_sigma_m is None:
        raise InputError(
            f"{name}: the accuracy of these heights is not stated: give the error of single heights "
            "with --control-dem-sigma-m (a surface has its own), and the common error of the whole "
            "model with --control-dem-frame-sigma-m HORIZONTAL,UP, one standard deviation in metres"
        )
    return ControlHeights(name, terrain, Frame.from_sigmas(*heights.frame_sigma_m))
