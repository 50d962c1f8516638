"""Many later scenes on a base, and bases of many archives: as far off as they are stated."""

import json
import os
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amers.app.usecases.base.making import MadeBase, make_base
from amers.app.usecases.base.request import BaseOptions, BaseRequest
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.geodesy import east_north_up
from amers.services.simulation.view import ViewPlan, simulate_view
from amers.services.types import Array
from tests.command_line import amers_here
from tests.open_archive import (
    CENTRE,
    GSD_M,
    TILES,
    OpenArchive,
    TrueDate,
    light_of,
    lon_lat_of_pixels,
    make_archive,
    map_of,
    ortho_pixels,
    write_cog,
)

pytestmark = [pytest.mark.long, pytest.mark.thorough, pytest.mark.endurance]

ARCHIVES = range(21, 27)
SCENES = range(10)


def frame_error_m(archive: OpenArchive, made: MadeBase) -> Array:
    """East and north by which a base is off."""
    dates = [date[:10].replace("-", "") for date in made.placed.dates]
    true_m = np.array([archive.dates[date].error_m for date in dates])
    return np.asarray((true_m - made.placed.frames.error_m).mean(axis=0))


@dataclass(frozen=True)
class Base:
    """A base with its archive, and by how much it is off."""

    archive: OpenArchive
    block: Path
    off_m: Array

    def registered(self, scene: Path) -> dict[str, Any]:
        output = scene.with_suffix("")
        words = ["scene", "register", scene, "--block", self.block, "-o", output, "--sigma-m", "20"]
        done = amers_here([*words, "--json"], os.environ)
        assert done.returncode == 0, done.stderr
        return dict(json.loads(done.stdout))

    def shares(self, name: str, left_m: Array, result: dict[str, Any]) -> tuple[float, float]:
        """What a scene is off by on the base and on the Earth, as shares of the stated CE90."""
        relative_m, earth_m = np.linalg.norm(left_m - self.off_m), np.linalg.norm(left_m)
        stated = [result[kind]["ce90_m"] for kind in ("relative_to_control_points", "on_the_earth")]
        print(f"{name}: {relative_m:.2f} of {stated[0]:.2f} m, {earth_m:.2f} of {stated[1]:.2f} m")
        return float(relative_m / stated[0]), float(earth_m / stated[1])


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Base:
    folder = tmp_path_factory.mktemp("scenes")
    archive = make_archive(folder / "archive", 31)
    catalogue = str(archive.folder / "items.json")
    request = BaseRequest("sentinel-2", (catalogue,), bbox=archive.region, geoid=archive.geoid)
    made = make_base(request, folder / "b", BlockIdentity("b"), BaseOptions(spacing_m=500.0))
    return Base(archive, folder / "b", frame_error_m(archive, made))


def test_later_scenes_of_10_m_are_right_within_what_is_stated(base: Base, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    last = base.archive.dates[max(base.archive.dates)].moment
    shares = []
    for number in SCENES:
        moment, error_m = last + timedelta(days=int(rng.integers(20, 600))), rng.normal(0.0, 12.0, 2)
        tile = list(TILES)[number % 2]
        light = light_of(base.archive.world, TrueDate(moment, "22", "05.11", 0.0, 0.0, error_m), rng)
        seen = ortho_pixels(base.archive.world, light, lon_lat_of_pixels(tile), error_m)
        pixels = np.rint(1300.0 + 6000.0 * seen + rng.normal(0.0, 15.0, seen.shape)).astype(np.uint16)
        scene = tmp_path / f"T{tile}_{moment:%Y%m%d}T103021_B04_{number}.tif"
        write_cog(scene, pixels, *map_of(tile))
        result = base.registered(scene)
        line_px, sample_px = result["shift_px"]
        left_m = error_m - np.array([sample_px, -line_px]) * GSD_M
        shares.append(base.shares(scene.stem, left_m, result))
    assert (np.array(shares) < 1.0).mean() >= 0.9


def test_later_scenes_of_2_m_are_right_within_what_is_stated(base: Base, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    last = base.archive.dates[max(base.archive.dates)].moment
    line_sample = np.stack(np.meshgrid([200.0, 700.0, 1200.0], [200.0, 700.0, 1200.0]), -1).reshape(
        -1, 2
    )
    level = np.full(len(line_sample), 200.0)
    shares = []
    for number in SCENES:
        place = CENTRE[0] + rng.uniform(-0.005, 0.005), CENTRE[1] + rng.uniform(-0.002, 0.002)
        moment = last + timedelta(days=int(rng.integers(20, 600)))
        direction_deg = float(rng.uniform(2.0, 20.0)), float(rng.uniform(0.0, 360.0))
        plan = ViewPlan(f"view-{number}", place, (1400, 1400), 2.0, *direction_deg, moment)
        east_m, north_m = rng.normal(0.0, 20.0, 2)
        view = simulate_view(base.archive.world, plan, rng, (east_m, north_m))
        scene = tmp_path / f"view-{number}.tif"
        write_raster(scene, view.pixels, view.geometry.delivered)
        result = base.registered(scene)
        refined = read_rpc(scene, scene.with_suffix("") / "refined_RPC.TXT").model
        ground = view.geometry.rpc.locate(line_sample, level)
        placed = refined.locate(line_sample, level)
        off_m = [east_north_up(p[None], g)[0, :2] for p, g in zip(placed, ground, strict=True)]
        shares.append(base.shares(scene.stem, np.mean(off_m, axis=0), result))
    assert (np.array(shares) < 1.0).mean() >= 0.9


def test_bases_of_many_archives_are_as_far_off_as_stated(tmp_path: Path) -> None:
    normalised = []
    for seed in ARCHIVES:
        archive = make_archive(tmp_path / f"archive-{seed}", seed)
        box = CENTRE[0] - 0.02, CENTRE[1] - 0.012, CENTRE[0] + 0.02, CENTRE[1] + 0.012
        catalogue = str(archive.folder / "items.json")
        request = BaseRequest("sentinel-2", (catalogue,), bbox=box, geoid=archive.geoid)
        made = make_base(request, tmp_path / f"{seed}", BlockIdentity("b"), BaseOptions(dates=6))
        normalised.append(frame_error_m(archive, made) / made.placed.frames.sigma_m)
    rms = np.sqrt(np.mean(np.square(normalised)))
    print(f"errors of {len(ARCHIVES)} bases over their sigmas: root mean square {rms:.2f}")
    assert 0.6 < rms < 1.5, "twelve draws of a normal law stay within"
