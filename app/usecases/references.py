"""Reference images of an installation: add, list, find one for a scene, record where scenes matched."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from amers.app.config import Settings
from amers.app.db import references
from amers.app.db.engine import Connection, Database
from amers.app.db.references import ReferenceRow
from amers.app.errors import Conflict, InputError, NotFound
from amers.app.usecases.registration.reference_source import (
    CoveringReference,
    FindReference,
    ReferenceFiles,
    read_reference,
)
from amers.app.usecases.server_files import file_below
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.pieces import CATALOGUES
from amers.services.geodesy import ecef_from_lon_lat_h
from amers.services.imagery.scene import Scene, scene_footprint
from amers.services.matching.reference_image import ReferenceMatchingOptions
from amers.services.registration.on_points import Registration
from amers.services.registration.scene_marks import without_marks
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array, BoolArray

LONGEST_NAME = 120


@dataclass(frozen=True)
class NewReference:
    """A reference image that an administrator adds; paths are relative to AMERS_REFERENCE_FOLDER.

    Attributes:
        name: for people, unique.
        image: path of the ortho-image.
        dem: path of the heights of the same ground; without it only ortho-images can be registered.
        vertical: vertical datum of the heights (ellipsoid, EGM96, EPSG:…), where the file states none.
        geoid: path of a grid file of the geoid, where PROJ has none.
        sigma_m: accuracy of the image's frame on the Earth, one standard deviation per coordinate.
        sigma_up_m: the same of the heights.
    """

    name: str
    image: str
    dem: str | None = None
    vertical: str | None = None
    geoid: str | None = None
    sigma_m: float | None = None
    sigma_up_m: float | None = None


def add_reference(connection: Connection, settings: Settings, new: NewReference) -> ReferenceRow:
    """Add a reference image; its files are opened to check them, and stay in their folder.

    Raises:
        InputError: AMERS_REFERENCE_FOLDER is not set, or the name or a file cannot be used.
        Conflict: another reference has this name.
    """
    if not 1 <= len(new.name.strip()) <= LONGEST_NAME:
        raise InputError(f"name: 1 to {LONGEST_NAME} characters expected, {len(new.name.strip())} found")
    for name, value in (("sigma_m", new.sigma_m), ("sigma_up_m", new.sigma_up_m)):
        if value is not None and not 0.0 < value < np.inf:
            raise InputError(f"{name}: {value:g} found, more than 0 expected")
    reference = read_reference(reference_files(settings, new))
    assert isinstance(reference.model, OrthoModel)
    scene = Scene(reference.image, reference.model, Acquisition(new.name), 0.0)
    image = references.NewReferenceImage(
        name=new.name.strip(),
        image=new.image,
        dem=new.dem,
        vertical=new.vertical,
        geoid=new.geoid,
        sigma_m=new.sigma_m,
        sigma_up_m=new.sigma_up_m,
        gsd_m=reference.model.grid.gsd_m,
        checksums={
            path: _sha256(_path_below(settings, field, path))
            for field, path in (("image", new.image), ("dem", new.dem), ("geoid", new.geoid))
            if path is not None
        },
    )
    row = references.insert_reference(connection, image, scene_footprint(scene))
    if row is None:
        raise Conflict(f"name: there is a reference {new.name!r} already; choose another name")
    return row


def list_references(connection: Connection) -> list[ReferenceRow]:
    """All references, by name."""
    return references.list_references(connection)


def remove_reference(connection: Connection, name: str) -> None:
    """Delete a reference with the places recorded on it; its files stay in their folder.

    Raises:
        NotFound: there is no reference of this name.
    """
    if not references.delete_reference(connection, name):
        raise NotFound(f"no reference {name:.120}")


def references_of_store(database: Database, settings: Settings) -> FindReference:
    """A source of the installation's references, with the places where earlier scenes matched them."""

    def find(outline: Array) -> CoveringReference | None:
        with database.snapshot() as connection:
            row = references.best_reference(connection, outline)
            if row is None:
                return None
            places = references.places_inside(connection, row.id, outline, worthwhile=True)
        return CoveringReference(
            row.name, reference_files(settings, row), row.id, row.gsd_m, places.lon_lat_h
        )

    return find


