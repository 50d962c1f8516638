"""`amers points reach`: the published archipelago in files, each site alone, the others as check."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.parameters import ImageParameters
from amers.services.quality.site_reach import site_reach
from amers.services.sensors.ortho import OrthoModel
from benchmarks._cape_verde import SITES, STEREO, Draw, draw
from benchmarks._cape_verde_files import write_files
from benchmarks.cape_verde import PUBLISHED
from tests.command_line import amers_here

pytestmark = pytest.mark.long


A_THIRD_OF_A_METRE = 0.33
"""The command has the true terrain at the ties, the draw one that is 3 m off."""


@pytest.fixture(scope="module")
def one() -> Draw:
    return draw(np.random.default_rng(47), 150).without(STEREO)


@pytest.fixture(scope="module")
def words(one: Draw, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return write_files(tmp_path_factory.mktemp("islands"), one)


def without_displacement(image: ImageParameters) -> ImageParameters:
    """An ortho-image as its file has it."""
    if isinstance(image.model, OrthoModel):
        return replace(image, model=replace(image.model, displacement=None))
    return image


def test_the_command_has_the_table_of_the_adjustment(one: Draw, words: list[str]) -> None:
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
    images = [without_displacement(image) for image in one.images]
    direct = site_reach(images, one.observations, one.sites, one.heights)
    expected = {(check.active, check.check): check for check in direct.checks}
    for check in checks:
        known = expected[check["known"], check["check"]]
        off_m = np.array(check["error_m"])[:2] - known.error_m[:2]
        assert np.abs(off_m).max() < A_THIRD_OF_A_METRE
        declared_m = np.sqrt(np.trace(np.array(check["covariance_m2"])[:2, :2]))
        assert declared_m == pytest.approx(np.sqrt(np.trace(known.covariance_m2[:2, :2])), rel=0.1)
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
