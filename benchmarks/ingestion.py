"""Points ingested a second, checks and commit included, each with 8 chips of 16 bits.

One block is made and ingested into a private cluster that keeps every commit, as an installation's does.
The time is told by steps; without the two steps that pass over the bytes of the chip files (checksum,
copy) what is left is the work on rows. Run: python -m benchmarks.ingestion
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

from app.db import engine
from app.db.embedded import Cluster
from app.storage import Storage
from app.usecases.blocks import ingest_block
from tests.factories import make_block

RESULTS = Path(__file__).parent / "results"
IMAGES = 8


def main() -> None:
    """Make a block, ingest it, print and keep what it took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        made = make_block(folder / "block", count=arguments.points, n_images=IMAGES, gsds_m=(2.0,))
        steps: dict[str, float] = {}
        last = [time.perf_counter(), "checking checksums"]

        def note(fraction: float, message: str) -> None:
            now = time.perf_counter()
            steps[str(last[1])] = steps.get(str(last[1]), 0.0) + now - float(last[0])
            last[:] = [now, message]

        with Cluster(folder / "postgres", durable=True).lease() as dsn:
            engine.upgrade(dsn)
            last[0] = start = time.perf_counter()
            with engine.connect(dsn) as connection:
                ingest_block(connection, Storage(folder / "storage"), made.folder, note)
            note(1.0, "end")
            total_s = time.perf_counter() - start
    chips_s = steps["checking checksums"] + steps["storing chips"]
    outcome = {
        "points": arguments.points,
        "chips": arguments.points * IMAGES,
        "points_per_s": arguments.points / total_s,
        "points_per_s_without_chip_files": arguments.points / (total_s - chips_s),
        "steps_s": steps,
    }
    print(json.dumps(outcome, indent=1))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "ingestion.json").write_text(json.dumps(outcome, indent=1) + "\n")


if __name__ == "__main__":
    main()
