"""Canvases: views of a raw image without its georeferencing, to draw on it in pixel coordinates."""

from pathlib import Path
from xml.sax.saxutils import escape

from amers.services.errors import InputError
from amers.services.formats.images.raster import open_raster

_GDAL_TYPES = {
    "uint8": "Byte",
    "uint16": "UInt16",
    "int16": "Int16",
    "uint32": "UInt32",
    "int32": "Int32",
    "float32": "Float32",
    "float64": "Float64",
}


def write_canvas(image: Path, path: Path) -> None:
    """Write a virtual raster of GDAL that shows an image without RPC, control points and map grid.

    QGIS warps an image with an RPC or control points to longitude and latitude; the canvas it shows as
    the pixels are, with x = column and y = -row from the corner of the first pixel. Pixels stay in the
    image, whose absolute path the canvas has.

    Raises:
        InputError: the output has another suffix than `.vrt`.
        FormatError: the image cannot be read.
    """
    if path.suffix.lower() != ".vrt":
        raise InputError(f"{path}: {path.suffix or 'no suffix'} found, .vrt expected")
    raster = open_raster(image)
    dataset = raster.dataset
    lines, samples = dataset.shape
    bands = []
    for band, dtype in enumerate(dataset.dtypes, start=1):
        nodata = dataset.nodatavals[band - 1]
        bands += [
            f'  <VRTRasterBand dataType="{_GDAL_TYPES.get(dtype, "Float32")}" band="{band}">',
            *([] if nodata is None else [f"    <NoDataValue>{nodata:.17g}</NoDataValue>"]),
            f"    <ColorInterp>{dataset.colorinterp[band - 1].name.capitalize()}</ColorInterp>",
            "    <SimpleSource>",
            f'      <SourceFilename relativeToVRT="0">{escape(str(image.resolve()))}</SourceFilename>',
            f"      <SourceBand>{band}</SourceBand>",
            "    </SimpleSource>",
            "  </VRTRasterBand>",
        ]
    raster.close()
    head = f'<VRTDataset rasterXSize="{samples}" rasterYSize="{lines}">'
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([head, *bands, "</VRTDataset>", ""]), encoding="utf-8")
