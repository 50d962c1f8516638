"""Bases from a simulated archive of Sentinel-2 kind behind a STAC API: made, interrupted, used."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely

from amers.app.errors import InputError
from amers.app.usecases.base import making
from amers.app.usecases.base.made import MadeBase
from amers.app.usecases.base.making import make_base, plan
from amers.app.usecases.base.request import BaseOptions, BaseRequest
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats import addresses
from amers.services.formats.addresses import Address
from amers.services.formats.block.reader import read_block, read_document
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.window_copy import WindowSource, copy_window
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.geodesy import east_north_up, metres_per_degree
from amers.services.imagery.archives import SENTINEL_2
from amers.services.map_grid import lon_lat_of_xy, xy_of_lon_lat
from amers.services.simulation.view import ViewPlan, simulate_view
from tests.app.test_production_run import content
from tests.command_line import amers_here
from tests.open_archive import (
    CENTRE,
    GSD_M,
    LOCAL_M,
    SIZE_PX,
    Faults,
    OpenArchive,
    TrueDate,
    light_of,
    lon_lat_of_pixels,
    make_archive,
    map_of,
    ortho_pixels,
    running_archive,
    write_cog,
)

pytestmark = [pytest.mark.long, pytest.mark.thorough]

FEW = BaseOptions(dates=3)
LATER_M = np.array([14.0, -9.0])
"""Error of a later scene, east and north."""


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> OpenArchive:
    return make_archive(tmp_path_factory.mktemp("open") / "archive")


@pytest.fixture(autouse=True)
def nothing_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ports of servers are used again, and blocks in memory would be those of another one."""
    monkeypatch.setattr(addresses, "_KEPT", addresses._KeptBlocks())


def request_of(archive: OpenArchive, catalogue: str, **more: Any) -> BaseRequest:
    given = {"bbox": archive.region, "geoid": archive.geoid, **more}
    return BaseRequest("sentinel-2", (catalogue,), **given)


def small_part(archive: OpenArchive) -> tuple[float, float, float, float]:
    """A region of 2 x 2 km across the border of the zones."""
    lon, lat = CENTRE
    return lon - 0.0125, lat - 0.009, lon + 0.0125, lat + 0.009


@pytest.fixture(scope="module")
def base(
    archive: OpenArchive, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any], list[str]]:
    """A base made by one command, from a server with faults; what it printed, and what was asked."""
    block = tmp_path_factory.mktemp("base") / "valley"
    broken = f"{archive.items[40]['id']}_red.tif"
    gone = f"{archive.items[30]['id']}_red.tif"
    faults = Faults(busy=2, failing=4, uses=25, broken=(broken,), gone=(gone,))
    with running_archive(archive, faults) as server:
        bbox = [f"{value:.7f}" for value in archive.region]
        words = ["--bbox", *bbox, "--from", "sentinel-2", "--catalogue", server.url]
        done = amers_here(
            ["base", "make", *words, "--geoid", archive.geoid, "-o", block, "--json"], os.environ
        )
        assert done.returncode == 0, done.stderr
        return block, json.loads(done.stdout), list(server.asked)


