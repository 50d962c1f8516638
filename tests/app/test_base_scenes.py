"""Many later scenes on a base, and bases of many archives: as far off as they are stated."""

import json
import os
import shutil
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amers.app.usecases.base.made import MadeBase
from amers.app.usecases.base.making import make_base
from amers.app.usecases.base.request import BaseOptions, BaseRequest
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.geodesy import east_north_up, metres_per_degree
from amers.services.quality.block import produced_accuracy
from amers.services.quality.correction_accuracy import in_rings
from amers.services.sensors.correction import ImageCorrection
from amers.services.simulation.view import ViewPlan, simulate_view
from amers.services.types import Array, BoolArray
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

ARCHIVES = range(21, 25)
SCENES = range(10)
GRID = 7
"""Nodes of the predicted accuracy along a side, of the options of a registration."""
CE90_TO_SIGMA = 1.0 / np.sqrt(2.0 * np.log(10.0))


def frame_error_m(archive: OpenArchive, made: MadeBase) -> Array:
    """East and north by which a base is off."""
    true_m = np.array([archive.error_of(date) for date in made.placed.dates])
    return np.asarray((true_m - made.placed.frames.error_m).mean(axis=0))


@dataclass(frozen=True)
class Base:
    """A base with its archive, and by how much it is off."""

    archive: OpenArchive
    block: Path
    off_m: Array

    def registered(self, scene: Path, sigma_m: float = 20.0) -> tuple[dict[str, Any], dict[str, Any]]:
        """What the command prints, and its report."""
        output = scene.with_suffix("")
        words = ["scene", "register", scene, "--block", self.block, "-o", output, "--sigma-m", sigma_m]
        done = amers_here([*words, "--json"], os.environ)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout), json.loads((output / "report.json").read_text())

    @property
    def last(self) -> datetime:
        return self.archive.dates[max(self.archive.dates)].moment


@dataclass
class Errors:
    """True errors of scenes over what is stated, place by place.

    Attributes:
        relative: errors of a coordinate on the base over their stated sigmas, mean squares of scenes.
        worst, earth: largest errors of scenes over the stated CE90, on the base and on the Earth.
        lost: shares of points within scenes that are not found.
    """

    relative: list[float] = field(default_factory=list)
    worst: list[float] = field(default_factory=list)
    earth: list[float] = field(default_factory=list)
    lost: list[float] = field(default_factory=list)

    def add(self, base: Base, left_m: Array, result: dict[str, Any], report: dict[str, Any]) -> None:
        """Add a scene with its errors (n, 2) on the Earth at the nodes of the predicted accuracy."""
        ce90_m = np.array(report["predicted"]["ce90_px"]).ravel() * report["scene"]["gsd_m"]
        held = held_nodes(report, len(left_m))
        relative_m = np.linalg.norm(left_m - base.off_m, axis=1)[held]
        earth_m = np.linalg.norm(left_m, axis=1)[held]
        stated = [result[kind]["ce90_m"] for kind in ("relative_to_control_points", "on_the_earth")]
        counts, beyond = report["point_counts"], number_beyond(report)
        self.relative.append(float(np.mean((relative_m / ce90_m[held] / CE90_TO_SIGMA) ** 2) / 2.0))
        self.worst.append(float(relative_m.max() / stated[0]))
        self.earth.append(float(earth_m.max() / stated[1]))
        self.lost.append(1.0 - counts["matched"] / (counts["visible"] - beyond))
        print(
            f"{result['scene']}: {np.sqrt(self.relative[-1]):.2f} sigmas, worst {relative_m.max():.2f} "
            f"of {stated[0]:.2f} m, on the Earth {earth_m.max():.2f} of {stated[1]:.2f} m, "
            f"{result['verdict']}, {100 * self.lost[-1]:.0f} % lost"
        )

    def check(self) -> None:
        """Errors are as large as stated, or up to two fifths smaller, on average over all places."""
        rms = float(np.sqrt(np.mean(self.relative)))
        print(f"{len(self.relative)} scenes: {rms:.2f} of the stated sigma")
        assert 0.6 <= rms <= 1.2
        assert (np.array(self.worst) < 1.3).mean() >= 0.8
        assert (np.array(self.earth) < 1.0).mean() >= 0.8
        assert np.mean(self.lost) < 0.05


