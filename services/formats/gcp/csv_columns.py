"""Column names of point tables: the value, the unit and the vertical datum of each column."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.elevation.heights import unit_m
from amers.services.statements import Subject

ABOVE_SEA = "sea level"
"""Datum of a head that says "above sea level" or "orthometric", without the name of a geoid."""
ELLIPSOIDAL = "ellipsoid"


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_HEIGHT = _words("height heights hgt h z alt altitude elev elevation elevations ele hae")
_LOOKS_LIKE_HEIGHT = re.compile(
    r"height|hgt|elev|altit|orthom|ellipsh|höhe|hoehe|hauteur|cota|cote|quota|altura|altez|depth|niveau"
)
_MAYBE_HEIGHT = _words("up u rl ht el dtm dem dsm")
_SYSTEM = re.compile(r"\w*datum|\w?crs|\w?srs|epsg\w*|srid|projection|(?:utm)?zone")
_OF_HEIGHTS = re.compile(r"vert|vdatum|vcrs|height|elev|geoid")
_ELLIPSOID = _words("ell ellip ellips ellipsoid ellipsoidal ellipsoidic hae wgs84")
_SEA = _words("ortho orthometric msl amsl asl sea")
_GEOIDS = {"egm84": "EGM84", "egm96": "EGM96", "egm2008": "EGM2008", "egm08": "EGM2008"}
_UNDULATION = {"geoid", "undulation", "separation"}
_FILLER = _words(
    "above over on of in the mean level point pt pnt gcp coord coordinate coordinates ground map world "
    "terrain surface geo geographic geodetic value dd deg degree degrees decimal gps gnss utm datum "
    "dms wgs84 wgs 84 epsg 4326 intl international grid"
)
_POSITION = {
    "lon": _words("lon long longitude lng"),
    "lat": _words("lat latitude"),
    "x": _words("x e east easting"),
    "y": _words("y n north northing"),
}
_OTHER_NAMES = {
    "id": _words("id name pointid ptid gcpid gcp gcpname point pointname label station marker"),
    "image": _words("image imagename filename"),
    "active": _words("active enable enabled"),
    "check": _words("check checkpoint ischeckpoint"),
}
_SUBJECTS = {
    Subject.ACCURACY: _words(
        "sigma std stdev stddev sd rms rmse err error accuracy acc precision ce90 le90 ce95 le95 cep "
        "residual uncertainty covariance var variance dx dy dz pdop hdop vdop quality"
    ),
    Subject.EPOCH: _words("epoch date time year datetime timestamp day"),
    Subject.UNIT: _words("unit units uom"),
    Subject.VERTICAL_DATUM: _words(
        "vdatum vertical geoid undulation separation heightdatum vcrs geoidmodel"
    ),
    Subject.PIXEL_ORIGIN: _words("row col column pixel px py line sample pixelx pixely"),
    Subject.HORIZONTAL_DATUM: _words(
        "datum crs srs epsg srid projection zone ellipsoid proj hdatum lon lat long longitude latitude "
        "lng easting northing x y east north"
    ),
    Subject.VALIDITY: _words("status valid use used active check flag"),
}
_SIGMA = re.compile(r"sigma_(east|north|horizontal|up)_(\w+)", re.IGNORECASE)


@dataclass(frozen=True)
class Head:
    """The head of a column.

    Attributes:
        text: as the file has it.
        name: of the value: "height", a name of `COLUMNS`, "active", "check"; None for one that is not
            read.
        unit_m: of a length, metres; None where the head states none.
        datum: of a height: "ellipsoid", a geoid, or `ABOVE_SEA`; None where the head states none.
        subject: what the column states, where it is not read.
        looks_like_height: whether a column that is not read may have heights.
        states: what the values of a column state of the others: a unit, a vertical datum, a reference
            system; None for nothing.
    """

    text: str
    name: str | None = None
    unit_m: float | None = None
    datum: str | None = None
    subject: Subject = Subject.IDENTITY
    looks_like_height: bool = False
    states: Subject | None = None


def read_head(text: str) -> Head:
    """What the head of a column says, in the words of surveyors and of software for maps."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text.replace("_", " "))
    words = re.findall(r"[^\W_]+", spaced.lower())
    of_unit_m, rest = _unit(words)
    joined = "".join(words)
    sigma = _SIGMA.fullmatch(text)
    if sigma is not None and of_unit_m is not None:
        return Head(text, f"sigma_{sigma[1].lower()}_m", of_unit_m)
    for name, others in _OTHER_NAMES.items():
        if joined in others:
            return Head(text, name)
    subject = next((one for one, of in _SUBJECTS.items() if of & {*words, joined}), None)
    if subject is Subject.ACCURACY:
        return Head(text, subject=subject)
    for name, synonyms in _POSITION.items():
        others = _FILLER | ({"x", "y"} if name in ("lon", "lat") else set())
        if synonyms & set(rest) and set(rest) <= synonyms | others:
            return Head(text, name, of_unit_m, subject=Subject.HORIZONTAL_DATUM)
    states = _states(words)
    if states is not None:
        return Head(text, subject=states, states=states)
    height = _height(text, rest, of_unit_m)
    if height is not None:
        return height
    is_like = (
        bool((_HEIGHT | _MAYBE_HEIGHT) & set(words)) or _LOOKS_LIKE_HEIGHT.search(joined) is not None
    )
    is_like &= not _UNDULATION & set(words)
    if subject is None and is_like:
        subject = Subject.VERTICAL_DATUM
    return Head(text, subject=subject or Subject.IDENTITY, looks_like_height=is_like)