def record_places(
    connection: Connection, covering: CoveringReference, registration: Registration, outline: Array
) -> None:
    """Record where a scene matched a reference, for later scenes of the same ground.

    Places nearer to each other than half a search window show the same ground and count as one, so the
    number of places on a piece of ground is limited. A failed registration is not recorded.

    Args:
        connection: with the transaction that stores the registration.
        covering: the reference.
        registration: of the scene on the reference.
        outline: (m, 2) lon, lat that contains the scene.
    """
    if covering.id is None or registration.qualification.verdict == "failed":
        return
    if not references.lock_reference(connection, covering.id):
        return
    measures = without_marks(registration.measures)
    is_tried = np.isfinite(measures.lon_lat_h).all(axis=1)
    is_tried &= ~np.isin(measures.reason, ("nodata", "saturated"))
    earlier = references.places_inside(connection, covering.id, outline, worthwhile=False)
    apart_m = ReferenceMatchingOptions().window_px / 2.0 * covering.gsd_m
    place = ecef_from_lon_lat_h(measures.lon_lat_h[is_tried])
    is_active = measures.active[is_tried]
    nearest = np.full(len(place), len(earlier.id))
    if len(earlier.id):
        tree = cKDTree(ecef_from_lon_lat_h(earlier.lon_lat_h))
        _, nearest = tree.query(place, distance_upper_bound=apart_m)
    is_again = nearest < len(earlier.id)
    rows, row_of_place = np.unique(nearest[is_again], return_inverse=True)
    is_matched = np.bincount(row_of_place, weights=is_active[is_again], minlength=len(rows)) > 0
    references.count_places(connection, earlier.id[rows], is_matched)
    new = np.flatnonzero(~is_again & is_active)
    new = new[_mutually_apart(place[new], apart_m)]
    references.insert_places(connection, covering.id, measures.lon_lat_h[is_tried][new])


def _mutually_apart(ecef: Array, apart_m: float) -> BoolArray:
    """Which places (n, 3) to take so that no two of them are nearer than a distance; the first stays."""
    is_taken = np.ones(len(ecef), dtype=bool)
    if len(ecef):
        for first, second in sorted(cKDTree(ecef).query_pairs(apart_m)):
            is_taken[second] &= not is_taken[first]
    return is_taken


def reference_files(settings: Settings, reference: NewReference | ReferenceRow) -> ReferenceFiles:
    """The files of a reference on this machine.

    Raises:
        InputError: AMERS_REFERENCE_FOLDER is not set, or a path does not lead to a file below it.
    """
    terrain = None
    if reference.dem is not None:
        geoid = None if reference.geoid is None else _path_below(settings, "geoid", reference.geoid)
        dem = _path_below(settings, "dem", reference.dem)
        terrain = TerrainFile(dem, reference.vertical, geoid)
    elif reference.vertical is not None or reference.geoid is not None:
        raise InputError(
            "vertical, geoid: given without dem, whose heights they describe; add dem, or leave them out"
        )
    image = _path_below(settings, "image", reference.image)
    for path in (reference.image, reference.dem or ""):
        if path.lower().endswith(CATALOGUES):
            raise InputError(
                f"{path}: a catalogue leads to files elsewhere; an image below AMERS_REFERENCE_FOLDER "
                "expected"
            )
    return ReferenceFiles(image, terrain, reference.sigma_m, reference.sigma_up_m)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _path_below(settings: Settings, field: str, path: str) -> Path:
    """The path of a file below AMERS_REFERENCE_FOLDER."""
    if settings.reference_folder is None:
        raise InputError(
            f"{field}: reference images cannot be used, because AMERS_REFERENCE_FOLDER is not set"
        )
    return file_below(settings.reference_folder, path, field, "AMERS_REFERENCE_FOLDER")
