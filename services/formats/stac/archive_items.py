"""STAC items of archives of ortho-images: tile, orbit and processing baseline.

| fact | properties, the first that is stated |
|---|---|
| tile | `grid:code`; `s2:mgrs_tile`; `mgrs:utm_zone` and its parts; `landsat:wrs_path` and `…_row` |
| tile otherwise | `proj:code` or `proj:epsg` with the place of the footprint |
| orbit | `sat:relative_orbit`; `landsat:wrs_path`; `R…` in `s2:product_uri` or in the id |
| baseline | `s2:processing_baseline`; `processing:version`; `N…` as for the orbit |
"""

import math
import re
from typing import Any

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.stac.items import StacImage, parse_item
from amers.services.geodesy import sun_direction
from amers.services.imagery.archives import Archive, ArchiveImage

_ORBIT = re.compile(r"_R(\d{3})_")
_BASELINE = re.compile(r"_N(\d{2})(\d{2})_")


def archive_image(item: Any, archive: Archive, source: str) -> ArchiveImage:
    """What an item states of its image.

    Args:
        item: JSON of a STAC item.
        archive: that it belongs to.
        source: where it stands, for messages.

    Raises:
        FormatError: a field is missing or wrong, or the item is of another collection.
    """
    stated = parse_item(item, source)
    collection, name = stated.key
    if collection and archive.collections and collection not in archive.collections:
        expected = ", ".join(archive.collections)
        raise FormatError(
            f"{source}: item {name!r:.80}: collection {collection:.80} found, {expected} expected"
        )
    asset_address(item, archive.image, source)
    properties = item["properties"]
    product = f"{properties.get('s2:product_uri') or name}_"
    quality = properties.get(archive.quality)
    if quality is not None and quality not in archive.qualities:
        raise FormatError(
            f"{source}: item {name!r:.80}: {archive.quality}: {quality!r:.40} found, "
            f"{' or '.join(archive.qualities)} expected: the accuracy of others is not stated"
        )
    baseline = _text(properties, "s2:processing_baseline", "processing:version")
    if not baseline and (found := _BASELINE.search(product)):
        baseline = f"{found[1]}.{found[2]}"
    orbit = _text(properties, "sat:relative_orbit", "landsat:wrs_path")
    if not orbit and (found := _ORBIT.search(product)):
        orbit = str(int(found[1]))
    return ArchiveImage(
        id=name,
        acquired=stated.acquired,
        platform=stated.platform,
        orbit=orbit,
        tile=_tile(properties, stated.footprint),
        baseline=baseline,
        footprint=stated.footprint,
        cloud=_share(stated.cloud_percent),
        snow=_share(stated.snow_percent),
        sun_deg=_sun_deg(stated),
        offset=archive.offset_of(baseline, properties),
        accuracy=archive.stated(baseline),
    )


def asset_address(item: Any, name: str, source: str) -> str:
    """The address of an asset of an item.

    Raises:
        FormatError: the item has no such asset.
    """
    assets = item.get("assets")
    asset = assets.get(name) if isinstance(assets, dict) else None
    address = asset.get("href") if isinstance(asset, dict) else None
    if not isinstance(address, str) or not address:
        found = ", ".join(sorted(assets)) if isinstance(assets, dict) else "none"
        raise FormatError(
            f"{source}: item {item.get('id')!r:.80}: assets: {found:.200} found, {name} expected; name "
            "the assets of this catalogue in a file (--from FILE.toml)"
        )
    return address


def _tile(properties: Any, footprint: Any) -> str:
    direct = _text(properties, "grid:code", "s2:mgrs_tile").removeprefix("MGRS-").removeprefix("T")
    if direct:
        return direct
    for names in (
        ("mgrs:utm_zone", "mgrs:latitude_band", "mgrs:grid_square"),
        ("landsat:wrs_path", "landsat:wrs_row"),
    ):
        parts = [_text(properties, name) for name in names]
        if all(parts):
            return "".join(parts) if names[0].startswith("mgrs") else "-".join(parts)
    lon, lat = footprint.centroid.coords[0]
    code = _text(properties, "proj:code", "proj:epsg").removeprefix("EPSG:")
    return f"{code or 'map'}_{lon:.1f}_{lat:.1f}"


def _text(properties: Any, *names: str) -> str:
    for name in names:
        value = properties.get(name)
        if isinstance(value, str | int) and not isinstance(value, bool) and str(value):
            return str(value)
    return ""


def _sun_deg(stated: StacImage) -> tuple[float, float]:
    """Elevation and azimuth of the sun: as stated, else of the time and the place."""
    sun_deg = stated.sun_elevation_deg, stated.sun_azimuth_deg
    if np.isfinite(sun_deg).all():
        return sun_deg
    return sun_direction(np.array(stated.footprint.centroid.coords[0]), stated.acquired)


def _share(percent: float) -> float:
    return 0.0 if math.isnan(percent) else percent / 100.0
