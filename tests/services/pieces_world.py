"""An ortho-image cut into pieces, as people have them: tiles, archives, catalogues, other zones."""

import json
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import rasterio
from rasterio.vrt import WarpedVRT
from rasterio.warp import Resampling, calculate_default_transform
from rasterio.windows import Window, bounds, transform

TILE_PX = 1000
OVERLAP_PX = 100


def cut(image: Path, folder: Path, name: str = "tile_{0}_{1}.tif") -> list[Path]:
    """Overlapping tiles of an image, each with its place and its value without data."""
    folder.mkdir(parents=True)
    tiles = []
    with rasterio.open(image) as whole:
        for line in range(0, whole.height, TILE_PX):
            for sample in range(0, whole.width, TILE_PX):
                lines = min(TILE_PX + OVERLAP_PX, whole.height - line)
                samples = min(TILE_PX + OVERLAP_PX, whole.width - sample)
                window = Window(sample, line, samples, lines)
                tiles.append(folder / name.format(line, sample))
                profile = whole.profile | {"height": lines, "width": samples}
                profile["transform"] = transform(window, whole.transform)
                with rasterio.open(tiles[-1], "w", **profile) as tile:
                    tile.write(whole.read(1, window=window), 1)
    return tiles


def in_zone(image: Path, target: Path, crs: str) -> Path:
    """An image on the map of another zone, of the same ground sampling.

    Its pixels are in place within a thousandth: `rasterio.warp.reproject` leaves an eighth.
    """
    with rasterio.open(image) as old:
        place, width, height = calculate_default_transform(
            old.crs, crs, old.width, old.height, *old.bounds, resolution=old.transform.a
        )
        with WarpedVRT(
            old,
            crs=crs,
            transform=place,
            width=width,
            height=height,
            resampling=Resampling.lanczos,
            tolerance=0.001,
            nodata=0,
        ) as warped:
            pixels, profile = warped.read(1), old.profile
    profile |= {"crs": crs, "transform": place, "width": width, "height": height}
    with rasterio.open(target, "w", **profile) as new:
        new.write(pixels, 1)
    return target


def as_safe(tiles: list[Path], folder: Path) -> Path:
    """Tiles as a folder of a product of Sentinel-2, with other bands and masks that are no reference."""
    granule = folder / "S2A_MSIL1C_20160608T153121_N0500_R025_T33UUU.SAFE" / "GRANULE" / "L1C"
    images, masks = granule / "IMG_DATA", granule / "QI_DATA"
    images.mkdir(parents=True)
    masks.mkdir()
    for number, tile in enumerate(tiles):
        with rasterio.open(tile) as old:
            profile, pixels = old.profile, old.read(1)
        profile.pop("nodata")
        for band, values in (("B04", pixels), ("B08", pixels[::-1])):
            with rasterio.open(images / f"T33UUU_{number}_{band}.tif", "w", **profile) as new:
                new.write(values, 1)
        with rasterio.open(masks / f"MSK_{number}.tif", "w", **profile) as new:
            new.write(pixels // 2, 1)
    return granule.parents[1]


def packed(folder: Path, target: Path) -> Path:
    """A folder as a `.zip` or a `.tar.gz`."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    if target.suffix == ".zip":
        with zipfile.ZipFile(target, "w") as archive:
            for path in files:
                archive.write(path, path.relative_to(folder.parent))
    else:
        with tarfile.open(target, "w:gz", compresslevel=1) as tar:
            for path in files:
                tar.add(path, path.relative_to(folder.parent))
    return target


def item(image: Path, folder: Path, href: str | None = None) -> Path:
    """A STAC item beside a catalogue, whose asset is an image or an archive."""
    with rasterio.open(image) as opened:
        west, south, east, north = rasterio.warp.transform_bounds(
            opened.crs, "EPSG:4326", *bounds(Window(0, 0, opened.width, opened.height), opened.transform)
        )
    corners = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    document: dict[str, Any] = {
        "type": "Feature",
        "stac_version": "1.0.0",
        "id": image.stem,
        "bbox": [west, south, east, north],
        "geometry": {"type": "Polygon", "coordinates": [corners]},
        "properties": {"datetime": "2016-06-08T15:31:21Z"},
        "assets": {
            "red": {"href": image.name, "type": "image/tiff"},
            "thumbnail": {"href": "preview.png", "type": "image/png"},
        },
        "links": [],
    }
    if href is not None:
        document["assets"]["red"] = {"href": href, "type": "application/gzip"}
    path = folder / f"{image.stem}_item.json"
    path.write_text(json.dumps(document))
    return path


def catalogue(tiles: list[Path]) -> Path:
    """A STAC collection of tiles, in their folder."""
    folder = tiles[0].parent
    links = [{"rel": "item", "href": f"./{item(tile, folder).name}"} for tile in tiles]
    path = folder / "collection.json"
    path.write_text(
        json.dumps({"type": "Collection", "stac_version": "1.0.0", "id": "tiles", "links": links})
    )
    return path
