"""Images, models and archives that must be refused: damaged, absurd, or reading other files."""

import gzip
import io
import struct
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio

from amers.services.formats.sensor_models.rpc_text import parse_rpc_text
from tests.app.flat_world import FlatWorld
from tests.app.hostile_installation import LIMIT_BYTES

SHORT, LONG, LONG8 = 3, 4, 16
FORMS = {SHORT: "H", LONG: "I", LONG8: "Q"}
WIDTH, LENGTH, BITS, COMPRESSION, INTERPRETATION, OFFSETS, SAMPLES, ROWS, COUNTS = (
    256,
    257,
    258,
    259,
    262,
    273,
    277,
    278,
    279,
)
PLAIN = {
    WIDTH: (LONG, 16),
    LENGTH: (LONG, 16),
    BITS: (SHORT, 16),
    COMPRESSION: (SHORT, 1),
    INTERPRETATION: (SHORT, 1),
    OFFSETS: (LONG, 8),
    SAMPLES: (SHORT, 1),
    ROWS: (LONG, 16),
    COUNTS: (LONG, 512),
}
OUTSIDE = "<outside>"


@dataclass(frozen=True)
class BadScene:
    """A delivery that cannot become a registered scene.

    Attributes:
        name: what is wrong with it.
        says: what the refusal or the failure names.
        image: made of a good delivery.
        models: files beside the image; `<outside>` in them is the folder of the canary.
        model: the one that the request names.
        file_name: as the sender calls the image.
    """

    name: str
    says: str
    image: Callable[[FlatWorld], bytes]
    models: dict[str, str | bytes] = field(default_factory=dict)
    model: str | None = None
    file_name: str = "scene.tif"


def tiff(following: int = 0, first: int = 520, **changed: tuple[int, int]) -> bytes:
    """A small TIFF with its pixels before its only directory, and with some of its numbers changed."""
    tags = {**PLAIN, **{int(key[1:]): value for key, value in changed.items()}}
    entries = b""
    for tag, (kind, value) in sorted(tags.items()):
        packed = struct.pack("<" + FORMS[kind], value)[:4].ljust(4, b"\0")
        entries += struct.pack("<HHI", tag, kind, 1) + packed
    directory = struct.pack("<H", len(tags)) + entries + struct.pack("<I", following)
    return b"II*\0" + struct.pack("<I", first) + bytes(512) + directory


def big_tiff(width: int, length: int) -> bytes:
    """A BigTIFF of a size that its few bytes cannot hold."""
    tags = {**PLAIN, WIDTH: (LONG8, width), LENGTH: (LONG8, length), OFFSETS: (LONG8, 16)}
    entries = b"".join(
        struct.pack("<HHQ", tag, kind, 1) + struct.pack("<" + FORMS[kind], value).ljust(8, b"\0")
        for tag, (kind, value) in sorted(tags.items())
    )
    return b"II+\0" + struct.pack("<HHQ", 8, 0, 16) + struct.pack("<Q", len(tags)) + entries + bytes(8)


def written(dtype: str, **more: object) -> Callable[[FlatWorld], bytes]:
    """An image of zeros, written by GDAL."""

    def make(world: FlatWorld) -> bytes:
        profile = {"driver": "GTiff", "width": 64, "height": 64, "count": 1, "dtype": dtype, **more}
        with rasterio.MemoryFile() as file:
            with file.open(**profile) as image:
                image.write(np.zeros((64, 64), dtype), 1)
            return bytes(file.read())

    return make


def always(content: bytes) -> Callable[[FlatWorld], bytes]:
    return lambda world: content


def good(world: FlatWorld) -> bytes:
    """The image without a model."""
    return world.image.read_bytes()


def jpeg2000(width: int, height: int) -> bytes:
    """The header of a code stream."""
    size = struct.pack(">HHIIIIIIIIH", 41, 0, width, height, 0, 0, width, height, 0, 0, 1)
    return b"\xff\x4f\xff\x51" + size + b"\x0f\x01\x01" + b"\xff\xd9"


