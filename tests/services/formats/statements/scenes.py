"""Scenes with several models, parts of full images, and products in tiles."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from rasterio.control import GroundControlPoint

from amers.services.formats.images import scene_rows
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models import product_documents
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.sensor_models.rpc_text import format_rpc_text
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Subject
from tests.services.formats.statements.cell import cell
from tests.services.formats.statements.scene_files import (
    CROP,
    FORMATS,
    FULL,
    GOLDEN,
    SHAPE,
    dim,
    part,
    placed,
    right,
    til,
    write,
    write_image,
)

SCENE, PRODUCT = scene_rows.READER.name, product_documents.READER.name
OTHER = part(9003.0, 15004.0)


@cell(SCENE, Subject.MODEL, "used", "tags of a.tif: sensor model: RPC of the image file: used")
def tags_alone(folder: Path) -> Scene:
    return right(read_scene(write_image(folder / "a.tif", CROP)), CROP)


@cell(SCENE, Subject.MODEL, "used", "a_RPC.TXT: sensor model: RPC as text: used (before tags of a.tif)")
def text_before_tags(folder: Path) -> Scene:
    write(folder / "a_RPC.TXT", FORMATS["text"](CROP))
    return right(read_scene(write_image(folder / "a.tif", OTHER)), CROP)


@cell(
    SCENE, Subject.MODEL, "named", "tags of a.tif: sensor model: another model: not used (5.00 px from"
)
def tags_after_text(folder: Path) -> Scene:
    write(folder / "a_RPC.TXT", FORMATS["text"](CROP))
    return read_scene(write_image(folder / "a.tif", OTHER))


@cell(
    SCENE, Subject.MODEL, "named", "a_RPC.TXT: sensor model: another model: not used (5.00 px from a.RPB"
)
def text_after_rpb(folder: Path) -> Scene:
    write(folder / "a_RPC.TXT", FORMATS["text"](OTHER))
    write(folder / "a.RPB", FORMATS["rpb"](CROP))
    return right(read_scene(write_image(folder / "a.tif")), CROP)


@cell(SCENE, Subject.MODEL, "named", "a.tif.aux.xml: sensor model: another model: not used (5.00 px")
def aux_after_tags_of_a_geotiff(folder: Path) -> Scene:
    write(folder / "a.tif.aux.xml", FORMATS["aux"](OTHER))
    return right(read_scene(write_image(folder / "a.tif", CROP)), CROP)


@cell(SCENE, Subject.MODEL, "named", "a.geom: sensor model: another model: not used (5.00 px")
def geom_after_isd(folder: Path) -> Scene:
    write(folder / "a.geom", FORMATS["geom"](OTHER))
    write(folder / "a.XML", FORMATS["isd"](CROP))
    return right(read_scene(write_image(folder / "a.tif")), CROP)


@cell(SCENE, Subject.MODEL, "named", "a.RPB is used: a_RPC.TXT: LINE_OFF is missing")
def broken_model_that_is_not_used(folder: Path) -> Scene:
    write(folder / "a_RPC.TXT", FORMATS["text"](CROP).replace("LINE_OFF", "LINE_OFFSET"))
    write(folder / "a.RPB", FORMATS["rpb"](CROP))
    return right(read_scene(write_image(folder / "a.tif")), CROP)


@cell(SCENE, Subject.MODEL, "refused", "no sensor model found")
def image_without_any(folder: Path) -> Scene:
    return read_scene(write_image(folder / "a.tif"))


@cell(SCENE, Subject.MODEL, "refused", "it has 4 ground control points, to which no model is fitted")
def image_with_ground_control_points(folder: Path) -> Scene:
    corners = [GroundControlPoint(r, c, 5.0 + c / 1e4, 44.0 - r / 1e4) for r in (0, 60) for c in (0, 80)]
    return read_scene(write_image(folder / "a.tif", gcps=(corners, "EPSG:4326")))


@cell(SCENE, Subject.MODEL, "refused", "delivered.txt beside it has a model: --model takes it")
def model_of_another_name(folder: Path) -> Scene:
    write(folder / "delivered.txt", FORMATS["text"](CROP))
    return read_scene(write_image(folder / "a.tif"))


@cell(
    SCENE, Subject.PLACE, "used", "a.tif, geotransform: place in the full image: line 9000, sample 15000"
)
def crop_with_the_model_of_the_full_image(folder: Path) -> Scene:
    return right(read_scene(write_image(folder / "a.tif", FULL, transform=placed())), CROP)


@cell(SCENE, Subject.PLACE, "used", "line 9000.5, sample 15000.5, in steps of 2 x 2 px")
def reduced_crop_with_the_model_of_the_full_image(folder: Path) -> Scene:
    image = write_image(folder / "a.tif", FULL, transform=placed(step=2.0))
    return right(read_scene(image), part(9000.5, 15000.5, 2.0))


@cell(SCENE, Subject.PLACE, "named", "tags of a.tif is in the pixels of this image")
def reduced_crop_with_its_own_model(folder: Path) -> Scene:
    own = part(9000.5, 15000.5, 2.0)
    return right(read_scene(write_image(folder / "a.tif", own, transform=placed(step=2.0))), own)


@cell(SCENE, Subject.PLACE, "named", "map grid in EPSG:32633: not used (tags of a.tif is used)")
def map_grid_beside_a_model(folder: Path) -> Scene:
    image = write_image(folder / "a.tif", CROP, crs="EPSG:32633", transform=placed(5.85e6, 3.3e5, 10.0))
    return right(read_scene(image), CROP)


@cell(SCENE, Subject.PLACE, "named", "map grid without a reference system: not used")
def world_file_beside_a_model(folder: Path) -> Scene:
    write(folder / "a.tfw", "10\n0\n0\n-10\n334005\n5851995\n")
    return right(read_scene(write_image(folder / "a.tif", CROP)), CROP)


@cell(SCENE, Subject.PLACE, "assumed", "its name says that it is a tile; tags of a_R1C2.tif is taken")
def tile_with_tags(folder: Path) -> Scene:
    return right(read_scene(write_image(folder / "a_R1C2.tif", CROP)), CROP)


@cell(SCENE, Subject.PLACE, "refused", "--crop-origin 9000,15000")
def crop_with_an_ambiguous_model(folder: Path) -> Scene:
    return read_scene(write_image(folder / "a.tif", part(4500.0, 7500.0), transform=placed()))


def chip(folder: Path, full: tuple[float, float, float, float], flag: str = "00") -> Path:
    """A NITF with an ICHIPB record: first line and sample of the full image, and its steps."""
    line, sample, line_step, sample_step = full
    content = (GOLDEN / "invented_rpc00b.ntf").read_bytes()
    ends = (0.5, 31.5), (0.5, 47.5)
    op = [(r, c) for r in ends[0] for c in ends[1]]
    fi = [(line + 0.5 + line_step * (r - 0.5), sample + 0.5 + sample_step * (c - 0.5)) for r, c in op]
    numbers = "".join(f"{value:012.3f}" for corner in (*op, *fi) for value in corner)
    record = f"{flag}{1:010.5f}0000{numbers}{26000:08d}{32000:08d}"
    head = content.index(b"RPC00B01041")
    # The lengths of the file, of the subheader and of its extended data grow by the record.
    tre = b"ICHIPB" + b"00224" + record.encode()
    grown = content[:head] + tre + content[head:]
    size = len(tre)
    position = head - 8
    extended = int(grown[position : position + 5])
    grown = grown[:position] + f"{extended + size:05d}".encode() + grown[position + 5 :]
    total = int(grown[342:354]) + size
    grown = grown[:342] + f"{total:012d}".encode() + grown[354:]
    subheader = int(grown[363:369]) + size
    grown = grown[:363] + f"{subheader:06d}".encode() + grown[369:]
    path = folder / "chip.ntf"
    path.write_bytes(grown)
    return path


def chipped(line: float, sample: float, step: tuple[float, float] = (1.0, 1.0)) -> RpcModel:
    """The right model of a chip, by the formula of STDI-0002."""
    model, steps = read_rpc(GOLDEN / "invented_rpc00b.ntf").model, np.array(step)
    offset = (model.image_offset - np.array([line, sample])) / steps
    return replace(model, image_offset=offset, image_scale=model.image_scale / steps)


@cell(SCENE, Subject.PLACE, "used", "chip.ntf, ICHIPB: place in the full image: line 4, sample 6: used")
def nitf_chip(folder: Path) -> Scene:
    scene = read_scene(chip(folder, (4.0, 6.0, 1.0, 1.0)))
    return right(scene, chipped(4.0, 6.0))


@cell(SCENE, Subject.PLACE, "used", "line 0.125, sample 0.125, in steps of 1.25 x 1.25 px: used")
def reduced_nitf_chip(folder: Path) -> Scene:
    scene = read_scene(chip(folder, (0.125, 0.125, 1.25, 1.25)))
    return right(scene, chipped(0.125, 0.125, (1.25, 1.25)))


@cell(SCENE, Subject.PLACE, "named", "IMAG /2: not used (tags of a.ntf is taken to be for these pixels")
def reduced_nitf_without_a_place(folder: Path) -> Scene:
    content = (GOLDEN / "invented_rpc00b.ntf").read_bytes()
    (folder / "a.ntf").write_bytes(content.replace(b"1.0 ", b"/2  ", 1))
    return read_scene(folder / "a.ntf")


@cell(SCENE, Subject.PLACE, "refused", "XFRM_FLAG '01' found, 00 expected")
def dewarped_nitf_chip(folder: Path) -> Scene:
    return read_scene(chip(folder, (4.0, 6.0, 1.0, 1.0), "01"))


@cell(SCENE, Subject.PLACE, "refused", "turned or mirrored in the full image")
def mirrored_nitf_chip(folder: Path) -> Scene:
    return read_scene(chip(folder, (4.0, 6.0, -1.0, 1.0)))


@cell(SCENE, Subject.PLACE, "named", "chip_RPC.TXT is in the pixels of this image")
def refined_nitf_chip(folder: Path) -> Scene:
    path = chip(folder, (4.0, 6.0, 1.0, 1.0))
    refined = chipped(5.0, 8.0)
    write(folder / "chip_RPC.TXT", format_rpc_text(refined))
    return right(read_scene(path), refined)


@cell(SCENE, Subject.ACCURACY, "used", "a.tif: accuracy: 6.00 m, one sigma: used")
def tags_with_a_stated_error(folder: Path) -> Scene:
    return read_scene(
        write_image(folder / "a.tif", replace(CROP, error_bias_m=6.0, error_random_m=np.nan))
    )


@cell(SCENE, Subject.ACCURACY, "named", "bias 6 m: not used (9 m was given)")
def stated_error_that_the_user_replaces(folder: Path) -> Scene:
    image = write_image(folder / "a.tif", replace(CROP, error_bias_m=6.0))
    return read_scene(image, sigma_m=9.0)


@cell(SCENE, Subject.ACCURACY, "assumed", "3.96 m, one sigma: assumed (that of PHR1B")
def tags_of_a_known_sensor(folder: Path) -> Scene:
    unknown = replace(CROP, error_bias_m=np.nan, error_random_m=np.nan)
    return read_scene(
        write_image(folder / "a.tif", unknown, tags={"MISSION": "PHR", "MISSION_INDEX": "1B"})
    )


@cell(SCENE, Subject.IDENTITY, "used", "a.tif: identity: PHR1B, 2013-02-08 08:36:09 UTC: used")
def tags_of_a_mission(folder: Path) -> Scene:
    tags = {"MISSION": "PHR", "MISSION_INDEX": "1B", "IMAGING_DATE": "2013-02-08"}
    return read_scene(write_image(folder / "a.tif", CROP, tags=tags | {"IMAGING_TIME": "08:36:09.1Z"}))


@cell(SCENE, Subject.HORIZONTAL_DATUM, "used", "WGS 84 / UTM zone 33N: used")
def ortho_on_a_map(folder: Path) -> Scene:
    image = write_image(folder / "a.tif", crs="EPSG:32633", transform=placed(5.85e6, 3.3e5, 10.0))
    return read_scene(image, sigma_m=5.0)


def four_tiles(folder: Path, suffix: str = ".TIF") -> None:
    """Four tiles of an image that is read whole; the last ones are smaller."""
    sizes = {(1, 1): (60, 80), (1, 2): (60, 30), (2, 1): (25, 80), (2, 2): (25, 30)}
    for (row, column), shape in sizes.items():
        write_image(folder / f"IMG_a_R{row}C{column}{suffix}", shape=shape, value=10 * row + column)


def check_mosaic(scene: Scene) -> Scene:
    """The scene, after a check of pixels on both sides of all seams, and of its model."""
    assert scene.image.shape == (85, 110)
    corner = scene.image.read(Window(59, 79, 2, 2))
    assert corner.tolist() == [[11, 12], [21, 22]]
    around = scene.image.read(Window(-1, -1, 87, 112))
    assert np.isfinite(around).sum() == 85 * 110
    return right(scene, CROP)


@cell(
    PRODUCT, Subject.PLACE, "used", "DIM_a.XML, 4 tiles: place in the full image: 85 x 110 pixels: used"
)
def product_of_dimap(folder: Path) -> Scene:
    four_tiles(folder)
    files = [(f"IMG_a_R{row}C{column}.TIF", row, column) for row in (1, 2) for column in (1, 2)]
    write(folder / "RPC_a.XML", FORMATS["dimap 2"](CROP))
    return check_mosaic(read_scene(write(folder / "DIM_a.XML", dim(files, (85, 110), SHAPE))))


@cell(PRODUCT, Subject.PLACE, "used", "a.TIL, 4 tiles: place in the full image: 85 x 110 pixels: used")
def product_of_til_by_its_folder(folder: Path) -> Scene:
    four_tiles(folder, ".tif")
    boxes = [(0, 0, 59, 79), (0, 80, 59, 109), (60, 0, 84, 79), (60, 80, 84, 109)]
    names = ["IMG_a_R1C1.TIF", "IMG_a_R1C2.TIF", "IMG_a_R2C1.TIF", "IMG_a_R2C2.TIF"]
    write(folder / "a.RPB", FORMATS["rpb"](CROP))
    write(folder / "a.TIL", til([(name, *box) for name, box in zip(names, boxes, strict=True)]))
    return check_mosaic(read_scene(folder))


@cell(PRODUCT, Subject.PLACE, "refused", "of its 4 tiles 1 not found: IMG_a_R2C2.TIF")
def product_without_a_tile(folder: Path) -> Scene:
    product_of_dimap(folder)
    (folder / "IMG_a_R2C2.TIF").unlink()
    return read_scene(folder / "DIM_a.XML")


@cell(PRODUCT, Subject.PLACE, "refused", "states 40 x 80 for this tile")
def product_with_a_tile_of_another_size(folder: Path) -> Scene:
    product_of_dimap(folder)
    files = [("IMG_a_R1C1.TIF", 1, 1), ("IMG_a_R2C1.TIF", 2, 1)]
    return read_scene(write(folder / "DIM_a.XML", dim(files, (85, 80), (40, 80))))


@cell(PRODUCT, Subject.PLACE, "refused", "overlap, tiles side by side expected")
def product_with_tiles_that_overlap(folder: Path) -> Scene:
    four_tiles(folder)
    boxes = [("IMG_a_R1C1.TIF", 0, 0, 59, 79), ("IMG_a_R1C2.TIF", 0, 70, 59, 99)]
    return read_scene(write(folder / "a.TIL", til(boxes)))


@cell(PRODUCT, Subject.PLACE, "refused", "a relative path inside the folder of the product expected")
def product_that_leads_elsewhere(folder: Path) -> Scene:
    boxes = [("../../etc/a.TIF", 0, 0, 59, 79), ("/b.TIF", 60, 0, 99, 79)]
    return read_scene(write(folder / "a.TIL", til(boxes)))


@cell(PRODUCT, Subject.UNIT, "refused", "tileUnits: Meters found, Pixels expected")
def product_in_metres(folder: Path) -> Scene:
    return read_scene(write(folder / "a.TIL", til([("a.TIF", 0, 0, 59, 79)], "Meters")))


@cell(PRODUCT, Subject.MODEL, "used", "RPC_a.XML: sensor model: RPC of DIMAP: used")
def product_with_the_rpc_of_the_whole(folder: Path) -> Scene:
    return product_of_dimap(folder)


@cell(PRODUCT, Subject.BANDS, "named", "the image IMG_a_NED: not used")
def product_with_two_groups_of_bands(folder: Path) -> Scene:
    names = [f"IMG_a_{bands}_R{row}C1.TIF" for bands in ("NED", "RGB") for row in (1, 2)]
    for name in names:
        write_image(folder / name)
    files = [(name, 1 + k % 2, 1) for k, name in enumerate(names)]
    write(folder / "RPC_a.XML", FORMATS["dimap 3"](CROP))
    return right(read_scene(write(folder / "DIM_a.XML", dim(files, (120, 80), SHAPE))), CROP)


@cell(PRODUCT, Subject.IDENTITY, "used", "identity: PHR1A: used")
def product_of_a_sensor(folder: Path) -> Scene:
    product_of_dimap(folder)
    files = [(f"IMG_a_R{row}C{column}.TIF", row, column) for row in (1, 2) for column in (1, 2)]
    source = "<Strip_Source><MISSION>PHR</MISSION><MISSION_INDEX>1A</MISSION_INDEX></Strip_Source>"
    write(folder / "DIM_a.XML", dim(files, (85, 110), SHAPE, source))
    return read_scene(folder / "DIM_a.XML")
