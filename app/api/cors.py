"""What pages of other sites may send and read, where a setting names those sites (CORS).

Source: Fetch Standard of WHATWG, CORS protocol.
"""

from typing import Any

from amers.app.config import Settings

METHODS = ("DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT")
EXPOSED = (
    "Accept-Ranges",
    "Allow",
    "Amers-Next-Token",
    "Amers-Scene",
    "Content-Crs",
    "Content-Disposition",
    "Content-Encoding",
    "Content-Length",
    "Content-Location",
    "Content-Range",
    "ETag",
    "Last-Modified",
    "Link",
    "Location",
    "OGC-NumberMatched",
    "OGC-NumberReturned",
    "Preference-Applied",
    "Retry-After",
    "Tus-Checksum-Algorithm",
    "Tus-Extension",
    "Tus-Max-Size",
    "Tus-Resumable",
    "Tus-Version",
    "Upload-Expires",
    "Upload-Length",
    "Upload-Metadata",
    "Upload-Offset",
    "WWW-Authenticate",
    "X-Request-ID",
)
"""Headers of replies that scripts may read; a test finds those that replies have and this lacks."""


def options(settings: Settings) -> dict[str, Any]:
    """The options of the middleware.

    A page may send any header: it is let in by its token, which no browser adds by itself.
    """
    return {
        "allow_origins": settings.cors_origins,
        "allow_methods": METHODS,
        "allow_headers": ("*",),
        "expose_headers": EXPOSED,
    }
