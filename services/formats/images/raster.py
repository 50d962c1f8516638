"""Opening untrusted image files: few drivers, few side files, limited sizes, local paths only."""

import shutil
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import rasterio
import rasterio.rpc
from pyproj.exceptions import ProjError
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window as RasterWindow

from amers.services.datums import DatumShift, datum_shift
from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace, file_bytes
from amers.services.formats.images.bands import BandMix, PixelCodes, default_mix, one_band
from amers.services.formats.images.datasets import (
    GDAL_CACHE,
    GDAL_OPTIONS,
    as_format_error,
    open_dataset,
)
from amers.services.formats.images.georeference import georeference
from amers.services.formats.images.validity import Validity, validity_of, values_of_palette
from amers.services.formats.images.working_copy import Pixels, open_pixels
from amers.services.imagery.source import ImageSource, Window
from amers.services.map_grid import MapGrid
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import FloatImage

# An image that is not rectified has a sensor model instead of a map grid.
warnings.simplefilter("ignore", NotGeoreferencedWarning)

GDAL_FIRST_PIXEL = 0.5
"""Line and sample of the centre of the first pixel in GDAL."""
MAX_PIXELS = 40_000_000_000
"""Largest number of pixels of an image: twice a strip of 40,000 samples and 500,000 lines."""
MAX_EXPANSION = 5_000
"""Largest ratio of pixel bytes to file bytes: Deflate reaches 1,032 on a constant image."""
_ALL_LOST = 1.0 - 1e-6
"""Sum of the weights of bands without data at which a mix has none: rounding leaves it below 1."""


class OpenImage(ImageSource, Protocol):
    """An image in one or several opened files."""

    @property
    def path(self) -> FilePlace:
        """Of the file, or of the document that lists the files."""
        ...

    @property
    def dataset(self) -> rasterio.DatasetReader:
        """Of the file, or of the first of the files."""
        ...

    @property
    def statements(self) -> Statements:
        """Of the files, and what became of them."""
        ...

    def close(self) -> None:
        """Close all files."""
        ...


