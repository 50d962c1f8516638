"""A pair of views of the town as files, with their true models or with one that is off."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from amers.app.usecases.registration.on_marks import refine_on_marks, written
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.source import Window
from amers.services.quality.check_points import CheckPoints
from amers.services.sensors.rpc import RpcModel
from amers.services.surface.options import SurfaceOptions
from tests.services.surface.worlds import scene

OPTIONS = SurfaceOptions(gsd_m=0.5, heights_m=(140.0, 180.0))
LOOKS = ("left", "right")
OFF_PX = (7.0, 4.0)
"""Lines are off by more than details are looked for across the rows that both images share."""


def model_of(look: str) -> RpcModel:
    """The true model of a view."""
    model = scene(look).model
    assert isinstance(model, RpcModel)
    return model


def write_pair(folder: Path, off_px: tuple[float, float] = (0.0, 0.0)) -> tuple[Path, ...]:
    """Write both views with their RPCs, the second of which is off by some pixels."""
    return tuple(
        write_view(folder, look, off) for look, off in zip(LOOKS, ((0.0, 0.0), off_px), strict=True)
    )


def write_view(folder: Path, look: str, off_px: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Write a view with its RPC, which is off by some pixels."""
    image, model, path = scene(look).image, model_of(look), folder / f"{look}.tif"
    pixels = image.read(Window(0, 0, *image.shape)).astype(np.uint16)
    write_raster(path, pixels, replace(model, image_offset=model.image_offset + off_px))
    return path


def write_registrations(images: tuple[Path, ...], folder: Path) -> Path:
    """Write a folder for each image with its refined model, from marks on the true one."""
    for image in images:
        true = model_of(image.stem)
        lines, samples = scene(image.stem).image.shape
        places = np.array([[a, b] for a in (0.1, 0.5, 0.9) for b in (0.1, 0.5, 0.9)]) * [lines, samples]
        ground = true.locate(places, np.full(len(places), 150.0))
        unknown = np.full((len(places), 3), np.nan)
        opened = read_scene(image, sigma_m=1.0)
        refinement = refine_on_marks(
            opened, CheckPoints(ground, places, unknown, unknown[:, 0]), "shift"
        )
        written(refinement, image, None, opened, folder / image.stem)
    return folder