def rpc(changes: dict[str, str]) -> str:
    """The text of a model with some of its values changed."""
    values = {
        "LINE_OFF": "300",
        "SAMP_OFF": "300",
        "LAT_OFF": "43.25",
        "LONG_OFF": "5.25",
        "HEIGHT_OFF": "200",
        "LINE_SCALE": "300",
        "SAMP_SCALE": "300",
        "LAT_SCALE": "0.001",
        "LONG_SCALE": "0.002",
        "HEIGHT_SCALE": "500",
    }
    for kind, at in (("LINE_NUM", 3), ("LINE_DEN", 1), ("SAMP_NUM", 2), ("SAMP_DEN", 1)):
        values |= {f"{kind}_COEFF_{i}": str(float(i == at)) for i in range(1, 21)}
    return "".join(f"{key}: {value}\n" for key, value in (values | changes).items() if value)


parse_rpc_text(rpc({}), "the pattern of bad models")

EXPANDING = (
    '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {c} "{f"&{b};" * 10}">' for b, c in zip("abcdefghi", "bcdefghij", strict=True))
    + "]><Dimap_Document>&j;</Dimap_Document>"
)
REACHING = (
    f'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file://{OUTSIDE}/canary.txt">]>'
    "<Dimap_Document><Rational_Function_Model>&x;</Rational_Function_Model></Dimap_Document>"
)
NITF = b"NITF02.10BF01" + b" " * 10 + b"20240101000000" + b" " * 300
PAM = (
    "<PAMDataset><Metadata domain='RPC'>"
    + "".join(
        f"<MDI key='{line.split(': ')[0]}'>{line.split(': ')[1]}</MDI>" for line in rpc({}).splitlines()
    )
    + "</Metadata></PAMDataset>"
)


def modelled(name: str, says: str, text: str | bytes, file: str = "scene_RPC.TXT") -> BadScene:
    """A good image with a bad model, which the request names."""
    return BadScene(f"model {name}", says, good, {file: text}, file)


