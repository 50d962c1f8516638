"""Groups of options in the help of commands that have many: first the five that most people need."""

import re
from collections.abc import Mapping, Sequence

FEWEST = 12
"""Commands with fewer options show them in one group."""
FIRST: Mapping[str, tuple[str, ...]] = {
    "base make": ("bbox", "source", "catalogue", "dem", "output"),
    "block frame": ("images", "control", "control_sigma_m", "check", "output"),
    "block quality": ("site", "dem", "vertical", "ce90_m", "output"),
    "points experiment": ("images", "control_points", "draws", "sigma_m", "as_json"),
    "points intersect": ("images", "registered", "block", "sigma_m", "output"),
    "points reach": ("images", "site_frame_sigma_m", "sigma_m", "dem", "as_json"),
    "production ortho": ("dem", "vertical", "sigma_m", "output", "id"),
    "production points": ("images", "chips", "sigma_m", "output", "id"),
    "production run": ("images", "sigma_m", "control", "output", "id"),
    "scene mosaic": ("registered", "dem", "vertical", "output", "bbox"),
    "scene ortho": ("dem", "vertical", "registered", "output", "hide"),
    "scene register": ("block", "reference", "control", "sigma_m", "output"),
    "scene register-many": ("block", "join", "control", "sigma_m", "output"),
    "surface make": ("registered", "block", "gsd_m", "water", "output"),
    "vectors correct": ("image", "registration", "dem", "vertical", "output"),
    "vectors project": ("image", "registration", "dem", "vertical", "output"),
}
"""The five options of a command that its help shows first, by their names in Python."""
_GROUPS = (
    (r"images?|model|crop_origin|bands|mask|rigorous|sigma_m|mark_sigma_px|chips|chip_origin", "Images"),
    (r"control.*|neighbour", "Marked control"),
    (r"check.*|max_ce90.*|site.*|.*reach.*|excluded?|exclude_.*|ce90_m|le90_m|min_share", "Checks"),
    (r"reference.*|block|registered|registration|join|ortho_.*|selection|edge_sigma_m", "Reference"),
    (r".*dem.*|vertical|geoid|height.*|flat_m|terrain|frame_.*|surface_pairs|water", "Heights"),
    (r"crs|columns|sigma_axes|point_sigma_m|layer|pixels", "Columns of a file of points or vectors"),
    (r"output|id|version|title|license|copy_image|as_json|to|publish|only_plan", "Output"),
    (r"work|jobs|cluster|server|token|seed|draws", "Computing"),
)
"""Names of options in Python, and the group that has them; the first group that has one counts."""
_OTHER = "Method"


def group_of(command: str, name: str) -> str | None:
    """The group of an option in the help of a command; None for those that come first."""
    if name in FIRST.get(command, ()):
        return None
    return next((title for names, title in _GROUPS if re.fullmatch(names, name)), _OTHER)


def groups(command: str, names: Sequence[str]) -> dict[str, str | None]:
    """The groups of the options of a command by their names in Python; none where it has few."""
    if len(names) < FEWEST:
        return {}
    return {name: group_of(command, name) for name in names}
