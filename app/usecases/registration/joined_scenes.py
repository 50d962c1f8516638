"""Scenes that were registered together, in a folder, for scenes that join them later."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from amers.app.usecases.control_files import IMAGES_NPZ
from amers.app.usecases.registration.register import SceneFiles
from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import FormatError
from amers.services.formats.adjusted_images import read_adjusted_images

SCENES_JSON = "scenes.json"
SCENES_FORMAT = "amers-scenes/1"


@dataclass(frozen=True)
class Member:
    """A scene of a block.

    Attributes:
        name: that it has in the block.
        address: where its image is: a path, or the id of a scene of a service.
        files: of the scene.
        heights_m: that its model was adjusted for.
    """

    name: str
    address: str
    files: SceneFiles
    heights_m: tuple[float, float]


@dataclass(frozen=True)
class JoinedScenes:
    """Scenes that were registered together before.

    Attributes:
        members: their files.
        known: what their adjustment has told of them.
    """

    members: tuple[Member, ...]
    known: KnownImages


def format_scenes(members: Sequence[Member]) -> str:
    """The files of the scenes of a block, so that later scenes can be tied to them."""
    scenes = [
        {
            "name": one.name,
            "image": one.address,
            "model": None if one.files.model is None else str(one.files.model.resolve()),
            "sigma_m": one.files.sigma_m,
            "bands": one.files.bands,
            "rigorous": one.files.rigorous,
            "heights_m": one.heights_m,
            "mask": None if one.files.mask is None else str(one.files.mask.resolve()),
        }
        for one in members
    ]
    return json.dumps({"format": SCENES_FORMAT, "scenes": scenes}, indent=2) + "\n"


def read_joined(folder: Path) -> JoinedScenes:
    """The scenes of a folder with the results on all scenes of a block; images are at their addresses.

    Raises:
        FormatError: the folder is not that of scenes registered together.
    """
    _, known = read_adjusted_images(folder / IMAGES_NPZ)
    path = folder / SCENES_JSON
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != SCENES_FORMAT:
            raise ValueError(f"format {document['format']!r:.60}, {SCENES_FORMAT!r} expected")
        members = [
            Member(
                str(one["name"]),
                str(one["image"]),
                SceneFiles(
                    image=Path(one["image"]),
                    model=None if one["model"] is None else Path(one["model"]),
                    sigma_m=one["sigma_m"],
                    bands=one["bands"],
                    rigorous=one["rigorous"],
                    mask=None if one["mask"] is None else Path(one["mask"]),
                ),
                (float(one["heights_m"][0]), float(one["heights_m"][1])),
            )
            for one in document["scenes"]
        ]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise FormatError(
            f"{path}: the scenes of `amers scene register-many` expected: {error}"
        ) from None
    return JoinedScenes(tuple(one for one in members if one.name in known.names), known)
