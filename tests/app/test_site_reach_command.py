"""`amers points reach`: the published archipelago in files, each site alone, the others as check."""

import json
import os

import numpy as np
import pytest

from benchmarks._cape_verde import SITES, STEREO, draw
from benchmarks._cape_verde_files import write_files
from benchmarks.cape_verde import PUBLISHED
from tests.command_line import amers_here

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    one = draw(np.random.default_rng(47), 150).without(STEREO)
    return write_files(tmp_path_factory.mktemp("islands"), one)


def test_every_site_is_checked_by_every_other_one_within_what_is_declared(words: list[str]) -> None:
    done = amers_here(["points", "reach", *words, "--json"], os.environ)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["sites"] == list(SITES)
    assert document["heights"] == document["ties"] > 100
    checks = document["checks"]
    assert len(checks) == 12
    assert all(
        abs(check["distance_km"] - PUBLISHED[check["known"], check["check"]][0]) < 3.0
        for check in checks
    )
    squares = [
        np.array(check["error_m"])[:2]
        @ np.linalg.solve(np.array(check["covariance_m2"])[:2, :2], check["error_m"][:2])
        / 2.0
        for check in checks
    ]
    residuals_m = [check["residual_m"] for check in checks]
    print(f"residuals {np.round(residuals_m, 2).tolist()} m, normalised {np.mean(squares):.2f}")
    assert max(residuals_m) < 4.0
    assert np.mean(squares) < 2.0
    assert {corner["known"] for corner in document["corners"]} == set(SITES)
    table = amers_here(["points", "reach", *words], os.environ).stdout
    assert table.splitlines()[0].split() == [
        "known", "check", "km", "points", "east_m", "north_m", "up_m", "residual_m", "declared_m",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda words: words[:2] + words[5:], "1 known site given, at least 2 needed"),
        (
            lambda words: [*words, "--edge-sigma-m", "ortho_1.tif=none"],
            "--edge-sigma-m: given twice for ortho_1.tif",
        ),
    ],
    ids=["one", "edge"],
)
def test_what_cannot_be_measured_is_refused(words: list[str], change: object, message: str) -> None:
    done = amers_here(["points", "reach", *change(words)], os.environ)  # type: ignore[operator]
    assert done.returncode == 2
    assert message in done.stderr
