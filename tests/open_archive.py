"""A simulated archive of Sentinel-2 kind, as files and as a catalogue with its server on 127.0.0.1."""

import json
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import rasterio
import shapely
from rasterio.transform import Affine

from amers.services.geodesy import metres_per_degree, sun_direction
from amers.services.imagery.archives import COPERNICUS_DEM, SENTINEL_2
from amers.services.map_grid import lon_lat_of_xy, xy_of_lon_lat
from amers.services.simulation.conditions import clouds_over
from amers.services.simulation.grid import bilinear_values
from amers.services.simulation.light import day_of, radiance
from amers.services.simulation.world import World, make_world, natural_noise
from amers.services.types import Array

CENTRE = (6.0, 43.6)
"""On the border of the zones 31 and 32."""
POSTING_M = 5.0
GSD_M = 10.0
GEOID_M = 48.0
SIZE_PX = 700
TILES = {"31TGJ": ("EPSG:32631", -1_700.0), "32TLP": ("EPSG:32632", 1_700.0)}
"""Tiles, by their map and their distance east of the centre, metres: 7 km wide, they overlap."""
REGION_M = 3_500.0
"""Half the width of the region east and west of the centre; 1,500 m north and south."""
ORBITS = {"22": 0, "65": 3}
"""Relative orbits and their first day."""
DATES = 24
LOCAL_M = 0.9
"""Errors of details within a date, a coordinate, metres: what the two dates of Berlin have
(`pytest -s tests/journeys/test_real_base.py`)."""
_WAVES = 12
_WAVELENGTHS_M = 2000.0, 6000.0
_HAZE = 300.0
_GAIN = 6000.0


@dataclass(frozen=True)
class TrueDate:
    """A date of the archive: what is stated, and its error (2,) east, north, metres."""

    moment: datetime
    orbit: str
    baseline: str
    cloud: float
    snow: float
    error_m: Array
    waves: Array = field(default_factory=lambda: np.empty((0, 2, 4)))

    def error_at(self, lon_lat: Array) -> Array:
        """The error (…, 2) at places (…, 2): that of the date, and what varies over the ground."""
        metres = (lon_lat - np.array(CENTRE)) * np.array(metres_per_degree(CENTRE[1], 0.0))
        error_m = np.broadcast_to(self.error_m, lon_lat.shape).copy()
        for waves in self.waves:
            for axis, (per_east, per_north, phase, amplitude_m) in enumerate(waves.tolist()):
                angle = metres[..., 0] * per_east + metres[..., 1] * per_north + phase
                error_m[..., axis] += amplitude_m * np.sin(angle)
        return error_m


@dataclass
class OpenArchive:
    """Files of the archive and their truth.

    Attributes:
        folder: with `items.json` (item collection), images, masks and heights.
        world: the ground.
        dates: by the day and orbit in the names of items.
        region: west, south, east, north.
        geoid: grid of EGM2008 for it.
    """

    folder: Path
    world: World
    dates: dict[str, TrueDate]
    region: tuple[float, float, float, float]
    geoid: Path
    items: list[dict[str, Any]] = field(default_factory=list)

    def error_of(self, date: str) -> Array:
        """The true error (2,) of a date, such as 2021-05-02, the mean over the region."""
        return self.dates[date[:10].replace("-", "")].error_at(self.places).mean(axis=0)

    @property
    def places(self) -> Array:
        """Longitudes and latitudes (n, 2) all over the region."""
        west, south, east, north = self.region
        lon, lat = np.meshgrid(np.linspace(west, east, 29), np.linspace(south, north, 13))
        return np.column_stack([lon.ravel(), lat.ravel()])


