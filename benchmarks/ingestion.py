"""Points ingested per second, with all checks and the commit, each with 8 chips of 16 bits.

One block is made and ingested into a private cluster with durable commits, as in an installation. The
time is reported by steps. Without the step that copies the chip files (copy, checksum, sync to the
disk), the rest is the work on rows. For comparison, the same files are only copied and synced by as
many threads, which shows the speed of the disk.
Run: python -m benchmarks.ingestion
"""

import argparse
import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import Cluster
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block
from amers.services.formats.block.check import CHECKSUM_THREADS
from benchmarks._measuring import keep, open_folder
from tests.factories import make_block

IMAGES = 8


def main() -> None:
    """Make a block, ingest it, print and save the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000)
    arguments = parser.parse_args()
    with open_folder() as folder:
        made = make_block(folder / "block", count=arguments.points, n_images=IMAGES, gsds_m=(2.0,))
        steps: dict[str, float] = {}
        last = [time.perf_counter(), "checking checksums"]
        copy_s = plain_copy(sorted((made.folder / "chips").iterdir()), folder / "copy")

        def note(fraction: float, message: str) -> None:
            now = time.perf_counter()
            steps[str(last[1])] = steps.get(str(last[1]), 0.0) + now - float(last[0])
            last[:] = [now, message]

        with Cluster(folder / "postgres", durable=True).lease() as dsn:
            revisions.upgrade(dsn)
            last[0] = start = time.perf_counter()
            with engine.connect(dsn) as connection:
                ingest_block(connection, Storage(folder / "storage"), made.folder, note)
            note(1.0, "end")
            total_s = time.perf_counter() - start
    chips_s = steps["storing chips"]
    outcome = {
        "points": arguments.points,
        "chips": arguments.points * IMAGES,
        "points_per_s": arguments.points / total_s,
        "points_per_s_without_chip_files": arguments.points / (total_s - chips_s),
        "plain_copy_of_chips_s": copy_s,
        "points_per_s_if_the_disk_were_all": arguments.points / copy_s,
        "steps_s": steps,
    }
    print(json.dumps(outcome, indent=1))
    keep("ingestion", outcome)


def plain_copy(files: list[Path], folder: Path) -> float:
    """Seconds to copy files in parallel until they are on the disk."""
    folder.mkdir()

    def copy(file: Path) -> None:
        shutil.copyfile(file, folder / file.name)
        with (folder / file.name).open("rb") as copied:
            os.fsync(copied.fileno())

    start = time.perf_counter()
    with ThreadPoolExecutor(CHECKSUM_THREADS) as pool:
        list(pool.map(copy, files))
    taken_s = time.perf_counter() - start
    shutil.rmtree(folder)
    return taken_s


if __name__ == "__main__":
    main()