@dataclass(frozen=True)
class RasterImage:
    """One band of an image file, or a mix of several: an `ImageSource` for one thread at a time.

    Attributes:
        path: of the file, or its address.
        dataset: the dataset that `open_raster` opened, with the metadata of the image.
        pixels: the dataset from which pixels are read: the same one, or a working copy.
        mix: the bands and their weights.
        validity: which pixels have no data.
        palette: grey value of each index of a band with a colour table; None for others.
        codes: statements of the product about its pixels, in addition to those of the file.
        statements: of the file, and what became of them.
    """

    path: FilePlace
    dataset: rasterio.DatasetReader
    pixels: Pixels
    mix: BandMix
    validity: Validity
    palette: FloatImage | None = None
    codes: PixelCodes = field(default_factory=PixelCodes)
    statements: Statements = ()

    @property
    def band(self) -> int:
        """Number of the first band."""
        return self.mix.bands[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.dataset.height, self.dataset.width

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, (lines, samples) float32; see `ImageSource`.

        A pixel of a mix has no data where none of its bands has, as in `dataset_mask` of GDAL: it is the
        mean of those that have. It is saturated where one band is.

        Raises:
            FormatError: the file cannot be read there.
        """
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        line, sample = max(window.line, 0), max(window.sample, 0)
        lines = min(window.line + window.lines, self.shape[0]) - line
        samples = min(window.sample + window.samples, self.shape[1]) - sample
        if lines > 0 and samples > 0:
            inside = out[
                line - window.line : line - window.line + lines,
                sample - window.sample : sample - window.sample + samples,
            ]
            self._fill(inside, RasterWindow(sample, line, samples, lines))
        return out

    def sampled(self, window: Window, shape: tuple[int, int]) -> FloatImage:
        """Pixels of a window inside the image, spread evenly; see `SampledSource`.

        Raises:
            FormatError: the file cannot be read there.
        """
        out = np.empty(shape, dtype=np.float32)
        self._fill(out, RasterWindow(window.sample, window.line, window.samples, window.lines))
        return out

    def close(self) -> None:
        """Close the file; it cannot be read afterwards."""
        self.pixels.close()
        self.validity.close()

    def with_codes(self, codes: PixelCodes) -> "RasterImage":
        """The image with other statements of its product about its pixels."""
        return replace(self, codes=codes)

    def with_mix(self, mix: BandMix) -> "RasterImage":
        """The same file with other bands."""
        return replace(self, mix=mix)

    def __reduce__(self) -> tuple[Any, ...]:
        """In another process the file is opened again."""
        path = self.path if isinstance(self.path, Address) else self.path.resolve()
        return _opened_again, (path, self.mix, self.codes)

    def _fill(self, out: FloatImage, window: RasterWindow) -> None:
        with as_format_error(self.path, "readable pixels"), rasterio.Env(**GDAL_CACHE):
            dataset = self.pixels.dataset
            if len(self.mix.bands) == 1:
                self._fill_band(out, dataset, self.band, window)
            else:
                self._fill_mix(out, dataset, window)
            hidden = self.validity.hidden(dataset, window, out.shape)
        if hidden is not None:
            out[hidden] = np.nan

    def _fill_mix(self, out: FloatImage, dataset: rasterio.DatasetReader, window: RasterWindow) -> None:
        out[:] = 0.0
        one, lost = np.empty_like(out), None
        for band, weight in zip(self.mix.bands, self.mix.weights, strict=True):
            self._fill_band(one, dataset, band, window)
            missing = np.isnan(one) if self._has_gaps(band) else None
            if missing is not None and missing.any():
                lost = np.zeros(out.shape, dtype=np.float32) if lost is None else lost
                one[missing] = 0.0
                lost[missing] += np.float32(weight)
            out += np.float32(weight) * one
        if lost is not None:
            lost[lost >= _ALL_LOST] = np.nan
            out /= 1.0 - lost

    def _has_gaps(self, band: int) -> bool:
        """Whether pixels of a band may have no data."""
        is_whole = np.dtype(self.dataset.dtypes[band - 1]).kind in "ui"
        return not is_whole or self.codes.nodata is not None or self.validity.is_stated(band)

    def _fill_band(
        self, out: FloatImage, dataset: rasterio.DatasetReader, band: int, window: RasterWindow
    ) -> None:
        pixels = dataset.read(band, window=window, out_shape=out.shape)
        if self.palette is None:
            out[:] = pixels
        else:
            index = np.minimum(pixels, len(self.palette) - 1)
            out[:] = np.where(index == pixels, self.palette[index], np.nan)
        for saturated in self.saturated_values(band):
            if pixels.max() >= saturated:
                out[pixels == saturated] = np.inf
        missing = self.validity.missing(band, pixels)
        if missing is not None:
            out[missing] = np.nan
        elif self.codes.nodata is not None and not self.validity.is_stated(band):
            out[pixels == self.codes.nodata] = np.nan

    def saturated_values(self, band: int) -> tuple[int, ...]:
        """The values of a band that mean "saturated": the largest of its bits, and that of the product.

        None for floating-point pixels and for 8 bits: producers stretch the contrast of 8-bit images for
        display, so that their largest value is valid. 12 bits in 16, when neither file nor product says
        so, do not state their largest value, and it counts as grey.
        """
        dtype = np.dtype(self.dataset.dtypes[band - 1])
        if dtype.kind not in "ui" or dtype.itemsize < 2:
            return ()
        largest = int(np.iinfo(dtype).max)
        bits = self.dataset.tags(band, ns="IMAGE_STRUCTURE").get("NBITS", "")
        if bits.isdecimal() and len(bits) <= 2 and int(bits):  # a file beside the image may say anything
            largest = min(largest, 2 ** int(bits) - 1)
        stated = self.codes.saturated
        return (largest,) if stated in (None, largest) else (largest, stated)


def open_raster(path: FilePlace, bands: int | BandMix | None = 1) -> RasterImage:
    """Open one band, or a mix of several, of a GeoTIFF (or COG), JPEG 2000 or NITF file.

    Only the file itself is opened, with its mask `NAME.msk` and what GDAL keeps of its bands in
    `NAME.aux.xml`: no path that is a URL, no archive, no file that refers to others. A file at an
    `Address`, as operators and their catalogues give, is read by parts. The last pixel is read: a
    truncated file is refused here and not during the processing. A file that would be unpacked again for
    each window is unpacked once, into a working copy. Indices of a colour table are replaced by the grey
    of their colours.

    Args:
        path: of a regular file, or an address.
        bands: number of a band, counted from 1, or a mix; None for the `default_mix`.

    Raises:
        FormatError: the file cannot be used; the message states the reason and what was expected.
    """
    with rasterio.Env(**GDAL_OPTIONS):
        dataset = open_dataset(path)
        try:
            validity = validity_of(path, dataset)
            if bands is None:
                bands = default_mix(validity.colours, path)
            mix = bands if isinstance(bands, BandMix) else one_band(bands)
            check_declaration(path, dataset, mix)
            palette, statements = _palette(path, dataset, mix, validity)
            image = RasterImage(path, dataset, open_pixels(path, dataset), mix, validity, palette)
            statements += (*validity.statements, *_other_pages(path, dataset))
            last = replace(image, pixels=Pixels(path, dataset, is_copied=False))
            last.read(Window(image.shape[0] - 1, image.shape[1] - 1, 1, 1))
        except FormatError:
            dataset.close()
            raise
    return replace(image, statements=statements)


def open_values(path: FilePlace) -> RasterImage:
    """Open the first band of an image for its values, such as classes, not for its colours.

    Raises:
        FormatError: the file cannot be used.
    """
    return replace(open_raster(path), palette=None)


def _opened_again(path: FilePlace, mix: BandMix, codes: PixelCodes) -> RasterImage:
    return replace(open_raster(path, mix), codes=codes)


def _palette(
    path: FilePlace, dataset: rasterio.DatasetReader, mix: BandMix, validity: Validity
) -> tuple[FloatImage | None, Statements]:
    """The grey values of a colour table; None where the bands have none."""
    with_table = [band for band in mix.bands if validity.colours[band - 1] == "palette"]
    if not with_table:
        return None, ()
    value, band = "colour table", with_table[0]
    if len(mix.bands) > 1:
        raise FormatError(
            f"{path}: band {band} has a colour table, and its values have no mean with other bands; "
            f"give it alone (--bands {band})"
        )
    note = "the grey of each pixel is the mean of the red, green and blue of its colour"
    said = Statement(path.name, Subject.BANDS, Use.USED, value, f"band {band}", note)
    return values_of_palette(dataset, band), (said,)


def _other_pages(path: FilePlace, dataset: rasterio.DatasetReader) -> Statements:
    """What is said of further images in a file."""
    others = len(dataset.subdatasets) - 1
    if others < 1:
        return ()
    note = (
        "the first is read; write another one into a file of its own: gdal_translate "
        f"{dataset.subdatasets[1].replace(str(dataset.name), path.name)} OTHER.tif"
    )
    value = f"{others + 1} images in one file"
    return (Statement(path.name, Subject.IDENTITY, Use.NOT_USED, value, "images 2 and more", note),)


def map_grid_of(image: OpenImage) -> MapGrid | None:
    """The map grid of an image, of its own or of a file beside it; None when none states it.

    Raises:
        FormatError: the grid is degenerate, its centre is not on the Earth, or its reference system has
            no usable transformation to WGS 84.
    """
    stated = georeference(image.path, image.dataset)
    t = stated.transform
    if stated.crs is None or t.is_identity:
        return None
    crs = stated.crs.to_wkt(version="WKT2_2019")
    step_xy = np.array([[t.b, t.a], [t.e, t.d]])
    origin_xy = np.array([t.c, t.f]) + step_xy @ [GDAL_FIRST_PIXEL, GDAL_FIRST_PIXEL]
    grid = MapGrid(crs, origin_xy, step_xy, image.shape)
    if not abs(np.linalg.det(step_xy)) > 0.0:
        raise FormatError(
            f"{image.path}: geotransform: {tuple(t)[:6]} places all pixels on a line, a grid expected"
        )
    try:
        centre = grid.lon_lat((np.array([image.shape], dtype=np.float64) - 1.0) / 2.0)
    except ProjError:
        shift_of_grid(image, grid)  # says what is missing
        raise
    if not np.isfinite(centre).all():
        raise FormatError(f"{image.path}: its centre is not on the Earth in {crs[:60]}…")
    return grid


def shift_of_grid(image: OpenImage, grid: MapGrid) -> DatumShift:
    """The operation that leads from the map of an image to WGS 84, at its centre.

    Raises:
        FormatError: there is no usable operation.
    """
    centre = (np.array([image.shape], dtype=np.float64) - 1.0) / 2.0
    return datum_shift(grid.crs, grid.xy(centre)[0], str(image.path))


def copy_with_rpc(path_in: Path, path_out: Path, model: RpcModel) -> None:
    """Write a copy of a GeoTIFF that differs only in its RPC tags.

    Args:
        path_in: the delivered image, which stays unchanged.
        path_out: the copy; an existing file is replaced.
        model: the RPC for the tags.

    Raises:
        FormatError: the image is not a GeoTIFF, or the copy would overwrite it.
    """
    image = open_raster(path_in)
    driver = image.dataset.driver
    image.close()
    if driver != "GTiff":
        raise FormatError(f"{path_in}: {driver} found; only a GeoTIFF can be copied with new RPC tags")
    if path_out.resolve() == path_in.resolve():
        raise FormatError(
            f"{path_out}: the delivered image would be overwritten; give another output folder"
        )
    shutil.copyfile(path_in, path_out)
    with (
        as_format_error(path_out, "a GeoTIFF with writable tags"),
        rasterio.Env(**GDAL_OPTIONS),
        rasterio.open(path_out.resolve(), "r+", driver="GTiff", IGNORE_COG_LAYOUT_BREAK="YES") as copy,
    ):
        copy.rpcs = gdal_rpc(model)


def write_raster(path: Path, pixels: npt.NDArray[Any], model: RpcModel | None = None) -> None:
    """Write one band as a tiled, compressed GeoTIFF.

    Args:
        path: of the file; an existing one is replaced.
        pixels: (lines, samples) uint8, uint16 or float32.
        model: the RPC for the tags, if any.
    """
    lines, samples = pixels.shape
    with (
        rasterio.Env(**GDAL_OPTIONS),
        rasterio.open(
            path.resolve(),
            "w",
            driver="GTiff",
            height=lines,
            width=samples,
            count=1,
            dtype=pixels.dtype,
            tiled=True,
            compress="deflate",
            predictor=3 if pixels.dtype.kind == "f" else 2,
            BIGTIFF="IF_SAFER",
        ) as file,
    ):
        file.write(pixels, 1)
        if model is not None:
            file.rpcs = gdal_rpc(model)


def gdal_rpc(model: RpcModel) -> rasterio.rpc.RPC:
    """The RPC in the structure of GDAL, which writes unknown errors as -1."""
    line_off, samp_off = model.image_offset.tolist()
    line_scale, samp_scale = model.image_scale.tolist()
    long_off, lat_off, height_off = model.ground_offset.tolist()
    long_scale, lat_scale, height_scale = model.ground_scale.tolist()
    return rasterio.rpc.RPC(
        line_off=line_off,
        samp_off=samp_off,
        line_scale=line_scale,
        samp_scale=samp_scale,
        long_off=long_off,
        lat_off=lat_off,
        height_off=height_off,
        long_scale=long_scale,
        lat_scale=lat_scale,
        height_scale=height_scale,
        line_num_coeff=model.line_num.tolist(),
        line_den_coeff=model.line_den.tolist(),
        samp_num_coeff=model.sample_num.tolist(),
        samp_den_coeff=model.sample_den.tolist(),
        err_bias=-1.0 if np.isnan(model.error_bias_m) else model.error_bias_m,
        err_rand=-1.0 if np.isnan(model.error_random_m) else model.error_random_m,
    )


def check_declaration(path: FilePlace, dataset: rasterio.DatasetReader, mix: BandMix) -> None:
    """Refuse impossible sizes and bands before memory is allocated for them.

    Raises:
        FormatError: the file declares what it cannot contain.
    """
    for band in mix.bands:
        if not 1 <= band <= dataset.count:
            raise FormatError(f"{path}: band {band} requested, the image has {dataset.count} bands")
        dtype = np.dtype(dataset.dtypes[band - 1])
        if dtype.kind not in "uif":
            raise FormatError(f"{path}: expected integer or floating-point pixels, found {dtype.name}")
    pixels, size = dataset.width * dataset.height, file_bytes(path)
    if pixels > MAX_PIXELS or pixels * dtype.itemsize > MAX_EXPANSION * size:
        raise FormatError(
            f"{path}: declares {dataset.height} lines of {dataset.width} samples in {size} bytes; "
            f"at most {MAX_PIXELS} pixels, and {MAX_EXPANSION} bytes of pixels for each byte of file, "
            "are accepted"
        )