def make_archive(folder: Path, seed: int = 7, dates: int = DATES) -> OpenArchive:
    """Simulate the archive, or its first dates, and write its files."""
    rng = np.random.default_rng(seed)
    world = make_world(rng, 8_000.0, POSTING_M, 150.0, centre_lon_lat=CENTRE, region_m=2_500.0)
    east_m, north_m = metres_per_degree(CENTRE[1], 0.0)
    reach = REGION_M / east_m, 1_500.0 / north_m
    region = (CENTRE[0] - reach[0], CENTRE[1] - reach[1], CENTRE[0] + reach[0], CENTRE[1] + reach[1])
    (folder / "data").mkdir(parents=True)
    archive = OpenArchive(folder, world, {}, region, folder / "geoid.gtx")
    for date in _dates(rng)[:dates]:
        name = f"{date.moment:%Y%m%d}"
        archive.dates[name] = date
        light = light_of(world, date, rng)
        for tile in TILES:
            archive.items.append(_write_granule(archive, tile, date, light, rng))
    archive.items.append(_write_heights(archive, rng.spawn(1)[0]))
    write_geoid(archive.geoid)
    document = {"type": "FeatureCollection", "features": archive.items}
    (folder / "items.json").write_text(json.dumps(document))
    return archive


def _dates(rng: np.random.Generator) -> list[TrueDate]:
    """Dates of two orbits over two years: a third of the older baseline, a third cloudy, one in snow."""
    common_m = rng.normal(0.0, SENTINEL_2.accuracy[1].common_m, 2)
    dates = []
    for number in range(DATES):
        orbit = list(ORBITS)[number % 2]
        day = 30 * number + ORBITS[orbit]
        is_new = number >= DATES // 3
        moment = datetime(2021, 2, 3, 10, 30, tzinfo=UTC) + timedelta(days=day)
        stated = SENTINEL_2.accuracy[1 if is_new else 0]
        error_m = rng.normal(0.0, stated.own_m, 2) + (common_m if is_new else 0.0)
        cloud = float(rng.uniform(0.3, 0.8)) if number % 3 == 1 else float(rng.uniform(0.0, 0.08))
        snow = 0.5 if moment.month == 1 else 0.0
        baseline = "05.10" if is_new else "02.14"
        dates.append(TrueDate(moment, orbit, baseline, cloud, snow, error_m, _waves(rng.spawn(1)[0])))
    return dates


def _waves(rng: np.random.Generator) -> Array:
    """Waves (n, 2, 4) over the ground, of east and north: per metre east and north, phase, amplitude."""
    shape = _WAVES, 2
    per_metre = 2.0 * np.pi / rng.uniform(*_WAVELENGTHS_M, shape)
    direction, phase = rng.uniform(0.0, 2.0 * np.pi, (2, *shape))
    amplitude_m = np.full(shape, LOCAL_M * np.sqrt(2.0 / _WAVES))
    return np.stack(
        [per_metre * np.cos(direction), per_metre * np.sin(direction), phase, amplitude_m], axis=-1
    )


def light_of(world: World, date: TrueDate, rng: np.random.Generator) -> Any:
    """Light of the cells of the world on a day, averaged over pixels of 10 m."""
    day = date.moment.date()
    season = 0.25 * (1.0 - np.cos(2.0 * np.pi * (day.timetuple().tm_yday - 196) / 365.25))
    sun = sun_direction(world.centre_lon_lat, date.moment)
    state = day_of(world, day, *sun, season=float(season))
    light = radiance(world, state, (0, 0), world.albedo.shape)
    return cv2.GaussianBlur(light, (0, 0), 0.45 * GSD_M / POSTING_M)


def map_of(tile: str) -> tuple[str, Affine]:
    crs, east_m = TILES[tile]
    per_degree = metres_per_degree(CENTRE[1], 0.0)[0]
    centre = xy_of_lon_lat(crs, np.array([[CENTRE[0] + east_m / per_degree, CENTRE[1]]]))[0]
    west, north = np.round((centre + [-SIZE_PX * GSD_M / 2.0, SIZE_PX * GSD_M / 2.0]) / 20.0) * 20.0
    return crs, Affine(GSD_M, 0.0, west, 0.0, -GSD_M, north)


@lru_cache
def lon_lat_of_pixels(tile: str) -> Array:
    """(lines, samples, 2) longitude and latitude of the centres of pixels."""
    crs, transform = map_of(tile)
    at = np.arange(SIZE_PX) + 0.5
    column, row = np.meshgrid(at, at)
    xy = np.column_stack(transform @ (column.ravel(), row.ravel()))
    return lon_lat_of_xy(crs, xy).reshape(SIZE_PX, SIZE_PX, 2)


