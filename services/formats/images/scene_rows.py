"""What becomes of the statements of a scene about its sensor model, its place and its accuracy."""

from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.statements import Subject

READER = Reader(
    "Scenes: RPC and place in GeoTIFF, JPEG 2000 and NITF",
    ("read_scene",),
    (
        Treatment(
            Subject.MODEL,
            "used",
            "The first model in the order of GDAL: files of vendors, tags of the image, other files.",
        ),
        Treatment(
            Subject.MODEL,
            "named",
            "Every other model that differs from the used model by 0.01 px or more, or cannot be read.",
        ),
        Treatment(
            Subject.MODEL,
            "refused",
            "There is no model, or there are only ground control points, to which no model is fitted.",
        ),
        Treatment(
            Subject.PLACE, "used", "ICHIPB of a NITF, or the geotransform of a cropped or reduced image."
        ),
        Treatment(
            Subject.PLACE,
            "assumed",
            "If an image is a tile by its name, a model with the name of the tile is the model of the "
            "tile.",
        ),
        Treatment(Subject.PLACE, "named", "The map grid of an image that has a sensor model."),
        Treatment(
            Subject.PLACE,
            "refused",
            "A cropped image whose RPC may belong to the crop or to the full image. State "
            "`--crop-origin`.",
        ),
        Treatment(Subject.ACCURACY, "used", "ERR_BIAS and ERR_RAND of tags and of RPC00B."),
        Treatment(
            Subject.ACCURACY, "named", "ERR_BIAS and ERR_RAND, if `--sigma-m` states another accuracy."
        ),
        Treatment(
            Subject.ACCURACY,
            "assumed",
            "The accuracy of the sensor, if Amers knows the sensor; otherwise 50 m.",
        ),
        Treatment(
            Subject.IDENTITY, "used", "MISSION and IMAGING_DATE of the tags, and IDATIM of a NITF."
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "used", "The reference system of an ortho-image."),
    ),
    never=(
        Subject.PIXEL_ORIGIN,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.VALIDITY,
        Subject.BANDS,
    ),
)
