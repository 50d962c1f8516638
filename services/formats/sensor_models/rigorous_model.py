"""The rigorous model of a product, whichever of the supported formats its metadata have."""

from collections.abc import Callable
from pathlib import Path

from services.errors import FormatError
from services.formats.sensor_models.dimap_rigorous import parse_dimap_rigorous
from services.formats.sensor_models.phr_dimap import parse_phr_dimap
from services.formats.sensor_models.spot_dimap import parse_spot_dimap
from services.formats.sensor_models.worldview_isd import parse_worldview_isd
from services.formats.sensor_models.xml_values import parse_xml
from services.formats.text_files import read_text
from services.sensors.pushbroom import PushbroomModel

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
    version = ""
    if root.tag == "Dimap_Document":
        versions = [
            root.find(f"{place}/METADATA_FORMAT") for place in ("Metadata_Id", "Metadata_Identification")
        ]
        version = next((found.get("version", "") for found in versions if found is not None), "")
    reader = _READERS.get((root.tag, version.partition(".")[0]))
    if reader is None:
        raise FormatError(
            f"{path.name}: <{root.tag[:60]}> of version {version[:20] or 'unknown'} found, one of "
            "PHR_Dimap_Document, isd, Dimap_Document 1 and Dimap_Document 2 expected"
        )
    return reader(text, path.name)
