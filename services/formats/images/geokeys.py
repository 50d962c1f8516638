"""GeoTIFF keys that the reading library ignores. Sources: OGC GeoTIFF 1.1, GDAL RFC 81."""

import struct
from pathlib import Path

_KEYS, _DOUBLES = 34735, 34736
_EPOCH_KEY = 5120
_MOST_ENTRIES = 1000


def coordinate_epoch(path: Path) -> float | None:
    """The epoch of the coordinates that a GeoTIFF states, in years; None where it states none."""
    with path.open("rb") as file:
        head = file.read(16)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or len(head) < 16:
            return None
        is_big = struct.unpack(order + "H", head[2:4])[0] == 43
        count_form, entry_form, value = ("Q", "HHQ", "Q") if is_big else ("H", "HHI", "I")
        try:
            file.seek(struct.unpack(order + value, head[8:16] if is_big else head[4:8])[0])
            (count,) = struct.unpack(order + count_form, file.read(struct.calcsize(order + count_form)))
            size = struct.calcsize(order + entry_form + value)
            entries = file.read(size * min(count, _MOST_ENTRIES))
            arrays: dict[int, tuple[float, ...]] = {}
            for tag, _, number, at in struct.iter_unpack(order + entry_form + value, entries):
                if tag in (_KEYS, _DOUBLES) and number <= 100_000:
                    form = f"{order}{number}{'H' if tag == _KEYS else 'd'}"
                    file.seek(at)
                    arrays[tag] = struct.unpack(form, file.read(struct.calcsize(form)))
        except (struct.error, OSError):
            return None
    keys = arrays.get(_KEYS, ())
    for first in range(4, len(keys) - 3, 4):
        key, tag, _, index = (int(number) for number in keys[first : first + 4])
        if key == _EPOCH_KEY and tag == _DOUBLES and index < len(arrays.get(_DOUBLES, ())):
            return arrays[_DOUBLES][index]
    return None
