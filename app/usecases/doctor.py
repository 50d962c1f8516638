"""What of an installation and of this machine works, and what to do where something does not."""

import os
import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from importlib.metadata import version

import cv2
import numpy as np
import rasterio
from pyproj import CRS, proj_version_str

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.binaries import find_binaries
from amers.app.errors import AmersError
from amers.app.usecases import storage_identity
from amers.app.usecases.installation import Installation
from amers.app.usecases.operations import existing_folder
from amers.app.usecases.readiness import Readiness, State
from amers.services.formats.elevation.geoid import GRIDS, NAMED, geoid_of_crs

_GIB = float(1 << 30)
_WORKING_BYTES = 2 << 30
"""Room for one registration of a large scene with its files."""
_SOMEWHERE = np.array([2.35, 48.85])


@dataclass(frozen=True)
class Finding:
    """What was found of one part.

    Attributes:
        part: which.
        status: "ok", "degraded" (some work is not possible) or "failed".
        found: in words, and what to do where it is not ok.
    """

    part: str
    status: State
    found: str


def examine(settings: Settings) -> Iterator[Finding]:
    """What of an installation and this machine works: versions, database, storage, page, grids, room."""
    yield _versions()
    yield _machine()
    yield from _database(settings)
    yield _page()
    yield from _geoids()
    yield _room(settings)


def _versions() -> Finding:
    return Finding(
        "versions",
        "ok",
        f"Amers {version('amers')}, Python {platform.python_version()}, PROJ {proj_version_str}, "
        f"GDAL {rasterio.__gdal_version__}, OpenCV {cv2.__version__}, NumPy {np.__version__}",
    )


def _machine() -> Finding:
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    cores = len(os.sched_getaffinity(0))
    found = f"{cores} cores for this process, {memory_bytes / _GIB:.1f} GiB of memory"
    if memory_bytes < _WORKING_BYTES:
        return Finding("machine", "degraded", f"{found}: large scenes need {_WORKING_BYTES / _GIB:.0f}")
    return Finding("machine", "ok", found)


def _database(settings: Settings) -> Iterator[Finding]:
    """The database and the parts that are examined through it; a private one runs meanwhile."""
    try:
        if settings.database_url is None:
            binaries = find_binaries()
            yield Finding("PostgreSQL", "ok", f"version {binaries.version} in {binaries.folder}")
            if not (settings.data_folder / "postgres").exists():
                where = settings.data_folder
                yield Finding(
                    "database", "ok", f"none in {where}: the first command that needs it makes it"
                )
                return
        with engine.opened(settings) as database:
            storage = storage_identity.opened(database, settings)
            readiness = Readiness(Installation(database, storage, settings))
            try:
                parts = readiness.check()
            finally:
                readiness.close()
    except AmersError as error:
        yield Finding("database", "failed", str(error))
        return
    for name, part in parts.items():
        reason = part.reason or "works"
        if name == "worker" and part.status != "ok":
            reason = "none runs: start one with `amers serve` or `amers worker` when jobs wait"
            yield Finding(name, "ok", reason)
        else:
            yield Finding(name, part.status, reason)


def _page() -> Finding:
    page = resources.files("amers.app.web") / "built" / "index.html"
    if page.is_file():
        return Finding("map page", "ok", "built")
    return Finding(
        "map page", "degraded", "not built: run `make page` in the sources; the API works without"
    )


def _geoids() -> Iterator[Finding]:
    """Whether heights above the usual geoids can be converted."""
    for name, code in NAMED.items():
        try:
            geoid_of_crs(CRS(code), _SOMEWHERE)
        except AmersError as error:
            if name in GRIDS:
                yield Finding(f"geoid {name}", "degraded", str(error))
        else:
            yield Finding(f"geoid {name}", "ok", "its grid is installed")


def _room(settings: Settings) -> Finding:
    folder = existing_folder(settings.data_folder)
    free_bytes = shutil.disk_usage(folder).free
    found = f"{free_bytes / _GIB:.1f} GiB free in {folder}"
    if not os.access(folder, os.W_OK):
        return Finding("data folder", "failed", f"{folder}: this user may not write there")
    if free_bytes < max(settings.min_free_bytes, _WORKING_BYTES):
        return Finding("data folder", "degraded", f"{found}: free some room, or set AMERS_DATA_FOLDER")
    return Finding("data folder", "ok", found)