IMAGES = [
    BadScene("tiff of eight bytes", "scene.tif", always(b"II*\0\x08\0\0\0")),
    BadScene("tiff cut in the middle", "scene.tif", lambda world: world.tagged.read_bytes()[:200_000]),
    BadScene("tiff cut before its last byte", "scene.tif", lambda world: world.image.read_bytes()[:-1]),
    BadScene("tiff whose directory lies beyond its end", "scene.tif", always(tiff(first=2**31))),
    BadScene("tiff whose directory lies in its head", "scene.tif", always(tiff(first=2))),
    BadScene("tiff whose directories go in a circle", "RPC", always(tiff(following=520))),
    BadScene("tiff of 4,000 million lines", "declares", always(tiff(t257=(LONG, 2**31 - 1)))),
    BadScene(
        "tiff of 2^62 pixels", "scene.tif", always(tiff(t256=(LONG, 2**31 - 1), t257=(LONG, 2**31 - 1)))
    ),
    BadScene("tiff of no lines", "scene.tif", always(tiff(t257=(LONG, 0)))),
    BadScene("tiff of 65,535 bands", "scene.tif", always(tiff(t277=(SHORT, 65_535)))),
    BadScene("tiff of 255 bits", "scene.tif", always(tiff(t258=(SHORT, 255)))),
    BadScene("tiff of an unknown compression", "scene.tif", always(tiff(t259=(SHORT, 9_999)))),
    BadScene("tiff whose pixels lie beyond its end", "scene.tif", always(tiff(t273=(LONG, 2**32 - 1)))),
    BadScene(
        "tiff of a strip of 4 GB", "scene.tif", always(tiff(t279=(LONG, 2**32 - 1), t259=(SHORT, 8)))
    ),
    BadScene("tiff of rows without number", "RPC", always(tiff(t278=(LONG, 2**32 - 1)))),
    BadScene("big tiff of 2^40 pixels", "scene.tif", always(big_tiff(2**20, 2**20))),
    BadScene("big tiff of 2^60 lines", "scene.tif", always(big_tiff(1, 2**60))),
    BadScene("tiff of complex pixels", "complex", written("complex64")),
    BadScene("tiff of zeros without a model", "RPC", written("uint16")),
    BadScene(
        "tiff of zeros, compressed ten times over", "RPC", written("uint8", compress="deflate", zlevel=9)
    ),
    BadScene("jpeg 2000 of a head only", "scene.jp2", always(jpeg2000(100, 100)), file_name="scene.jp2"),
    BadScene(
        "jpeg 2000 of 2^62 pixels", "scene.jp2", always(jpeg2000(2**31, 2**31)), file_name="scene.jp2"
    ),
    BadScene(
        "jpeg 2000 of a box only",
        "scene.jp2",
        always(b"\0\0\0\x0cjP  \r\n\x87\n"),
        file_name="scene.jp2",
    ),
    BadScene("nitf of a head only", "scene.ntf", always(NITF), file_name="scene.ntf"),
    BadScene("nitf of four letters", "scene.ntf", always(b"NITF"), file_name="scene.ntf"),
    BadScene("image whose model is in a sidecar of GDAL", "RPC", good, {"scene.tif.aux.xml": PAM}),
    BadScene("image whose model is missing", "not the name of", good, {}, "../<others_scene>/a.tif"),
    BadScene("image whose model is not there", "gone_RPC.TXT", good, {}, "gone_RPC.TXT"),
    BadScene("image that is its own model", "scene.tif", good, {}, "scene.tif"),
]
MODELS = [
    modelled("that is empty", "scene_RPC.TXT", b""),
    modelled("of zeros", "scene_RPC.TXT", bytes(1000)),
    modelled("of random bytes", "scene_RPC.TXT", np.random.default_rng(1).bytes(2000)),
    modelled("in UTF-16 without a mark", "scene_RPC.TXT", rpc({}).encode("utf-16-le")),
    modelled("without a value", "LINE_SCALE", rpc({"LINE_SCALE": ""})),
    modelled("with a scale of zero", "scale", rpc({"LINE_SCALE": "0"})),
    modelled("with a scale NaN", "LINE_SCALE", rpc({"LINE_SCALE": "nan"})),
    modelled("with an offset infinite", "SAMP_OFF", rpc({"SAMP_OFF": "inf"})),
    modelled("with a coefficient of 400 digits", "finite", rpc({"SAMP_NUM_COEFF_1": "9" * 400})),
    modelled("with a coefficient of letters", "SAMP_NUM_COEFF_1", rpc({"SAMP_NUM_COEFF_1": "x"})),
    modelled("that divides by zero", "denominator", rpc({"LINE_DEN_COEFF_1": "0"})),
    modelled("beyond the pole", "outside the Earth", rpc({"LAT_OFF": "123"})),
    modelled("somewhere else", "control point", rpc({"LONG_OFF": "95.25"})),
    modelled("with a value twice", "LINE_OFF", rpc({}) + "LINE_OFF: 7\n"),
    modelled("of ten million characters", "scene_RPC.TXT", "LINE_OFF: 1 " * 400_000),
    modelled("that is XML of nothing", "scene_RPC.XML", "<a/>", "scene_RPC.XML"),
    modelled("that is broken XML", "scene_RPC.XML", "<Dimap_Document>", "scene_RPC.XML"),
    modelled("that reads a file", "scene_RPC.XML", REACHING, "scene_RPC.XML"),
    modelled("that expands without end", "scene_RPC.XML", EXPANDING, "scene_RPC.XML"),
    modelled("deep as XML can be", "scene_RPC.XML", "<a>" * 100_000, "scene_RPC.XML"),
    modelled("RPB of nothing", "scene.RPB", "BEGIN_GROUP = IMAGE\nEND", "scene.RPB"),
    modelled("RPB without an end", "scene.RPB", "lineNumCoef = (" + "1," * 10_000, "scene.RPB"),
]


def zipped(*files: tuple[str, bytes], link: str | None = None) -> bytes:
    """A zip; with a link in it if `link` is given."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files:
            archive.writestr(name, data)
        if link is not None:
            info = zipfile.ZipInfo(link)
            info.external_attr = 0o120777 << 16
            archive.writestr(info, "/etc/passwd")
    return out.getvalue()


def tarred(*files: tuple[str, bytes], kind: bytes = tarfile.REGTYPE, target: str = "") -> bytes:
    """A tar whose last member has this type."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for name, data in files:
            info = tarfile.TarInfo(name)
            last = (name, data) == files[-1] and kind != tarfile.REGTYPE
            info.type, info.linkname = (kind, target) if last else (tarfile.REGTYPE, "")
            info.size = 0 if last else len(data)
            archive.addfile(info, io.BytesIO(data))
    return out.getvalue()


