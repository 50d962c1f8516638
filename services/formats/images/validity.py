"""Pixels without data in an image file: masks, alpha bands and nodata values, as in GDAL.

The first of these decides, the others are named: a mask inside the file, a mask beside it (`NAME.msk`),
an alpha band, a nodata value. GDAL looks for an alpha band among two or four bands only, and for nodata
values before it, pixel by pixel of one band; its `dataset_mask` has the order taken here.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio
from rasterio.enums import MaskFlags
from rasterio.windows import Window as RasterWindow

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.images.datasets import as_format_error, open_dataset
from amers.services.formats.images.layout import MIB, READ_BY_WINDOWS_BYTES, largest_piece_bytes
from amers.services.formats.text_files import parse_number, parse_xml, read_text
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import BoolArray

_ALPHA = "alpha"
_PER_DATASET = 2
"""Flag of GDAL for a mask of all bands."""
_LOOKED_AT, _LINES, _SAMPLES = 5, 16, 128
"""Windows along each side of an image in which the values of an alpha band are looked at; their size."""
_OPAQUE_SHARE = 0.5
"""Least share of the pixels with an alpha above 0 that have its largest value: others show a seam alone.
Of the pixels of a band of grey, far fewer are the brightest."""
_NAMES = {"Gray": "gray", "Palette": "palette", "Red": "red", "Green": "green", "Blue": "blue"}
_NAMES |= {"Alpha": _ALPHA, "NIR": "undefined", "Undefined": "undefined"}


@dataclass(frozen=True)
class Validity:
    """What decides which pixels of an image have no data.

    Attributes:
        colours: colour interpretation of each band, by GDAL's names; that of a file beside goes before.
        nodata: value of each band without data, None for none; without effect below a mask or an alpha.
        alpha: number of the band that is 0 where the image is transparent; None for none.
        is_masked: whether the file has a mask inside.
        beside: a mask in a file of its own; None for none.
        statements: of the file and of those beside, about valid pixels.
    """

    colours: tuple[str, ...]
    nodata: tuple[float | None, ...]
    alpha: int | None = None
    is_masked: bool = False
    beside: rasterio.DatasetReader | None = None
    statements: Statements = ()

    @property
    def image_bands(self) -> tuple[int, ...]:
        """Numbers of the bands that are images."""
        return tuple(band for band in range(1, len(self.colours) + 1) if band != self.alpha)

    def is_stated(self, band: int) -> bool:
        """Whether anything says which pixels of a band have no data."""
        return self._hides or self.nodata[band - 1] is not None

    def hidden(
        self, dataset: rasterio.DatasetReader, window: RasterWindow, shape: tuple[int, ...]
    ) -> BoolArray | None:
        """Where a mask or an alpha band hides a window, read in a shape; None without any."""
        if self.is_masked:
            return np.asarray(dataset.read_masks(1, window=window, out_shape=shape) == 0)
        if self.beside is not None:
            return np.asarray(self.beside.read(1, window=window, out_shape=shape) == 0)
        if self.alpha is not None:
            return np.asarray(dataset.read(self.alpha, window=window, out_shape=shape) == 0)
        return None

    def missing(self, band: int, pixels: np.ndarray) -> BoolArray | None:
        """Where pixels of a band have its nodata value; None where it has none."""
        value = self.nodata[band - 1]
        if value is None or self._hides:
            return None
        if pixels.dtype.kind != "f":
            return np.asarray(pixels == value)
        # The file may state it in fewer digits than the pixels have.
        with np.errstate(over="ignore", invalid="ignore"):
            near = np.abs(pixels - value) <= 4.0 * np.spacing(np.abs(pixels))
        return np.asarray(np.isnan(pixels) | near)

    def close(self) -> None:
        """Close the mask."""
        if self.beside is not None:
            self.beside.close()

    @property
    def _hides(self) -> bool:
        return self.is_masked or self.beside is not None or self.alpha is not None


def validity_of(path: FilePlace, dataset: rasterio.DatasetReader) -> Validity:
    """What the file of a dataset, and the files beside it, state about pixels without data.

    Raises:
        FormatError: a mask beside the file has another size than the image, or cannot be read.
    """
    colours = [colour.name for colour in dataset.colorinterp]
    nodata, source = list(dataset.nodatavals), {band: path.name for band in dataset.indexes}
    for band, element in _bands_beside(path):
        if not 1 <= band <= dataset.count:
            continue
        name = f"{path.name}.aux.xml"
        value = element.findtext("NoDataValue")
        if value is not None:
            nodata[band - 1], source[band] = _nodata_value(value, name), name
        colours[band - 1] = _NAMES.get(element.findtext("ColorInterp") or "", colours[band - 1])
    flags = dataset.mask_flag_enums[0]
    has_alpha_mask = MaskFlags.alpha in flags
    plain = MaskFlags.all_valid in flags or MaskFlags.nodata in flags
    beside, said = _mask_beside(path, dataset)
    alpha, said_of_alpha = _alpha(path, dataset, colours)
    found = Validity(
        tuple(colours),
        tuple(nodata),
        alpha,
        not plain and not has_alpha_mask,
        beside,
    )
    return replace(found, statements=(*_decisions(path, found, source), *said, *said_of_alpha))


def _decisions(path: FilePlace, found: Validity, source: dict[int, str]) -> Statements:
    """What decides, and what is there besides."""
    stated: list[tuple[str, str, str]] = []
    if found.is_masked:
        stated.append((path.name, "", "mask inside the file"))
    if found.beside is not None:
        stated.append((f"{path.name}.msk", "", "mask beside the file"))
    if found.alpha is not None:
        stated.append((path.name, f"band {found.alpha}", "alpha: no data where it is 0"))
    values = {(source[k + 1], value) for k, value in enumerate(found.nodata) if value is not None}
    alike = len(values) == 1 and None not in found.nodata
    numbers = [(k + 1, value) for k, value in enumerate(found.nodata) if value is not None]
    levels = [[one] for one in stated]
    if numbers:
        levels.append(
            [
                (source[band], "" if alike else f"band {band}", f"no data where the value is {value:g}")
                for band, value in (numbers[:1] if alike else numbers)
            ]
        )
    first = levels[0][0][2] if levels else ""
    return tuple(
        Statement(
            file,
            Subject.VALIDITY,
            Use.NOT_USED if k else Use.USED,
            value,
            where,
            f"the {first.partition(':')[0]} goes before it" if k else "",
        )
        for k, level in enumerate(levels)
        for file, where, value in level
    )


def _mask_beside(
    path: FilePlace, dataset: rasterio.DatasetReader
) -> tuple[rasterio.DatasetReader | None, Statements]:
    """The mask in `NAME.msk`, and what is said of one that is not used."""
    place = _beside(path, ".msk")
    if place is None:
        return None, ()
    mask = open_dataset(place)
    if mask.shape != dataset.shape:
        mask.close()
        raise FormatError(
            f"{place}: {mask.height} x {mask.width} pixels found, {dataset.height} x {dataset.width} as "
            f"in {path.name} expected, whose mask it is by its name: remove or rename it"
        )
    piece = 0 if isinstance(place, Address) else largest_piece_bytes(place)
    if piece > READ_BY_WINDOWS_BYTES:
        mask.close()
        raise FormatError(
            f"{place}: strips or tiles of {piece // MIB} MiB found, at most "
            f"{READ_BY_WINDOWS_BYTES // MIB} MiB expected of a mask: write it in tiles"
        )
    flags = [mask.tags().get(f"INTERNAL_MASK_FLAGS_{band}", "") for band in dataset.indexes]
    if any(flag.isdecimal() and int(flag) & _PER_DATASET for flag in flags):
        return mask, ()
    mask.close()
    note = (
        "GDAL marks masks of all bands with INTERNAL_MASK_FLAGS_1=2; give it as --mask where it is one"
    )
    said = Statement(place.name, Subject.VALIDITY, Use.NOT_USED, "mask beside the file", "", note)
    return None, (said,)


def _alpha(
    path: FilePlace, dataset: rasterio.DatasetReader, colours: list[str]
) -> tuple[int | None, Statements]:
    """The band that is an alpha by its name and by its values, and what is said of others."""
    said: list[Statement] = []
    alpha = None
    for band in [k + 1 for k, colour in enumerate(colours) if colour == _ALPHA]:
        if alpha is None and _is_alpha(path, dataset, band):
            alpha = band
            continue
        colours[band - 1] = "undefined"
        note = "its values are a range of grey: taken as a band of the image, such as near infrared"
        said.append(Statement(path.name, Subject.VALIDITY, Use.NOT_USED, "alpha", f"band {band}", note))
    return alpha, tuple(said)


def _is_alpha(path: FilePlace, dataset: rasterio.DatasetReader, band: int) -> bool:
    """Whether most pixels of a band that are not 0 have its largest value, as far as it is looked at."""
    seen = []
    first = [
        np.linspace(0, max(size - side, 0), _LOOKED_AT).astype(int)
        for size, side in zip(dataset.shape, (_LINES, _SAMPLES), strict=True)
    ]
    with as_format_error(path, "readable pixels"):
        for line in np.unique(first[0]).tolist():
            for sample in np.unique(first[1]).tolist():
                lines, samples = min(_LINES, dataset.height), min(_SAMPLES, dataset.width)
                seen.append(
                    dataset.read(band, window=RasterWindow(sample, line, samples, lines)).ravel()
                )
    values = np.concatenate(seen)
    values = values[values != 0]
    return len(values) == 0 or bool(np.mean(values == values.max()) >= _OPAQUE_SHARE)


def _bands_beside(path: FilePlace) -> list[tuple[int, ElementTree.Element]]:
    """The bands in `NAME.aux.xml`, where GDAL keeps what a format has no place for."""
    place = _beside(path, ".aux.xml")
    if place is None:
        return []
    root = parse_xml(read_text(place), place.name)
    bands = [(element.get("band", ""), element) for element in root.findall("PAMRasterBand")]
    return [(int(number), element) for number, element in bands if number.isdecimal()]


def _beside(path: FilePlace, suffix: str) -> Path | None:
    """The file beside an image with one more suffix; at an address, the image alone is read."""
    if not isinstance(path, Path):
        return None
    place = path.resolve().with_name(path.resolve().name + suffix)
    return place if place.is_file() else None


def _nodata_value(text: str, source: str) -> float:
    return float("nan") if text.strip().lower() == "nan" else parse_number(text, "NoDataValue", source)


def values_of_palette(dataset: rasterio.DatasetReader, band: int) -> np.ndarray[Any, Any]:
    """Grey value (n,) of each index of the colour table of a band; NaN where it is transparent."""
    table = dataset.colormap(band)
    grey = np.full(max(table) + 1, np.nan, dtype=np.float32)
    for index, (red, green, blue, opacity) in table.items():
        if opacity:
            grey[index] = (red + green + blue) / 3.0
    return grey