def ortho_pixels(world: World, light: Any, lon_lat: Array, error_m: Array) -> Array:
    """Light at pixels (…, 2), which show the ground that lies `error_m` west and south of them."""
    degrees = np.asarray(error_m) / np.array(metres_per_degree(CENTRE[1], 0.0))
    place = world.column_row((lon_lat - degrees).reshape(-1, 2))
    return bilinear_values(light, place).reshape(lon_lat.shape[:-1])


def _write_granule(
    archive: OpenArchive, tile: str, date: TrueDate, light: Any, rng: np.random.Generator
) -> dict[str, Any]:
    crs, transform = map_of(tile)
    lon_lat = lon_lat_of_pixels(tile)
    seen = ortho_pixels(archive.world, light, lon_lat, date.error_at(lon_lat))
    classes = np.full(seen.shape, 4, dtype=np.uint8)
    at = np.arange(SIZE_PX, dtype=np.float64)
    if (clouds := clouds_over(seen.shape, date.cloud, rng)) is not None:
        opacity = clouds.opacity(at, at)
        seen = seen + opacity * (0.65 - seen)
        classes[opacity > 0.1] = 9
    if date.snow:
        noise = cv2.resize(natural_noise(rng, 128, 2.5, 0.05), seen.shape[::-1])
        fallen = noise > np.quantile(noise, 1.0 - date.snow)
        seen = np.where(fallen, 0.85, seen)
        classes[fallen] = 11
    added = 1000.0 if date.baseline >= "04.00" else 0.0
    values = _HAZE + _GAIN * seen + rng.normal(0.0, 15.0, seen.shape) + added
    pixels = np.clip(np.rint(values), 1, 65534).astype(np.uint16)
    beyond = np.zeros(seen.shape, dtype=np.bool_)
    if date.orbit == "65" and tile == "31TGJ":
        column, row = np.meshgrid(at, at)
        beyond = column < 0.25 * SIZE_PX + 0.2 * row
    pixels[beyond] = 0
    classes[beyond] = 0
    name = f"S2A_{tile}_{date.moment:%Y%m%d}_0_L2A"
    write_cog(archive.folder / "data" / f"{name}_red.tif", pixels, crs, transform)
    coarse = transform @ Affine.scale(2.0)
    write_cog(archive.folder / "data" / f"{name}_scl.tif", classes[::2, ::2], crs, coarse)
    return _item(name, tile, date, lon_lat, is_cut=bool(beyond.any()))


def write_cog(path: Path, pixels: Any, crs: str, transform: Affine, **more: Any) -> None:
    """Write a tiled GeoTIFF."""
    profile = {
        "driver": "GTiff",
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "count": 1,
        "dtype": pixels.dtype,
        "crs": crs,
        "transform": transform,
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "compress": "DEFLATE",
        "nodata": 0,
        **more,
    }
    with rasterio.open(path, "w", **profile) as file:
        file.write(pixels, 1)


def _item(name: str, tile: str, date: TrueDate, lon_lat: Array, *, is_cut: bool) -> dict[str, Any]:
    corners = [lon_lat[0, 0], lon_lat[-1, 0], lon_lat[-1, -1], lon_lat[0, -1]]
    if is_cut:
        corners[:2] = [lon_lat[0, SIZE_PX // 4], lon_lat[-1, int(0.45 * SIZE_PX) - 1]]
    ring = [corner.tolist() for corner in [*corners, corners[0]]]
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": name,
        "collection": "sentinel-2-l2a",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": {
            "datetime": f"{date.moment:%Y-%m-%dT%H:%M:%SZ}",
            "platform": "sentinel-2a",
            "eo:cloud_cover": round(100.0 * date.cloud, 2),
            "eo:snow_cover": round(100.0 * date.snow, 2),
            "grid:code": f"MGRS-{tile}",
            "sat:relative_orbit": int(date.orbit),
            "s2:processing_baseline": date.baseline,
        },
        "assets": {
            "red": {"href": f"data/{name}_red.tif", "type": "image/tiff; application=geotiff"},
            "scl": {"href": f"data/{name}_scl.tif", "type": "image/tiff; application=geotiff"},
        },
        "links": [],
    }


