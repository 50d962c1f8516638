"""Small images and files of models for cells: one invented model, whole and of a part of its image."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.transform import Affine

from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.sensor_models.dimap import format_dimap_rpc
from amers.services.formats.sensor_models.geom import format_geom
from amers.services.formats.sensor_models.rpc_text import (
    RPB_KEYS,
    RPB_LISTS,
    format_rpb,
    format_rpc_text,
    named_numbers,
    parse_rpc_text,
)
from amers.services.imagery.scene import Scene
from amers.services.sensors.rpc import RpcModel

GOLDEN = Path(__file__).parents[3] / "golden"
FULL = parse_rpc_text((GOLDEN / "invented_RPC.TXT").read_text())
GEOM = (GOLDEN / "invented.geom").read_text()
DIMAP_2 = (GOLDEN / "RPC_invented_v2.XML").read_text()
DIMAP_3 = (GOLDEN / "RPC_invented_v3.XML").read_text()
ORIGIN = (9000.0, 15000.0)
SHAPE = (60, 80)

a_hundredth_of_a_pixel = 0.01


def part(line: float = ORIGIN[0], sample: float = ORIGIN[1], step: float = 1.0) -> RpcModel:
    """The model of a part of the full image, that begins at a line and a sample and has larger steps."""
    offset = (FULL.image_offset - np.array([line, sample])) / step
    return replace(FULL, image_offset=offset, image_scale=FULL.image_scale / step)


CROP = part()


def write_image(path: Path, model: RpcModel | None = None, **profile: Any) -> Path:
    """A small GeoTIFF, with a model in its tags."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shape = profile.pop("shape", SHAPE)
    tags = profile.pop("tags", {})
    gcps = profile.pop("gcps", None)
    value = profile.pop("value", None)
    profile = {"driver": "GTiff", "dtype": "uint16", "count": 1, **profile}
    with rasterio.open(path, "w", height=shape[0], width=shape[1], **profile) as file:
        line, sample = np.indices(shape)
        file.write(
            (5 * line + 2 * sample + 1 if value is None else np.full(shape, value)).astype("uint16"), 1
        )
        if model is not None:
            file.rpcs = gdal_rpc(model)
        if gcps is not None:
            file.gcps = gcps
        file.update_tags(**tags)
    return path


def placed(line: float = ORIGIN[0], sample: float = ORIGIN[1], step: float = 1.0) -> Affine:
    """The geotransform of a crop or a reduction, from the corners of pixels."""
    return Affine(step, 0.0, sample, 0.0, step, line)


