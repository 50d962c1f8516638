"""From an empty store to a published base in one command: interrupted, with faults, by processes."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from amers.app.config import Settings
from amers.app.usecases.base.making import make_base
from amers.app.usecases.base.request import BaseOptions, BaseRequest
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.new_block import BlockIdentity
from amers.services.errors import NotEnoughPoints
from amers.services.formats import addresses
from tests.app.callers import Bearer, Caller
from tests.app.test_production_run import content, dask_cluster
from tests.command_line import Done, amers_here, environment_of
from tests.open_archive import CENTRE, Faults, OpenArchive, make_archive, running_archive

pytestmark = [pytest.mark.long, pytest.mark.thorough]

LON, LAT = CENTRE
BOX = LON - 0.0125, LAT - 0.009, LON + 0.0125, LAT + 0.009


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> OpenArchive:
    return make_archive(tmp_path_factory.mktemp("open") / "archive", dates=6)


@pytest.fixture(autouse=True)
def nothing_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ports of servers are used again, and blocks in memory would be those of another one."""
    monkeypatch.setattr(addresses, "_KEPT", addresses._KeptBlocks())


def make(archive: OpenArchive, catalogue: str, output: Path, settings: Settings) -> Done:
    output.parent.mkdir(exist_ok=True)
    box = [f"{value:.7f}" for value in BOX]
    words = ["base", "make", "--bbox", *box, "--from", "sentinel-2", "--catalogue", catalogue]
    more = ["--geoid", archive.geoid, "--dates", "3", "--id", "valley", "--jobs", "1", "--publish"]
    return amers_here([*words, *more, "-o", output, "--json"], environment_of(settings))


def states(client: Caller) -> list[tuple[str, str]]:
    found = client.get("/collections/blocks/items").json()["features"]
    return [(one["properties"]["id"], one["properties"]["state"]) for one in found]


def served(client: Caller) -> int:
    box = ",".join(f"{value}" for value in BOX)
    reply = client.get("/collections/points/items", params={"bbox": box, "limit": 1000})
    return len(reply.json()["features"])


def test_one_command_publishes_a_base_from_a_catalogue_with_faults(
    archive: OpenArchive, bearer: Bearer, settings: Settings, tmp_path: Path
) -> None:
    with running_archive(archive, Faults(busy=2, failing=4, uses=12)) as server:
        done = make(archive, server.url, tmp_path / "made" / "valley", settings)
    assert done.returncode == 0, done.stderr
    made = json.loads(done.stdout)
    assert made["state"] == "published"
    assert made["cpu_s_per_point"] > 0.0
    page = Path(made["report"]).read_text()
    assert "Contains modified Copernicus Sentinel data 2021" in page
    report = json.loads(Path(made["report"]).with_suffix(".json").read_text())
    assert sorted({one["date"] for one in report["images"]}) == made["dates"]
    assert report["points"] == made["points"]
    assert served(bearer("admin")) > 0.8 * made["points"] > 15
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"valley", "valley.report"}


def test_a_publication_that_is_interrupted_goes_on_with_the_same_command(
    archive: OpenArchive,
    bearer: Bearer,
    settings: Settings,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    admin = bearer("admin")
    with running_archive(archive) as server:
        for name in ("ingest_block", "publish_block"):
            with monkeypatch.context() as patched:
                patched.setattr(lifecycle, name, interrupted)
                assert make(archive, server.url, tmp_path / "made" / "valley", settings).returncode != 0
            assert not (tmp_path / "made" / "valley").exists()
            assert states(admin) == []
        read = len(server.sent)
        done = make(archive, server.url, tmp_path / "made" / "valley", settings)
        assert len(server.sent) == read, "nothing was read again"
    assert done.returncode == 0, done.stderr
    assert served(admin) > 15
    assert {path.name for path in (tmp_path / "made").iterdir()} == {"valley", "valley.report"}


def test_a_store_that_cannot_be_used_is_named_before_anything_is_read(
    archive: OpenArchive, settings: Settings, tmp_path: Path
) -> None:
    gone = settings.model_copy(update={"data_folder": tmp_path / "file"})
    (tmp_path / "file").write_text("")
    with running_archive(archive) as server:
        done = make(archive, server.url, tmp_path / "made" / "valley", gone)
        assert done.returncode != 0
        assert server.asked == []


def test_processes_and_a_cluster_make_the_same_base_bit_for_bit(
    archive: OpenArchive, tmp_path: Path
) -> None:
    catalogue = str(archive.folder / "items.json")
    request = BaseRequest("sentinel-2", (catalogue,), bbox=BOX, geoid=archive.geoid)

    def made(name: str, compute: ComputeOptions) -> dict[str, str]:
        place = WorkPlace(tmp_path / "work", compute)
        folder = tmp_path / name
        make_base(request, folder, BlockIdentity("b"), BaseOptions(dates=3), place=place)
        return content(folder)

    alone = made("alone", ComputeOptions())
    assert made("processes", ComputeOptions(jobs=2)) == alone
    with dask_cluster(2) as cluster:
        assert made("cluster", ComputeOptions(cluster=cluster.address)) == alone


def test_ground_without_texture_gives_no_points(archive: OpenArchive, tmp_path: Path) -> None:
    flat, rng = tmp_path / "flat", np.random.default_rng(1)
    shutil.copytree(archive.folder, flat)
    for path in (flat / "data").glob("*_red.tif"):
        with rasterio.open(path, "r+") as image:
            image.write(rng.normal(2000.0, 15.0, image.shape).astype(np.uint16), 1)
    catalogue = str(flat / "items.json")
    request = BaseRequest("sentinel-2", (catalogue,), bbox=BOX, geoid=archive.geoid)
    with pytest.raises(NotEnoughPoints, match=r"^0 usable points found"):
        make_base(request, tmp_path / "b", BlockIdentity("b"), BaseOptions(dates=3))
    assert not (tmp_path / "b").exists()
