"""Names of figures for people: words with axes and units, from the names that JSON has."""

import re

LABELS = {
    "gsd_m": "pixel size (m)",
    "gsds_m": "pixel sizes (m)",
    "chip_gsds_m": "pixel sizes of the chips (m)",
    "seen": "pixels with data (%)",
    "share_of_full_tiles": "share of full tiles (%)",
    "largest_px": "largest displacement of a pixel (px)",
    "error_px": "largest difference from the model (px)",
    "frame_sigma_before_m": "sigma of the frame before, horizontal, up (m)",
    "frame_sigma_m": "sigma of the frame, horizontal, up (m)",
    "check_normalised": "check errors over their sigmas, mean square",
    "check_ce90_m": "CE90 of the check points (m)",
    "check_le90_m": "LE90 of the check points (m)",
    "points_per_km2": "points per km2",
    "bytes_per_km2": "bytes per km2",
    "cpu_s": "CPU time of each stage (s), its tasks",
    "cpu_s_per_point": "CPU time per point (s)",
    "verdict_on_all": "verdict on all",
}
"""Names that need more words than their parts."""
SHARES = ("seen", "share_of_full_tiles")
"""Figures that are shares of 1 in JSON, and per cent for people."""
_AXES = ("east_north_up", "east_north", "line_sample")
_UNITS = {
    "m": "m",
    "px": "px",
    "s": "s",
    "percent": "%",
    "deg": "degrees",
    "km2": "km2",
    "bytes": "bytes",
}
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")


def label(name: str) -> str:
    """A name with blanks, and with its axes and its unit where it ends with them.

    Args:
        name: as JSON has it; texts that are no such name stay unchanged.
    """
    if name in LABELS or not _NAME.fullmatch(name):
        return LABELS.get(name, name)
    stem, _, last = name.rpartition("_")
    unit = _UNITS.get(last) if stem else None
    text = stem if unit else name
    for axes in _AXES:
        text = text.replace(f"_{axes}", f" in {axes.replace('_', ', ')}")
    return text.replace("_", " ") + (f" ({unit})" if unit else "")
