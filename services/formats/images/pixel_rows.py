"""What becomes of the statements of image files about their pixels, and of those of masks."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

READER = Reader(
    "Pixels of images: GeoTIFF, JPEG 2000, NITF",
    ("open_raster", "open_values"),
    (
        Treatment(
            Subject.VALIDITY,
            "used",
            "The first of: a mask inside the file, one beside it (`NAME.msk`), an alpha band of any "
            "number, nodata (of the file, of `NAME.aux.xml`, of a DIMAP document). A mean of bands has "
            "no data where none of them has.",
        ),
        Treatment(
            Subject.VALIDITY,
            "named",
            "Those that come after; an alpha whose values are a range of grey, which is a band of the "
            "image; a `NAME.msk` that is no mask of all bands.",
        ),
        Treatment(Subject.VALIDITY, "refused", "A `NAME.msk` of another size."),
        Treatment(
            Subject.BANDS,
            "used",
            "Those of `--bands`; the mean of red, green and blue that lie within 0.3 px of each other; "
            "brightness (Y, lightness); the grey of the colours of a colour table.",
        ),
        Treatment(
            Subject.BANDS,
            "assumed",
            "The first three bands where none has a colour, or the first of two; the middle band alone "
            "where bands lie farther apart, or cannot be compared.",
        ),
        Treatment(
            Subject.BANDS,
            "refused",
            "Bands that the file does not have; inks, hue and saturation; a colour table among other "
            "bands; complex numbers.",
        ),
        Treatment(Subject.UNIT, "named", "Unit, scale and offset: only the contrast of a scene counts."),
        Treatment(Subject.IDENTITY, "named", "Further images in the file: the first is read."),
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
            Subject.VALIDITY, "used", "Pixels that are not 0 are excluded; its nodata excludes none."
        ),
        Treatment(Subject.PLACE, "used", "Its map grid, in any reference system."),
        Treatment(
            Subject.PLACE, "assumed", "The frame of the image, of a mask on no map with its proportions."
        ),
        Treatment(
            Subject.PLACE,
            "refused",
            "A map grid that does not cover the image, or of an image on no map; other proportions.",
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