def write(path: Path, text: str) -> Path:
    """A text file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def aux_rpc(model: RpcModel) -> str:
    """An `.aux.xml` with a RPC."""
    numbers = named_numbers(model)
    rows = [f'<MDI key="{key}">{value!r}</MDI>' for key, value in numbers.items() if "COEFF" not in key]
    for name in RPB_LISTS:
        values = " ".join(repr(numbers[f"{name}_COEFF_{i}"]) for i in range(1, 21))
        rows.append(f'<MDI key="{name}_COEFF">{values}</MDI>')
    return f'<PAMDataset><Metadata domain="RPC">{"".join(rows)}</Metadata></PAMDataset>'


def isd(model: RpcModel, shape: tuple[int, int] = SHAPE, specification: str = "RPC00B") -> str:
    """The XML of a WorldView product with nothing but sizes, time, angles and a RPB block."""
    numbers = named_numbers(model)
    rows = [f"<{name.upper()}>{numbers[key]!r}</{name.upper()}>" for key, name in RPB_KEYS.items()]
    for key, name in RPB_LISTS.items():
        values = " ".join(repr(numbers[f"{key}_COEFF_{i}"]) for i in range(1, 21))
        rows.append(
            f"<{name.upper()}List><{name.upper()}>{values}</{name.upper()}></{name.upper()}List>"
        )
    bias = numbers.get("ERR_BIAS", 0.0)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        f"<isd><IMD><NUMROWS>{shape[0]}</NUMROWS><NUMCOLUMNS>{shape[1]}</NUMCOLUMNS>"
        "<FIRSTLINETIME>2024-05-01T10:20:30.5Z</FIRSTLINETIME><MEANSUNEL>41.0</MEANSUNEL>"
        "<MEANSUNAZ>152.0</MEANSUNAZ><MEANSATEL>66.0</MEANSATEL><MEANSATAZ>73.0</MEANSATAZ></IMD><RPB>"
        f"<SATID>WV02</SATID><SPECID>{specification}</SPECID><IMAGE><ERRBIAS>{bias}</ERRBIAS>"
        f"<ERRRAND>0.0</ERRRAND>{''.join(rows)}</IMAGE></RPB></isd>"
    )


def til(tiles: list[tuple[str, int, int, int, int]], units: str = "Pixels") -> str:
    """A tile map file: name, top, left, bottom, right of each tile."""
    groups = "".join(
        f'BEGIN_GROUP = TILE_{i}\n\tfilename = "{name}";\n\tULColOffset = {left};\n'
        f"\tULRowOffset = {top};\n"
        f"\tLRColOffset = {right};\n\tLRRowOffset = {bottom};\nEND_GROUP = TILE_{i}\n"
        for i, (name, top, left, bottom, right) in enumerate(tiles, start=1)
    )
    return f'bandId = "P";\nnumTiles = {len(tiles)};\ntileUnits = "{units}";\n{groups}END;\n'


def dim(
    files: list[tuple[str, int, int]], shape: tuple[int, int], size: tuple[int, int], more: str = ""
) -> str:
    """The document of a DIMAP product: its files with rows and columns, size of image and tile."""
    entries = "".join(
        f'<Data_File tile_R="{row}" tile_C="{column}"><DATA_FILE_PATH href="{name}"/></Data_File>'
        for name, row, column in files
    )
    return (
        '<Dimap_Document><Metadata_Identification><METADATA_FORMAT version="2.15">DIMAP'
        f"</METADATA_FORMAT></Metadata_Identification>{more}<Raster_Data><Data_Access><Data_Files>{entries}</Data_Files>"
        f"</Data_Access><Raster_Dimensions><NROWS>{shape[0]}</NROWS><NCOLS>{shape[1]}</NCOLS><Tile_Set>"
        f'<Regular_Tiling><NTILES_SIZE nrows="{size[0]}" ncols="{size[1]}"/><OVERLAP_ROW>0</OVERLAP_ROW>'
        "<OVERLAP_COL>0</OVERLAP_COL></Regular_Tiling></Tile_Set></Raster_Dimensions></Raster_Data>"
        "</Dimap_Document>"
    )


FORMATS = {
    "text": format_rpc_text,
    "rpb": lambda model: format_rpb(model, "WV02"),
    "isd": isd,
    "dimap 2": lambda model: format_dimap_rpc(DIMAP_2, model),
    "dimap 3": lambda model: format_dimap_rpc(DIMAP_3, model),
    "geom": lambda model: format_geom(model, GEOM),
    "aux": aux_rpc,
}
"""Texts of files with a model."""


def off_px(scene: Scene, model: RpcModel) -> float:
    """Largest distance between the model of a scene and another one, over the image."""
    line, sample = (np.linspace(0.0, size - 1.0, 3) for size in scene.image.shape)
    image = np.array([(a, b) for a in line for b in sample])
    ground = model.locate(image, np.full(len(image), float(model.ground_offset[2])))
    return float(np.abs(scene.model.project(ground) - image).max())


def right(scene: Scene, model: RpcModel) -> Scene:
    """The scene, after a check that its model is the right one within a hundredth of a pixel."""
    assert off_px(scene, model) < a_hundredth_of_a_pixel
    return scene


def without(text: str, pattern: str, by: str = "") -> str:
    """A text in which something is replaced, and was there."""
    changed = re.sub(pattern, by, text, count=1)
    assert changed != text
    return changed
