"""Choice of the model of an image that has several, in GDAL's order, and their differences.

GDAL 3.10 takes, for a GeoTIFF, the files of vendors, then the RPC tag, then `.aux.xml`; for JPEG 2000
`.aux.xml` first; for NITF `.aux.xml`, `_RPC.TXT` and RPC00B. Among files of vendors: `.RPB`, the XML of
WorldView, `_RPC.TXT`, the RPC of DIMAP, `.rpc`. What GDAL does not read comes after what it reads.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.images.tiled_image import SceneImage, TiledImage
from amers.services.formats.sensor_models.model_files import (
    Convention,
    FoundModel,
    has_model,
    read_model_file,
    tagged_model,
)
from amers.services.formats.sensor_models.product_documents import (
    airbus_names,
    document_names,
    without_tile,
)
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Statement, Subject, Use

SAME_PX = 0.01
"""Models that differ by less in the image are the same."""

_VENDORS = ("rpb", "isd", "text", "airbus", "rpc")
_OTHERS = ("other text", "other dimap", "geom", "rigorous")
ORDER = {
    "GTiff": (*_VENDORS, "tags", "aux", *_OTHERS),
    "JP2OpenJPEG": ("aux", *_VENDORS, "tags", *_OTHERS),
    "NITF": ("aux", "text", "tags", "rpb", "isd", "airbus", "rpc", *_OTHERS),
}
"""Kinds of models by the driver of the image, the first one found is used."""

ORDER_FOR_PEOPLE = (
    "STEM.RPB, STEM.XML (WorldView), STEM_RPC.TXT, RPC_NAME.XML (DIMAP), STEM.rpc, tags of the image, "
    "IMAGE.aux.xml, STEM_RPC.XML, STEM.geom, DIM_NAME.XML, METADATA.DIM, PHRDIMAP_NAME.XML; for JPEG "
    "2000 IMAGE.aux.xml first, for NITF IMAGE.aux.xml, STEM_RPC.TXT and RPC00B first"
)
"""As `--help` and documents state it."""


_WORDS: dict[Convention, str] = {
    "tags": "RPC of the image file",
    "text": "RPC as text",
    "rpb": "RPB",
    "isd": "RPB block of an ISD",
    "dimap": "RPC of DIMAP",
    "geom": "RPC of a .geom",
    "aux": "RPC of an .aux.xml",
    "rigorous": "rigorous model",
}


@dataclass(frozen=True)
class ModelSource:
    """A model that an image may have.

    Attributes:
        kind: of `ORDER`.
        path: of its file: the image itself for its tags.
        read: reads it.
    """

    kind: str
    path: FilePlace
    read: Callable[[], FoundModel]


def model_sources(image: SceneImage, siblings: Siblings) -> Iterator[ModelSource]:
    """The models of an image, the one that is used first.

    A rigorous model is one only where there is no other: an RPC is fitted to it, which takes time.
    """
    names = names_of_models(image)
    is_found = False
    for kind in ORDER.get(image.dataset.driver, ORDER["GTiff"]):
        if kind == "tags":
            if not isinstance(image, TiledImage) and image.dataset.tags(ns="RPC"):
                is_found = True
                yield ModelSource(kind, image.path, partial(tagged_model, image.dataset, image.path))
        elif kind != "rigorous" or not is_found:
            for file in siblings.named(names[kind]):
                if has_model(file):
                    is_found = True
                    yield ModelSource(kind, file, partial(read_model_file, file))


def names_of_models(image: SceneImage) -> dict[str, list[str]]:
    """By kind, the names that a file with a model of an image may have.

    The files of vendors may have the name of the whole image where the image is a tile of it.
    """
    if isinstance(image, TiledImage):
        return _names_of_product(image)
    stem, whole = image.path.stem, without_tile(image.path.stem)
    stems = list(dict.fromkeys([stem, whole]))
    return {
        "rpb": [f"{name}.RPB" for name in stems],
        "isd": [f"{name}.XML" for name in stems],
        "text": [f"{stem}_RPC.TXT"],
        "airbus": [f"RPC_{name}.XML" for name in airbus_names(stem)],
        "rpc": [f"{stem}.rpc"],
        "aux": [f"{image.path.name}.aux.xml"],
        "other text": [f"{stem}.RPC.TXT", f"RPC_{stem}.TXT"],
        "other dimap": [f"{stem}_RPC.XML"],
        "geom": [f"{stem}.geom"],
        "rigorous": [
            *document_names(stem),
            f"{stem}.DIM",
            *(f"PHRDIMAP_{name}.XML" for name in [*airbus_names(stem), whole]),
        ],
    }


def model_statements(
    used: FoundModel, model: RpcModel, others: list[tuple[str, RpcModel | str]], shape: tuple[int, int]
) -> list[Statement]:
    """What became of the models of an image.

    Args:
        used: the model that is used.
        model: the same, in the pixels of the image.
        others: names of the other models, and each in the pixels of the image, or why it has none.
        shape: of the image.
    """
    statements = []
    differ = []
    for name, other in others:
        if isinstance(other, str):
            note = f"{used.name} is used: {other}"
        else:
            difference_px = largest_difference_px(model, other, shape)
            if difference_px < SAME_PX:
                continue
            apart = (
                f"{difference_px:.2f} px" if np.isfinite(difference_px) else "another place of the Earth"
            )
            note = f"{apart} from {used.name}, which is used as GDAL does; --model takes the other"
            differ.append(name)
        statements.append(Statement(name, Subject.MODEL, Use.NOT_USED, "another model", note=note))
    note = f"before {', '.join(differ)}" if differ else ""
    return [
        Statement(used.name, Subject.MODEL, Use.USED, _WORDS[used.convention], note=note),
        *statements,
    ]


def largest_difference_px(model: RpcModel, other: RpcModel, shape: tuple[int, int]) -> float:
    """Largest distance in an image between two models, over corners, sides and middle at two heights.

    Infinite where the other one does not see the ground that the first one sees.
    """
    low, high = model.height_range_m
    line, sample = np.meshgrid(*(np.linspace(0.0, size - 1.0, 3) for size in shape), indexing="ij")
    image = np.tile(np.column_stack([line.ravel(), sample.ravel()]), (2, 1))
    middle, half = (low + high) / 2.0, (high - low) / 4.0
    ground = model.locate(image, np.repeat([middle - half, middle + half], len(image) // 2))
    apart = np.hypot(*(other.project(ground) - model.project(ground)).T)
    return float(np.inf if np.isnan(apart).any() else apart.max())


def other_model(read: Callable[[], RpcModel]) -> RpcModel | str:
    """A model that is not used, or why it cannot be read."""
    try:
        return read()
    except FormatError as error:
        return str(error)


def _names_of_product(image: TiledImage) -> dict[str, list[str]]:
    """The names for the whole image of a product, in the formats of its vendor."""
    names: dict[str, list[str]] = {kind: [] for kinds in ORDER.values() for kind in kinds}
    tiles = [tile.path.stem for tile in image.tiles]
    stems = list(dict.fromkeys([image.path.stem, *map(without_tile, tiles), *tiles]))
    wholes = list(dict.fromkeys([image.path.stem, without_tile(tiles[0])]))
    names["rpb"] = [f"{name}.RPB" for name in stems]
    names["isd"] = [f"{name}.XML" for name in stems]
    names["text"] = [f"{name}_RPC.TXT" for name in wholes]
    names["airbus"] = list(dict.fromkeys(f"RPC_{n}.XML" for tile in tiles for n in airbus_names(tile)))
    names["rigorous"] = [image.path.name]
    return names
