"""A simulated continent in small as files: what a user has, and apart from it the truth.

| path | content |
|---|---|
| `archive/items.ndjson` | STAC items of the images, with masks in `archive/masks` |
| `archive/images` | GeoTIFF, 12 bits, RPC tags as delivered |
| `area.geojson` | the ground that the archive is about |
| `control` | older block, elevation model and ortho-images with their stated accuracy |
| `check` | ortho-images that no production sees |
| `later` | images of the years after, for registration |
| `truth` | world and errors; no production reads it |
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import date
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely

from amers.services.errors import InputError
from amers.services.geodesy import metres_per_degree
from amers.services.simulation.archive import (
    CENTRE_LON_LAT,
    CONTINENT,
    FIRST_DAY,
    LAST_DAY,
    SMALL,
    ArchiveSize,
    ArchiveView,
    archive_views,
    later_views,
    older_views,
    view_geometry,
)
from amers.services.simulation.changes import Change, apply_changes, draw_changes, scatter_things
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewGeometry
from amers.services.simulation.world import World, flood, make_world
from amers.services.types import Array

SIZES = {"continent": CONTINENT, "small": SMALL}
SMALLEST_HILL_M = 900.0
WATER_SHARE = 0.05
CHANGED_A_YEAR = 0.01
THINGS_PER_KM2 = 15.0
_LAYERS = ("terrain_m", "roof_m", "albedo", "parcel")


@dataclass(frozen=True)
class Continent:
    """A simulated continent in a folder.

    Attributes:
        folder: of all its files.
        size: of its world and of its archive.
        seed: everything follows from it.
    """

    folder: Path
    size: ArchiveSize
    seed: int

    @property
    def size_name(self) -> str:
        """Name of its size."""
        return next(name for name, size in SIZES.items() if size == self.size)

    @property
    def truth(self) -> Path:
        """Folder that no production reads."""
        return self.folder / "truth"

    @property
    def area(self) -> shapely.Polygon:
        """The ground that the archive is about."""
        per_degree = np.array(metres_per_degree(CENTRE_LON_LAT[1], 300.0))
        half = self.size.area_m / 2.0 / per_degree
        return shapely.box(*(np.array(CENTRE_LON_LAT) - half), *(np.array(CENTRE_LON_LAT) + half))

    @cached_property
    def views(self) -> Mapping[str, ArchiveView]:
        """The images of the archive, by name."""
        return {view.name: view for view in archive_views(self.size, self.seed)}

    @cached_property
    def later(self) -> Mapping[str, ArchiveView]:
        """The images of the years after, by name."""
        return {view.name: view for view in later_views(self.size, self.seed)}

    @cached_property
    def older(self) -> Mapping[str, ArchiveView]:
        """The images that the older base is made from, by name."""
        return {view.name: view for view in older_views(self.size, self.seed)}

    @cached_property
    def world(self) -> World:
        """The world before all changes; its files are mapped and shared, changes stay in memory."""
        return self.fresh_world()

    @cached_property
    def changes(self) -> tuple[Change, ...]:
        """What changes on the ground over the years."""
        rng = np.random.default_rng([self.seed, 4])
        return draw_changes(self.world, rng, FIRST_DAY, LAST_DAY, CHANGED_A_YEAR)

    def fresh_world(self) -> World:
        """The world before all changes, whose arrays the caller may change."""
        return open_world(self.truth / "world")

    def world_on(self, day: date) -> World:
        """The world on a day, without things that come and go."""
        return apply_changes(self.fresh_world(), self.changes, day)

    def world_of(self, view: ArchiveView) -> World:
        """The world as an image shows it: on its day, with the things that are there during its pass."""
        world = self.world_on(view.day)
        scatter_things(world, np.random.default_rng([self.seed, 5, view.orbit]), THINGS_PER_KM2)
        return world

    def geometry(self, view: ArchiveView) -> ViewGeometry:
        """The true geometry of an image, and the model that is delivered."""
        return view_geometry(self.world, view)

    def image(self, view: ArchiveView) -> TiledView:
        """The pixels of an image, rendered where they are read."""
        return TiledView(self.world_of(view), self.geometry(view), view.seed, view.conditions)

    def ground(self, view: ArchiveView, line_sample: Array) -> Array:
        """The ground (n, 3) that positions (n, 2) of an image truly show."""
        return surface_seen(self.world_of(view), self.geometry(view).true_model, line_sample)


def make_truth(folder: Path, size_name: str, seed: int) -> Continent:
    """A continent whose world is written, or kept when it is there.

    Raises:
        InputError: the folder has a continent of another size or seed.
    """
    continent = Continent(folder, SIZES[size_name], seed)
    stated = folder / "truth" / "continent.json"
    if stated.exists():
        found = open_continent(folder)
        if (found.size, found.seed) != (continent.size, seed):
            raise InputError(
                f"{folder}: a continent of another size or seed found (seed {found.seed}); "
                "give a new folder"
            )
        return found
    world_folder = folder / "truth" / "world"
    world_folder.mkdir(parents=True, exist_ok=True)
    size = continent.size
    world = make_world(
        np.random.default_rng([seed, 0]),
        size.world_m,
        size.posting_m,
        size.relief_m,
        centre_lon_lat=CENTRE_LON_LAT,
        smallest_hill_m=SMALLEST_HILL_M,
        region_m=size.region_m,
    )
    flood(world, WATER_SHARE)
    for name in _LAYERS:
        np.save(world_folder / f"{name}.npy", getattr(world, name))
    grid = {
        "seed": world.seed,
        "origin_lon_lat": world.origin_lon_lat.tolist(),
        "step_deg": world.step_deg.tolist(),
        "posting_m": world.posting_m,
    }
    (world_folder / "grid.json").write_text(json.dumps(grid))
    document = {"size": size_name, "seed": seed, **asdict(size)}
    stated.write_text(json.dumps(document, indent=1))
    return continent


def open_continent(folder: Path) -> Continent:
    """The continent in a folder.

    Raises:
        InputError: there is none.
    """
    path = folder / "truth" / "continent.json"
    if not path.exists():
        raise InputError(f"{folder}: no continent found; make one with benchmarks.continent make")
    document = json.loads(path.read_text())
    return Continent(folder, SIZES[document["size"]], int(document["seed"]))


def open_world(folder: Path) -> World:
    """A world whose layers are mapped from files; what is written into them stays in this process."""
    grid = json.loads((folder / "grid.json").read_text())
    layers = {name: np.asarray(np.load(folder / f"{name}.npy", mmap_mode="c")) for name in _LAYERS}
    return World(
        seed=grid["seed"],
        origin_lon_lat=np.array(grid["origin_lon_lat"]),
        step_deg=np.array(grid["step_deg"]),
        posting_m=grid["posting_m"],
        **layers,
    )
