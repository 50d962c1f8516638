"""The rigorous model of a product, from metadata in any supported format."""

from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

from amers.services.errors import FormatError
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.sensor_models.dimap_rigorous import parse_dimap_rigorous
from amers.services.formats.sensor_models.phr_dimap import parse_phr_dimap
from amers.services.formats.sensor_models.spot_dimap import parse_spot_dimap
from amers.services.formats.sensor_models.worldview_isd import parse_worldview_isd
from amers.services.formats.text_files import parse_xml, read_text
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc_fit import RpcFit, fit_rpc
from amers.services.statements import Subject

READER = Reader(
    "Orbit and attitude (PHRDIMAP, DIMAP 1 and 2)",
    ("parse_phr_dimap", "parse_spot_dimap", "parse_dimap_rigorous", "read_rigorous_model"),
    (
        Treatment(
            Subject.MODEL,
            "used",
            "The product has no RPC: Amers fits an RPC to the rigorous model. With "
            "`--rigorous`, Amers uses the rigorous model itself.",
        ),
        Treatment(
            Subject.MODEL,
            "named",
            "The product also has an RPC, and Amers uses the RPC. `amers scene "
            "register-many --rigorous` adjusts orbit and attitude instead.",
        ),
        Treatment(Subject.MODEL, "refused", "A value is missing, impossible or not supported."),
        Treatment(
            Subject.IDENTITY,
            "used",
            "The document states the name of the product, which identifies the image: all"
            " images have the file name IMAGERY.",
        ),
        Treatment(
            Subject.ACCURACY,
            "assumed",
            "The file states no accuracy: Amers uses the accuracy of the sensor if it "
            "knows the sensor, otherwise 50 m.",
        ),
    ),
    never=(
        Subject.PLACE,
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.VALIDITY,
        Subject.BANDS,
    ),
)

_READERS: dict[tuple[str, str], Callable[[str, str], PushbroomModel]] = {
    ("PHR_Dimap_Document", ""): parse_phr_dimap,
    ("isd", ""): parse_worldview_isd,
    ("Dimap_Document", "1"): parse_spot_dimap,
    ("Dimap_Document", "2"): parse_dimap_rigorous,
}
"""Readers by root element and major version of DIMAP."""


def read_rigorous_model(path: Path) -> PushbroomModel:
    """The rigorous model in the metadata of a product.

    Read are PHRDIMAP (CNES), DIMAP of version 1 (SPOT 1 to 5, level 1A) and of version 2 (SPOT 6/7,
    Pléiades) and the XML of basic WorldView products.

    Raises:
        FormatError: there is no such model, or a value is missing, impossible or not supported.
    """
    text = read_text(path)
    root = parse_xml(text, path.name)
    reader = _READERS.get(_kind(root))
    if reader is None:
        raise FormatError(
            f"{path.name}: <{root.tag[:60]}> of version {_version(root)[:20] or 'unknown'} found, "
            "one of PHR_Dimap_Document, isd, Dimap_Document 1 and Dimap_Document 2 expected"
        )
    return reader(text, path.name)


def rpc_of_rigorous_model(text: str, source: str) -> RpcFit | None:
    """The RPC fitted to the rigorous model of an XML document; None without such a model.

    A DIMAP document of version 2 has one where it has `Refined_Model`.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: a value of the model is missing, impossible or not supported.
    """
    model = rigorous_model_in(text, source)
    return None if model is None else fit_rpc(model, model.image_shape, model.height_range_m)


def rigorous_model_in(text: str, source: str) -> PushbroomModel | None:
    """The rigorous model of an XML document; None without one, as `rpc_of_rigorous_model`."""
    root = parse_xml(text, source)
    kind = _kind(root)
    if kind not in _READERS or (kind[1] == "2" and root.find(".//Refined_Model") is None):
        return None
    return _READERS[kind](text, source)


def _kind(root: ElementTree.Element) -> tuple[str, str]:
    """Root element and major version, as the readers are listed."""
    return root.tag, _version(root).partition(".")[0]


def _version(root: ElementTree.Element) -> str:
    """The version of a DIMAP document; empty for other documents."""
    if root.tag != "Dimap_Document":
        return ""
    for part in ("Metadata_Id", "Metadata_Identification"):
        declared = root.find(f"{part}/METADATA_FORMAT")
        if declared is not None:
            return declared.get("version", "")
    return ""
