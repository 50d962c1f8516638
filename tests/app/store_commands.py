"""Every command that uses the store, with arguments that it succeeds with on one small installation.

A new command is added here, or to those that do without the store; a test compares with the commands.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import numpy as np
from pydantic import SecretStr

from amers.app.cli.commands import COMMANDS
from amers.app.cli.on_demand import Group, Tree
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.app.storage import Storage
from amers.app.usecases import storage_identity
from amers.app.usecases.backups.make import make_backup
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.history import suspend_point
from amers.app.usecases.installation import Installation
from amers.app.usecases.references import NewReference, add_reference
from amers.app.usecases.registration.control_sources import points_of_store
from amers.app.usecases.registration.register import (
    ControlSources,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from amers.app.usecases.tokens import create_token
from amers.services.registration.options import RegistrationOptions
from tests.app.conftest import fresh_database
from tests.app.flat_world import CENTRE, SIGMA_M, make_flat_world
from tests.app.joint_world import write_scenes
from tests.app.test_references import SIZE, write
from tests.factories import make_block

Words = tuple[object, ...]
BOX = ",".join(f"{value:.4f}" for value in (*(CENTRE - 0.1), *(CENTRE + 0.1)))
WITHOUT_STORE = {
    "scene mosaic",
    "points experiment",
    "points intersect",
    "points reach",
    "scene ortho",
    "scene straighten",
    "surface difference",
    "surface make",
    "surface points",
    "vectors canvas",
    "vectors correct",
    "vectors project",
    "block frame",
    "production select",
    "production plan",
    "production run",
    "production points",
    "production ortho",
    "db verify-backup",
    "store trash list",
    "store trash restore",
}
"""Commands that work on files alone."""
ON_REQUEST = {"base make", "base update"}
"""Commands that open the store where `--publish` asks for it; `tests/app/test_base.py` has these."""
WITH_PROCESSES = {"demo", "serve", "worker", "doctor"}
"""Commands that run services, which outlive their sessions, or whose result is what does not work."""


@dataclass(frozen=True)
class Place:
    """An installation that one command may change.

    Attributes:
        folder: for what commands write; `data` in it holds the storage.
        made: files that nobody changes: blocks, scenes, references, a backup.
        dsn: of its database.
    """

    folder: Path
    made: Path
    dsn: str

    @property
    def environment(self) -> dict[str, str]:
        """Of commands on this installation."""
        return {
            "PATH": "/usr/bin:/bin",
            "HOME": str(self.folder),
            "AMERS_DATABASE_URL": self.dsn,
            "AMERS_DATA_FOLDER": str(self.folder / "data"),
            "AMERS_REFERENCE_FOLDER": str(self.made),
        }


STORE_COMMANDS: dict[str, Callable[[Place], Words]] = {
    "block ingest": lambda place: (place.made / "new",),
    "block list": lambda place: (),
    "block show": lambda place: ("flat",),
    "block publish": lambda place: ("staged",),
    "block restore": lambda place: ("withdrawn",),
    "block prioritise": lambda place: ("flat", 3),
    "block withdraw": lambda place: ("flat",),
    "block delete": lambda place: ("staged@1",),
    "block export": lambda place: ("--bbox", BOX, "-o", place.folder / "exported"),
    "block quality": lambda place: ("flat", "-o", place.folder / "quality"),
    "block renew": lambda place: ("flat", "--image", place.made / "world/tagged.tif"),
    "points query": lambda place: ("--bbox", BOX, "-o", place.folder / "points.json"),
    "points suspensions": lambda place: (),
    "points suspend": lambda place: (FIRST_POINT + 1, "--because", "rebuilt"),
    "points reinstate": lambda place: (FIRST_POINT,),
    "scene register": lambda place: (
        place.made / "world/tagged.tif",
        *("--sigma-m", SIGMA_M, "-o", place.folder / "registered"),
    ),
    "scene register-many": lambda place: (
        *(place.made / "joint/east.tif", place.made / "joint/south.tif"),
        *("--sigma-m", SIGMA_M, "-o", place.folder / "together"),
    ),
    "reference add": lambda place: ("land.tif", "--name", "south"),
    "reference list": lambda place: (),
    "reference remove": lambda place: ("north",),
    "db upgrade": lambda place: (),
    "db status": lambda place: (),
    "db backup": lambda place: (place.folder / "backup",),
    "db restore": lambda place: (place.made / "backup",),
    "store adopt": lambda place: (),
    "store usage": lambda place: (),
    "store sweep": lambda place: (),
    "store verify": lambda place: ("--rate", 10_000),
    "store trash empty": lambda place: (),
    "token create": lambda place: ("surveyor", "--scope", "read"),
    "token list": lambda place: (),
    "token revoke": lambda place: ("keeper",),
    "audit": lambda place: (),
}
ON_AN_EMPTY_STORE = {"db upgrade", "db restore"}
FIRST_POINT = 1 << 26
"""Id of the first point of the first block."""


def all_commands(tree: Tree = COMMANDS, above: str = "") -> set[str]:
    """The commands of `amers` in words."""
    names: set[str] = set()
    for name, entry in tree.items():
        words = f"{above} {name}".strip()
        names |= all_commands(entry.commands, words) if isinstance(entry, Group) else {words}
    return names


@dataclass(frozen=True)
class Installations:
    """Makes installations of the same content.

    Attributes:
        made: files that nobody changes.
    """

    cluster: Cluster
    made: Path
    filled: str
    empty: str

    @contextmanager
    def new(self, folder: Path, command: str) -> Iterator[Place]:
        """An installation for one run of a command, gone at the end of the context."""
        is_empty = command in ON_AN_EMPTY_STORE
        place = folder / uuid4().hex
        place.mkdir(parents=True)
        if not is_empty:
            shutil.copytree(self.made / "data", place / "data")
        with fresh_database(self.cluster, self.empty if is_empty else self.filled) as dsn:
            yield Place(place, self.made, dsn)
        shutil.rmtree(place)


def fill(dsn: str, made: Path, *, points: int, size: int) -> None:
    """Fill an installation, and write the files that commands take, into a folder."""
    world = make_flat_world(made / "world", size=size, points=points)
    settings = settings_of(dsn, made)
    storage = Storage(settings.data_folder / "storage")
    write(made / "land.tif", np.full((SIZE, SIZE), 300.0, np.float32))
    (made / "joint").mkdir()
    write_scenes(world, made / "joint")
    make_block(made / "new", 3, name="new", seed=9)
    with engine.pooled(dsn, settings) as database:
        assert storage_identity.prepare(database.transaction, storage) is None
        with database.transaction() as connection:
            lifecycle.ingest_block(connection, storage, world.block)
            lifecycle.publish_block(connection, "flat")
            for seed, name in enumerate(("withdrawn", "staged")):
                block = make_block(made / name, 3, name=name, seed=seed)
                lifecycle.ingest_block(connection, storage, block.folder)
            lifecycle.publish_block(connection, "withdrawn")
            lifecycle.withdraw_block(connection, "withdrawn")
            suspend_point(connection, FIRST_POINT, "rebuilt")
            create_token(connection, "keeper", ["read"])
            add_reference(connection, settings, NewReference("north", "land.tif", sigma_m=5.0))
        make_backup(Installation(database, storage, settings), made / "backup")


def register(dsn: str, made: Path) -> None:
    """Record a registration of the scene in a filled installation."""
    settings, scene = settings_of(dsn, made), made / "world/tagged.tif"
    with engine.pooled(dsn, settings) as database:
        storage = Storage(settings.data_folder / "storage")
        registered = run_registration(
            SceneFiles(scene, sigma_m=SIGMA_M),
            ControlSources(points_of_store(database, storage)),
            made / "registered",
            options=RegistrationOptions(max_points=0),
        )
        with database.transaction() as connection:
            record_registration(connection, registered, image_key(scene))


def settings_of(dsn: str, made: Path, data: Path | None = None) -> Settings:
    """Settings of an installation whose other files are in a folder, as its data by default."""
    return Settings(
        database_url=SecretStr(dsn),
        data_folder=data or made / "data",
        reference_folder=made,
        ingest_folder=made,
    )
