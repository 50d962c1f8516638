"""One model in one file: RPC text, RPB, ISD, DIMAP, `.geom`, `.aux.xml` or the tags of an image."""

import re
from dataclasses import dataclass, replace
from typing import Literal
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import rasterio

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.sensor_models.dimap import dimap_first_pixel, parse_dimap_rpc
from amers.services.formats.sensor_models.geom import is_geom, parse_geom
from amers.services.formats.sensor_models.rigorous_model import rpc_of_rigorous_model
from amers.services.formats.sensor_models.rpc_text import (
    RPB_KEYS,
    RPB_LISTS,
    RPC00A_ORDER,
    named_numbers,
    parse_rpb,
    parse_rpc_text,
    rpc_from_numbers,
)
from amers.services.formats.sensor_models.xml_values import single
from amers.services.formats.text_files import parse_number, parse_xml, read_text
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Statement, Statements, Subject, Use

Convention = Literal["tags", "text", "rpb", "isd", "dimap", "geom", "aux", "rigorous"]


@dataclass(frozen=True)
class FoundModel:
    """A model as its file has it.

    Attributes:
        model: in the pixels of the image that the file is for.
        path: of the file.
        convention: its format.
        mended: what was changed in it; "" where nothing was.
        shape: lines and samples of the image that it is for, where its file states them.
        statements: of its file, beyond the model itself.
    """

    model: RpcModel
    path: FilePlace
    convention: Convention
    mended: str = ""
    shape: tuple[int, int] | None = None
    statements: Statements = ()

    @property
    def name(self) -> str:
        """For people: the file, with its tags where it is the image itself."""
        return f"tags of {self.path.name}" if self.convention == "tags" else self.path.name


def read_model_file(path: FilePlace) -> FoundModel:
    """The model of a file, whose content, not its name, decides on the format.

    Raises:
        FormatError: it cannot be read, or a line or a value has another form than expected.
    """
    text = read_text(path)
    if text.lstrip("\ufeff \t\r\n").startswith("<"):
        return _read_xml(text, path)
    if re.search(r"\bBEGIN_GROUP\b", text):
        return FoundModel(
            parse_rpb(text, path.name), path, "rpb", statements=_rpb_statements(text, path)
        )
    if is_geom(text):
        model, mended = parse_geom(text, path.name)
        origin = Statement(path.name, Subject.PIXEL_ORIGIN, Use.USED, mended)
        return FoundModel(model, path, "geom", mended, statements=(origin,) if mended else ())
    return FoundModel(parse_rpc_text(text, path.name), path, "text")


def has_model(path: FilePlace) -> bool:
    """Whether an XML file that may be about anything has a model; any other file is taken to have one.

    A file that cannot be read as XML has none.
    """
    if path.suffix.lower() not in (".xml", ".dim"):
        return True
    text = read_text(path)
    try:
        root = parse_xml(text, path.name)
    except FormatError:
        return False
    if root.tag == "PAMDataset":
        return _rpc_domain(root) is not None
    if root.tag == "isd":
        return root.find("RPB") is not None or root.find("EPH") is not None
    models = "Global_RFM", "Refined_Model", "Data_Strip"
    return root.tag == "PHR_Dimap_Document" or any(root.find(f".//{tag}") is not None for tag in models)


def tagged_model(dataset: rasterio.DatasetReader, path: FilePlace) -> FoundModel:
    """The RPC in the tags of a GeoTIFF, or the RPC00B or RPC00A of a NITF.

    Raises:
        FormatError: a number is missing or is none.
    """
    tags = dataset.tags(ns="RPC")
    records = dataset.tags(ns="TRE")
    if "RPC00A" in records and "RPC00B" not in records:
        tags = {**tags, **_rpc00a_coefficients(records["RPC00A"])}
    return FoundModel(_parse_tags(tags, path.name), path, "tags")


def format_aux_rpc(text: str, model: RpcModel) -> str:
    """A copy of a `.aux.xml` with another RPC; all else stays.

    Args:
        text: the delivered file.
        model: the RPC to write.
    """
    numbers = named_numbers(model)
    items = {key: repr(value) for key, value in numbers.items() if "_COEFF_" not in key}
    for name in RPB_LISTS:
        items[f"{name}_COEFF"] = " ".join(repr(numbers[f"{name}_COEFF_{i}"]) for i in range(1, 21))
    rows = "".join(f'\n    <MDI key="{key}">{escape(value)}</MDI>' for key, value in items.items())
    return re.sub(
        r"(<Metadata\s[^>]*domain=[\"']RPC[\"'][^>]*>).*?(</Metadata>)",
        lambda found: f"{found[1]}{rows}\n  {found[2]}",
        text,
        count=1,
        flags=re.DOTALL,
    )


