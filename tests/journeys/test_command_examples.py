"""Every example that the help of a command shows, run as it is written, on small files of its names."""

import csv
import json
import shlex
import shutil
from collections.abc import Mapping
from contextlib import chdir
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import pytest
from pyproj import datadir

from amers.app.cli.examples import EXAMPLES
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import metres_per_degree
from tests.app.flat_world import GROUND_H
from tests.app.test_production_plan import PLAN
from tests.command_line import Done, amers_here, amers_process
from tests.journeys.guide_files import CENTRE, write_geoids, write_guide_files
from tests.service_process import installed_at

pytestmark = [pytest.mark.long, pytest.mark.thorough]

COPIES = {
    "a.tif": "IMG_1.TIF",
    "b.tif": "IMG_2.TIF",
    "c.tif": "later.tif",
    "first.tif": "scenes/first.tif",
    "second.tif": "scenes/second.tif",
    "third.tif": "more.tif",
    "heights.tif": "dem.tif",
    "june.tif": "ortho.tif",
    "may.tif": "ortho.tif",
    "parcels.gpkg": "map.gpkg",
    "other.tif": "more.tif",
    "archive.geojson": "region.geojson",
}
"""Names that examples give to files of the guide."""
COLUMNS = ["id", "image", "line", "sample", "lon", "lat", "height_m", "sigma_horizontal_m", "sigma_up_m"]
ORDER = """
doctor; db upgrade; db status; token create; token list; token revoke; store adopt; reference add;
reference list; production plan; production select; production points; production ortho; production run;
block ingest, block show, block publish, block prioritise, block withdraw; block list; block quality;
points query; points suspend; points suspensions; points reinstate; points intersect;
points experiment; points reach;
block frame; scene register; scene register-many; block renew; scene ortho; scene straighten;
scene mosaic; surface make; surface points; surface difference; vectors canvas; vectors correct;
vectors project; block export; block restore; block delete; audit; store usage;
store sweep; store trash list; store trash restore; store trash empty; db backup;
db verify-backup; store verify; db restore; reference remove; base make; base update; demo; serve; worker
"""
"""All commands, each after those that make what it needs; with commas: all first examples first."""
GROUPS = [[" ".join(name.split()) for name in group.split(",")] for group in ORDER.split(";")]
NOT_RUN = {
    "serve": "runs until a signal: test_demo.py",
    "worker": "runs until a signal: test_worker_ending.py",
    "demo": "takes a minute: test_demo.py",
    "db restore": "needs an empty installation: test_backup.py",
    "store trash restore": "needs what a sweep moved at that time: test_retention.py",
    "points suspend ": "needs the id of a point of the store: test_history.py",
    "points reinstate": "needs the id of a point of the store: test_history.py",
    "scene straighten": "needs a scene whose lines moved: test_straightening.py",
    "production points points.csv --chips": "the guide has it with the chips of a base: test_guide.py",
    "production select https": "contacts a server: test_select_command.py",
    "points query --bbox 5.3,43.5,5.5,43.7 --server": "contacts a server: test_python_client.py",
    "base make --bbox": "contacts a server: test_base.py",
    "base update": "needs images that are newer: test_base.py",
}
"""Beginnings of examples that are not run here, with the tests that run the like."""
REGISTERED = "scene register a.tif b.tif c.tif --block my-block -o registered"
BEFORE = {
    "reference add ortho.tif --name coast --dem": ("reference remove coast",),
    "production select": ("cp country.geojson region.geojson",),
    "production points": ("points intersect marks.csv --images a.tif --images b.tif -o points.csv",),
    "block ingest my-block --priority": ("production run a.tif b.tif c.tif --version 2 -o my-block",),
    "block publish my-block": ("block withdraw my-block",),
    "points intersect marks.csv --images a.tif --images b.tif --registered": (REGISTERED,),
    "block renew": ("scene register first.tif second.tif -o registered",),
    "scene ortho": ("scene register scene.tif --block my-block -o registered",),
    "scene mosaic a.tif b.tif --registered": (REGISTERED,),
    "vectors correct": ("scene register scene.tif --block my-block -o registered",),
    "surface difference": ("cp surface.tif before.tif", "cp surface.tif after.tif"),
    "block withdraw my-block@1": ("block restore my-block@1",),
    "points query": ("block restore my-block@2",),
    "block delete my-block@2": ("block withdraw my-block@2",),
    "reference remove harbour": ("reference add ortho.tif --name harbour --sigma-m 1",),
    "base make": ("cp archive.geojson region.geojson",),
}
"""What is done before an example that begins so, unless the example before it has the same."""
RUNS = [
    line
    for group in GROUPS
    for number in range(2)
    for line in dict.fromkeys(f"{command} {EXAMPLES[command][number]}".strip() for command in group)
    if not line.startswith(tuple(NOT_RUN))
]