def held_nodes(report: dict[str, Any], count: int) -> BoolArray:
    """Which nodes (n,) of the predicted accuracy points support."""
    nodes = nodes_of((report["scene"]["lines"], report["scene"]["samples"]))
    assert len(nodes) == count
    outline = tuple(np.array(ring) for ring in report["coverage"]["outline"])
    return in_rings(outline, nodes)


def nodes_of(shape: tuple[int, int]) -> Array:
    """Lines and samples (n, 2) of the nodes of the predicted accuracy."""
    at = (np.linspace(0.0, size - 1.0, GRID) for size in shape)
    return np.stack(np.meshgrid(*at, indexing="ij"), axis=-1).reshape(-1, 2)


def number_beyond(report: dict[str, Any]) -> int:
    """Points whose chips the scene does not show."""
    return sum(one["count"] for one in report["reasons"] if one["reason"] == "nodata")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Base:
    folder = tmp_path_factory.mktemp("scenes")
    archive = make_archive(folder / "archive", 31)
    catalogue = str(archive.folder / "items.json")
    request = BaseRequest("sentinel-2", (catalogue,), bbox=archive.region, geoid=archive.geoid)
    made = make_base(request, folder / "b", BlockIdentity("b"), BaseOptions(spacing_m=500.0))
    return Base(archive, folder / "b", frame_error_m(archive, made))


def later_pixels(base: Base, rng: np.random.Generator, tile: str, error_m: Array) -> tuple[str, Array]:
    """The name and the pixels of a later granule."""
    moment = base.last + timedelta(days=int(rng.integers(20, 600)))
    light = light_of(base.archive.world, TrueDate(moment, "22", "05.11", 0.0, 0.0, error_m), rng)
    seen = ortho_pixels(base.archive.world, light, lon_lat_of_pixels(tile), error_m)
    pixels = np.rint(1300.0 + 6000.0 * seen + rng.normal(0.0, 15.0, seen.shape)).astype(np.uint16)
    return f"T{tile}_{moment:%Y%m%dT%H%M%S}_B04", pixels


