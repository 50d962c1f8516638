"""Reference images of an installation: registered by an administrator, found for a scene, remembered."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from app.config import Settings
from app.db import references
from app.db.engine import Connection, Database
from app.db.references import ReferenceRow
from app.errors import Conflict, InputError, NotFound
from app.usecases.registration.reference_source import (
    FindReference,
    FoundReference,
    ReferenceFiles,
    read_reference,
)
from app.usecases.server_files import file_below
from app.usecases.terrain_file import TerrainFile
from services.geodesy import ecef_from_lon_lat_h
from services.imagery.scene import Scene, scene_footprint
from services.matching.reference_image import ReferenceMatchingOptions
from services.registration.on_points import Registration
from services.sensors.ortho import OrthoModel
from services.types import Acquisition, Array, BoolArray

LONGEST_NAME = 120


@dataclass(frozen=True)
class NewReference:
    """A reference image that an administrator lets scenes be registered on.

    Attributes:
        name: for people.
        image: path of the ortho-image below AMERS_REFERENCE_FOLDER.
        dem: path of the heights of the same place, there too; without it only ortho-images can be
            registered on the reference.
        vertical: what the heights are counted from, when the file does not say: ellipsoid, EGM96, EPSG:…
        geoid: path of a grid file of the geoid, there too, if PROJ has none.
        sigma_m: how well the image lies on the Earth as a whole, one standard deviation a coordinate.
    """

    name: str
    image: str
    dem: str | None = None
    vertical: str | None = None
    geoid: str | None = None
    sigma_m: float | None = None


def add_reference(connection: Connection, settings: Settings, new: NewReference) -> ReferenceRow:
    """Let scenes be registered on a reference image; its files are opened and stay where they are.

    Raises:
        InputError: no folder is open, a file is not below it or cannot be used, or the name is none.
        Conflict: there is a reference of that name.
    """
    if not 1 <= len(new.name.strip()) <= LONGEST_NAME:
        raise InputError(f"name: 1 to {LONGEST_NAME} characters expected, {len(new.name)} found")
    if new.sigma_m is not None and not 0.0 < new.sigma_m < np.inf:
        raise InputError(f"sigma_m: {new.sigma_m:g} found, more than 0 expected")
    files = _files(settings, new.image, new.dem, new.vertical, new.geoid, new.sigma_m)
    held = read_reference(files)
    assert isinstance(held.model, OrthoModel)
    scene = Scene(held.image, held.model, Acquisition(new.name), 0.0)
    row = references.insert_reference(
        connection,
        name=new.name.strip(),
        image=new.image,
        dem=new.dem,
        vertical=new.vertical,
        geoid=new.geoid,
        sigma_m=new.sigma_m,
        gsd_m=held.model.grid.gsd_m,
        outline=scene_footprint(scene),
    )
    if row is None:
        raise Conflict(f"there is a reference {new.name!r} already")
    return row


def list_references(connection: Connection) -> list[ReferenceRow]:
    """All references, by name."""
    return references.list_references(connection)


def remove_reference(connection: Connection, name: str) -> None:
    """Use a reference no longer; the places found on it are forgotten, its files stay where they are.

    Raises:
        NotFound: there is none of that name.
    """
    if not references.delete_reference(connection, name):
        raise NotFound(f"no reference {name:.120}")


def references_of_store(database: Database, settings: Settings) -> FindReference:
    """The references of the installation, with the places that earlier scenes were found by."""

    def find(outline: Array) -> FoundReference | None:
        with database.transaction() as connection:
            row = references.best_reference(connection, outline)
            if row is None:
                return None
            known = references.places_inside(connection, row.id, outline, worthwhile=True)
        files = _files(settings, row.image, row.dem, row.vertical, row.geoid, row.sigma_m)
        return FoundReference(row.name, files, row.id, row.gsd_m, known.lon_lat_h)

    return find


def keep_places(
    connection: Connection, found: FoundReference, registration: Registration, outline: Array
) -> None:
    """Remember where a scene was found on a reference, for the next scene of the same ground.

    Places nearer each other than half a search window show the same ground and are one; so many
    scenes do not leave more places than the ground has room for. A failed registration leaves none.

    Args:
        outline: (m, 2) lon, lat that holds the scene.
    """
    if found.id is None or registration.qualification.verdict == "failed":
        return
    if not references.lock_reference(connection, found.id):
        return
    measures = registration.measures
    tried = np.isfinite(measures.lon_lat_h).all(axis=1) & (measures.reason != "nodata")
    kept = references.places_inside(connection, found.id, outline, worthwhile=False)
    apart_m = ReferenceMatchingOptions().window_px / 2.0 * found.gsd_m
    place = ecef_from_lon_lat_h(measures.lon_lat_h[tried])
    active = measures.active[tried]
    same = np.full(len(place), len(kept.id))
    if len(kept.id):
        _, same = cKDTree(ecef_from_lon_lat_h(kept.lon_lat_h)).query(place, distance_upper_bound=apart_m)
    again = same < len(kept.id)
    ids, first = np.unique(same[again], return_inverse=True)
    seen = np.bincount(first, weights=active[again], minlength=len(ids)) > 0
    references.count_places(connection, kept.id[ids], seen)
    new = np.flatnonzero(~again & active)
    new = new[_apart(place[new], apart_m)]
    references.insert_places(connection, found.id, measures.lon_lat_h[tried][new])


def _apart(ecef: Array, apart_m: float) -> BoolArray:
    """Places (n, 3) of which none is too near an earlier one of them."""
    kept = np.ones(len(ecef), dtype=bool)
    if len(ecef):
        for first, second in sorted(cKDTree(ecef).query_pairs(apart_m)):
            kept[second] &= not kept[first]
    return kept


def _files(
    settings: Settings,
    image: str,
    dem: str | None,
    vertical: str | None,
    geoid: str | None,
    sigma_m: float | None,
) -> ReferenceFiles:
    """The files of a reference on this machine.

    Raises:
        InputError: no folder is open, or a path is not one of a file below it.
    """
    terrain = None
    if dem is not None:
        grid = None if geoid is None else _below(settings, "geoid", geoid)
        terrain = TerrainFile(_below(settings, "dem", dem), vertical, grid)
    elif vertical is not None or geoid is not None:
        raise InputError("vertical, geoid: of the heights of a dem, which is not given")
    return ReferenceFiles(_below(settings, "image", image), terrain, sigma_m)


def _below(settings: Settings, name: str, path: str) -> Path:
    """A file below AMERS_REFERENCE_FOLDER."""
    if settings.reference_folder is None:
        raise InputError("no reference image can be used: AMERS_REFERENCE_FOLDER is not set")
    return file_below(settings.reference_folder, path, name, "AMERS_REFERENCE_FOLDER")
