"""A surface is the same bytes however it is made: killed in the middle, by processes, on a cluster."""

import hashlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.surface import SurfaceFiles, run_surface
from tests.app.surface_world import OPTIONS, write_view
from tests.app.test_production_run import dask_cluster

pytestmark = [pytest.mark.long, pytest.mark.thorough]

PATIENCE_S = 300.0


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Three views, so that pairs are aligned too."""
    folder = tmp_path_factory.mktemp("images")
    return tuple(write_view(folder, look) for look in ("left", "right", "down"))


def made(images: tuple[Path, ...], output: Path, compute: ComputeOptions) -> str:
    run_surface(SurfaceFiles(images), output, OPTIONS, place=WorkPlace(compute=compute))
    return hash_of(output)


def hash_of(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def alone(images: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the surface made in one process without a break."""
    return made(images, tmp_path_factory.mktemp("alone") / "surface.tif", ComputeOptions())


def kill_in(stage: str, words: list[str], work: Path) -> None:
    """Run a command until a stage has its first result, and kill it."""
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        until = time.monotonic() + PATIENCE_S
        while not list((work / stage).glob("[!.]*")):
            assert process.poll() is None, f"ended before {stage}"
            assert time.monotonic() < until, f"no result of {stage}"
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -signal.SIGKILL


def test_a_command_that_is_killed_in_every_stage_goes_on_to_the_same_bytes(
    images: tuple[Path, ...], alone: str, tmp_path: Path
) -> None:
    output = tmp_path / "surface.tif"
    words = [sys.executable, "-m", "amers", "surface", "make", *map(str, images), "-o", str(output)]
    words += ["--gsd-m", "0.5", "--heights-m", "140,180"]
    work = tmp_path / "surface.tif.work"
    for stage in ("coarse", "pairs", "align", "fuse"):
        kill_in(stage, words, work)
        assert not output.exists()
    assert len(list((work / "pairs").glob("*"))) >= 2
    subprocess.run(words, check=True, capture_output=True)
    assert hash_of(output) == alone
    assert not work.exists()


def test_two_processes_make_the_same_surface_bit_for_bit(
    images: tuple[Path, ...], alone: str, tmp_path: Path
) -> None:
    assert made(images, tmp_path / "surface.tif", ComputeOptions(jobs=2)) == alone


def test_two_workers_of_a_cluster_make_the_same_surface_bit_for_bit(
    images: tuple[Path, ...], alone: str, tmp_path: Path
) -> None:
    with dask_cluster(2) as cluster:
        compute = ComputeOptions(cluster=cluster.address)
        assert made(images, tmp_path / "surface.tif", compute) == alone
