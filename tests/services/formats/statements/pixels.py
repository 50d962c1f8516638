"""Valid pixels, bands and colours of image files, as GDAL takes them; masks on maps."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
import rasterio.shutil
import rasterio.transform
import rasterio.warp
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

from amers.services.formats.images import pixel_rows
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.masks import MaskedImage, apply_mask
from amers.services.formats.images.raster import RasterImage, open_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.statements import Statements, Subject
from amers.services.types import BoolArray
from tests.services.formats.statements.cell import cell

PIXELS, MASK = pixel_rows.READER.name, pixel_rows.MASK_READER.name
SHAPE = (96, 120)
GRID = Affine(10.0, 0.0, 330000.0, 0.0, -10.0, 5862000.0)
_NOISE = np.random.default_rng(7).normal(0.0, 1.0, SHAPE).astype(np.float32)
GREY = np.clip(900.0 + 900.0 * cv2.GaussianBlur(_NOISE, (0, 0), 1.5), 100.0, 4000.0)
"""Grey values without 0."""
OPEN = np.ones(SHAPE, dtype=bool)
OPEN[:30, 20:70] = False
"""Where alpha bands and masks of these files are open."""
GREY_ALPHA = {"photometric": "MINISBLACK", "ALPHA": "YES"}


@dataclass(frozen=True)
class Read:
    """What a reader said, where it returns more than its result."""

    statements: Statements


def write(
    path: Path,
    bands: list[np.ndarray],
    colours: str = "",
    dtype: str = "uint16",
    *,
    on_map: bool = True,
    mask: BoolArray | None = None,
    **options: object,
) -> Path:
    """A GeoTIFF with colours such as "red green blue alpha", and a mask inside."""
    where = {"crs": "EPSG:32633", "transform": GRID} if on_map else {}
    lines, samples = bands[0].shape
    profile = {"driver": "GTiff", "width": samples, "height": lines, **where, **options}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK="YES"),
        rasterio.open(path, "w", count=len(bands), dtype=dtype, **profile) as file,
    ):
        file.write(np.stack(bands).astype(dtype))
        if colours:
            file.colorinterp = [ColorInterp[name] for name in colours.split()]
        if mask is not None:
            file.write_mask(mask)
    return path


def mask_beside(path: Path, valid: BoolArray, flags: str = "2") -> None:
    """Write `NAME.msk`."""
    place = write(path.with_name("mask.tif"), [valid * 255], dtype="uint8", on_map=False)
    with rasterio.open(place, "r+") as file:
        file.update_tags(INTERNAL_MASK_FLAGS_1=flags)
    place.rename(path.with_name(f"{path.name}.msk"))


def shown(path: Path, valid: BoolArray, bands: str | None = None) -> RasterImage:
    """The image of a file, of which these pixels are valid."""
    image = open_raster(path, None if bands is None else parse_bands(bands))
    np.testing.assert_array_equal(np.isfinite(image.read(Window(0, 0, *SHAPE))), valid)
    return image


def as_gdal(path: Path) -> RasterImage:
    """The image of a file whose valid pixels are those of `dataset_mask`."""
    with rasterio.open(path) as file:
        return shown(path, file.dataset_mask() != 0)


def scene(path: Path, bands: str | None = None) -> Scene:
    return read_scene(path, sigma_m=1.0, bands=None if bands is None else parse_bands(bands))


def alpha(largest: int = 65535) -> np.ndarray:
    return OPEN * largest


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif: valid pixels: mask inside the file: used")
def mask_inside(folder: Path) -> RasterImage:
    return as_gdal(write(folder / "a.tif", [GREY], mask=OPEN))


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif.msk: valid pixels: mask beside the file: used")
def msk_of_one_band(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY])
    mask_beside(path, OPEN)
    return as_gdal(path)


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif.msk: valid pixels: mask beside the file: used")
def msk_of_three_bands_before_nodata(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY] * 3, "red green blue", nodata=int(GREY[5, 5]))
    mask_beside(path, OPEN)
    return as_gdal(path)


@cell(
    PIXELS, Subject.VALIDITY, "used", "a.tif, band 4: valid pixels: alpha: no data where it is 0: used"
)
def alpha_as_fourth_band(folder: Path) -> RasterImage:
    return as_gdal(write(folder / "a.tif", [GREY] * 3 + [alpha()], "red green blue alpha"))


@cell(
    PIXELS, Subject.VALIDITY, "used", "a.tif, band 5: valid pixels: alpha: no data where it is 0: used"
)
def alpha_as_fifth_band(folder: Path) -> RasterImage:
    """GDAL looks for it among two or four bands; its `gdalwarp` takes it."""
    bands = [GREY] * 4 + [alpha()]
    return shown(write(folder / "a.tif", bands, "blue green red undefined alpha"), OPEN)


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif, band 1: valid pixels: alpha")
def alpha_as_first_band_is_no_image(folder: Path) -> RasterImage:
    image = shown(write(folder / "a.tif", [alpha(), GREY], "alpha gray"), OPEN)
    assert image.mix.bands == (2,)
    return image


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif, band 2: valid pixels: alpha")
def alpha_of_eight_bits_with_a_soft_edge(folder: Path) -> RasterImage:
    soft = cv2.GaussianBlur(alpha(255).astype(np.float32), (0, 0), 2.0).astype(np.uint8)
    return as_gdal(write(folder / "a.tif", [GREY // 16, soft], "", "uint8", **GREY_ALPHA))


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif, band 2: valid pixels: alpha")
def alpha_of_sixteen_bits_that_is_255(folder: Path) -> RasterImage:
    return as_gdal(write(folder / "a.tif", [GREY, alpha(255)], **GREY_ALPHA))


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif, band 2: valid pixels: alpha")
def alpha_that_is_opaque_everywhere(folder: Path) -> RasterImage:
    return as_gdal(write(folder / "a.tif", [GREY, OPEN * 0 + 65535], **GREY_ALPHA))


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif: valid pixels: no data where the value is 7: used")
def nodata_of_integers(folder: Path) -> RasterImage:
    return as_gdal(write(folder / "a.tif", [np.where(OPEN, GREY, 7)], nodata=7))


@cell(PIXELS, Subject.VALIDITY, "used", "no data where the value is -3.40282e+38: used")
def nodata_of_floats_in_fewer_digits(folder: Path) -> RasterImage:
    lowest = float(np.finfo(np.float32).min)
    pixels = np.where(OPEN, GREY, lowest)
    path = write(folder / "a.tif", [pixels], dtype="float32", nodata=-3.4028234e38)
    return shown(path, OPEN)


@cell(PIXELS, Subject.VALIDITY, "used", "no data where the value is nan: used")
def nodata_that_is_no_number(folder: Path) -> RasterImage:
    pixels = np.where(OPEN, GREY, np.nan)
    return as_gdal(write(folder / "a.tif", [pixels], dtype="float32", nodata=np.nan))


@cell(PIXELS, Subject.VALIDITY, "used", "no data where the value is 0: used")
def nodata_0_of_colours_of_which_one_is_0(folder: Path) -> RasterImage:
    """Dark ground: 0 in one band is a value, 0 in all is none."""
    red = np.where(OPEN, GREY, 0)
    path = write(folder / "a.tif", [red, GREY, GREY], "red green blue", nodata=0)
    return shown(path, np.ones(SHAPE, dtype=bool))


@cell(PIXELS, Subject.VALIDITY, "used", "no data where the value is 0: used")
def nodata_0_of_all_colours(folder: Path) -> RasterImage:
    bands = [np.where(OPEN, GREY, 0)] * 3
    return as_gdal(write(folder / "a.tif", bands, "red green blue", nodata=0))


@cell(
    PIXELS, Subject.VALIDITY, "used", "a.tif.aux.xml: valid pixels: no data where the value is 7: used"
)
def nodata_beside_the_file(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [np.where(OPEN, GREY, 7)])
    (folder / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="1"><NoDataValue>7</NoDataValue></PAMRasterBand></PAMDataset>'
    )
    return as_gdal(path)


@cell(
    PIXELS, Subject.VALIDITY, "used", "a.tif.aux.xml, band 2: valid pixels: no data where the value is 8"
)
def nodata_of_each_band(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY, np.where(OPEN, GREY, 8)])
    (folder / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="2"><NoDataValue>8</NoDataValue></PAMRasterBand></PAMDataset>'
    )
    return shown(path, OPEN, "2")


@cell(PIXELS, Subject.VALIDITY, "used", "a.tif, band 2: valid pixels: alpha")
def alpha_that_a_file_beside_names(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY, alpha()])
    (folder / "a.tif.aux.xml").write_text(
        '<PAMDataset><PAMRasterBand band="2"><ColorInterp>Alpha</ColorInterp></PAMRasterBand>'
        "</PAMDataset>"
    )
    return shown(path, OPEN)


@cell(
    PIXELS, Subject.VALIDITY, "named", "a.tif, band 4: valid pixels: alpha: not used (its values are a"
)
def infrared_tagged_as_alpha(folder: Path) -> RasterImage:
    """Some of it is 0, such as water."""
    path = write(folder / "a.tif", [GREY] * 3 + [np.where(OPEN, GREY, 0)], "red green blue alpha")
    image = shown(path, np.ones(SHAPE, dtype=bool))
    assert image.validity.image_bands == (1, 2, 3, 4)
    return image


@cell(PIXELS, Subject.VALIDITY, "named", "a.tif, band 4: valid pixels: alpha: not used")
def dark_infrared_of_eight_bits(folder: Path) -> RasterImage:
    """Water: most pixels have the same low value."""
    infrared = np.where(GREY > 1100.0, GREY / 16.0, 3.0)
    bands = [GREY // 16] * 3 + [infrared]
    return shown(write(folder / "a.tif", bands, "red green blue alpha", "uint8"), OPEN | True)


@cell(
    PIXELS,
    Subject.VALIDITY,
    "named",
    "no data where the value is 0: not used (the alpha goes before it)",
)
def nodata_beside_an_alpha(folder: Path) -> RasterImage:
    bands = [np.where(GREY > 1000.0, GREY, 0)] * 3 + [alpha()]
    return as_gdal(write(folder / "a.tif", bands, "red green blue alpha", nodata=0))


@cell(PIXELS, Subject.VALIDITY, "named", "7: not used (the mask inside the file goes before it)")
def nodata_below_a_mask(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [np.where(GREY > 1000.0, GREY, 7)], mask=OPEN, nodata=7)
    return as_gdal(path)


@cell(
    PIXELS,
    Subject.VALIDITY,
    "named",
    "a.tif.msk: valid pixels: mask beside the file: not used (the mask",
)
def msk_beside_a_mask_inside(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY], mask=OPEN)
    mask_beside(path, ~OPEN)
    return as_gdal(path)


@cell(PIXELS, Subject.VALIDITY, "named", "give it as --mask where it is one")
def msk_without_the_flags_of_gdal(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY])
    mask_beside(path, OPEN, flags="")
    return as_gdal(path)


@cell(PIXELS, Subject.VALIDITY, "refused", "20 x 120 pixels found, 96 x 120 as in a.tif expected")
def msk_of_another_size(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY])
    mask_beside(path, OPEN[:20])
    return open_raster(path)


@cell(PIXELS, Subject.VALIDITY, "refused", "strips or tiles of 17 MiB found")
def msk_of_one_large_strip(folder: Path) -> RasterImage:
    """A small file that would fill the memory of everyone who reads a window of it."""
    large = np.ones((4200, 4300), dtype=bool)
    path = write(folder / "a.tif", [large * 7], dtype="uint8", tiled=True, compress="deflate")
    place = write(
        folder / "mask.tif",
        [large * 255],
        dtype="uint8",
        on_map=False,
        compress="deflate",
        blockysize=4200,
    )
    place.rename(folder / "a.tif.msk")
    return open_raster(path)


@cell(PIXELS, Subject.BANDS, "used", "a.tif, band 1: bands: colour table: used")
def colour_table(folder: Path) -> RasterImage:
    """Its indices say nothing of the brightness."""
    index = (GREY // 16).astype(np.uint8)
    path = write(folder / "a.tif", [index], dtype="uint8", photometric="PALETTE")
    colours = {k: (255 - k, (7 * k) % 256, k // 2, 255) for k in range(256)}
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, colours)
    image = shown(path, OPEN | True)
    grey = np.array([sum(colours[k][:3]) / 3.0 for k in range(256)])
    read = image.read(Window(0, 0, *SHAPE))
    np.testing.assert_allclose(read, grey[index], rtol=1e-5)
    return image


@cell(PIXELS, Subject.BANDS, "used", "mean of red, green, blue, which lie within 0.00 px of each other")
def colours_in_another_order(folder: Path) -> Scene:
    found = scene(write(folder / "a.tif", [GREY] * 4, "blue green red undefined"))
    assert found.image.mix.bands == (3, 2, 1)  # type: ignore[attr-defined]
    return found


@cell(PIXELS, Subject.BANDS, "used", "blue alone, as requested")
def band_of_a_caller(folder: Path) -> Scene:
    return scene(write(folder / "a.tif", [GREY] * 3, "red green blue"), "3")


@cell(
    PIXELS, Subject.BANDS, "assumed", "mean of the first three bands, taken as visible; band 4 not used"
)
def four_bands_without_colours(folder: Path) -> Scene:
    return scene(write(folder / "a.tif", [GREY] * 4, "gray undefined undefined undefined"))


@cell(PIXELS, Subject.BANDS, "assumed", "band 1 alone, the first band: assumed (band 2 not used")
def two_bands(folder: Path) -> Scene:
    return scene(write(folder / "a.tif", [GREY] * 2, "gray undefined"))


@cell(PIXELS, Subject.BANDS, "assumed", "green alone: assumed (red, green, blue lie up to 2.00 px apart")
def bands_that_lie_apart(folder: Path) -> Scene:
    bands = [GREY, GREY, np.roll(GREY, 2, axis=0)]
    return scene(write(folder / "a.tif", bands, "red green blue"))


@cell(PIXELS, Subject.BANDS, "refused", "band 1 is cyan")
def inks(folder: Path) -> RasterImage:
    return open_raster(write(folder / "a.tif", [GREY] * 4, "cyan magenta yellow black"), None)


@cell(PIXELS, Subject.BANDS, "refused", "band 5 requested, the image has 4 bands")
def band_that_is_missing(folder: Path) -> Scene:
    return scene(write(folder / "a.tif", [GREY] * 4), "5")


@cell(PIXELS, Subject.BANDS, "refused", "expected integer or floating-point pixels, found complex64")
def complex_numbers(folder: Path) -> RasterImage:
    return open_raster(write(folder / "a.tif", [GREY], dtype="complex64"))


@cell(
    PIXELS,
    Subject.UNIT,
    "named",
    "a.tif, band 1: unit: reflectance, scale 0.0001, offset -0.1: not used",
)
def scaled_pixels(folder: Path) -> Scene:
    path = write(folder / "a.tif", [GREY])
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets, file.units = (1e-4,), (-0.1,), ("reflectance",)
    return scene(path)


@cell(PIXELS, Subject.IDENTITY, "named", "2 images in one file: not used (the first is read")
def two_pages(folder: Path) -> RasterImage:
    path = write(folder / "a.tif", [GREY])
    other = write(folder / "b.tif", [GREY + 1.0])
    with rasterio.open(other) as file:
        rasterio.shutil.copy(file, path, driver="GTiff", APPEND_SUBDATASET="YES")
    image = open_raster(path)
    np.testing.assert_array_equal(image.read(Window(0, 0, *SHAPE)), GREY.astype(np.uint16))
    return image


def masked(folder: Path, mask: np.ndarray, excluded: BoolArray, **options: object) -> MaskedImage:
    """The image with a mask, which excludes these pixels."""
    image = open_raster(write(folder / "a.tif", [GREY], on_map=bool(options.pop("image_on_map", True))))
    found = apply_mask(image, write(folder / "mask.tif", [mask], dtype="uint8", **options))  # type: ignore[arg-type]
    np.testing.assert_array_equal(np.isnan(found.read(Window(0, 0, *SHAPE))), excluded)
    return found


@cell(MASK, Subject.VALIDITY, "used", "mask.tif: valid pixels: mask: no data where it is not 0: used")
def mask_of_the_same_grid(folder: Path) -> MaskedImage:
    return masked(folder, ~OPEN * 3, ~OPEN)


@cell(MASK, Subject.PLACE, "used", "mask.tif: place in the full image: map grid of the mask: used")
def mask_of_the_whole_tile(folder: Path) -> MaskedImage:
    whole = np.zeros((300, 300))
    whole[100:196, 40:160] = ~OPEN
    whole[:100] = 1
    return masked(folder, whole, ~OPEN, transform=GRID @ Affine.translation(-40, -100))


@cell(MASK, Subject.PLACE, "used", "map grid of the mask: used")
def coarser_mask(folder: Path) -> MaskedImage:
    coarse = ~OPEN[::10, ::10]
    fine = np.kron(coarse, np.ones((10, 10), dtype=bool))[: SHAPE[0], : SHAPE[1]]
    return masked(folder, coarse, fine, transform=GRID @ Affine.scale(10.0))


@cell(MASK, Subject.PLACE, "used", "map grid of the mask: used")
def mask_in_the_next_zone(folder: Path) -> Read:
    """Pixels beside its borders aside, it hides what it shows."""
    image = open_raster(write(folder / "a.tif", [GREY]))
    with rasterio.open(write(folder / "same.tif", [~OPEN], dtype="uint8")) as file:
        bounds = rasterio.warp.transform_bounds(file.crs, "EPSG:32632", *file.bounds)
        grid = rasterio.transform.from_bounds(*bounds, 400, 400)
        pixels = np.zeros((400, 400), np.uint8)
        rasterio.warp.reproject(
            file.read(1),
            pixels,
            src_transform=file.transform,
            src_crs=file.crs,
            dst_transform=grid,
            dst_crs="EPSG:32632",
        )
    place = write(folder / "mask.tif", [pixels], dtype="uint8", crs="EPSG:32632", transform=grid)
    found = apply_mask(image, place)
    hidden = np.isnan(found.read(Window(0, 0, *SHAPE)))
    assert (hidden != ~OPEN).sum() < 60
    return Read(found.statements)


@cell(MASK, Subject.PLACE, "assumed", "mask.tif: place in the full image: the frame of a.tif: assumed")
def mask_on_no_map(folder: Path) -> MaskedImage:
    return masked(folder, ~OPEN, ~OPEN, on_map=False)


@cell(MASK, Subject.PLACE, "refused", "% of a.tif by its map grid, a mask of all its ground expected")
def mask_that_ends_inside(folder: Path) -> MaskedImage:
    return masked(folder, ~OPEN, ~OPEN, transform=GRID @ Affine.translation(30, 0))


@cell(MASK, Subject.PLACE, "refused", "0 % of a.tif by its map grid")
def mask_of_another_place(folder: Path) -> MaskedImage:
    return masked(folder, ~OPEN, ~OPEN, transform=GRID @ Affine.translation(3000, 0))


@cell(MASK, Subject.PLACE, "refused", "mask.tif: has a map grid, and a.tif has none")
def mask_on_a_map_of_an_image_on_none(folder: Path) -> MaskedImage:
    return masked(folder, ~OPEN, ~OPEN, image_on_map=False)


@cell(MASK, Subject.PLACE, "refused", "96 x 60 pixels found, a mask of the same ground as a.tif")
def mask_of_other_proportions(folder: Path) -> MaskedImage:
    return masked(folder, ~OPEN[:, :60], ~OPEN, on_map=False)
