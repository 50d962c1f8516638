"""Simulated images, their terrain and a block for the notebooks: each file is written on first use."""

import sys
from dataclasses import dataclass
from pathlib import Path

import amers

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent))

import simulated_images  # noqa: E402 - it lies in the folder of the examples

FOLDER = Path("output")
"""In the working folder, which is that of the notebooks."""


@dataclass(frozen=True)
class TrueScene:
    """The true model of the simulated scene; for a real scene it is unknown."""

    model: object


def block_images() -> list[Path]:
    """Three overlapping images, each with a model that is 3 m wrong."""
    paths = [FOLDER / f"view_{number:02}.tif" for number in (1, 2, 3)]
    if not all(path.exists() for path in paths):
        simulated_images.write_block_images(FOLDER)
    return paths


def scene_image() -> Path:
    """Another image of the same ground, with a model that is 50 m wrong."""
    path = FOLDER / "scene.tif"
    return path if path.exists() else simulated_images.write_scene(FOLDER)


def true_scene() -> TrueScene:
    """The true model of this image, for `amers.project` and `amers.locate`."""
    return TrueScene(simulated_images.true_model_of_scene())


def terrain_file() -> Path:
    """The heights of the ground above the ellipsoid, without buildings."""
    path = FOLDER / "dem.tif"
    if not path.exists():
        FOLDER.mkdir(exist_ok=True)
        simulated_images.write_terrain(path)
    return path


def block_folder() -> Path:
    """A block of control points from the three images; the notebook produce_block.ipynb explains it."""
    path = FOLDER / "block"
    if not path.exists():
        amers.produce_points(block_images(), path, gsds_m=(1.0, 4.0), points=60, sigma_m=3.0)
    return path