def _write_heights(archive: OpenArchive, rng: np.random.Generator) -> dict[str, Any]:
    """The terrain of the world above the geoid, every 30 m."""
    west, south, east, north = archive.region
    margin, step = 0.08, 1.0 / 3600.0
    lon = np.arange(west - margin, east + margin, step)
    lat = np.arange(north + margin, south - margin, -step)
    grid = np.stack(np.meshgrid(lon, lat), axis=-1)
    heights = archive.world.height_m(grid.reshape(-1, 2)).reshape(grid.shape[:2]) - GEOID_M
    stated = COPERNICUS_DEM.accuracy[0]
    noise = cv2.resize(natural_noise(rng, 256, 1.0, 0.0), heights.shape[::-1])
    heights += rng.normal(0.0, stated.common_m) + stated.own_m * noise / noise.std()
    transform = Affine(step, 0.0, lon[0] - step / 2.0, 0.0, -step, lat[0] + step / 2.0)
    path = archive.folder / "data" / "dem.tif"
    write_cog(path, heights.astype(np.float32), "EPSG:4326", transform, nodata=-32767.0)
    box = shapely.box(lon[0], lat[-1], lon[-1], lat[0])
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": "Copernicus_DSM_COG_10_N43_00_E006_00_DEM",
        "collection": "cop-dem-glo-30",
        "geometry": shapely.geometry.mapping(box),
        "properties": {"datetime": "2021-04-22T00:00:00Z"},
        "assets": {"data": {"href": "data/dem.tif", "type": "image/tiff; application=geotiff"}},
        "links": [],
    }


def write_geoid(path: Path, centre: tuple[float, float] = CENTRE) -> None:
    """A geoid that is level, as GTX."""
    rows, columns = 41, 41
    header = struct.pack(">4d2i", centre[1] - 2.0, centre[0] - 2.0, 0.1, 0.1, rows, columns)
    path.write_bytes(header + np.full((rows, columns), GEOID_M, dtype=">f4").tobytes())


@dataclass
class Faults:
    """What a server does wrong.

    Attributes:
        busy: replies of 429 that are left for searches.
        failing: replies of 503 and 429 that are left for files.
        uses: requests after which a signature expires; 0: addresses have none.
        broken: names of files whose pixels are damaged.
        gone: names of files that are not there.
        is_plain: addresses of items stay as they are.
    """

    busy: int = 0
    failing: int = 0
    uses: int = 0
    broken: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    is_plain: bool = False


