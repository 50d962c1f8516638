"""The process `make-surface`: the surface that uploaded scenes show."""

import hashlib
import json
import math
import shutil
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases import quotas
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.orthorectification import MapLimits, require_warranted_gsd
from amers.app.usecases.processes import (
    STATEMENTS_VALUE,
    Commit,
    Process,
    Work,
    stated_document,
    work_folder,
)
from amers.app.usecases.registered_scene import SceneModel, read_registered_scene
from amers.app.usecases.results import store_results
from amers.app.usecases.stored_scenes import StoredScene, check_scenes, local_scene, stored_scenes
from amers.app.usecases.surface import (
    SurfaceScene,
    refuse_ortho_image,
    surface_inputs,
    write_surface,
)
from amers.app.usecases.surface_map import MAP_VALUES, SURFACE_NAME, map_values
from amers.services.formats.images.surfaces import BANDS
from amers.services.surface.options import MOST_FILL_CELLS, SurfaceOptions
from amers.services.surface.surface import surface_grid

REPORT_NAME = "report.html"
MOST_PAIRS = 100
"""Pairs of one job at most: each is matched over all the ground that it shows."""
_CELL_BYTES = 4 * len(BANDS)


@dataclass(frozen=True)
class MakeSurface:
    """The inputs of a surface.

    Attributes:
        scenes: ids of uploaded scenes of the same ground, 2 to 100.
        registrations: ids of the jobs that registered the scenes, such as one job register-scenes. If
            several jobs registered the same scene, the last one counts. By default none: the models
            uploaded with the scenes are used. These models must agree, such as the models of one
            adjusted block.
        gsd_m: side of a cell, metres; by default the ground sampling of the finest scene.
        heights_m: lowest and highest height of the surface above the ellipsoid, metres; by default the
            height range of the sensor models.
        pairs: largest number of scene pairs that are matched, 1 to 100.
        fill_cells: fill gaps from heights at most this many cells away, 0 to 20.
    """

    scenes: tuple[UUID, ...]
    registrations: tuple[UUID, ...] = ()
    gsd_m: float | None = None
    heights_m: tuple[float, float] | None = None
    pairs: int = SurfaceOptions.pairs
    fill_cells: int = SurfaceOptions.fill_cells


def _check(connection: Connection, caller: Token, inputs: MakeSurface) -> None:
    if inputs.gsd_m is not None and not inputs.gsd_m > 0.0:
        raise InputError(f"gsd_m: {inputs.gsd_m:g} found, a length above 0 m expected")
    if inputs.heights_m is not None and not inputs.heights_m[0] < inputs.heights_m[1]:
        low, high = inputs.heights_m
        raise InputError(f"heights_m: {low:g} and {high:g} found, the lower height first expected")
    if not 1 <= inputs.pairs <= MOST_PAIRS:
        raise InputError(f"pairs: {inputs.pairs} found, 1 to {MOST_PAIRS} expected")
    if not 0 <= inputs.fill_cells <= MOST_FILL_CELLS:
        raise InputError(f"fill_cells: {inputs.fill_cells} found, 0 to {MOST_FILL_CELLS} expected")
    check_scenes(connection, caller, inputs.scenes, fewest=2)
    stored = stored_scenes(connection, inputs.scenes, inputs.registrations)
    known_m = [one.row.gsd_m for one in stored if one.row.gsd_m is not None]
    if inputs.gsd_m is not None and len(known_m) == len(stored):
        require_warranted_gsd(inputs.gsd_m, min(known_m))


def _run(work: Work) -> Commit:
    """Make the surface of uploaded scenes and put it into the storage."""
    inputs: MakeSurface = work.inputs
    with work.database.snapshot() as connection:
        stored = stored_scenes(connection, inputs.scenes, inputs.registrations)
        owner = work.job.owner
        room = None if owner is None else quotas.room_left(connection, work.settings, owner)
    options = SurfaceOptions(inputs.gsd_m, inputs.heights_m, inputs.pairs, fill_cells=inputs.fill_cells)
    keys = [key for one in stored for key in one.keys]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="amers-")))
        kept = stack.enter_context(work.storage.lasting_folder(work_folder(work.job.id)))
        stack.enter_context(suspecting_damage(work.database, work.storage, keys))
        scenes = [_scene(work, one, stack) for one in stored]
        opened = [one.scene for one in scenes]
        grid = surface_grid(opened, options)
        MapLimits(room).check(opened, grid, _CELL_BYTES)
        free_bytes = shutil.disk_usage(kept).free - work.settings.min_free_bytes
        most_bytes = max(free_bytes if room is None else min(room, free_bytes), 0)
        # Another version, or other models, would not go on from the same results.
        facts = json.dumps(surface_inputs(scenes, options), sort_keys=True)
        surface = write_surface(
            scenes,
            folder / SURFACE_NAME,
            options,
            grid=grid,
            place=WorkPlace(kept / hashlib.sha256(facts.encode()).hexdigest(), most_bytes=most_bytes),
            progress=work.progress,
        )
        on_map = map_values(surface.path)
        files = store_results(work, {SURFACE_NAME: surface.path, REPORT_NAME: surface.report})

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "lines": surface.lines,
            "samples": surface.samples,
            "gsd_m": surface.gsd_m,
            "crs": surface.crs,
            "sigma_m": None if math.isnan(surface.sigma_m) else surface.sigma_m,
            "cells": surface.cells,
            "pairs": list(surface.pairs),
            **on_map,
            "statements": stated_document(surface.statements),
            "files": files,
        }

    return commit


def _scene(work: Work, stored: StoredScene, stack: ExitStack) -> SurfaceScene:
    """A scene with its model, open until the stack closes."""
    row = stored.row
    image, registration = local_scene(work, stored, stack)
    scene, _ = read_registered_scene(SceneModel(image, registration=registration))
    stack.callback(scene.image.close)  # type: ignore[attr-defined]
    refuse_ortho_image(scene, row.name)
    return SurfaceScene(scene, str(row.id), {"scene": str(row.id), "sha256": row.sha256})


MAKE_SURFACE = Process(
    id="make-surface",
    title="Make a surface",
    description="Make a surface model from uploaded scenes of the same ground: heights with "
    "their accuracy, on a map. Register the scenes together first, so that their models agree.",
    scope=Scope.REGISTER,
    inputs=MakeSurface,
    outputs={
        SURFACE_NAME: "The surface, a cloud-optimised GeoTIFF with four bands: height above the "
        "ellipsoid and its standard deviation in metres, number of images, and a code for the "
        "reason if a cell has no height.",
        REPORT_NAME: "A page about the surface: heights, accuracy, pairs of scenes, empty cells "
        "by reason.",
    },
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the map, px"},
        "samples": {"type": "integer", "title": "Samples of the map, px"},
        "gsd_m": {"type": "number", "title": "Side of a cell, metres"},
        "crs": {"type": "string", "title": "Reference system of the map"},
        "sigma_m": {
            "type": ["number", "null"],
            "title": "Median of the standard deviations of the heights, metres",
        },
        "cells": {"type": "object", "title": "Number of cells with a height, and without one by reason"},
        "pairs": {
            "type": "array",
            "items": {"type": "object"},
            "title": "Pairs of scenes with their base over height, shift onto the others, and noise",
        },
        **MAP_VALUES,
        "statements": STATEMENTS_VALUE,
    },
)