def test_one_command_makes_a_base_from_a_catalogue_with_faults(archive, base) -> None:
    block, made, asked = base
    print({name: value for name, value in made.items() if name != "attribution"})
    assert sum("/search" in one for one in asked) >= 5, "two tries were refused, and pages follow"
    assert any("/items/" in one for one in asked), "addresses were asked for again"
    assert made["tiles"] == ["32TLP", "31TGJ"]
    assert 6 <= len(made["dates"]) <= 14
    assert made["orbits"] == 2
    assert len({int(date[5:7]) % 12 // 3 for date in made["dates"]}) == 4
    assert made["points_per_km2"] >= 0.5
    assert made["bytes_read"] > 0
    assert len(made["left_out"]) == 2, "the damaged file and the missing one"
    document = json.loads((block / "block.json").read_text())
    assert "Contains modified Copernicus Sentinel data 2021-2022" in json.dumps(document)
    assert not block.with_name("valley.work").exists()


def frame_error_m(archive: OpenArchive, made: dict[str, Any]) -> np.ndarray:
    """East and north by which the base is off: what dates are off by in truth, beyond what is found."""
    true_m = [archive.error_of(date) for date in made["dates"]]
    left_m = np.array(true_m) - np.array(made["date_errors_east_north_m"])
    assert np.ptp(left_m, axis=0).max() < 3.0 * LOCAL_M, "all dates are in one frame"
    return np.asarray(left_m.mean(axis=0))


def test_the_frame_of_the_base_is_as_far_off_as_stated(archive, base) -> None:
    _, made, _ = base
    off_m = frame_error_m(archive, made)
    print(f"the base is off by {off_m} m, sigma {made['sigma_m']} m")
    assert np.abs(off_m).max() < 3.0 * made["sigma_m"]
    assert made["sigma_m"] >= 3.2, "no better than the producer states"
    assert made["sigma_m"] < 4.5, "many dates and two orbits agree"


def test_the_heights_are_as_far_off_as_stated(archive, base) -> None:
    block, made, _ = base
    points = read_block(block).points
    ground = points.lon_lat_h[:, :2] - frame_error_m(archive, made) / metres_per_degree(CENTRE[1], 0.0)
    error_m = points.lon_lat_h[:, 2] - archive.world.height_m(ground)
    common_m, own_m = error_m.mean(), error_m.std(ddof=1)
    sigma_m = np.sqrt(np.median(points.covariance_m2[:, 2, 2]))
    print(f"heights: all {common_m:.2f} m, each {own_m:.2f} m, stated {sigma_m:.2f} m")
    assert 0.6 < own_m / sigma_m < 1.4, "20 points show it no better"
    assert abs(common_m) < 3.0 * points.frames[0].sigma_up_m


def test_a_plan_reads_no_image_and_foresees_the_bytes(archive, tmp_path) -> None:
    with running_archive(archive) as server:
        planned, candidates = plan(request_of(archive, server.url))
        assert not any("data/" in one for one in server.asked)
        made = make_base(request_of(archive, server.url), tmp_path / "b", BlockIdentity("b"))
    assert planned.bytes == pytest.approx(made.bytes, rel=0.5)
    images = {candidates.images[date.image].id for date in planned.dates}
    used = {image.id for tile in made.placed.tiles for image in tile.images}
    assert len(images & used) > 0.6 * len(used)


def test_of_a_large_image_only_the_tiles_around_the_region_are_sent(archive, tmp_path) -> None:
    rng = np.random.default_rng(4)
    pixels = rng.integers(1000, 4000, (5000, 5000), dtype=np.uint16)
    crs, transform = map_of("32TLP")
    path = archive.folder / "data" / "large_red.tif"
    write_cog(path, pixels, crs, transform, blockxsize=512, blockysize=512)
    corner = np.array([[transform.c + 20_000.0, transform.f - 20_000.0]])
    region = shapely.box(
        *lon_lat_of_xy(crs, corner - 4_000.0)[0], *lon_lat_of_xy(crs, corner + 4_000.0)[0]
    )
    with running_archive(archive) as server:
        source = WindowSource(Address(f"{server.url}/data/large_red.tif"), None, SENTINEL_2)
        copied = copy_window(source, region, tmp_path / "copy.tif")
    bytes_share = sum(server.sent) / path.stat().st_size
    print(f"{bytes_share:.3f} of the bytes, {copied.pixels / pixels.size:.3f} of the pixels")
    assert bytes_share < 1.0 / 3.0
    assert copied.pixels < pixels.size / 20
    with rasterio.open(tmp_path / "copy.tif") as copy:
        row = round((transform.f - copy.transform.f) / GSD_M)
        column = round((copy.transform.c - transform.c) / GSD_M)
        part = pixels[row : row + copy.height, column : column + copy.width]
        np.testing.assert_array_equal(copy.read(1), part)
    path.unlink()


def later_scene(archive: OpenArchive, folder: Path, name: str) -> Path:
    """An ortho-image of 10 m of the year after, which is off by LATER_M."""
    rng = np.random.default_rng(11)
    last = archive.dates[max(archive.dates)]
    moment = last.moment.replace(year=last.moment.year + 1, month=5)
    date = TrueDate(moment, "22", "05.11", 0.0, 0.0, LATER_M)
    crs, transform = map_of("32TLP")
    light = light_of(archive.world, date, rng)
    seen = ortho_pixels(archive.world, light, lon_lat_of_pixels("32TLP"), LATER_M)
    pixels = np.rint(1300.0 + 6000.0 * seen + rng.normal(0.0, 15.0, seen.shape)).astype(np.uint16)
    write_cog(folder / f"{name}.tif", pixels, crs, transform)
    return folder / f"{name}.tif"


def registered(scene: Path, block: Path, output: Path) -> dict[str, Any]:
    words = ["scene", "register", scene, "--block", block, "-o", output, "--sigma-m", "20", "--json"]
    done = amers_here(words, os.environ)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def test_a_later_scene_of_10_m_is_registered_within_what_is_stated(archive, base, tmp_path) -> None:
    block, made, _ = base
    result = registered(
        later_scene(archive, tmp_path, "T32TLP_20240512T103021_B04"), block, tmp_path / "o"
    )
    line_px, sample_px = result["shift_px"]
    # The scene is corrected onto the base, whose own error stays.
    left_m = LATER_M - np.array([sample_px, -line_px]) * GSD_M
    relative_m = left_m - frame_error_m(archive, made)
    print(f"off by {left_m} m on the Earth, {relative_m} m on the base; {result['verdict']}")
    assert result["verdict"] in ("good", "usable")
    counts = json.loads((tmp_path / "o" / "report.json").read_text())["point_counts"]
    reasons = json.loads((tmp_path / "o" / "report.json").read_text())["reasons"]
    beyond = sum(one["count"] for one in reasons if one["reason"] == "nodata")
    assert counts["matched"] >= 0.95 * (counts["visible"] - beyond), "later dates find the points"
    assert np.linalg.norm(relative_m) < result["relative_to_control_points"]["ce90_m"]
    assert np.linalg.norm(left_m) < 1.5 * result["on_the_earth"]["ce90_m"]


def test_a_scene_of_2_m_is_brought_from_30_m_to_the_base(archive, base, tmp_path) -> None:
    block, made, _ = base
    planned = ViewPlan("later-2m", CENTRE, (2000, 2000), 2.0, 5.0, 100.0)
    view = simulate_view(archive.world, planned, np.random.default_rng(3), (24.0, -18.0))
    scene = tmp_path / "later-2m.tif"
    write_raster(scene, view.pixels, view.geometry.delivered)
    result = registered(scene, block, tmp_path / "out")
    refined = read_rpc(scene, tmp_path / "out" / "refined_RPC.TXT").model
    line_sample = np.stack(np.meshgrid([300.0, 1000.0, 1700.0], [300.0, 1000.0, 1700.0]), -1).reshape(
        -1, 2
    )
    ground = view.geometry.rpc.locate(line_sample, np.full(9, 200.0))
    placed = refined.locate(line_sample, np.full(9, 200.0))
    off_m = np.mean([east_north_up(p[None], g)[0, :2] for p, g in zip(placed, ground, strict=True)], 0)
    relative_m = off_m - frame_error_m(archive, made)
    print(f"off by {off_m} m on the Earth, {relative_m} m on the base; {result['verdict']}")
    assert result["verdict"] in ("good", "usable")
    assert np.linalg.norm(relative_m) < result["relative_to_control_points"]["ce90_m"]
    assert np.linalg.norm(off_m) < 1.5 * result["on_the_earth"]["ce90_m"]


def interrupted(count: int) -> Any:
    """A progress that ends the work at a number of its messages."""
    left = [count]

    def progress(fraction: float, message: str) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt

    return progress


def test_a_base_that_is_interrupted_ten_times_is_the_same_block(archive, tmp_path) -> None:
    with running_archive(archive) as server:
        request = request_of(archive, server.url, bbox=small_part(archive))
        make_base(request, tmp_path / "whole", BlockIdentity("b"), FEW)
        searches = len([one for one in server.asked if "/search" in one])
        for count in range(10):
            progress = interrupted(count)
            with pytest.raises(KeyboardInterrupt):
                make_base(request, tmp_path / "again", BlockIdentity("b"), FEW, progress=progress)
            assert not (tmp_path / "again").exists()
        before = len(server.sent)
        make_base(request, tmp_path / "again", BlockIdentity("b"), FEW)
        assert len(server.sent) == before, "nothing was read again"
        assert len([one for one in server.asked if "/search" in one]) <= 3 * searches
    assert content(tmp_path / "again") == content(tmp_path / "whole")


def test_a_process_that_is_killed_leaves_what_it_read(archive, tmp_path) -> None:
    with running_archive(archive) as server:
        region = small_part(archive)
        make_base(
            request_of(archive, server.url, bbox=region), tmp_path / "whole", BlockIdentity("b"), FEW
        )
        words = ["base", "make", "--from", "sentinel-2", "--catalogue", server.url, "--geoid"]
        words += [str(archive.geoid), "--dates", "3", "--id", "b", "-o", str(tmp_path / "again")]
        words += ["--bbox", *(repr(value) for value in region)]
        process = subprocess.Popen(
            [sys.executable, "-m", "amers", *words], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        images = tmp_path / "again.work" / "images"
        end = time.monotonic() + 60.0
        while len(list(images.glob("*.json"))) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait(10.0)
        assert len(list(images.glob("*.json"))) >= 2
        done = amers_here(words, os.environ)
        assert done.returncode == 0, done.stderr
    assert content(tmp_path / "again") == content(tmp_path / "whole")


def vanished(path: Path, place: np.ndarray, copy: Path) -> None:
    """A copy of an image on which other ground lies within 700 m of a place."""
    with rasterio.open(path) as image:
        pixels, profile = image.read(1), image.profile
        (x, y), reach = xy_of_lon_lat(image.crs.to_wkt(), place[None, :2])[0], 70
        column, row = (round(value) for value in ~image.transform @ (x, y))
    part = pixels[max(0, row - reach) : row + reach, max(0, column - reach) : column + reach]
    part[:] = np.random.default_rng(8).integers(1500, 5000, part.shape)
    with rasterio.open(copy, "w", **profile) as out:
        out.write(pixels, 1)


def test_an_update_reads_new_dates_alone_and_drops_what_they_contradict(archive, tmp_path) -> None:
    earlier = [one for one in archive.items if one["properties"]["datetime"] < "2022-09-01"]
    old, new = (replace(archive, folder=tmp_path / name, items=[]) for name in ("old", "new"))
    for one, items in ((old, earlier), (new, archive.items)):
        one.folder.mkdir()
        (one.folder / "data").symlink_to(archive.folder / "data")
        one.items.extend(items)
    work, region = tmp_path / "work", small_part(archive)
    with running_archive(old) as server:
        first = make_base(
            request_of(archive, server.url, bbox=region),
            tmp_path / "a",
            BlockIdentity("b"),
            FEW,
            place=WorkPlace(work),
        )
    gone = read_block(tmp_path / "a").points.lon_lat_h[0]
    (new.folder / "data").unlink()
    shutil.copytree(archive.folder / "data", new.folder / "data")
    for item in archive.items:
        if item["properties"]["datetime"] > "2022-09-01":
            name = f"{item['id']}_red.tif"
            vanished(archive.folder / "data" / name, gone, new.folder / "data" / name)
    with running_archive(new) as server:
        words = ["base", "update", work, "--catalogue", server.url, "-o", tmp_path / "c", "--json"]
        done = amers_here(words, os.environ)
        assert done.returncode == 0, done.stderr
        made = json.loads(done.stdout)
        images = {one.partition("?")[0].rpartition("/")[2] for one in server.asked if "_red" in one}
    assert images
    assert all(name[10:18] > "20220901" for name in images), "images of before were read again"
    metadata = read_document(tmp_path / "c").metadata
    assert (metadata.id, metadata.version) == ("b", "2")
    assert sum(date > "2022-09-01" for date in made["dates"]) >= 2
    points = read_block(tmp_path / "c").points.lon_lat_h
    off_m = np.linalg.norm((points - gone)[:, :2] * metres_per_degree(CENTRE[1], 0.0), axis=1)
    assert off_m.min() > 100.0, "the point that vanished is still there"
    assert len(points) > 0.6 * len(first.points), "chips of 1 km beside it show it, too"
    again = amers_here(
        ["base", "update", work, "--catalogue", str(old.folder), "-o", tmp_path / "d"], os.environ
    )
    assert again.returncode != 0


def test_the_archive_can_be_a_folder_and_the_region_a_file_or_a_scene(archive, tmp_path) -> None:
    region = tmp_path / "region.geojson"
    region.write_text(json.dumps(shapely.geometry.mapping(shapely.box(*small_part(archive)))))
    catalogue = str(archive.folder / "items.json")
    request = request_of(archive, catalogue, bbox=None, area=region)
    made: MadeBase = make_base(request, tmp_path / "b", BlockIdentity("b"), FEW)
    assert made.bytes == 0 or made.pixels > 0
    scene = later_scene(archive, tmp_path, "T32TLP_20240512T103021_B04_10m")
    planned, _ = plan(request_of(archive, catalogue, bbox=None, scene=scene))
    assert planned.area_km2 == pytest.approx((SIZE_PX * GSD_M / 1000.0) ** 2, rel=0.1)


def test_a_catalogue_on_a_server_leads_to_no_file_of_this_machine(archive, tmp_path) -> None:
    local = f"file://{archive.folder / 'data' / 'dem.tif'}"
    items = [
        {**one, "assets": {name: {**asset, "href": local} for name, asset in one["assets"].items()}}
        for one in archive.items
    ]
    hostile = replace(archive, items=items)
    with running_archive(hostile, Faults(is_plain=True)) as server:
        request = request_of(archive, server.url, bbox=small_part(archive))
        with pytest.raises(InputError, match="leads to a file of this machine"):
            make_base(request, tmp_path / "b", BlockIdentity("b"), FEW)


def test_what_is_missing_is_named(archive, tmp_path) -> None:
    with pytest.raises(InputError, match="--area, --bbox or --scene"):
        plan(request_of(archive, "x", bbox=None))
    with pytest.raises(
        InputError, match=r"--from: 'quickbird' found, sentinel-2, landsat or FILE\.toml"
    ):
        plan(BaseRequest("quickbird", ("x",), bbox=archive.region))
    with pytest.raises(InputError, match="within 180"):
        plan(request_of(archive, "x", bbox=(179.0, 0.0, -179.0, 1.0)))
    without = [one for one in archive.items if one["collection"] == "sentinel-2-l2a"]
    lines = tmp_path / "items.ndjson"
    lines.write_text("\n".join(json.dumps(one) for one in without))
    with pytest.raises(
        InputError, match=r"heights of the region: no item of cop-dem-glo-30 .* \(--dem\)"
    ):
        plan(request_of(archive, str(lines)))
    with pytest.raises(InputError, match="--catalogue: nothing found"):
        plan(BaseRequest("sentinel-2", (), bbox=archive.region))
    assert making.plan is plan
