"""Amers: an open base of 3D ground control points, and the registration of satellite scenes on them.

These names are the library; `docs/library.md` shows them at work. They are loaded on their first use, so
that `import amers` costs nothing. All other modules may change from one version to the next.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from amers.app.client import Client as Client
    from amers.app.client import ServiceError as ServiceError
    from amers.geometry import TiePoints as TiePoints
    from amers.geometry import locate as locate
    from amers.geometry import match_images as match_images
    from amers.geometry import project as project
    from amers.opened import Block as Block
    from amers.opened import Scene as Scene
    from amers.opened import Terrain as Terrain
    from amers.opened import open_block as open_block
    from amers.opened import open_scene as open_scene
    from amers.opened import open_terrain as open_terrain
    from amers.services.errors import AmersError as AmersError
    from amers.services.errors import ComputationError as ComputationError
    from amers.services.errors import InputError as InputError
    from amers.tasks import correct_vectors as correct_vectors
    from amers.tasks import mosaic as mosaic
    from amers.tasks import orthorectify as orthorectify
    from amers.tasks import produce_points as produce_points
    from amers.tasks import refine as refine
    from amers.tasks import register as register
    from amers.tasks import register_on_reference as register_on_reference
    from amers.tasks import register_together as register_together
    from amers.tasks import straighten as straighten
    from amers.tasks import surface as surface

__all__ = [
    "AmersError",
    "Block",
    "Client",
    "ComputationError",
    "InputError",
    "Scene",
    "ServiceError",
    "Terrain",
    "TiePoints",
    "correct_vectors",
    "locate",
    "match_images",
    "mosaic",
    "open_block",
    "open_scene",
    "open_terrain",
    "orthorectify",
    "produce_points",
    "project",
    "refine",
    "register",
    "register_on_reference",
    "register_together",
    "straighten",
    "surface",
]
_MODULES = {
    "amers.app.client": ("Client", "ServiceError"),
    "amers.geometry": ("TiePoints", "locate", "match_images", "project"),
    "amers.opened": ("Block", "Scene", "Terrain", "open_block", "open_scene", "open_terrain"),
    "amers.services.errors": ("AmersError", "ComputationError", "InputError"),
    "amers.tasks": (
        "correct_vectors",
        "mosaic",
        "orthorectify",
        "produce_points",
        "refine",
        "register",
        "register_on_reference",
        "register_together",
        "straighten",
        "surface",
    ),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("amers")
    if name not in _HOME:
        raise AttributeError(f"module 'amers' has no attribute {name!r}")
    with _installed_packages_first():
        value: object = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


@contextmanager
def _installed_packages_first() -> Iterator[None]:
    """Import packages from where they are installed, not modules of their names in the working folder.

    Python looks in the folder of a script first, or in the working folder. People work in folders that
    have a `numpy.py` or an `app.py` of their own.
    """
    before = sys.path[:]
    here = {"", os.getcwd() if os.path.isdir(".") else ""}
    sys.path.sort(key=lambda place: place in here)
    try:
        yield
    finally:
        sys.path[:] = before