@pytest.fixture(scope="module")
def reader(installation: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file of every name that the examples give."""
    folder = tmp_path_factory.mktemp("reader")
    write_guide_files(folder)
    for name, of_guide in COPIES.items():
        shutil.copy(folder / of_guide, folder / name)
    for name in ("ortho.tif", "heights.tif"):
        shutil.copy(folder / name, installation / "references" / name)
    (folder / "configuration.json").write_text(json.dumps(PLAN))
    items = [json.loads(line) for line in (folder / "catalogue.ndjson").read_text().splitlines()]
    (folder / "catalogue.json").write_text(json.dumps({"type": "FeatureCollection", "features": items}))
    write_marks(folder)
    return folder


def write_marks(folder: Path) -> None:
    """Write marks of the same ground in the images that examples name."""
    lon, lat = CENTRE
    per_degree = metres_per_degree(lat, 0.0)
    rows = []
    for number, (east, north) in enumerate(np.random.default_rng(4).uniform(-150.0, 150.0, (24, 2)), 1):
        place = np.array([[lon + east / per_degree[0], lat + north / per_degree[1], GROUND_H]])
        for image in ("a.tif", "b.tif"):
            line, sample = read_scene(folder / image).model.project(place)[0]
            rows.append([f"M{number}", image, line, sample, *place[0], 0.1, 0.1])
    half = len(rows) // 2
    parts = {"marks": rows, "check": rows[:12], "north": rows[:half], "south": rows[half:]}
    for name, some in parts.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            file.write("# pixel-origin=centre heights=ellipsoid\n")
            csv.writer(file).writerows([COLUMNS, *some])


@pytest.fixture(scope="module")
def done(installation: Path, reader: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Done]:
    """What each example does, one after the other."""
    geoids = tmp_path_factory.mktemp("geoids")
    write_geoids(geoids)
    environment = installed_at(
        installation / "data",
        AMERS_REFERENCE_FOLDER=str(installation / "references"),
        PROJ_USER_WRITABLE_DIRECTORY=str(geoids),
    )
    folders_of_proj = datadir.get_data_dir()
    datadir.append_data_dir(str(geoids))
    done = {}
    try:
        with chdir(reader):
            for before, line in pairwise(["", *RUNS]):
                for one in prepared(line) if prepared(line) != prepared(before) else ():
                    done[one] = run(one, environment)
                done[line] = run(line, environment)
    finally:
        datadir.set_data_dir(folders_of_proj)
    return done


def prepared(line: str) -> list[str]:
    """What is done before an example."""
    return [
        one for start, lines in BEFORE.items() if f"{line} ".startswith(f"{start} ") for one in lines
    ]


def run(line: str, environment: Mapping[str, str]) -> Done:
    """Run a line, whose output is new: as a process where it has processes that need geoids."""
    words = shlex.split(line)
    if words[0] == "cp":
        shutil.copy(words[1], words[2])
        return Done(words, 0, "", "")
    if "-o" in words or line.startswith("db backup"):
        output = Path(words[words.index("-o") + 1] if "-o" in words else words[2])
        shutil.rmtree(output) if output.is_dir() else output.unlink(missing_ok=True)
    return (amers_process if line.startswith("scene mosaic") else amers_here)(words, environment)


@pytest.mark.parametrize("line", RUNS)
def test_an_example_runs_as_it_is_written(done: dict[str, Done], line: str):
    for one in (*prepared(line), line):
        assert done[one].returncode == 0, done[one].stdout + done[one].stderr


def test_no_command_is_forgotten():
    assert sorted(chain(*GROUPS)) == sorted(EXAMPLES)
