"""The name under which a browser keeps a reply.

Sources: RFC 6266, Content-Disposition; RFC 8187, encoding.
"""

import re
from urllib.parse import quote

SHOWN = ("text/html", "text/plain", "application/json", "image/png", "image/jpeg", "image/svg+xml")
"""Types that a browser shows; it asks its user where to keep all others."""
_ATTRIBUTE_CHARACTERS = "!#$&+-.^_`|~"


def disposition(name: str, media_type: str = "") -> str:
    """The value of `Content-Disposition` for a file.

    A name with other characters than plain ones comes twice: encoded, and for old clients without them.

    Args:
        name: of the file; a folder in it becomes a part of the name.
        media_type: of the reply.
    """
    shown = media_type.partition(";")[0] in SHOWN
    flat = re.sub(r"[/\\]+", "-", name.strip("/\\"))
    usable = "".join(letter for letter in flat if letter.isprintable()) or "file"
    plain = re.sub(r"[^ !#-$&-\[\]-~]|%", "_", usable)
    value = f'{"inline" if shown else "attachment"}; filename="{plain}"'
    if plain == usable:
        return value
    return f"{value}; filename*=UTF-8''{quote(usable, safe=_ATTRIBUTE_CHARACTERS)}"
