"""`amers production run` in one process, several, or on a cluster: the same block, also after kills."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
import rasterio
from distributed import Client
from rasterio.transform import from_origin

from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.app.usecases.ground_classes import GroundFiles
from amers.app.usecases.image_production import ProductionImages, WorkPlace, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.services.adjustment import block_parts, dissection, reduced_system
from amers.services.adjustment.bundle import adjust_block
from amers.services.formats.block.reader import read_block
from amers.services.formats.images.raster import write_raster
from amers.services.production.image_production import Production
from amers.services.tasks import Arrays, Work
from benchmarks.block_adjustment import large_block
from tests.service_process import free_port
from tests.services import simulated
from tests.services.simulated import BLOCK_SIGMA_M, block_views, world

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SECONDS_TO_START = 60.0
OPTIONS = replace(simulated.OPTIONS, surface_pairs=1)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ProductionImages:
    folder = tmp_path_factory.mktemp("images")
    for view in block_views():
        path = folder / f"{view.geometry.acquisition.image_id}.tif"
        write_raster(path, view.pixels, view.geometry.delivered)
    return ProductionImages(tuple(sorted(folder.glob("*.tif"))), sigma_m=BLOCK_SIGMA_M)


def content(block: Path) -> dict[str, str]:
    """Hashes of all files of a block but the document, which states when it was made."""
    return {
        str(file.relative_to(block)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(block.rglob("*"))
        if file.is_file() and file.name != "block.json"
    }


def make(images: ProductionImages, folder: Path, place: WorkPlace) -> dict[str, str]:
    run_image_production(images, folder, BlockIdentity("made"), OPTIONS, place=place)
    return content(folder)


def test_a_production_whose_report_was_not_written_goes_on(
    images: ProductionImages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody puts a file into the place of its report while it works."""
    folder, module = tmp_path / "block", "amers.app.usecases.image_production"
    with monkeypatch.context() as patched:
        patched.setattr(
            f"{module}.adjustment_report",
            lambda *_, **__: (tmp_path / "block.adjustment").write_text("of somebody"),
        )
        with pytest.raises(InputError, match=r"block\.adjustment: is a file"):
            make(images, folder, WorkPlace())
    assert not folder.exists()
    (tmp_path / "block.adjustment").unlink()
    make(images, folder, WorkPlace())
    assert (tmp_path / "block.adjustment" / "report.html").exists()


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the block made in one process, once there is a `production`."""
    return tmp_path_factory.mktemp("alone") / "block"


@pytest.fixture(scope="module")
def production(images: ProductionImages, block: Path) -> Production:
    """The block made in one process."""
    return run_image_production(images, block, BlockIdentity("made"), OPTIONS)


@pytest.fixture(scope="module")
def alone(block: Path, production: Production) -> dict[str, str]:
    """The content of the block made in one process."""
    return content(block)


@dataclass(frozen=True)
class Cluster:
    """A scheduler of Dask and its workers, each a process."""

    address: str
    workers: list[subprocess.Popen[bytes]]


@contextmanager
def dask_cluster(count: int) -> Iterator[Cluster]:
    """A scheduler and workers of one thread each on the loopback, ended at the end."""

    def begin(*words: str) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        return subprocess.Popen(
            [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    address = f"tcp://127.0.0.1:{(port := free_port())}"
    started = [begin("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")]
    try:
        for _ in range(count):
            worker = ("--nthreads", "1", "--nworkers", "1", "--no-nanny", "--no-dashboard")
            started.append(begin("dask_worker", address, "--host", "127.0.0.1", *worker))
        with Client(address, timeout=SECONDS_TO_START) as client:
            client.wait_for_workers(count, timeout=SECONDS_TO_START)
        yield Cluster(address, started[1:])
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def test_several_processes_make_the_same_block_bit_for_bit(images, alone, tmp_path) -> None:
    assert make(images, tmp_path / "block", WorkPlace(compute=ComputeOptions(jobs=2))) == alone


@pytest.mark.endurance
def test_a_cluster_makes_the_same_block_bit_for_bit(images, alone, tmp_path) -> None:
    with dask_cluster(2) as cluster:
        place = WorkPlace(compute=ComputeOptions(cluster=cluster.address))
        assert make(images, tmp_path / "block", place) == alone


@contextmanager
def slowed(worker: subprocess.Popen[bytes]) -> Iterator[None]:
    """A worker that is let work for a fifth of the time."""
    ended = Event()

    def hold() -> None:
        while not ended.wait(0.1):
            worker.send_signal(signal.SIGSTOP)
            ended.wait(0.4)
            worker.send_signal(signal.SIGCONT)

    thread = Thread(target=hold)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_a_worker_that_is_killed_beside_a_slow_one_changes_nothing(images, alone, tmp_path) -> None:
    work = tmp_path / "work"
    with dask_cluster(2) as cluster, slowed(cluster.workers[1]):
        killed = []

        def kill_one(fraction: float, message: str) -> None:
            # Several tasks may end between two messages: the first one comes while some are computed.
            if message.startswith("measures: ") and not killed:
                os.kill(cluster.workers[0].pid, signal.SIGKILL)
                killed.append(message)

        place = WorkPlace(work, ComputeOptions(cluster=cluster.address))
        run_image_production(
            images, tmp_path / "block", BlockIdentity("made"), OPTIONS, place=place, progress=kill_one
        )
        assert killed
    assert content(tmp_path / "block") == alone


def test_a_block_is_adjusted_in_parts_bit_for_bit_though_a_worker_is_killed(monkeypatch) -> None:
    monkeypatch.setattr(block_parts, "PART_OBSERVATIONS", 1000)
    monkeypatch.setattr(dissection, "GROUP_ROWS", 100)
    monkeypatch.setattr(dissection, "DIRECT_ROWS", 100)
    monkeypatch.setattr(reduced_system, "DENSE_ROWS", 100)
    _, images, observations, passes = large_block(60, 60, seed=3, blunders=0.05)
    here = Work()
    alone = adjust_block(images, observations, passes=passes, work=here)
    with dask_cluster(2) as cluster, open_executor(ComputeOptions(cluster=cluster.address)) as opened:

        class Killing(dict[str, Arrays]):
            """Kills a worker when the first step is kept."""

            def __setitem__(self, name: str, arrays: Arrays) -> None:
                cluster.workers[0].kill()
                super().__setitem__(name, arrays)

        work = Work(opened[0], Killing(), opened[1])
        block = adjust_block(images, observations, passes=passes, work=work)
    assert cluster.workers[0].poll() is not None
    assert work.effort["adjust"].tasks == here.effort["adjust"].tasks > 50
    for name in ("values", "lon_lat_h", "point_covariance_m2", "residual_px", "active"):
        np.testing.assert_array_equal(getattr(block, name), getattr(alone, name))


class StoppedHereError(Exception):
    """Somebody stopped the production."""


@pytest.mark.parametrize(
    "stage",
    [
        pytest.param("features", marks=pytest.mark.endurance),
        "matches",
        pytest.param("measures", marks=pytest.mark.endurance),
        "points",
    ],
)
def test_an_interrupted_production_goes_on_from_where_it_was(
    images, alone, tmp_path, monkeypatch, stage
) -> None:
    def stop(fraction: float, message: str) -> None:
        if message.startswith(f"{stage}: 1 "):
            raise StoppedHereError

    folder = tmp_path / "block"
    with pytest.raises(StoppedHereError):
        run_image_production(images, folder, BlockIdentity("made"), OPTIONS, progress=stop)
    assert not folder.exists()
    work = tmp_path / "block.work"
    kept = {file: file.stat().st_mtime_ns for file in work.rglob("*.npy")}
    assert kept
    place = WorkPlace(work)
    assert make(images, folder, place) == alone
    assert {file: file.stat().st_mtime_ns for file in kept} == kept, "computed again"


def test_the_work_folder_is_gone_when_the_block_is_complete(block, production) -> None:
    assert sorted(file.name for file in block.parent.iterdir()) == ["block", "block.adjustment"]


def test_the_adjustment_is_reported_image_by_image_and_point_by_point(images, block, production) -> None:
    folder = block.parent / "block.adjustment"
    report = json.loads((folder / "report.json").read_text())
    assert [image["name"] for image in report["images"]] == [file.stem for file in images.files]
    assert {image["verdict"] for image in report["images"]} == {"fits"}
    assert all(0.5 * image["measures"] < image["used"] for image in report["images"])
    assert report["on_the_earth"]["words"].startswith("CE90")
    surface = production.points.surface
    assert sum(report["points_without_surface"].values()) == int(np.isnan(surface.height_m).sum())
    lines = (folder / "points.csv").read_text().splitlines()
    assert len(lines) == 1 + len(production.points)
    columns = dict(zip(lines[0].split(","), lines[1].split(","), strict=True))
    assert float(columns["lon"]) == pytest.approx(production.points.lon_lat_h[0, 0], abs=1e-7)
    assert int(columns["used"]) >= OPTIONS.min_views
    page = (folder / "report.html").read_text()
    assert all(file.stem in page for file in images.files)


def test_points_stand_on_the_land_cover_and_not_on_water_or_excluded_ground(images, tmp_path) -> None:
    """West of the middle lies water; of the rest, trees and buildings, the north is excluded."""
    lon, lat = world().centre_lon_lat
    cover = np.full((100, 100), 10, dtype=np.uint8)
    cover[:, :50], cover[:, 75:] = 80, 50
    grid = from_origin(lon - 0.01, lat + 0.01, 0.0002, 0.0002)
    form = {"driver": "GTiff", "width": 100, "height": 100, "count": 1, "dtype": "uint8"}
    with rasterio.open(tmp_path / "cover.tif", "w", **form, crs="EPSG:4326", transform=grid) as file:
        file.write(cover, 1)
    north = [[lon - 1, lat], [lon + 1, lat], [lon + 1, lat + 1], [lon - 1, lat + 1], [lon - 1, lat]]
    polygon = {"type": "Polygon", "coordinates": [north]}
    (tmp_path / "north.geojson").write_text(json.dumps(polygon))
    ground = GroundFiles((tmp_path / "north.geojson",), tmp_path / "cover.tif")
    made = run_image_production(
        replace(images, ground=ground), tmp_path / "block", BlockIdentity("made"), OPTIONS
    )
    places = made.points.lon_lat_h[:, :2]
    a_metre = 1e-5
    assert len(places) >= 6
    assert (places[:, 0] > lon - a_metre).all()
    assert (places[:, 1] < lat + a_metre).all()
    contents = read_block(tmp_path / "block")
    on_trees = contents.points.lon_lat_h[:, 0] < lon + 0.005
    expected = np.where(on_trees, "trees", "buildings")
    assert contents.typology.tolist() == expected.tolist()


def test_work_on_other_images_is_refused(images, tmp_path) -> None:
    work = WorkPlace(tmp_path / "work")
    fewer = ProductionImages(images.files[:2], sigma_m=BLOCK_SIGMA_M)

    def stop(fraction: float, message: str) -> None:
        if message.startswith("features: 1 "):
            raise StoppedHereError

    with pytest.raises(StoppedHereError):
        run_image_production(
            images, tmp_path / "a", BlockIdentity("a"), OPTIONS, place=work, progress=stop
        )
    with pytest.raises(InputError, match=r"other inputs.*--work"):
        run_image_production(fewer, tmp_path / "b", BlockIdentity("b"), OPTIONS, place=work)


def test_a_cluster_that_does_not_answer_is_named(images, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("amers.app.usecases.executors._SECONDS_TO_CONNECT", 1)
    place = WorkPlace(compute=ComputeOptions(cluster="tcp://127.0.0.1:9"))
    with pytest.raises(InputError, match=r"--cluster: tcp://127\.0\.0\.1:9: no scheduler"):
        run_image_production(images, tmp_path / "block", BlockIdentity("made"), OPTIONS, place=place)


def test_what_is_made_is_a_valid_block(block, production) -> None:
    points = read_block(block).points
    assert len(points) > 20
    assert np.isfinite(points.lon_lat_h).all()


@pytest.mark.long
@pytest.mark.thorough
def test_a_block_of_images_that_state_no_accuracy_says_that_it_was_assumed(images, tmp_path) -> None:
    folder = tmp_path / "block"
    run_image_production(replace(images, sigma_m=None), folder, BlockIdentity("unstated"), OPTIONS)
    (frame,) = read_block(folder).points.frames
    assert frame.assumed == (
        "50 m for the models of 3 of 3 images, which state none; give --sigma-m or --control"
    )
    report = json.loads((tmp_path / "block.adjustment" / "report.json").read_text())
    assert report["on_the_earth"]["words"].endswith(f": assumed: {frame.assumed}")
    page = (tmp_path / "block.adjustment" / "report.html").read_text()
    assert 'class="verdict usable"' in page
