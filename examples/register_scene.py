"""Register a scene on the control points of a block.

    python examples/register_scene.py BLOCK FOLDER [SCENE]

BLOCK is the folder of a block, for instance the one that make_block.py writes. Without a scene of your
own, the example simulates one whose model is 50 m wrong. It writes the refined model into FOLDER.
"""

import sys
from pathlib import Path

import numpy as np
import simulated_images

from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.refined_model import Stated, write_refined
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.registration.on_points import register_scene


def register(image: Path, block_folder: Path, folder: Path) -> None:
    """Refine the model of a scene, print how good the result is, and write it into a folder."""
    # A scene is an image that is read by windows, its sensor model, and how wrong that model may be.
    scene = read_scene(image, sigma_m=50.0)

    # A block holds a table of points and the files of their chips, which are read when they are needed.
    points = read_block(block_folder).points
    chips = FolderChips(block_folder)

    # Predict where the scene shows the points, find their chips there, adjust the model, qualify it.
    registration = register_scene(scene, points, chips)

    measures, quality = registration.measures, registration.qualification
    print(f"{len(measures.point_id)} points lie in the scene, {measures.matched.sum()} were found")
    print(f"{measures.active.sum()} of them take part in the final adjustment")
    print(f"verdict: {quality.verdict}")
    for criterion in quality.criteria:
        limit = f"{criterion.comparison} {criterion.limit:g} to be {criterion.needed_for}"
        print(f"  {criterion.name}: {criterion.value:.2f}, {limit}")

    # A registered model projects ground positions into the image like the model that was delivered.
    ground = points.lon_lat_h
    moved_px = registration.model.project(ground) - scene.model.project(ground)
    print(f"the model moved by {np.nanmedian(np.hypot(*moved_px.T)):.1f} px (median over the points)")

    model, adjustment = registration.model, registration.adjustment
    # All points of one block share its frame; the errors of the model on the Earth include it.
    # They hold in the area that the points support, and nothing is stated outside it.
    refined = write_refined(
        ImageFiles(image),
        model,
        adjustment,
        shape=scene.image.shape,
        folder=folder,
        stated=Stated(points.frames[0], quality.coverage.outline),
    )
    print(f"{refined.note}: {', '.join(path.name for path in refined.files)}")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    block, output, *images = map(Path, sys.argv[1:])
    register(images[0] if images else simulated_images.write_scene(output / "images"), block, output)
