"""Treatment of the statements of image files and masks about their pixels."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

READER = Reader(
    "Pixels of images: GeoTIFF, JPEG 2000, NITF",
    ("open_raster", "open_values"),
    (
        Treatment(
            Subject.VALIDITY,
            "used",
            "The first that exists of: a mask inside the file, a mask file next to it (`NAME.msk`), an "
            "alpha band with any band number, a nodata value (of the file, of `NAME.aux.xml`, or of a "
            "DIMAP document). A mean of bands has no data where none of the bands has data.",
        ),
        Treatment(
            Subject.VALIDITY,
            "named",
            "All later ones of this list. An alpha band with a range of grey values, which is used as a "
            "band of the image. A `NAME.msk` that is not a mask of all bands.",
        ),
        Treatment(Subject.VALIDITY, "refused", "`NAME.msk` has another size than the image."),
        Treatment(
            Subject.BANDS,
            "used",
            "The bands of `--bands`. Without this option: the mean of red, green and blue, if they "
            "match within 0.3 px; a band of brightness (Y, lightness); the grey value of the colours of "
            "a colour table.",
        ),
        Treatment(
            Subject.BANDS,
            "assumed",
            "If no band has a colour, the mean of the first three bands, or the first of two bands. If "
            "the bands do not match within 0.3 px or cannot be compared, the middle band alone.",
        ),
        Treatment(
            Subject.BANDS,
            "refused",
            "Bands that the file does not have, inks, hue and saturation, a colour table together with "
            "other bands, and complex numbers.",
        ),
        Treatment(
            Subject.UNIT,
            "named",
            "Unit, scale and offset, because only the contrast of a scene matters.",
        ),
        Treatment(
            Subject.IDENTITY, "named", "Further images in the file, because the first image is read."
        ),
    ),
    (
        Subject.MODEL,
        Subject.PLACE,
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.ACCURACY,
    ),
)

MASK_READER = Reader(
    "Masks of images (`--mask`)",
    (),
    (
        Treatment(
            Subject.VALIDITY,
            "used",
            "Pixels that are not 0 are excluded. Nodata pixels of the mask exclude nothing.",
        ),
        Treatment(Subject.PLACE, "used", "The map grid of the mask, in any reference system."),
        Treatment(
            Subject.PLACE,
            "assumed",
            "A mask without a map grid covers the whole image, if it has the same proportions.",
        ),
        Treatment(
            Subject.PLACE,
            "refused",
            "The map grid does not cover the image, the mask has a map grid but the image has none, or "
            "the proportions differ.",
        ),
    ),
    (
        Subject.MODEL,
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.BANDS,
        Subject.IDENTITY,
        Subject.ACCURACY,
    ),
)
