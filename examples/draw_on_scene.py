"""Bring shapes that were drawn on a raw scene onto the map, and compare them with the true ground.

    python examples/draw_on_scene.py FOLDER

FOLDER is the one into which register_scene.py wrote the simulated scene and its refined model. The
example writes a terrain, a field and a road in pixels of the scene, and the same on the map.
"""

import json
import sys
from pathlib import Path

import numpy as np
import shapely
import simulated_images

from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.app.usecases.vector_files import CorrectionOptions, VectorFile
from amers.app.usecases.vectors import correct_file
from amers.services.formats.vector.layers import read_layer
from amers.services.geodesy import metres_per_degree
from amers.services.lines_of_sight import intersect_terrain

DRAWN = {
    "field": {"type": "Polygon", "coordinates": [[[120, 150], [260, 170], [240, 330], [120, 150]]]},
    "road": {"type": "LineString", "coordinates": [[80, 600], [300, 480], [620, 520]]},
}
"""Shapes in pixels: x to the right and y downwards, from the corner of the first pixel."""
PIXELS = CorrectionOptions(pixels="corner")


def draw(folder: Path) -> None:
    """Bring what was drawn onto the map, and print how far it is from the truth."""
    ground = TerrainFile(simulated_images.write_terrain(folder / "terrain.tif"), "ellipsoid")
    drawn, on_map, vertices = (folder / f"{name}.geojson" for name in ("drawn", "map", "vertices"))
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": shape}
        for name, shape in DRAWN.items()
    ]
    drawn.write_text(json.dumps({"type": "FeatureCollection", "features": features}))

    # The refined model and its accuracy come from the folder of the registration.
    scene = SceneModel(folder / "images" / "scene.tif", registration=folder)
    made = correct_file(VectorFile(drawn), scene, ground, on_map, vertices=vertices, options=PIXELS)
    print(f"{made.features} features, {made.vertices} vertices, {made.added_vertices} of them added")

    # Every vertex has its place in the image. Nobody knows the true model of a real scene; that of a
    # simulated one shows what the ground is there.
    layer = read_layer(vertices)
    line, sample, ce90_m = (
        layer.attributes[name].to_numpy() for name in ("line", "sample", "ce90_earth")
    )
    true_model = simulated_images.true_model_of_scene()
    truth = intersect_terrain(true_model, np.column_stack([line, sample]), read_terrain(ground))
    placed = shapely.get_coordinates(layer.geometries)
    per_degree = metres_per_degree(float(placed[0, 1]), 0.0)
    off_m = np.hypot(*((placed - truth[:, :2]) * per_degree).T)
    print(f"{np.median(off_m):.2f} m from the truth in the median, {off_m.max():.2f} m at most")
    print(f"CE90 {np.median(ce90_m):.2f} m on the Earth is stated")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    draw(Path(sys.argv[1]))