def test_later_scenes_of_10_m_are_as_far_off_as_stated(base: Base, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    errors = Errors()
    for number in SCENES:
        tile, error_m = list(TILES)[number % 2], rng.normal(0.0, 12.0, 2)
        name, pixels = later_pixels(base, rng, tile, error_m)
        scene = tmp_path / f"{name}_{number}.tif"
        write_cog(scene, pixels, *map_of(tile))
        result, report = base.registered(scene)
        found = report["correction"]
        values = [np.array(found[key]) for key in ("parameters_px", "centre_px", "half_size_px")]
        nodes = nodes_of(pixels.shape)
        line_m, sample_m = ((ImageCorrection(*values).apply(nodes) - nodes) * GSD_M).T
        errors.add(base, error_m - np.column_stack([sample_m, -line_m]), result, report)
    errors.check()


def test_ground_that_has_changed_is_counted_as_lost(base: Base, tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    name, pixels = later_pixels(base, rng, "32TLP", np.zeros(2))
    pixels[:, 250:400] = rng.integers(1500, 5000, (len(pixels), 150))
    write_cog(tmp_path / f"{name}.tif", pixels, *map_of("32TLP"))
    _, report = base.registered(tmp_path / f"{name}.tif")
    counts = report["point_counts"]
    lost = 1.0 - counts["matched"] / (counts["visible"] - number_beyond(report))
    print(f"{100.0 * lost:.0f} % lost")
    assert lost > 0.15


def views(base: Base, gsd_m: float, size: int, seed: int, offsets_m: Array, folder: Path) -> Errors:
    """Errors of simulated views that are off by offsets (n, 2), registered on the base."""
    rng, errors = np.random.default_rng(seed), Errors()
    sigma_m = max(20.0, float(np.sqrt(np.mean(offsets_m**2))))
    for number, (east_m, north_m) in enumerate(offsets_m.tolist()):
        place = CENTRE[0] + rng.uniform(-0.005, 0.005), CENTRE[1] + rng.uniform(-0.002, 0.002)
        moment = base.last + timedelta(days=int(rng.integers(20, 600)))
        direction_deg = float(rng.uniform(2.0, 20.0)), float(rng.uniform(0.0, 360.0))
        plan = ViewPlan(f"view-{number}", place, (size, size), gsd_m, *direction_deg, moment)
        view = simulate_view(base.archive.world, plan, rng, (east_m, north_m))
        scene = folder / f"view-{number}.tif"
        write_raster(scene, view.pixels, view.geometry.delivered)
        result, report = base.registered(scene, sigma_m)
        refined = read_rpc(scene, scene.with_suffix("") / "refined_RPC.TXT").model
        nodes = nodes_of((size, size))
        level = np.full(len(nodes), 200.0)
        ground, placed = view.geometry.rpc.locate(nodes, level), refined.locate(nodes, level)
        off_m = [east_north_up(p[None], g)[0, :2] for p, g in zip(placed, ground, strict=True)]
        errors.add(base, np.array(off_m), result, report)
        scene.unlink()
    return errors


def test_later_scenes_of_2_m_are_as_far_off_as_stated(base: Base, tmp_path: Path) -> None:
    offsets_m = np.random.default_rng(16).normal(0.0, 20.0, (len(SCENES), 2))
    views(base, 2.0, 1400, 6, offsets_m, tmp_path).check()


def test_scenes_of_half_a_metre_are_brought_from_hundreds_of_metres_to_the_base(
    base: Base, tmp_path: Path
) -> None:
    offsets_m = np.array([[210.0, -130.0], [-330.0, 240.0], [90.0, 480.0]])
    errors = views(base, 0.5, 5000, 7, offsets_m, tmp_path)
    assert max(errors.worst) < 1.3
    assert max(errors.earth) < 1.0


def point_errors_m(archive: OpenArchive, made: MadeBase) -> Array:
    """East, north and up (n, 3) by which the points of a base are off on the Earth."""
    points, frames = made.points, made.placed.frames
    images = {image.id: image for tile in made.placed.tiles for image in tile.images}
    per_degree = np.array(metres_per_degree(CENTRE[1], 0.0))
    errors = []
    for place, first in zip(points.lon_lat_h, points.views.start[:-1].tolist(), strict=True):
        # The detail of a point is that of its first image, which shows it where its date is off.
        image = images[points.views.images[points.views.image[first]].image_id]
        frame_m = frames.error_m[made.placed.dates.index(image.date)]
        date = archive.dates[f"{image.acquired:%Y%m%d}"]
        error_m = date.error_at(place[:2] + frame_m / per_degree) - frame_m
        up_m = place[2] - archive.world.height_m((place[:2] - error_m / per_degree)[None])[0]
        errors.append([*error_m, up_m])
    return np.array(errors)


def test_points_of_many_archives_are_as_far_off_as_stated(tmp_path: Path) -> None:
    frames, relative, stated = [], [], []
    for seed in ARCHIVES:
        archive = make_archive(tmp_path / f"archive-{seed}", seed)
        catalogue = str(archive.folder / "items.json")
        request = BaseRequest("sentinel-2", (catalogue,), bbox=archive.region, geoid=archive.geoid)
        options = BaseOptions(dates=6, spacing_m=500.0)
        made = make_base(request, tmp_path / f"{seed}", BlockIdentity("b"), options)
        error_m = point_errors_m(archive, made)
        frames.append(error_m[:, :2].mean(axis=0) / made.placed.frames.sigma_m)
        relative.append(error_m - error_m.mean(axis=0))
        accuracy = produced_accuracy(made.points).relative_to_control_points
        stated.append([accuracy.ce90_m, accuracy.le90_m])
        shutil.rmtree(archive.folder)
    rms = np.sqrt(np.mean(np.square(frames)))
    print(f"errors of {len(ARCHIVES)} bases over their sigmas: root mean square {rms:.2f}")
    assert 0.6 < rms < 1.5, "eight draws of a normal law stay within"
    errors_m = np.concatenate(relative)
    ce90_m = np.quantile(np.linalg.norm(errors_m[:, :2], axis=1), 0.9)
    le90_m = np.quantile(np.abs(errors_m[:, 2]), 0.9)
    stated_m = np.mean(stated, axis=0)
    print(f"{len(errors_m)} points: CE90 {ce90_m:.2f} m, LE90 {le90_m:.2f} m; stated {stated_m}")
    assert 0.8 < ce90_m / stated_m[0] < 1.25
    assert 0.8 < le90_m / stated_m[1] < 1.25
