"""Scenes from STAC items: their image files, and the statements of the items."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import shapely
from pyproj import CRS
from pyproj.exceptions import CRSError

from amers.services.datums import horizontal
from amers.services.errors import FormatError
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.stac.items import Json, StacImage, parse_item
from amers.services.formats.stac.places import image_place
from amers.services.imagery.hidden import without_hidden_ground
from amers.services.imagery.scene import Scene
from amers.services.sensors.ortho import OrthoModel
from amers.services.statements import Statement, Subject, Use

READER = Reader(
    "Items of STAC catalogues",
    ("read_catalogue", "read_item_scene"),
    (
        Treatment(Subject.IDENTITY, "used", "`id`, `platform` and the time identify the image."),
        Treatment(Subject.IDENTITY, "refused", "Two items have the same id, or an item has no id."),
        Treatment(
            Subject.VALIDITY,
            "used",
            "The item has masks in GeoJSON. The ground that they cover counts as hidden in the image.",
        ),
        Treatment(Subject.VALIDITY, "named", "The item has masks in other formats."),
        Treatment(
            Subject.BANDS, "refused", "The item has several images, and none of them has the role data."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM, "refused", "A mask in GeoJSON is in another system than WGS 84."
        ),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "named",
            "`proj:code` or `proj:epsg` states another system than the image. Amers uses "
            "the system of the image.",
        ),
        Treatment(Subject.ORDER, "refused", "A latitude of the footprint is above 90 degrees."),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The item has a property `accuracy:…`. Its meaning differs between producers.",
        ),
        Treatment(Subject.UNIT, "refused", "An angle or a percentage is out of its range."),
    ),
    never=(
        Subject.MODEL,
        Subject.PLACE,
        Subject.PIXEL_ORIGIN,
        Subject.VERTICAL_DATUM,
        Subject.EPOCH,
    ),
)


def read_item_scene(
    item: Any,
    source: str,
    hidden: shapely.Geometry | None = None,
    *,
    sigma_m: float | None = None,
    ortho_sigma_m: float | None = None,
) -> Scene:
    """The scene of an item's image, without the ground that its masks hide.

    Its name is that of the item; platform and time are the item's where it states them.

    Args:
        item: JSON of a STAC item, with absolute addresses.
        source: where it stands, for messages.
        hidden: polygons of clouds and the like; None hides nothing.
        sigma_m, ortho_sigma_m: accuracy of the model, see `read_scene`.

    Raises:
        FormatError: the item has no image in a file, or the image cannot be used.
    """
    stated = parse_item(item, source)
    name = stated.key[1]
    path = image_place(item, f"{source}: item {name!r:.80}")
    try:
        scene = read_scene(path, sigma_m=sigma_m, ortho_sigma_m=ortho_sigma_m)
        scene = without_hidden_ground(scene, hidden)
    except FormatError as error:
        raise FormatError(f"image {name:.80}: {error}") from None
    acquisition = replace(
        scene.acquisition,
        image_id=name,
        sensor=stated.platform or scene.acquisition.sensor,
        acquired_at=stated.acquired,
        sun_elevation_deg=stated.sun_elevation_deg,
        sun_azimuth_deg=stated.sun_azimuth_deg,
    )
    own = _statements(item["properties"], stated, scene, hidden)
    return replace(scene, acquisition=acquisition, statements=(*own, *scene.statements))


def _statements(
    properties: Json, stated: StacImage, scene: Scene, hidden: shapely.Geometry | None
) -> Iterator[Statement]:
    """What became of the statements of an item about its image."""
    name = stated.key[1]
    yield Statement(name, Subject.IDENTITY, Use.USED, stated.platform or name)
    if hidden is not None:
        yield Statement(name, Subject.VALIDITY, Use.USED, "masks in GeoJSON")
    if stated.other_masks:
        value = f"{stated.other_masks} masks"
        note = "they are no GeoJSON; --exclude takes masks on a map"
        yield Statement(name, Subject.VALIDITY, Use.NOT_USED, value, "assets", note)
    code = properties.get("proj:code") or properties.get("proj:epsg")
    if code is not None and isinstance(scene.model, OrthoModel):
        crs = str(code) if ":" in str(code) else f"EPSG:{code}"
        if not _is_same(crs, scene.model.grid.crs):
            note = "that of the image is used"
            yield Statement(name, Subject.HORIZONTAL_DATUM, Use.NOT_USED, crs, "proj", note)
    for key in sorted(key for key in properties if key.startswith("accuracy:")):
        value = f"{key} {properties[key]}"[:80]
        yield Statement(name, Subject.ACCURACY, Use.NOT_USED, value, note="--sigma-m states it")


def _is_same(code: str, crs: str) -> bool:
    """Whether a code is that of the horizontal system of an image; an unknown code is of none."""
    try:
        return horizontal(CRS.from_user_input(code)) == horizontal(CRS.from_user_input(crs))
    except CRSError:
        return False