class _Handler(BaseHTTPRequestHandler):
    """A STAC API in pages, and its files by ranges."""

    archive: OpenArchive
    faults: Faults
    asked: list[str]
    sent: list[int]
    signature: list[int]
    lock: threading.Lock
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._reply(urlsplit(self.path).path, None)

    def do_HEAD(self) -> None:
        self._reply(urlsplit(self.path).path, None)

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self._reply(urlsplit(self.path).path, body)

    def log_message(self, *_: Any) -> None:
        """Keep quiet."""

    @property
    def base(self) -> str:
        host, port = self.server.server_address[:2]
        return f"http://{host!s}:{port}"

    def _reply(self, path: str, body: dict[str, Any] | None) -> None:
        self.asked.append(f"{self.command} {self.path}")
        if path == "/":
            link = {"rel": "search", "href": f"{self.base}/search"}
            self._json({"type": "Catalog", "stac_version": "1.0.0", "links": [link]})
        elif path == "/search":
            with self.lock:
                is_busy, self.faults.busy = self.faults.busy > 0, self.faults.busy - 1
            if is_busy:
                self._send(429, b"", {"Retry-After": "0"})
            else:
                self._search(body)
        elif path.startswith("/items/"):
            name = path.removeprefix("/items/")
            self._json(next(self._signed(one) for one in self.archive.items if one["id"] == name))
        else:
            self._file(path.removeprefix("/"))

    def _search(self, body: dict[str, Any] | None) -> None:
        query = parse_qs(urlsplit(self.path).query)
        wanted = body["collections"] if body else query["collections"][0]
        first = 0 if body is None else int(body["token"])
        found = [one for one in self.archive.items if one["collection"] in wanted]
        page = [self._signed(one) for one in found[first : first + 20]]
        links = []
        if first + 20 < len(found):
            following = {"token": str(first + 20), "collections": wanted}
            links = [{"rel": "next", "href": f"{self.base}/search", "method": "POST", "body": following}]
        self._json({"type": "FeatureCollection", "features": page, "links": links})

    def _signed(self, item: dict[str, Any]) -> dict[str, Any]:
        query = f"?sig={self.signature[0]}" if self.faults.uses else ""
        assets = {
            name: asset
            if self.faults.is_plain
            else {**asset, "href": f"{self.base}/{asset['href']}{query}"}
            for name, asset in item["assets"].items()
        }
        links = [{"rel": "self", "href": f"{self.base}/items/{item['id']}"}]
        return {**item, "assets": assets, "links": links}

    def _file(self, name: str) -> None:
        with self.lock:
            if self.faults.failing > 0:
                self.faults.failing -= 1
                self._send(429 if self.faults.failing % 2 else 503, b"")
                return
            signature = parse_qs(urlsplit(self.path).query).get("sig", [""])[0]
            if self.faults.uses:
                self.signature[1] += 1
                if self.signature[1] % self.faults.uses == 0:
                    self.signature[0] += 1
            is_refused = bool(self.faults.uses) and int(signature or -1) < self.signature[0] - 1
        path = self.archive.folder / name
        if is_refused:
            self._send(403, b"")
        elif name.rpartition("/")[2] in self.faults.gone or not path.is_file():
            self._send(404, b"")
        else:
            self._range(path)

    def _range(self, path: Path) -> None:
        size = path.stat().st_size
        headers = {
            "Last-Modified": "Wed, 21 Oct 2026 07:28:00 GMT",
            "ETag": '"1"',
            "Accept-Ranges": "bytes",
        }
        stated = self.headers.get("Range")
        first, last = 0, size - 1
        if stated is not None:
            first, last = (int(part) for part in stated.removeprefix("bytes=").split("-"))
            last = min(last, size - 1)
            headers["Content-Range"] = f"bytes {first}-{last}/{size}"
            self.sent.append(last + 1 - first)
        with path.open("rb") as file:
            file.seek(first)
            content = bytearray(file.read(last + 1 - first))
        if path.name in self.faults.broken:
            start, end = max(0, 2000 - first), max(0, 2000 + size // 2 - first)
            content[start:end] = bytes(len(content[start:end]))
        self._send(200 if stated is None else 206, bytes(content), headers)

    def _json(self, document: dict[str, Any]) -> None:
        self._send(200, json.dumps(document).encode())

    def _send(self, status: int, content: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


@dataclass
class RunningArchive:
    """A server of an archive.

    Attributes:
        url: of its landing page.
        asked: requests so far.
        sent: lengths of ranges.
    """

    url: str
    asked: list[str]
    sent: list[int]


@contextmanager
def running_archive(archive: OpenArchive, faults: Faults | None = None) -> Iterator[RunningArchive]:
    """Serve an archive on 127.0.0.1 until the end of the block."""
    members: dict[str, Any] = {
        "archive": archive,
        "faults": faults or Faults(),
        "asked": [],
        "sent": [],
        "signature": [1, 0],
        "lock": threading.Lock(),
    }
    handler = type("Handler", (_Handler,), members)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as service:
        service.daemon_threads = True
        thread = threading.Thread(target=service.serve_forever, daemon=True)
        thread.start()
        try:
            address = f"http://127.0.0.1:{service.server_port}"
            yield RunningArchive(address, members["asked"], members["sent"])
        finally:
            service.shutdown()
            thread.join(5.0)