def _states(words: list[str]) -> Subject | None:
    """What the values of a column state of the others, by the words of its head."""
    if {"unit", "units", "uom"} & set(words):
        return Subject.UNIT
    if {"above", "over"} & set(words) or not any(map(_SYSTEM.fullmatch, words)):
        return None
    is_vertical = any(_OF_HEIGHTS.match(word) or word in _HEIGHT for word in words)
    return Subject.VERTICAL_DATUM if is_vertical else Subject.HORIZONTAL_DATUM


def _unit(words: list[str]) -> tuple[float | None, list[str]]:
    """The unit among the words of a head, and the other words; a head of a unit alone has none."""
    for size in (3, 2, 1):
        for start in range(len(words) - size + 1):
            try:
                found_m = unit_m("".join(words[start : start + size]), "", "")
            except VerticalDatumError:
                continue
            if size < len(words):
                return found_m, words[:start] + words[start + size :]
    return None, words


def _height(text: str, words: list[str], of_unit_m: float | None) -> Head | None:
    """The head of a column of heights of which every word is understood; None for any other."""
    given = set(words)
    geoids = given & set(_GEOIDS)
    is_sea, is_ellipsoidal = bool(given & _SEA), bool(given & _ELLIPSOID)
    if "geoid" in given and given & {"above", "over"}:
        is_sea, given = True, given - {"geoid"}
    known = _HEIGHT | _SEA | _ELLIPSOID | _FILLER | set(_GEOIDS)
    if not given & (_HEIGHT | {"msl", "amsl", "asl"}) or not given <= known:
        return None
    if len(geoids) + is_ellipsoidal > 1 or (is_sea and is_ellipsoidal):
        return None
    datum = ABOVE_SEA if is_sea else ELLIPSOIDAL if is_ellipsoidal else None
    datum = _GEOIDS[geoids.pop()] if geoids else datum
    return Head(text, "height", of_unit_m, datum, subject=Subject.VERTICAL_DATUM)


def chosen_height(heads: Sequence[Head], datum: str | None, source: str) -> int | None:
    """The place of the column of heights among the columns of a file; None for a file without heights.

    Args:
        heads: of all columns.
        datum: that the caller states: "ellipsoid" or any other; None for none.
        source: name of the file, for messages.

    Raises:
        FormatError: there are several, or a column that may have heights is not understood.
    """
    heights = [place for place, head in enumerate(heads) if head.name == "height"]
    if len(heights) > 1 and datum is not None:
        is_ellipsoidal = datum == ELLIPSOIDAL
        heights = [
            place for place in heights if (heads[place].datum == ELLIPSOIDAL) == is_ellipsoidal
        ] or heights
    if len(heights) > 1:
        found = ", ".join(repr(heads[place].text) for place in heights)
        raise FormatError(
            f"{source}, names of the columns: expected one column of heights, found {found}: name the "
            f"one to use (--columns height_m={heads[heights[0]].text})"
        )
    unclear = [head.text for head in heads if head.looks_like_height]
    if not heights and unclear:
        raise FormatError(
            f"{source}, names of the columns: {unclear[0]!r} may have heights, but its name, unit or "
            "datum is not understood; expected a name such as height, z, alt or elevation with a unit: "
            f"name it (--columns height_m={unclear[0]}, in metres), or remove the column"
        )
    return heights[0] if heights else None
