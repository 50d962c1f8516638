"""Recognition of image formats by their first bytes, without the library that reads them."""

DRIVER_OF_SIGNATURE = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"\0\0\0\x0cjP  \r\n\x87\n": "JP2OpenJPEG",
    b"\xff\x4f\xff\x51": "JP2OpenJPEG",
    b"NITF": "NITF",
    b"NSIF": "NITF",
}
"""The GDAL driver of a file, by its first bytes; no other driver is used."""
