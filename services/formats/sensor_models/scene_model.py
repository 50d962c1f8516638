"""The delivered model of a scene as a JSON document: enough to register marks without pixels."""

import json
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.text_files import load_json
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.sensors.base import SensorModel
from amers.services.sensors.ortho import OrthoModel
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Acquisition, FloatImage

SCENE_MODEL_FORMAT = "amers-scene-model/1"


@dataclass(frozen=True)
class _UnreadImage:
    """An image of which only the size is known."""

    shape: tuple[int, int]

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window: none is known."""
        return np.full((window.lines, window.samples), np.nan, dtype=np.float32)


def format_scene_model(scene: Scene) -> str:
    """The JSON document of a scene as delivered; numbers have the digits that reproduce them.

    Args:
        scene: with an RPC or a map grid, as `read_scene` gives it without a parameter set.
    """
    model = scene.model
    assert isinstance(model, RpcModel | OrthoModel)
    document: dict[str, Any] = {
        "format": SCENE_MODEL_FORMAT,
        "image": scene.acquisition.image_id,
        "shape": list(scene.image.shape),
        "sigma_m": scene.sigma_m,
        "pixel_origin": "the centre of the first pixel is line 0, sample 0",
    }
    if isinstance(model, RpcModel):
        document["rpc"] = {one.name: _plain(getattr(model, one.name)) for one in fields(model)}
    else:
        document["map_grid"] = {
            "crs": model.grid.crs,
            "origin_xy": model.grid.origin_xy.tolist(),
            "step_xy": model.grid.step_xy.tolist(),
        }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def parse_scene_model(text: str, source: str) -> Scene:
    """The scene of a document of `format_scene_model`; its image has a size, and no pixels.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: the text is no such document.
    """
    document = load_json(text, source)
    try:
        if document["format"] != SCENE_MODEL_FORMAT:
            raise ValueError(f"format {document['format']!r}")
        lines, samples = document["shape"]
        shape, model = (int(lines), int(samples)), _model(document)
        return Scene(
            _UnreadImage(shape), model, Acquisition(document["image"]), float(document["sigma_m"])
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{source}: expected a document of {SCENE_MODEL_FORMAT}, found {error}"
        ) from None


def _model(document: dict[str, Any]) -> SensorModel:
    """The model in a document."""
    if "rpc" in document:
        values: dict[str, Any] = {
            name: np.array(value, dtype=np.float64) if isinstance(value, list) else value
            for name, value in document["rpc"].items()
            if value is not None
        }
        return RpcModel(**values)
    grid = document["map_grid"]
    origin_xy, step_xy = (np.array(grid[name]) for name in ("origin_xy", "step_xy"))
    return OrthoModel(MapGrid(grid["crs"], origin_xy, step_xy, tuple(document["shape"])))


def _plain(value: Any) -> Any:
    """A list for an array; null for what is unknown."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value if value == value else None
