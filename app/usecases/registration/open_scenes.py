"""Scenes that are registered together, read from their files and open as long as the caller needs."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from app.usecases.registration.check_points import read_shared_check_points
from app.usecases.registration.joined_scenes import JoinedScenes
from app.usecases.registration.register import SceneFiles, grown
from services.conventions import MAX_ERROR_SIGMAS
from services.errors import AmersError, InputError
from services.formats.images.bands import parse_bands
from services.formats.images.scenes import read_scene
from services.imagery.scene import Scene, scene_footprint
from services.quality.check_points import CheckPoints
from services.sensors.parameter_sets import parameter_set_named
from services.sensors.pushbroom import PushbroomModel
from services.types import Array


@dataclass(frozen=True)
class OpenScene:
    """A scene that is read.

    Attributes:
        folder: name of the folder of its results.
        address: of its image, for scenes that join later.
        files: of the scene.
        scene: under the name that it has among the others.
        check_points: held out of its registration; None without.
    """

    folder: str
    address: str
    files: SceneFiles
    scene: Scene
    check_points: CheckPoints | None = None

    @property
    def name(self) -> str:
        """The name of the scene."""
        return self.scene.acquisition.image_id


def open_scenes(
    files: Mapping[str, SceneFiles],
    joined: JoinedScenes | None,
    address_of: Callable[[str, Path], str],
    stack: ExitStack,
) -> tuple[list[OpenScene], dict[str, AmersError]]:
    """The scenes that can be read, open until the stack closes, and why others cannot be.

    A scene whose metadata name it like another one gets the name of its folder.

    Args:
        files: of the scenes, by the names of their folders.
        joined: scenes that they join.
        address_of: what names an image to scenes that join later, by name of the folder and path.
        stack: closes the images.
    """
    opened: list[OpenScene] = []
    failed: dict[str, AmersError] = {}
    taken = {one.name for one in joined.members} if joined else set()
    for name, one in files.items():
        try:
            scene = _read(one, stack)
            if scene.acquisition.image_id in taken:
                scene = _named(scene, name)
            if scene.acquisition.image_id in taken:
                raise InputError(
                    f"{name}: the scenes that it joins have one of this name already; leave it out, or "
                    "rename the image if it is another one"
                )
            check_points = None
            if one.check_points is not None:
                check_points = read_shared_check_points(
                    one.check_points, one.check_heights, one.image, scene
                )
        except InputError as error:
            failed[name] = error
            continue
        taken.add(scene.acquisition.image_id)
        opened.append(OpenScene(name, address_of(name, one.image), one, scene, check_points))
    return opened, failed


def open_joined(joined: JoinedScenes, stack: ExitStack) -> list[OpenScene]:
    """Scenes that were registered together before, open until the stack closes.

    Raises:
        InputError: an image has moved.
    """
    return [
        OpenScene(
            one.address,
            one.address,
            one.files,
            _for_heights(_named(_read(one.files, stack), one.name), one.heights_m),
        )
        for one in joined.members
    ]


def refuse_unused(read: Sequence[OpenScene]) -> None:
    """Refuse options that no scene can use: parameters of rigorous models, and check points.

    Raises:
        InputError: no scene has a rigorous model, or marks in the file of check points.
    """
    asked = [one for one in read if one.files.rigorous is not None]
    if asked and all(one.scene.parameter_set is None for one in asked):
        raise InputError(
            f"rigorous: {asked[0].files.rigorous} given, and none of {len(asked)} scenes has metadata "
            "with a rigorous model beside it (DIMAP with orbit and attitude, PHRDIMAP, WorldView XML): "
            "leave the option out, or add the metadata of the products"
        )
    given = [one.files.check_points for one in read if one.files.check_points is not None]
    if given and all(one.check_points is None for one in read):
        raise InputError(
            f"{given[0].name}: no marks in any of {len(read)} scenes found; name their images"
        )


def _read(files: SceneFiles, stack: ExitStack) -> Scene:
    bands = None if files.bands is None else parse_bands(files.bands)
    scene = read_scene(
        files.image,
        files.model,
        sigma_m=files.sigma_m,
        bands=bands,
        mask=files.mask,
        parameter_set=None if files.rigorous is None else parameter_set_named(files.rigorous),
    )
    stack.callback(scene.image.close)  # type: ignore[attr-defined]
    return scene


def _named(scene: Scene, name: str) -> Scene:
    """The scene under the name that it has among others."""
    return replace(scene, acquisition=replace(scene.acquisition, image_id=name))


def _for_heights(scene: Scene, heights_m: tuple[float, float]) -> Scene:
    """The scene with the heights that its rigorous model was adjusted for."""
    if not isinstance(scene.model, PushbroomModel):
        return scene
    return replace(scene, model=replace(scene.model, height_range_m=heights_m))


def ground_outline(scenes: Sequence[Scene]) -> Array:
    """The outline (n, 2) of the ground of all scenes, lon and lat, as far as their models may be off."""
    outlines = [grown(scene_footprint(one), MAX_ERROR_SIGMAS * one.sigma_m) for one in scenes]
    for outline in outlines[1:]:
        outline[:, 0] -= 360.0 * np.round((outline[:, 0].mean() - outlines[0][:, 0].mean()) / 360.0)
    together = shapely.union_all([shapely.Polygon(outline) for outline in outlines])
    if not isinstance(together, shapely.Polygon):
        together = together.convex_hull
    return np.array(together.exterior.coords)[:-1]