def _read_xml(text: str, path: FilePlace) -> FoundModel:
    root = parse_xml(text, path.name)
    if root.tag == "PAMDataset":
        domain = _rpc_domain(root)
        if domain is None:
            raise FormatError(
                f'{path.name}: no <Metadata domain="RPC"> found, the RPC of an image expected'
            )
        tags = {item.get("key", ""): item.text or "" for item in domain.iter("MDI")}
        return FoundModel(_parse_tags(tags, path.name), path, "aux")
    if root.tag == "isd" and root.find("RPB") is not None:
        shape = _shape(root, "IMD/NUMROWS", "IMD/NUMCOLUMNS")
        return FoundModel(_parse_isd_rpb(root, path.name), path, "isd", shape=shape)
    fit = rpc_of_rigorous_model(text, path.name)
    if fit is not None:
        note = f"RPC fitted to it within {fit.max_error_px:.2g} px"
        return FoundModel(fit.model, path, "rigorous", note)
    last = _shape(root, ".//RFM_Validity//LAST_ROW", ".//RFM_Validity//LAST_COL")
    first = dimap_first_pixel(root, path.name)
    shape = None if last is None else (last[0] + 1 - int(first[0]), last[1] + 1 - int(first[1]))
    model = parse_dimap_rpc(text, path.name)
    stated = [
        Statement(path.name, Subject.PIXEL_ORIGIN, Use.USED, f"first pixel ({first[0]:g}, {first[1]:g})")
    ]
    error = root.find(".//ERR_BIAS_ROW")
    error = root.find(".//ERR_BIAS_X") if error is None else error
    if error is not None:
        note = "of the fit of the polynomials, not of the scene"
        value = f"{error.tag} {(error.text or '').strip()[:20]}"
        accuracy = Statement(path.name, Subject.ACCURACY, Use.NOT_USED, value, note=note)
        stated.append(replace(accuracy, is_usual=True))
    return FoundModel(model, path, "dimap", shape=shape, statements=tuple(stated))


def _shape(root: ElementTree.Element, rows: str, columns: str) -> tuple[int, int] | None:
    """Two whole numbers of a document; None where one is missing."""
    texts = [(root.findtext(path) or "").strip() for path in (rows, columns)]
    numbers = [int(float(text)) for text in texts if re.fullmatch(r"\d{1,9}(\.0*)?", text)]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def _rpb_statements(text: str, path: FilePlace) -> Statements:
    """For which band the RPC of a RPB is: all bands of an image take it."""
    band = re.search(r"\bbandId\s*=\s*\"?(\w+)", text, re.IGNORECASE)
    if band is None:
        return ()
    note = "all bands of the image have this model"
    return (Statement(path.name, Subject.BANDS, Use.NOT_USED, f"bandId {band[1]}", note=note),)


def _rpc_domain(root: ElementTree.Element) -> ElementTree.Element | None:
    return root.find("Metadata[@domain='RPC']")


def _parse_isd_rpb(root: ElementTree.Element, source: str) -> RpcModel:
    """The RPC in the RPB block of the XML of a WorldView product."""
    block = single(root, "RPB", source)
    order = (single(block, "SPECID", source).text or "").strip()
    if order.upper() != "RPC00B":
        raise FormatError(f"{source}: RPB/SPECID: expected RPC00B, found {order[:20] or 'none'}")
    keys = {**RPB_KEYS, "ERR_BIAS": "errBias", "ERR_RAND": "errRand"}

    def number(key: str) -> float:
        polynomial, _, index = key.partition("_COEFF_")
        if not index:
            element = single(block, f"IMAGE/{keys[key].upper()}", source)
            return parse_number(element.text or "", element.tag, source)
        name = RPB_LISTS[polynomial].upper()
        values = (single(block, f"IMAGE/{name}List/{name}", source).text or "").split()
        if len(values) != 20:
            raise FormatError(f"{source}: {name}: {len(values)} numbers found, 20 expected")
        return parse_number(values[int(index) - 1], name, source)

    return rpc_from_numbers(number)


def _rpc00a_coefficients(record: str) -> dict[str, str]:
    """The coefficients of an RPC00A record in the order of RPC00B.

    Read from the record, because GDAL confuses four of the terms of the second degree.
    """
    starts = {"LINE_NUM": 81, "LINE_DEN": 321, "SAMP_NUM": 561, "SAMP_DEN": 801}
    return {
        f"{name}_COEFF": " ".join(record[start + 12 * i : start + 12 * (i + 1)] for i in RPC00A_ORDER)
        for name, start in starts.items()
    }


def _parse_tags(tags: dict[str, str], source: str) -> RpcModel:
    def number(key: str) -> float:
        name, _, index = key.partition("_COEFF_")
        if key in ("ERR_BIAS", "ERR_RAND"):
            return parse_number(tags.get(key, "-1"), key, source)
        values = tags.get(f"{name}_COEFF" if index else key, "").split()
        if len(values) != (20 if index else 1):
            raise FormatError(f"{source}: RPC tags: {key} is missing")
        return parse_number(values[int(index) - 1 if index else 0], key, source)

    return rpc_from_numbers(number)
