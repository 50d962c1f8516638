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
            "The scene has one or more models. Amers uses the first one in the order of "
            "GDAL: files of vendors, tags of the image, other files.",
        ),
        Treatment(
            Subject.MODEL,
            "named",
            "The scene has a further model that differs from the used model by 0.01 px or"
            " more, or that cannot be read.",
        ),
        Treatment(
            Subject.MODEL,
            "refused",
            "There is no model, or there are only ground control points, to which no model is fitted.",
        ),
        Treatment(
            Subject.PLACE,
            "used",
            "ICHIPB of a NITF, or the geotransform of a cropped or reduced image, states "
            "the position of the image in the full image.",
        ),
        Treatment(
            Subject.PLACE,
            "assumed",
            "The name of the image shows that it is a tile, and a model has the same "
            "name: the model belongs to the tile.",
        ),
        Treatment(Subject.PLACE, "named", "An image with a sensor model also has a map grid."),
        Treatment(
            Subject.PLACE,
            "refused",
            "The image is cropped, and the RPC may belong to the crop or to the full "
            "image. State `--crop-origin`.",
        ),
        Treatment(
            Subject.ACCURACY, "used", "ERR_BIAS and ERR_RAND in tags or in RPC00B state the accuracy."
        ),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The file has ERR_BIAS and ERR_RAND, but `--sigma-m` states another accuracy.",
        ),
        Treatment(
            Subject.ACCURACY,
            "assumed",
            "The file states no accuracy: Amers uses the accuracy of the sensor if it "
            "knows the sensor, otherwise 50 m.",
        ),
        Treatment(
            Subject.IDENTITY,
            "used",
            "MISSION and IMAGING_DATE in tags, or IDATIM of a NITF, state the sensor and the time.",
        ),
        Treatment(Subject.HORIZONTAL_DATUM, "used", "An ortho-image states its reference system."),
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
