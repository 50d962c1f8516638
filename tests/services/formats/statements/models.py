"""Files with models: RPC text, RPB, ISD, DIMAP, `.geom`, `.aux.xml`, orbit and attitude."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from amers.services.formats.images.georeference import AUX_READER, WORLD_FILE_READER
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models import dimap, geom, rigorous_model, worldview_isd
from amers.services.formats.sensor_models.rpc_text import RPB_READER, RPC_TEXT_READER
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.statements import Subject
from tests.services.formats.sensor_models import simulated_metadata as simulated
from tests.services.formats.statements.cell import add, cell
from tests.services.formats.statements.scene_files import (
    CROP,
    DIMAP_2,
    DIMAP_3,
    FORMATS,
    FULL,
    GEOM,
    SHAPE,
    aux_rpc,
    dim,
    isd,
    part,
    placed,
    right,
    til,
    without,
    write,
    write_image,
)

TEXT, RPB = RPC_TEXT_READER.name, RPB_READER.name
ISD, DIMAP, OSSIM = worldview_isd.READER.name, dimap.READER.name, geom.READER.name
RIGOROUS, AUX, WORLD = rigorous_model.READER.name, AUX_READER.name, WORLD_FILE_READER.name
UNKNOWN = replace(CROP, error_bias_m=np.nan, error_random_m=np.nan)
UTM = 'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1]]'  # fmt: skip  # noqa: E501


def beside(folder: Path, name: str, text: str, image: str = "a.tif") -> Scene:
    """The scene of an image without a model of its own, and a file beside it."""
    write(folder / name, text)
    return read_scene(write_image(folder / image))


def text(**changes: str) -> str:
    """The RPC of the crop as text, with other values after keys."""
    lines = FORMATS["text"](CROP).splitlines()
    return "\n".join(
        next((f"{key}: {value}" for key, value in changes.items() if line.startswith(f"{key}:")), line)
        for line in lines
    )


@cell(TEXT, Subject.MODEL, "used", "a_RPC.TXT: sensor model: RPC as text: used")
def text_with_colons(folder: Path) -> Scene:
    return right(beside(folder, "a_RPC.TXT", text()), CROP)


@cell(TEXT, Subject.MODEL, "used", "a_rpc.txt: sensor model: RPC as text: used")
def text_in_lower_case_with_equals(folder: Path) -> Scene:
    return right(beside(folder, "a_rpc.txt", text().replace(": ", "=")), CROP)


@cell(TEXT, Subject.MODEL, "used", "a.rpc: sensor model: RPC as text: used")
def kompsat_with_units(folder: Path) -> Scene:
    words = {"LINE": "pixels", "SAMP": "pixels", "LAT_": "degrees", "LONG": "degrees", "HEIG": "meters"}
    rows = [
        f"{row} {words[row[:4]]}" if row[:4] in words and "COEFF" not in row else row
        for row in text().splitlines()
    ]
    return right(beside(folder, "a.rpc", "\n".join(rows)), CROP)


MODEL, UNIT = Subject.MODEL, Subject.UNIT
for name, subject, shows, content in (
    ("without_a_key", MODEL, "LINE_OFF is missing", without(text(), r"LINE_OFF.*\n")),
    ("with_a_key_twice", MODEL, "SAMP_OFF is given twice", f"{text()}\nSAMP_OFF: 7\n"),
    ("in_feet", UNIT, "HEIGHT_OFF in 'feet' found, metres expected", text(HEIGHT_OFF="1500 feet")),
    ("in_radians", UNIT, "LAT_OFF in 'radians' found, degrees expected", text(LAT_OFF="0.8 radians")),
    ("in_metres", UNIT, "LINE_SCALE in 'meters' found, pixels expected", text(LINE_SCALE="2 meters")),
    (
        "with_the_name_of_a_satellite",
        Subject.IDENTITY,
        "line 1: expected 'KEY: number', found 'SATELLITE: XX01'",
        "SATELLITE: XX01\n" + text(),
    ),
):
    read = partial(beside, name="a_RPC.TXT", text=content)
    add(RPC_TEXT_READER, subject, "refused", shows, f"text_{name}", read)


@cell(TEXT, Subject.ACCURACY, "used", "a_RPC.TXT: accuracy: 2.50 m, one sigma: used")
def text_with_a_stated_error(folder: Path) -> Scene:
    stated = replace(CROP, error_bias_m=2.5, error_random_m=np.nan)
    scene = beside(folder, "a_RPC.TXT", FORMATS["text"](stated))
    assert scene.sigma_m == 2.5
    return scene


@cell(TEXT, Subject.ACCURACY, "assumed", "50.00 m, one sigma: assumed (the sensor is unknown")
def text_without_errors(folder: Path) -> Scene:
    return beside(folder, "a_RPC.TXT", FORMATS["text"](UNKNOWN))


@cell(RPB, Subject.MODEL, "used", "a.RPB: sensor model: RPB: used")
def rpb_beside(folder: Path) -> Scene:
    return right(beside(folder, "a.RPB", FORMATS["rpb"](CROP)), CROP)


@cell(RPB, Subject.PLACE, "used", "P-1.TIL, tile of a product: place in the full image: line 60")
def rpb_of_the_whole_for_a_tile(folder: Path) -> Scene:
    rows = [("P_R1C1-1.TIF", 0, 0, 59, 79), ("P_R2C1-1.TIF", 60, 0, 119, 79)]
    write(folder / "P-1.TIL", til(rows))
    write(folder / "P-1.RPB", FORMATS["rpb"](CROP))
    return right(read_scene(write_image(folder / "P_R2C1-1.TIF")), part(9060.0))


@cell(RPB, Subject.PLACE, "used", "p.til, tile of a product: place in the full image: line 0, sample 80")
def rpb_named_like_the_tile(folder: Path) -> Scene:
    rows = [("P_R1C1.TIF", 0, 0, 59, 79), ("P_R1C2.TIF", 0, 80, 59, 159)]
    write(folder / "p.til", til(rows))
    write(folder / "P_R1C2.RPB", FORMATS["rpb"](CROP))
    return right(read_scene(write_image(folder / "P_R1C2.TIF")), part(9000.0, 15080.0))


@cell(RPB, Subject.PLACE, "assumed", "line 0, sample 0: assumed (its name says that it is a tile")
def rpb_of_a_tile_without_til(folder: Path) -> Scene:
    return right(beside(folder, "P_R2C1.RPB", FORMATS["rpb"](CROP), "P_R2C1.TIF"), CROP)


@cell(RPB, Subject.ORDER, "refused", "SpecId: expected RPC00B, found RPC00A")
def rpb_in_another_order(folder: Path) -> Scene:
    return beside(folder, "a.RPB", without(FORMATS["rpb"](CROP), "RPC00B", "RPC00A"))


@cell(RPB, Subject.ACCURACY, "used", "a.RPB: accuracy: 3.00 m, one sigma: used")
def rpb_with_a_stated_error(folder: Path) -> Scene:
    stated = replace(CROP, error_bias_m=3.0, error_random_m=np.nan)
    return beside(folder, "a.RPB", FORMATS["rpb"](stated))


@cell(RPB, Subject.IDENTITY, "used", "a.RPB: identity: WV02, 2012-05-17 10:42:31 UTC: used")
def rpb_with_imd(folder: Path) -> Scene:
    write(folder / "a.IMD", "\tfirstLineTime = 2012-05-17T10:42:31.123456Z;\n")
    return beside(folder, "a.RPB", FORMATS["rpb"](CROP))


@cell(RPB, Subject.BANDS, "named", "bandId P: not used")
def rpb_of_a_band(folder: Path) -> Scene:
    return beside(folder, "a.RPB", FORMATS["rpb"](CROP))


@cell(ISD, Subject.MODEL, "used", "a.XML: sensor model: RPB block of an ISD: used")
def isd_with_a_block_of_rpc(folder: Path) -> Scene:
    return right(beside(folder, "a.XML", isd(CROP)), CROP)


@cell(ISD, Subject.MODEL, "refused", "expected one IMAGE/LINEOFFSET in <RPB>, found 0")
def isd_without_an_offset(folder: Path) -> Scene:
    return beside(folder, "a.XML", without(isd(CROP), "<LINEOFFSET>.*?</LINEOFFSET>"))


@cell(ISD, Subject.PLACE, "used", "P.TIL, tile of a product: place in the full image: line 60, sample 0")
def isd_of_the_whole_for_a_tile(folder: Path) -> Scene:
    rows = [("P_R1C1.TIF", 0, 0, 59, 79), ("P_R2C1.TIF", 60, 0, 119, 79)]
    write(folder / "P.TIL", til(rows))
    write(folder / "P.XML", isd(CROP, (120, 80)))
    return right(read_scene(write_image(folder / "P_R2C1.TIF")), part(9060.0))


@cell(ISD, Subject.PLACE, "assumed", "a.XML is for 600 x 800 pixels, the image has 60 x 80")
def isd_of_a_larger_image(folder: Path) -> Scene:
    return beside(folder, "a.XML", isd(CROP, (600, 800)))


@cell(ISD, Subject.ORDER, "refused", "RPB/SPECID: expected RPC00B, found RPC00A")
def isd_in_another_order(folder: Path) -> Scene:
    return beside(folder, "a.XML", isd(CROP, specification="RPC00A"))


@cell(ISD, Subject.ACCURACY, "used", "a.XML: accuracy: 4.00 m, one sigma: used")
def isd_with_a_stated_error(folder: Path) -> Scene:
    return beside(folder, "a.XML", isd(replace(CROP, error_bias_m=4.0)))


@cell(ISD, Subject.ACCURACY, "assumed", "2.33 m, one sigma: assumed (that of WV02")
def isd_without_errors(folder: Path) -> Scene:
    return beside(folder, "a.XML", isd(UNKNOWN))


@cell(ISD, Subject.IDENTITY, "used", "a.XML: identity: WV02, 2024-05-01 10:20:30 UTC: used")
def isd_of_a_satellite(folder: Path) -> Scene:
    return beside(folder, "a.XML", isd(CROP))


@cell(DIMAP, Subject.MODEL, "used", "RPC_a.XML: sensor model: RPC of DIMAP: used")
def dimap_of_version_2(folder: Path) -> Scene:
    return right(beside(folder, "RPC_a.XML", FORMATS["dimap 2"](CROP), "IMG_a_R1C1.TIF"), CROP)


@cell(DIMAP, Subject.MODEL, "refused", "LINE_NUM_COEFF_1")
def dimap_without_a_coefficient(folder: Path) -> Scene:
    head, _, model = DIMAP_2.partition("<Inverse_Model>")
    changed = head + "<Inverse_Model>" + without(model, r"<LINE_NUM_COEFF_1>.*?</LINE_NUM_COEFF_1>")
    return beside(folder, "RPC_a.XML", changed, "IMG_a.tif")


for name, bands in (
    ("dimap_of_pleiades_neo_by_its_delivered_name", "P"),
    ("dimap_of_the_colours_of_pleiades_neo", "RGB"),
):
    file, image = "RPC_PNEO3_F_1.XML", f"IMG_PNEO3_F_1_{bands}_R1C1.TIF"
    read = partial(beside, name=file, text=FORMATS["dimap 3"](CROP), image=image)
    shows = f"{file}: sensor model: RPC of DIMAP: used"
    add(dimap.READER, MODEL, "used", shows, name, lambda folder, read=read: right(read(folder), CROP))
for first, document in ((1, DIMAP_2), (0, DIMAP_3)):
    read = partial(beside, name="RPC_a.XML", text=document, image="IMG_a.tif")
    shows = f"first pixel ({first}, {first}): used"
    add(dimap.READER, Subject.PIXEL_ORIGIN, "used", shows, f"dimap_that_counts_from_{first}", read)


def tiles_of_dimap(folder: Path, size: tuple[int, int] = SHAPE) -> None:
    """A document of 2 x 2 tiles with the RPC of the whole."""
    files = [(f"IMG_a_R{row}C{column}.TIF", row, column) for row in (1, 2) for column in (1, 2)]
    write(folder / "DIM_a.XML", dim(files, (2 * SHAPE[0], 2 * SHAPE[1]), size))
    write(folder / "RPC_a.XML", FORMATS["dimap 2"](CROP))


@cell(
    DIMAP,
    Subject.PLACE,
    "used",
    "DIM_a.XML, tile of a product: place in the full image: line 60, sample 80",
)
def dimap_tile_at_its_place(folder: Path) -> Scene:
    tiles_of_dimap(folder)
    return right(read_scene(write_image(folder / "IMG_a_R2C2.TIF")), part(9060.0, 15080.0))


@cell(DIMAP, Subject.PLACE, "used", "line 60, sample 0")
def converted_dimap_tile_with_a_given_model(folder: Path) -> Scene:
    tiles_of_dimap(folder)
    image = write_image(folder / "other" / "toa_R2C1_clean.tif")
    return right(read_scene(image, folder / "RPC_a.XML"), part(9060.0))


@cell(DIMAP, Subject.PLACE, "refused", "the image is a tile, and its RPC is for the whole image")
def dimap_tile_without_its_document(folder: Path) -> Scene:
    return beside(folder, "RPC_a.XML", FORMATS["dimap 2"](CROP), "IMG_a_R1C2.TIF")


@cell(DIMAP, Subject.PLACE, "refused", "60 x 80 pixels found, DIM_a.XML states 40 x 80 for this tile")
def dimap_tile_of_another_size(folder: Path) -> Scene:
    tiles_of_dimap(folder, (80, 80))
    return read_scene(write_image(folder / "IMG_a_R2C1.TIF"))


@cell(DIMAP, Subject.PLACE, "assumed", "the image has 60 x 80: taken from the first pixel on")
def dimap_of_a_larger_image(folder: Path) -> Scene:
    return beside(folder, "RPC_a.XML", DIMAP_2, "IMG_a.tif")


@cell(DIMAP, Subject.VALIDITY, "used", "no data where the value is 7: used")
def dimap_with_a_code_of_no_data(folder: Path) -> Scene:
    special = (
        "<Special_Value><SPECIAL_VALUE_TEXT>NODATA</SPECIAL_VALUE_TEXT>"
        "<SPECIAL_VALUE_COUNT>7</SPECIAL_VALUE_COUNT></Special_Value>"
    )
    write(folder / "DIM_a.XML", f"<Dimap_Document>{special}</Dimap_Document>")
    write(folder / "RPC_a.XML", FORMATS["dimap 2"](CROP))
    scene = read_scene(write_image(folder / "IMG_a.tif", value=7))
    assert np.isnan(scene.image.read(Window(0, 0, 2, 2))).all()
    return scene


@cell(DIMAP, Subject.ACCURACY, "named", "of the fit of the polynomials, not of the scene")
def dimap_with_the_errors_of_its_fit(folder: Path) -> Scene:
    errors = "<ERR_BIAS_ROW>0.0005</ERR_BIAS_ROW></Inverse_Model>"
    changed = FORMATS["dimap 2"](CROP)
    if "<ERR_BIAS" not in changed:
        changed = without(changed, "</Inverse_Model>", errors)
    return beside(folder, "RPC_a.XML", changed, "IMG_a.tif")


@cell(DIMAP, Subject.ACCURACY, "assumed", "one sigma: assumed (that of PHR")
def dimap_of_a_known_sensor(folder: Path) -> Scene:
    return beside(folder, "RPC_a.XML", FORMATS["dimap 2"](CROP), "IMG_a.tif")


@cell(DIMAP, Subject.IDENTITY, "used", "identity: PHR1A: used")
def dimap_with_the_document_of_its_product(folder: Path) -> Scene:
    source = "<Strip_Source><MISSION>PHR</MISSION><MISSION_INDEX>1A</MISSION_INDEX></Strip_Source>"
    write(folder / "DIM_a.XML", f"<Dimap_Document>{source}</Dimap_Document>")
    return beside(folder, "RPC_a.XML", FORMATS["dimap 2"](CROP), "IMG_a.tif")


@cell(OSSIM, Subject.MODEL, "used", "a.geom: sensor model: RPC of a .geom: used")
def geom_beside(folder: Path) -> Scene:
    return right(beside(folder, "a.geom", FORMATS["geom"](CROP)), CROP)


@cell(OSSIM, Subject.MODEL, "refused", "an RPC cannot express it")
def geom_with_a_rotation(folder: Path) -> Scene:
    rotation = (
        "number_of_adjustments: 1\ncurrent_adjustment: 0\nadjustment_0.number_of_params: 1\n"
        "adjustment_0.adj_param_0.description: map_rotation\nadjustment_0.adj_param_0.center: 0.5\n"
    )
    return beside(folder, "a.geom", FORMATS["geom"](CROP) + rotation)


@cell(OSSIM, Subject.PIXEL_ORIGIN, "used", "loses parts of a pixel")
def geom_of_a_loader_that_loses_half_a_pixel(folder: Path) -> Scene:
    whole = replace(
        FULL, image_offset=np.array([31321.0, 31321.0]), image_scale=np.array([31321.5, 31321.5])
    )
    kind = without(FORMATS["geom"](whole), "ossimRpcModel", "ossimPleiadesModel")
    return beside(folder, "a.geom", kind + "number_lines: 62644\nnumber_samples: 62644\n")


@cell(OSSIM, Subject.ORDER, "refused", "polynomial_format: expected A or B, found C")
def geom_in_another_order(folder: Path) -> Scene:
    return beside(
        folder,
        "a.geom",
        without(FORMATS["geom"](CROP), r"polynomial_format:\s+B", "polynomial_format: C"),
    )


@cell(
    OSSIM, Subject.PLACE, "used", "a.tif, geotransform: place in the full image: line 9000, sample 15000"
)
def geom_of_the_full_image_for_a_crop_of_otb(folder: Path) -> Scene:
    write(folder / "a.geom", GEOM)
    return right(read_scene(write_image(folder / "a.tif", transform=placed())), CROP)


@cell(OSSIM, Subject.ACCURACY, "used", "a.geom: accuracy: 5.00 m, one sigma: used")
def geom_with_a_stated_error(folder: Path) -> Scene:
    return beside(
        folder, "a.geom", FORMATS["geom"](replace(CROP, error_bias_m=5.0, error_random_m=np.nan))
    )


@cell(OSSIM, Subject.IDENTITY, "used", "a.geom: identity: GE01")
def geom_of_a_sensor(folder: Path) -> Scene:
    geom = without(FORMATS["geom"](CROP), r"sensor:.*\n")
    return beside(folder, "a.geom", geom + "sensor: GeoEye-1\n")


@cell(
    RIGOROUS,
    Subject.MODEL,
    "named",
    "METADATA.DIM: sensor model: parameters of orbit and attitude: not used",
)
def spot_through_its_rpc(folder: Path) -> Scene:
    return spot_by_its_delivered_names(folder)


@cell(RIGOROUS, Subject.MODEL, "used", "METADATA.DIM: sensor model: rigorous model: used")
def spot_by_its_delivered_names(folder: Path) -> Scene:
    write(folder / "METADATA.DIM", simulated.spot5_dimap(simulated.truth()))
    return read_scene(write_image(folder / "IMAGERY.TIF", shape=simulated.SHAPE))


@cell(RIGOROUS, Subject.MODEL, "refused", "METADATA.DIM")
def spot_without_a_line_period(folder: Path) -> Scene:
    changed = without(simulated.spot5_dimap(simulated.truth()), "<LINE_PERIOD>.*?</LINE_PERIOD>")
    write(folder / "METADATA.DIM", changed)
    return read_scene(write_image(folder / "IMAGERY.TIF", shape=simulated.SHAPE))


@cell(RIGOROUS, Subject.IDENTITY, "used", "METADATA.DIM: identity: SCENE_5_123: used")
def spot_called_like_all_others(folder: Path) -> Scene:
    named = "<Dataset_Id><DATASET_NAME>SCENE 5 123</DATASET_NAME></Dataset_Id></Dimap_Document>"
    document = without(simulated.spot5_dimap(simulated.truth()), "</Dimap_Document>", named)
    write(folder / "METADATA.DIM", document)
    scene = read_scene(write_image(folder / "IMAGERY.TIF", shape=simulated.SHAPE))
    assert scene.acquisition.image_id == "SCENE_5_123"
    return scene


@cell(RIGOROUS, Subject.ACCURACY, "assumed", "50.00 m, one sigma: assumed")
def spot_without_an_accuracy(folder: Path) -> Scene:
    return spot_by_its_delivered_names(folder)


@cell(AUX, Subject.MODEL, "used", "a.tif.aux.xml: sensor model: RPC of an .aux.xml: used")
def aux_with_an_rpc(folder: Path) -> Scene:
    return right(beside(folder, "a.tif.aux.xml", aux_rpc(CROP)), CROP)


@cell(AUX, Subject.MODEL, "refused", "a.tif.aux.xml: RPC tags: LINE_OFF is missing")
def aux_without_an_offset(folder: Path) -> Scene:
    return beside(folder, "a.tif.aux.xml", without(aux_rpc(CROP), '<MDI key="LINE_OFF">.*?</MDI>'))


def map_aux(folder: Path, text: str) -> Scene:
    """An ortho-image with an `.aux.xml`."""
    write(folder / "a.tif.aux.xml", f"<PAMDataset>{text}</PAMDataset>")
    image = write_image(folder / "a.tif", crs="EPSG:32633", transform=placed(5.85e6, 3.3e5, 10.0))
    return read_scene(image, sigma_m=5.0)


@cell(AUX, Subject.PLACE, "used", "a.tif.aux.xml, geotransform: place in the full image: map grid: used")
def aux_with_a_refined_map_grid(folder: Path) -> Scene:
    scene = map_aux(folder, "<GeoTransform>330012.0, 10.0, 0.0, 5850007.0, 0.0, -10.0</GeoTransform>")
    assert scene.model.grid.origin_xy.tolist() == [330017.0, 5850002.0]  # type: ignore[attr-defined]
    return scene


@cell(AUX, Subject.PLACE, "refused", "GeoTransform: 5 numbers found, 6 expected")
def aux_with_half_a_map_grid(folder: Path) -> Scene:
    return map_aux(folder, "<GeoTransform>330012.0, 10.0, 0.0, 5850007.0, 0.0</GeoTransform>")


@cell(AUX, Subject.HORIZONTAL_DATUM, "used", "WGS 84 / UTM zone 33N")
def aux_with_another_system(folder: Path) -> Scene:
    write(folder / "a.tif.aux.xml", f"<PAMDataset><SRS>{UTM}</SRS></PAMDataset>")
    image = write_image(folder / "a.tif", crs="EPSG:32632", transform=placed(5.85e6, 3.3e5, 10.0))
    return read_scene(image, sigma_m=5.0)


@cell(AUX, Subject.HORIZONTAL_DATUM, "refused", "a reference system as WKT expected")
def aux_with_words_for_a_system(folder: Path) -> Scene:
    return map_aux(folder, "<SRS>somewhere</SRS>")


def with_world_file(folder: Path, text: str, prj: str = "", name: str = "a.tfw") -> Scene:
    """An image without a map of its own, its world file and its `.prj`."""
    write(folder / name, text)
    if prj:
        write(folder / "a.prj", prj)
    return read_scene(write_image(folder / "a.tif"), sigma_m=5.0)


WORLD_TEXT = "10.0\n0.5\n-0.25\n-9.0\n334005.0\n5851995.0\n"


@cell(WORLD, Subject.PLACE, "used", "a.tfw, geotransform: place in the full image: map grid: used")
def world_file_with_prj(folder: Path) -> Scene:
    scene = with_world_file(folder, WORLD_TEXT, UTM)
    assert scene.model.grid.origin_xy.tolist() == [334005.0, 5851995.0]  # type: ignore[attr-defined]
    return scene


@cell(WORLD, Subject.PLACE, "used", "a.wld, geotransform: place in the full image: map grid: used")
def world_file_of_another_suffix(folder: Path) -> Scene:
    return with_world_file(folder, WORLD_TEXT, UTM, "a.wld")


@cell(WORLD, Subject.PLACE, "named", "a.tfw, geotransform: place in the full image: another map grid")
def world_file_that_contradicts_the_image(folder: Path) -> Scene:
    write(folder / "a.tfw", WORLD_TEXT)
    image = write_image(folder / "a.tif", crs="EPSG:32633", transform=placed(5.85e6, 3.3e5, 10.0))
    return read_scene(image, sigma_m=5.0)


@cell(WORLD, Subject.HORIZONTAL_DATUM, "used", "WGS 84 / UTM zone 33N: used")
def prj_beside_a_world_file(folder: Path) -> Scene:
    return with_world_file(folder, WORLD_TEXT, UTM)


for shows, content, prj in (
    ("5 numbers found, the 6 of a world file expected", "10 0 0 -10 334005", UTM),
    ("a reference system as WKT expected", WORLD_TEXT, "the usual one"),
    ("a.tfw has a geotransform and no reference system", WORLD_TEXT, ""),
):
    subject = Subject.PLACE if content != WORLD_TEXT else Subject.HORIZONTAL_DATUM
    add(
        WORLD_FILE_READER,
        subject,
        "refused",
        shows,
        shows,
        partial(with_world_file, text=content, prj=prj),
    )
