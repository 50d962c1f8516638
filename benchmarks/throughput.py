"""Many small scenes by one command and by the service, beside the registration alone.

One simulated block and a few simulated scenes of it, linked under many names, so that the making does
not dominate. Three ways register them: `register_scene` in a warm process, without files; `amers scene
register FOLDER --jobs 2`; and the service with two workers, by an upload and a job per scene. CPU time
is that of all processes, with their children and the database. The stages are timed in a warm process.
Run: python -m benchmarks.throughput --scenes 200
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from amers.app.usecases import report_files
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.registration import register
from amers.app.usecases.registration.control_sources import points_of_block
from amers.app.usecases.registration.register import ControlSources, SceneFiles, run_registration
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.production.image_production import ProductionOptions
from amers.services.registration.on_points import register_scene
from amers.services.simulation.view import ViewPlan, simulate_block, simulate_view
from amers.services.simulation.world import make_world
from benchmarks._measuring import keep
from benchmarks._servers import running
from tests.service_process import free_port, until

SHAPE = (2000, 2000)
GSD_M = 1.0
ERROR_M = (32.0, -22.0)
SKEW_PX = 1.0
SIGMA_M = float(np.hypot(*ERROR_M))
DISTINCT_SCENES = 2
WORKERS = 2
AMERS = (sys.executable, "-m", "amers")
OPEN_JOBS = 6
POLL_S = 2.0
"""Interval of the requests for the states of open jobs, which cost the API CPU time too."""
PATIENCE_S = 300.0
ENDED = ("successful", "failed", "dismissed")
TICKS = os.sysconf("SC_CLK_TCK")


def run(scenes: int, repeats: int) -> dict[str, Any]:
    """Register scenes in three ways; returns CPU and elapsed seconds, and shares of stages."""
    with tempfile.TemporaryDirectory(prefix="amers-throughput-") as temporary:
        folder = Path(temporary)
        # Started by root, the database server runs as another user, who has to enter the folder.
        folder.chmod(0o711)
        made = make_scenes(folder, scenes)
        alone_s, stages_s = in_process(folder, made[:DISTINCT_SCENES], repeats)
        command = by_command(folder, scenes)
        service = by_service(folder, made)
    for way in (command, service):
        way["ratio"] = way["cpu_s"] / alone_s
        way["scenes_per_hour_and_core"] = 3600.0 / way["cpu_s"]
    return {
        "scenes": scenes,
        "distinct_scenes": DISTINCT_SCENES,
        "shape": SHAPE,
        "register_scene_cpu_s": alone_s,
        "stages_cpu_s": stages_s,
        "command": command,
        "service": service,
    }


def make_scenes(folder: Path, count: int) -> list[Path]:
    """Write a block and scenes whose models are wrong by a shift and a skew; returns the images."""
    rng = np.random.default_rng(1)
    world = make_world(rng, 2600.0, 1.0, 120.0)
    views = simulate_block(world, rng, n_views=4, shape=(2200, 2200), gsd_m=GSD_M, error_m=4.0)
    (folder / "images").mkdir()
    (folder / "scenes").mkdir()
    sources = []
    for view in views:
        sources.append(folder / "images" / f"{view.geometry.plan.image_id}.tif")
        write_raster(sources[-1], view.pixels, view.geometry.delivered)
    identity = BlockIdentity("throughput", title="Simulated", license="CC0-1.0")
    given, options = ProductionImages(tuple(sources), sigma_m=4.0), ProductionOptions(2.0, 20.0)
    run_image_production(given, folder / "block", identity, options)
    lon, lat = (float(value) for value in world.centre_lon_lat)
    skew_px = np.array([[0.0, 0.0, SKEW_PX], [0.0, SKEW_PX, 0.0]])
    images = []
    for number in range(count):
        image = folder / "scenes" / f"scene_{number:04d}.tif"
        images.append(image)
        if number >= DISTINCT_SCENES:
            os.link(images[number % DISTINCT_SCENES], image)
            continue
        plan = ViewPlan(
            image_id=image.stem,
            lon_lat=(lon, lat),
            shape=SHAPE,
            gsd_m=GSD_M,
            incidence_deg=12.0,
            azimuth_deg=100.0 + 90.0 * number,
            acquired_at=datetime(2024, 8, 20, 10, 30, tzinfo=UTC),
        )
        view = simulate_view(world, plan, rng, ERROR_M, skew_px)
        write_raster(image, view.pixels, view.geometry.delivered)
    return images


def in_process(folder: Path, images: list[Path], repeats: int) -> tuple[float, dict[str, float]]:
    """CPU seconds per scene of `register_scene` alone, and of the stages of `run_registration`."""
    block, chips = read_block(folder / "block"), FolderChips(folder / "block")
    alone: list[float] = []
    for turn in range(repeats + 1):
        for image in images:
            scene = read_scene(image, sigma_m=SIGMA_M)
            started = time.process_time()
            register_scene(scene, block.points, chips)
            if turn > 0:
                alone.append(time.process_time() - started)
    stages: dict[str, float] = defaultdict(float)
    sources = ControlSources(points_of_block(folder / "block"))
    with _timed(stages):
        for turn in range(repeats + 1):
            if turn == 1:
                stages.clear()
            for number, image in enumerate(images):
                started = time.process_time()
                run_registration(
                    SceneFiles(image, sigma_m=SIGMA_M), sources, folder / "warm" / str(number)
                )
                stages["all"] += time.process_time() - started
    runs = repeats * len(images)
    per_scene = {name: value / runs for name, value in stages.items()}
    per_scene["deliverables"] -= per_scene["page"]
    figures = per_scene.pop("page") + per_scene.pop("figure data")
    named = {
        "reading": per_scene["reading"],
        "registration": per_scene["registration"],
        "refit": per_scene["refit"],
        "figures": figures,
        "deliverables": per_scene["deliverables"],
    }
    return float(np.mean(alone)), {**named, "other": per_scene["all"] - sum(named.values())}


@contextmanager
def _timed(stages: dict[str, float]) -> Iterator[None]:
    """Time the stages of `run_registration`, CPU seconds."""
    functions: tuple[tuple[Any, str, str], ...] = (
        (register, "read_scene", "reading"),
        (register, "register_scene", "registration"),
        (register, "write_refined", "refit"),
        (register, "figure_data", "figure data"),
        (register, "write_outputs", "deliverables"),
        (report_files, "format_html", "page"),
    )

    def timed(function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            started = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                stages[stage] += time.process_time() - started

        return call

    originals = [(module, name, getattr(module, name)) for module, name, _ in functions]
    for module, name, stage in functions:
        setattr(module, name, timed(getattr(module, name), stage))
    try:
        yield
    finally:
        for module, name, function in originals:
            setattr(module, name, function)


def by_command(folder: Path, count: int) -> dict[str, Any]:
    """Seconds per scene of one command over all scenes, its start included."""
    words = ["scene", "register", str(folder / "scenes"), "--block", str(folder / "block")]
    options = ["--sigma-m", str(SIGMA_M), "--jobs", str(WORKERS), "-o", str(folder / "out"), "--json"]
    before, started = _children_cpu_s(), time.monotonic()
    reply = _amers([*words, *options], {})
    elapsed_s = time.monotonic() - started
    records = json.loads(reply)
    wrong = [record for record in records if record.get("verdict") not in ("good", "usable")]
    if wrong or len(records) != count:
        raise RuntimeError(f"{len(records)} of {count} scenes, not registered: {wrong[:3]}")
    cpu_s = _children_cpu_s() - before
    return {"cpu_s": cpu_s / count, "elapsed_s": elapsed_s / count}


def by_service(folder: Path, images: list[Path]) -> dict[str, Any]:
    """Seconds per scene of a running service with two workers, upload and database included."""
    port = free_port()
    environment = {"AMERS_DATA_FOLDER": str(folder / "data"), "AMERS_LOG_LEVEL": "warning"}
    with ExitStack() as stack:
        service = stack.enter_context(
            running([*AMERS, "serve", "--port", str(port)], os.environ | environment)
        )
        url = f"http://127.0.0.1:{port}"
        if not until(lambda: _answers(url)):
            raise RuntimeError(f"the service did not answer; exit code {service.poll()}")
        others = [
            stack.enter_context(running([*AMERS, "worker"], os.environ | environment))
            for _ in range(WORKERS - 1)
        ]
        _amers(["block", "ingest", str(folder / "block"), "--publish"], environment)
        words = ["token", "create", "throughput", "--scope", "register", "--json"]
        secret = json.loads(_amers(words, environment))["secret"]
        headers = {"Authorization": f"Bearer {secret}"}
        with httpx.Client(base_url=url, headers=headers, timeout=60.0) as client:
            _register_all(client, images[:WORKERS])
            time.sleep(3.0)
            roots = [service.pid, *(other.pid for other in others)]
            (postmaster,) = (folder / "data").glob("**/postmaster.pid")
            database = int(postmaster.read_text().split()[0])
            before, database_before = sum(map(_tree_cpu_s, roots)), _tree_cpu_s(database)
            started = time.monotonic()
            _register_all(client, images)
            elapsed_s = time.monotonic() - started
            cpu_s = sum(map(_tree_cpu_s, roots)) - before
            database_s = _tree_cpu_s(database) - database_before
    count = len(images)
    return {
        "cpu_s": (cpu_s + database_s) / count,
        "database_cpu_s": database_s / count,
        "elapsed_s": elapsed_s / count,
    }


def _register_all(client: httpx.Client, images: list[Path]) -> None:
    """Upload and register scenes, a few jobs open at a time.

    Raises:
        RuntimeError: a request is refused, or a job does not succeed.
    """
    waiting, running = list(images), dict[str, Path]()
    deadline = time.monotonic() + PATIENCE_S
    while waiting or running:
        if time.monotonic() > deadline:
            raise RuntimeError(f"no job has ended within {PATIENCE_S:g} s")
        while waiting and len(running) < OPEN_JOBS:
            image = waiting.pop(0)
            scene = client.post(
                f"/scenes?name={image.name}&sigma_m={SIGMA_M}", content=image.read_bytes()
            ).raise_for_status()
            body = {"inputs": {"scene": scene.json()["id"]}}
            job = client.post("/processes/register-scene/execution", json=body).raise_for_status()
            running[job.headers["location"]] = image
        time.sleep(POLL_S)
        for location in tuple(running):
            document = client.get(location).json()
            if document["status"] not in ENDED:
                continue
            if document["status"] != "successful":
                raise RuntimeError(f"{running[location]}: {document}")
            del running[location]
            deadline = time.monotonic() + PATIENCE_S


def _amers(words: list[str], environment: dict[str, str]) -> str:
    """The standard output of a command that succeeds."""
    done = subprocess.run(
        [*AMERS, *words], env=os.environ | environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return done.stdout


def _answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz", timeout=30.0).status_code == 200
    except httpx.TransportError:
        return False


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _tree_cpu_s(root: int) -> float:
    """CPU seconds of a process, of its living descendants, and of those it has waited for."""
    children, ticks = defaultdict(list), {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        number = int(stat.parent.name)
        children[int(fields[1])].append(number)
        ticks[number] = sum(map(int, fields[11:15]))
    total, left = 0, [root]
    while left:
        number = left.pop()
        total += ticks.get(number, 0)
        left.extend(children[number])
    return total / TICKS


def show(outcome: dict[str, Any]) -> None:
    """Print the outcome as tables."""
    alone_s = outcome["register_scene_cpu_s"]
    stages = outcome["stages_cpu_s"]
    together_s = sum(stages.values())
    print(f"{'CPU time per scene':34}{'s':>8}{'ratio':>8}{'scenes/h/core':>15}{'elapsed s':>11}")
    print(f"{'register_scene alone':34}{alone_s:8.3f}{1.0:8.2f}{3600.0 / alone_s:15.0f}")
    print(f"{'with files, in a warm process':34}{together_s:8.3f}{together_s / alone_s:8.2f}")
    for name, words in (("command", "command, --jobs 2"), ("service", "service, two workers")):
        way = outcome[name]
        print(
            f"{words:34}{way['cpu_s']:8.3f}{way['ratio']:8.2f}"
            f"{way['scenes_per_hour_and_core']:15.0f}{way['elapsed_s']:11.2f}"
        )
    print("\nshare of the CPU time of the service, by stage")
    service = outcome["service"]
    shares = {
        **stages,
        "database": service["database_cpu_s"],
        "upload, start, queue, storage": service["cpu_s"] - together_s - service["database_cpu_s"],
    }
    for name, seconds in shares.items():
        print(f"{name:34}{seconds:8.3f}{100.0 * seconds / service['cpu_s']:7.0f} %")


def main() -> None:
    """Run the benchmark, print the tables and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200, help="number of scenes")
    parser.add_argument("--repeats", type=int, default=3, help="timed runs in one process")
    options = parser.parse_args()
    outcome = run(max(options.scenes, DISTINCT_SCENES), options.repeats)
    keep("throughput", outcome)
    show(outcome)


if __name__ == "__main__":
    main()
