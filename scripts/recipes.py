"""The recipes of docs/library.md, and the small simulated files on which they run."""

import json
import re
from pathlib import Path

import numpy as np

import amers
from amers.services.lines_of_sight import intersect_terrain
from examples import simulated_images

LIBRARY = Path(__file__).parents[1] / "docs" / "library.md"
FIELD = [[[120, -150], [260, -170], [240, -330], [120, -150]]]
"""In pixels of QGIS: column, minus row."""
MARKED_PX = np.array([[90.0, 120.0], [110.0, 600.0], [350.0, 340.0], [580.0, 90.0], [620.0, 610.0]])
OF_OTHERS = ("app/__init__.py", "services/__init__.py", "app.py", "numpy.py", "cv2.py")
"""Modules with names that Amers or its libraries have too."""


def recipes() -> dict[str, str]:
    """The programs of docs/library.md, by their headings."""
    sections = re.split(r"^##+ ", LIBRARY.read_text(encoding="utf-8"), flags=re.MULTILINE)
    programs = {}
    for section in sections:
        program = re.search(r"^```python\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
        if program is not None:
            programs[section.partition("\n")[0]] = program[1]
    return programs


def write_files(folder: Path) -> None:
    """Write the files that the recipes name: images, terrain, ortho-image, block, marks, a field."""
    views = simulated_images.write_block_images(folder)
    simulated_images.write_scene(folder)
    heights = simulated_images.write_terrain(folder / "dem.tif")
    terrain = amers.open_terrain(heights, vertical="ellipsoid")
    amers.produce_points(views, folder / "block", gsds_m=(1.0, 4.0), points=60, sigma_m=3.0)
    amers.orthorectify(views[0], terrain, folder / "ortho.tif")
    field = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": FIELD}}
    collection = {"type": "FeatureCollection", "features": [field]}
    (folder / "drawn.geojson").write_text(json.dumps(collection))
    true_model = simulated_images.true_model_of_scene()
    ground = intersect_terrain(true_model, MARKED_PX, terrain.grid)
    lines = ["# pixel-origin=centre", "id,lon,lat,height_m,line,sample"]
    for number, row in enumerate(np.column_stack([ground, MARKED_PX])):
        lines.append(f"{number},{row[0]:.9f},{row[1]:.9f},{row[2]:.4f},{row[3]},{row[4]}")
    (folder / "marks.csv").write_text("\n".join(lines) + "\n")


def write_modules_of_others(folder: Path) -> None:
    """Write modules into a folder that end the program which imports them."""
    for name in OF_OTHERS:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'raise SystemExit("{name} of the working folder was imported")\n')
