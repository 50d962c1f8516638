"""A block that is adjusted in parts: beside one solve, and the memory of its processes as it grows.

* beside: a block adjusted as one part and as many: parameters in units of their sigmas, covariances of
  points relative to their variances, memory of each process.
* growth: passes of 25 images side by side, or a square of them; each size with a process that holds the
  block and one that computes its parts.

Memory is what a process has at most beyond what it had before the adjustment, with compiled code loaded;
that is Python and its libraries, and the observations where the block is.

Run: python -m benchmarks.block_parts [--beside 2000] [--sizes 500,2000,8000] [--per-image 300]
"""

import argparse
import ctypes
import json
import multiprocessing
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from amers.services.adjustment import block_parts, dissection
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.formats.work_folder import WorkFolder
from amers.services.tasks import Arrays, Work
from amers.services.types import Array
from benchmarks._measuring import keep, memory_mib, print_table
from benchmarks.block_adjustment import PER_IMAGE, large_block

BLUNDERS = 0.05
NEVER = 10**9
LARGE = (75_000, 400_000)


def main() -> None:
    """Print the tables and keep their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--beside", type=int, default=2000, help="images (%(default)s)")
    parser.add_argument("--sizes", default="500,2000,8000", help="images (%(default)s)")
    parser.add_argument("--per-image", type=int, default=PER_IMAGE, help="points (%(default)s)")
    parser.add_argument("--one", type=int, help="adjust one block and print its figures")
    parser.add_argument("--whole", action="store_true", help="as one part")
    parser.add_argument("--result", type=Path, help="of one block, to compare with")
    arguments = parser.parse_args()
    if arguments.one:
        figures = adjusted(arguments.one, arguments.per_image, arguments.whole, arguments.result)
        print(json.dumps(figures))
        return
    outcome: dict[str, Any] = {}
    if arguments.beside:
        outcome["beside"] = beside(arguments.beside, arguments.per_image)
    if arguments.sizes:
        sizes = [int(size) for size in arguments.sizes.split(",")]
        rows = [in_process(size, arguments.per_image) for size in sizes]
        print_table("growth of a block in parts", rows, _columns(rows[0]))
        outcome["growth"] = {"measured": rows, "projected": projected(rows)}
        print(json.dumps(outcome["growth"]["projected"], indent=1))
    keep("block_parts", outcome)


def _columns(row: dict[str, Any]) -> dict[str, Any]:
    return {key: lambda row, key=key: f"{row[key]:,.0f}" for key in row}


def beside(n_images: int, per_image: int) -> dict[str, Any]:
    """What a block in parts differs by from one solve, and the memory of both."""
    with TemporaryDirectory() as folder:
        files = [Path(folder) / f"{name}.npz" for name in ("whole", "parts")]
        whole = in_process(n_images, per_image, "--whole", "--result", str(files[0]))
        parts = in_process(n_images, per_image, "--result", str(files[1]))
        one, other = (dict(np.load(file)) for file in files)
    own = np.sqrt(np.diagonal(one["covariance_m2"], 0, 1, 2))
    off_m2 = np.abs(other["covariance_m2"] - one["covariance_m2"])
    figures = {
        "parameters_in_sigmas": float((np.abs(other["values"] - one["values"]) / one["sigma"]).max()),
        "sigmas_of_parameters": float(np.abs(other["sigma"] / one["sigma"] - 1.0).max()),
        "covariances_of_points": float(np.nanmax(off_m2 / (own[:, :, None] * own[:, None, :]))),
        "frame": float(np.abs(other["frame_m2"] / one["frame_m2"] - 1.0).diagonal().max()),
        "observations_that_only_one_uses": int((one["active"] != other["active"]).sum()),
    }
    print_table("beside one solve", [whole, parts], _columns(whole))
    print(json.dumps(figures, indent=1))
    return {"whole": whole, "parts": parts, "differences": figures}


def in_process(n_images: int, per_image: int, *more: str) -> dict[str, Any]:
    """Figures of one block in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.block_parts", "--one", str(n_images)]
    command += ["--per-image", str(per_image), *more]
    outcome = subprocess.run(command, check=True, stdout=subprocess.PIPE)
    return dict(json.loads(outcome.stdout))


def adjusted(n_images: int, per_image: int, whole: bool, result: Path | None) -> dict[str, Any]:
    """Figures of one block: of the process that has it, and of the one that computes its parts."""
    if whole:
        block_parts.PART_OBSERVATIONS = dissection.DIRECT_ROWS = NEVER
    context = multiprocessing.get_context("spawn")
    with TemporaryDirectory() as folder, ProcessPoolExecutor(1, mp_context=context) as executor:
        _, *warm = large_block(400, 20, seed=0)
        adjust_block(warm[0], warm[1], passes=warm[2])
        executor.submit(_warmed).result()
        _, images, observations, passes = large_block(n_images, per_image, seed=1, blunders=BLUNDERS)
        work = Work(executor, WorkFolder(Path(folder), {}), ahead=1)
        forget_peak()
        before = memory_mib("VmRSS"), executor.submit(memory_mib, "VmRSS").result()
        begun = time.process_time()
        block = adjust_block(images, observations, passes=passes, work=work)
        here_s = time.process_time() - begun
        after = memory_mib("VmHWM"), executor.submit(memory_mib, "VmHWM").result()
    if result:
        write(result, block)
    parts = work.effort.get("adjust")
    return {
        "images": n_images,
        "points": int(np.isfinite(block.lon_lat_h[:, 0]).sum()),
        "observations": len(observations),
        "iterations": block.iterations,
        "block_cpu_s": here_s,
        "parts_cpu_s": parts.cpu_s if parts else 0.0,
        "tasks": parts.tasks if parts else 0,
        "block_before_mib": before[0],
        "block_mib": after[0] - before[0],
        "parts_before_mib": before[1],
        "parts_mib": after[1] - before[1],
    }


def forget_peak() -> None:
    """Give freed memory back, and count the highest from now on: making the block takes more."""
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")


def _warmed() -> Arrays:
    """Load what is compiled, as a worker has it after its first tasks."""
    _, *warm = large_block(400, 20, seed=0)
    adjust_block(warm[0], warm[1], passes=warm[2])
    return {}


def write(file: Path, block: BlockAdjustment) -> None:
    """What blocks are compared by."""
    sigma: Array = np.sqrt(block.accuracy.variance())[: block.values.size]
    np.savez(
        file,
        values=block.values,
        sigma=sigma.reshape(block.values.shape),
        covariance_m2=block.point_covariance_m2,
        frame_m2=block.frames[0].covariance_m2,
        active=block.active,
    )


def projected(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Memory and time of large blocks, by powers fitted to those of 2,000 images and more."""
    last = [row for row in rows if row["images"] >= 2000]
    if len(last) < 2:
        return {}
    images = np.log([row["images"] for row in last])
    figures = {}
    for name in ("block_mib", "block_cpu_s", "parts_mib", "parts_cpu_s"):
        power, factor = np.polyfit(images, np.log([row[name] for row in last]), 1)
        figures[name] = {
            "power": float(power),
            **{str(n): float(np.exp(factor + power * np.log(n))) for n in LARGE},
        }
    return figures


if __name__ == "__main__":
    main()
