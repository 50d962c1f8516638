"""The process that makes an uploaded scene visible on the page: its raw image as tiles."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import check_scene, present_scene
from amers.app.usecases.scenes import local_image, stored_keys
from amers.services.formats.images.tiles import TileIndex, format_tile_index, write_tiles
from amers.services.formats.sensor_models.product_image import open_image

INDEX_NAME, TILES_NAME = "tiles.json", "tiles.bin"


@dataclass(frozen=True)
class ViewScene:
    """The inputs of a view.

    Attributes:
        scene: id of an uploaded scene.
    """

    scene: UUID


def _check(connection: Connection, caller: Token, inputs: ViewScene) -> None:
    check_scene(connection, caller, inputs.scene)


def _run(work: Work) -> Commit:
    """Draw the tiles of an uploaded scene and put them into the storage."""
    inputs: ViewScene = work.inputs
    with work.database.snapshot() as connection:
        scene = present_scene(connection, inputs.scene)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        made = {name: Path(folder) / name for name in (INDEX_NAME, TILES_NAME)}
        with suspecting_damage(work.database, work.storage, stored_keys(scene)):
            index = _write(image, made[TILES_NAME], work)
        made[INDEX_NAME].write_text(format_tile_index(index), encoding="utf-8")
        stored = store_results(work, made)

    def commit(connection: Connection) -> dict[str, Any]:
        return {"lines": index.lines, "samples": index.samples, "files": stored}

    return commit


def _write(image: Path, tiles: Path, work: Work) -> TileIndex:
    raster = open_image(image, None)
    try:
        return write_tiles(raster, tiles, work.progress)
    finally:
        raster.close()


VIEW_SCENE = Process(
    id="view-scene",
    title="View a scene",
    description="Draw the raw image of an uploaded scene as tiles for a viewer: grey values at "
    "decreasing resolutions, without georeferencing.",
    scope=Scope.REGISTER,
    inputs=ViewScene,
    outputs={
        INDEX_NAME: "Size of the image, and offset and size of each tile in the file of tiles.",
        TILES_NAME: "The tiles, JPEG images one after another; read them by ranges.",
    },
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the image"},
        "samples": {"type": "integer", "title": "Samples of the image"},
    },
)
