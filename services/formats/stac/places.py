"""Paths and addresses of the files of STAC items."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace, file_place
from amers.services.formats.stac.items import Json

_IMAGE_TYPES = ("image/tiff", "image/jp2", "application/vnd.nitf")
_IMAGE_NAMES = (".tif", ".tiff", ".jp2", ".ntf", ".nitf")


def image_place(item: Json, source: str, preferred: tuple[str, ...] = ()) -> FilePlace:
    """The image file of an item: a preferred asset, the one with the role data, or the only image.

    Args:
        item: JSON, with absolute addresses.
        source: where it stands, for messages.
        preferred: names of assets, the best first.

    Raises:
        FormatError: there is none, there are several, or its address cannot be read.
    """
    assets = item.get("assets")
    images = {
        name: asset
        for name, asset in (assets.items() if isinstance(assets, dict) else ())
        if isinstance(asset, dict) and _is_image(asset)
    }
    data = {name: asset for name, asset in images.items() if "data" in (asset.get("roles") or ())}
    best = next(({name: images[name]} for name in preferred if name in images), None)
    chosen = best or data or images
    if len(chosen) != 1:
        found = ", ".join(sorted(chosen)) or "none"
        raise FormatError(
            f"{source}: assets: {found} found as images, one GeoTIFF, JPEG 2000 or NITF expected; give "
            'it the role "data"'
        )
    return place_of_address(str(next(iter(chosen.values()))["href"]), source)


def place_of_address(address: str, source: str) -> FilePlace:
    """The file at an absolute address of an item.

    Raises:
        FormatError: it cannot be read.
    """
    try:
        place = file_place(address)
    except FormatError as error:
        raise FormatError(f"{source}: {error}") from None
    if isinstance(place, Address) or "://" not in address:
        return place
    parts = urlsplit(address)
    if parts.scheme != "file" or parts.netloc:
        shown = address.partition("?")[0]
        raise FormatError(
            f"{source}: {shown:.200}: a file on this machine, in a shared folder, in a bucket (s3://) "
            "or on a server (https://) expected"
        )
    return Path(unquote(parts.path))


def _is_image(asset: Json) -> bool:
    address = asset.get("href")
    if not isinstance(address, str):
        return False
    kind = str(asset.get("type") or "").split(";")[0].strip()
    return kind in _IMAGE_TYPES or (not kind and address.lower().endswith(_IMAGE_NAMES))
