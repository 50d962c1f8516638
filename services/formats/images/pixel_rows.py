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
            "The image states which pixels have no data. Amers uses the first that exists"
            " of: a mask inside the file, a mask file next to it (`NAME.msk`), an alpha "
            "band, a nodata value (of the file, of `NAME.aux.xml`, or of a DIMAP "
            "document). A mean of bands has no data where none of its bands has data.",
        ),
        Treatment(
            Subject.VALIDITY,
            "named",
            "The image has a second statement about valid pixels, an alpha band with a "
            "range of grey values (Amers uses it as a band of the image), or a `NAME.msk`"
            " that is not a mask of all bands.",
        ),
        Treatment(Subject.VALIDITY, "refused", "`NAME.msk` has another size than the image."),
        Treatment(
            Subject.BANDS,
            "used",
            "`--bands` states the bands. Without this option, Amers uses the mean of red,"
            " green and blue if they match within 0.3 px, a band of brightness (Y, "
            "lightness), or the grey values of a colour table.",
        ),
        Treatment(
            Subject.BANDS,
            "assumed",
            "No band has a stated colour: Amers uses the mean of the first three bands, "
            "or the first band if there are two. If the bands do not match within 0.3 px "
            "or cannot be compared, Amers uses the middle band alone.",
        ),
        Treatment(
            Subject.BANDS,
            "refused",
            "`--bands` states a band that the file does not have. Or the bands are inks, "
            "hue or saturation, complex numbers, or a colour table together with other "
            "bands.",
        ),
        Treatment(
            Subject.UNIT,
            "named",
            "The file states a unit, a scale or an offset of the pixel values. A "
            "registration depends only on contrast.",
        ),
        Treatment(
            Subject.IDENTITY, "named", "The file contains further images. Amers reads the first image."
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
            "Pixels of the mask that are not 0 exclude pixels of the image. Nodata pixels"
            " of the mask exclude nothing.",
        ),
        Treatment(Subject.PLACE, "used", "The mask has a map grid, in any reference system."),
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