def lying(data: bytes) -> bytes:
    """A zip that declares a length of ten bytes for its first member, in both headers."""
    content = bytearray(zipped(("a.tif", data)))
    struct.pack_into("<L", content, 22, 10)
    struct.pack_into("<L", content, content.rfind(b"PK\1\2") + 24, 10)
    return bytes(content)


PIXELS = b"II*\0" + bytes(1000)
IMAGE = ("a.tif", PIXELS)
BOMB = bytes(LIMIT_BYTES + 1)
ARCHIVES: list[tuple[str, str, bytes]] = [
    ("zip with .. in a name", "not accepted", zipped(IMAGE, ("../../x.xml", b"x"))),
    ("zip with .. in the middle", "not accepted", zipped(IMAGE, ("a/../../x.xml", b"x"))),
    ("zip with an absolute name", "not accepted", zipped(IMAGE, ("/etc/cron.d/x", b"x"))),
    ("zip with a drive", "not accepted", zipped(IMAGE, ("C:/x.xml", b"x"))),
    ("zip with a backslash", "not accepted", zipped(IMAGE, ("..\\x.xml", b"x"))),
    ("zip with a line break in a name", "not accepted", zipped(IMAGE, ("a\nb.xml", b"x"))),
    ("zip with a link", "link", zipped(IMAGE, link="out")),
    ("zip with a name twice but for its case", "twice", zipped(IMAGE, ("A.TIF", PIXELS))),
    ("zip that is a bomb", "unpacks to more", zipped(IMAGE, ("zeros", BOMB))),
    ("zip that lies about a size", "a.tif", lying(bytes(200_000))),
    ("zip of ten thousand files", "more than", zipped(*((f"{i}.txt", b"") for i in range(10_001)))),
    ("zip in a zip", "exactly one is expected", zipped(("b.zip", zipped(IMAGE)))),
    ("zip of two images", "exactly one is expected", zipped(IMAGE, ("b.tif", PIXELS))),
    ("zip of a VRT", "exactly one is expected", zipped(("a.vrt", b"<VRTDataset/>"))),
    ("zip of a VRT that calls itself TIFF", "neither TIFF", zipped(("a.tif", b"<VRTDataset/>"))),
    ("zip without its end", "broken archive", zipped(IMAGE)[:-30]),
    ("zip without its beginning", "broken archive", zipped(IMAGE)[:4] + zipped(IMAGE)[60:]),
    ("zip of nothing", "neither TIFF", zipped()),
    ("zip whose name is all dots", "", zipped(("....", PIXELS))),
    ("tar with ..", "not accepted", tarred(IMAGE, ("../x", b"x"))),
    ("tar with an absolute name", "not accepted", tarred(IMAGE, ("/x", b"x"))),
    (
        "tar with a link to a file",
        "link",
        tarred(IMAGE, ("x", b""), kind=tarfile.SYMTYPE, target="/etc/passwd"),
    ),
    ("tar with a hard link", "link", tarred(IMAGE, ("x", b""), kind=tarfile.LNKTYPE, target="a.tif")),
    ("tar with a device", "device", tarred(IMAGE, ("x", b""), kind=tarfile.CHRTYPE)),
    ("tar with a pipe", "device", tarred(IMAGE, ("x", b""), kind=tarfile.FIFOTYPE)),
    ("tar that is a bomb", "unpacks to more", gzip.compress(tarred(IMAGE, ("zeros", BOMB)), 9)),
    ("tar cut in its first file", "", tarred(("a.tif", bytes(100_000)))[:2_000]),
    ("gzip of an empty tar", "exactly one is expected", gzip.compress(bytes(100_000))),
    ("gzip cut", "broken archive", gzip.compress(tarred(IMAGE))[:60]),
]


def folder_archive(folder: Path, spoil: Callable[[dict[str, bytes]], None]) -> bytes:
    """A zip of a block folder with some of its files changed."""
    files = {
        f"block/{path.relative_to(folder)}": path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    spoil(files)
    return zipped(*files.items())
