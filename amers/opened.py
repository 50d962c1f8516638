"""What the library opens: scenes, blocks of control points, terrains."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS

from amers.app.usecases.registration.register import SceneFiles
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.errors import InputError
from amers.services.formats.block.document import BlockMetadata
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.pieces import source_of
from amers.services.imagery import scene as imagery
from amers.services.sensors.base import SensorModel
from amers.services.statements import Statements
from amers.services.terrain import Terrain as TerrainGrid
from amers.services.types import Array, ControlPoints, point_chips

FilePath = str | Path


@dataclass(frozen=True, repr=False)
class Scene:
    """An image with its sensor model. It is read by windows, and closed as a context or by `close`.

    Attributes:
        files: files of the scene, with the statements of the caller about them.
        content: image, model, acquisition and accuracy, as the modules of `amers.services` use them.
    """

    files: SceneFiles
    content: imagery.Scene

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        acquisition, (lines, samples) = self.content.acquisition, self.shape
        time = acquisition.acquired_at
        taken = "at an unknown time" if time is None else f"{time:%Y-%m-%d %H:%M} UTC"
        lon, lat, height_m = imagery.scene_centre(self.content)
        return (
            f"Scene {self.files.image}: {acquisition.sensor or 'unknown sensor'}, {taken}\n"
            f"  {lines} x {samples} pixels of {self.gsd_m:.2f} m around {lon:.5f}, {lat:.5f}, "
            f"{height_m:.0f} m\n"
            f"  {type(self.model).__name__}, accurate to {self.content.sigma_m:.1f} m (1 sigma)"
        )

    @property
    def model(self) -> SensorModel:
        """From ground to image."""
        return self.content.model

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.content.image.shape

    @property
    def gsd_m(self) -> float:
        """Ground sampling at the centre, metres."""
        return imagery.scene_gsd_m(self.content)

    @property
    def footprint(self) -> Array:
        """Outline (m, 2) of the ground that the image can show: longitude, latitude; not closed."""
        return imagery.scene_footprint(self.content)

    @property
    def statements(self) -> Statements:
        """Statements of the files, with the treatment of each: used, assumed or not used."""
        return self.content.statements

    def close(self) -> None:
        """Close its files."""
        self.content.image.close()  # type: ignore[attr-defined]


@dataclass(frozen=True, repr=False)
class Block:
    """Control points with chips: small image patches of the places of the points.

    Attributes:
        folder: folder of the block.
        metadata: identity, licence and accuracy that the block states.
        points: the n points, as arrays with n rows: `points.id`, `points.lon_lat_h`, and more.
    """

    folder: Path
    metadata: BlockMetadata
    points: ControlPoints

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        frame = self.metadata.frame
        sigma = f"{frame.sigma_m:.2f} m (1 sigma)" if np.isfinite(frame.sigma_m) else "not stated"
        return (
            f"Block {self.metadata.id} {self.metadata.version}: {self.metadata.title}\n"
            f"  {len(self)} points with {len(self.points.views.gsd_m)} chips from "
            f"{len(self.points.views.images)} images\n"
            f"  horizontal accuracy of its frame on the Earth: {sigma}"
        )

    @property
    def chips(self) -> FolderChips:
        """The source of the chips, which are read when they are needed."""
        return FolderChips(self.folder)

    def chips_of(self, row: int) -> Array:
        """The chips (views, 101, 101) of the point in a row; 0 where they have no data."""
        return np.asarray(point_chips(self.points, self.chips, row))


@dataclass(frozen=True, repr=False)
class Terrain:
    """Heights of the ground.

    Attributes:
        file: file of the terrain, with the statements of the caller about it.
        grid: grid of heights, as the modules of `amers.services` use it.
    """

    file: TerrainFile
    grid: TerrainGrid

    def __repr__(self) -> str:
        lines, samples = self.grid.grid.shape
        return (
            f"Terrain {self.file.dem}: {CRS.from_user_input(self.grid.grid.crs).name}\n"
            f"  {lines} x {samples} heights, one every {self.grid.posting_m:.2f} m\n"
            f"  vertical datum: {self.grid.vertical}"
        )

    @property
    def statements(self) -> Statements:
        """Statements of the files, with the treatment of each: used, assumed or not used."""
        return self.grid.statements

    def height_m(self, lon_lat: ArrayLike) -> Array:
        """Heights above the ellipsoid of one place or of many, metres.

        Args:
            lon_lat: (2,) or (n, 2) longitude and latitude, degrees; a third column is not used.

        Returns:
            () or (n,) metres; NaN outside the grid and next to voids.

        Raises:
            InputError: a latitude is beyond 90 degrees, or the shape is wrong.
        """
        places = ground_rows(lon_lat, "lon_lat", columns=(2, 3))
        return one_or_many(self.grid.height_m(places), lon_lat)


def open_scene(
    image: FilePath,
    *,
    model: FilePath | None = None,
    sigma_m: float | None = None,
    bands: str | None = None,
    mask: FilePath | None = None,
    crop_origin: tuple[float, float] | None = None,
) -> Scene:
    """The scene of an image file. An image with a map grid and without a model is an ortho-image.

    Args:
        image: GeoTIFF, JPEG 2000 or NITF; or a product in tiles: its `DIM_….XML`, `.TIL` or folder.
        model: file of the sensor model. By default the model in the image, or in a file next to the
            image with the name that its format defines.
        sigma_m: horizontal accuracy of the model, one standard deviation per coordinate, metres. A
            registration searches up to three times this distance. By default the accuracy that the
            producer states, otherwise that of the sensor, otherwise 50 m; an ortho-image of an unknown
            sensor needs a value.
        bands: numbers of the bands to use, with optional weights, such as "1", "1,2,3" or "3:0.3,2:0.7".
            By default the panchromatic band, or the mean of the visible bands.
        mask: image of the same ground; pixels of the scene are ignored where it is not 0. By default no
            pixel is masked.
        crop_origin: line and sample of the first pixel of the image in the full image of the sensor
            model. By default the position that the files state.

    Raises:
        InputError: the image, its model or its mask cannot be used.
    """
    files = SceneFiles(
        Path(image),
        None if model is None else Path(model),
        sigma_m,
        bands,
        None if mask is None else Path(mask),
        crop_origin=crop_origin,
    )
    mix = None if bands is None else parse_bands(bands)
    content = read_scene(
        files.image,
        files.model,
        sigma_m=sigma_m,
        bands=mix,
        mask=files.mask,
        crop_origin=crop_origin,
    )
    return Scene(files, content)


def open_block(folder: FilePath) -> Block:
    """The block of control points in a folder.

    Raises:
        InputError: a file of the block is missing or unreadable.
    """
    contents = read_block(Path(folder))
    return Block(Path(folder), contents.document.metadata, contents.points)


def open_terrain(
    dem: FilePath | Sequence[FilePath],
    *,
    vertical: str | None = None,
    geoid: FilePath | None = None,
    fill_px: int = 0,
) -> Terrain:
    """The terrain in a file with heights.

    Args:
        dem: GeoTIFF (or COG), JPEG 2000 or NITF on a map: a path or an address, or several tiles; also a
            folder, an archive, a list or a STAC catalogue of tiles.
        vertical: vertical datum of the heights if the file does not state it: "ellipsoid", "EGM96",
            "EGM2008" or the code of a vertical reference system. By default the file must state it.
        geoid: grid file of the geoid. By default the installed grid of PROJ.
        fill_px: fill voids from heights at most this many nodes away. By default 0: voids stay.

    Raises:
        InputError: the file cannot be used, or its vertical datum is unknown.
    """
    source = source_of([dem] if isinstance(dem, str | Path) else dem)
    grid_file = None if geoid is None else Path(geoid)
    file = TerrainFile(source, vertical, grid_file, fill_px, geoid_option="`geoid`")
    return Terrain(file, read_terrain(file))


def as_scene(scene: Scene | FilePath) -> Scene:
    """A scene that is open, or that is opened now with the defaults of `open_scene`."""
    return scene if isinstance(scene, Scene) else open_scene(scene)


def as_block(block: Block | FilePath) -> Block:
    """A block that is open, or that is opened now."""
    return block if isinstance(block, Block) else open_block(block)


def as_terrain(terrain: Terrain | FilePath) -> Terrain:
    """A terrain that is open, or that is opened now with the defaults of `open_terrain`."""
    return terrain if isinstance(terrain, Terrain) else open_terrain(terrain)


def rows_of(values: ArrayLike, name: str, columns: tuple[int, ...]) -> Array:
    """One position, or many, as rows (n, columns) of doubles.

    Raises:
        InputError: the values are no numbers, or have another shape.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: numbers expected: {error}") from None
    if array.ndim not in (1, 2) or array.shape[-1] not in columns:
        shapes = " or ".join(f"({count},) or (n, {count})" for count in columns)
        raise InputError(f"{name}: shape {array.shape} found, {shapes} expected")
    return np.atleast_2d(array)


def ground_rows(lon_lat_h: ArrayLike, name: str, columns: tuple[int, ...] = (3,)) -> Array:
    """One ground position, or many, as rows.

    Raises:
        InputError: the values are no longitudes and latitudes, or have another shape.
    """
    rows = rows_of(lon_lat_h, name, columns)
    for column, (word, limit) in enumerate((("longitude", 360.0), ("latitude", 90.0))):
        beyond = np.flatnonzero(np.abs(rows[:, column]) > limit)
        if len(beyond):
            raise InputError(
                f"{name}: {word} {rows[beyond[0], column]:g} found in row {beyond[0]}, -{limit:g} to "
                f"{limit:g} degrees expected; the order is longitude, latitude, height"
            )
    return rows


def one_or_many(rows: Array, given: ArrayLike) -> Array:
    """Results for rows of positions, without the first axis where one position was given."""
    return rows[0] if np.ndim(given) == 1 else rows
