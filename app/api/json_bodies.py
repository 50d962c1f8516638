"""Bodies in JSON: what they are sent as, and what JSON cannot carry.

Source: RFC 8259, section 8.1; RFC 9110, section 15.5.16.
"""

from email.message import Message

from starlette.exceptions import HTTPException

from amers.app.api.negotiation import JSON
from amers.app.json_values import unusable_body

CHARSETS = ("utf-8", "utf8", "us-ascii")
SEND = f"send JSON with the header Content-Type: {JSON}"


def refuse_no_json(content_type: str | None, body: bytes) -> None:
    """Refuse a body that is not sent as JSON in UTF-8, or has a value that JSON does not have.

    Its syntax is checked later, where it is parsed; an empty body is one that may be left out.

    Raises:
        HTTPException: the reply says what to send (415, 400, 422).
    """
    if not body:
        return
    _refuse_other_type(content_type)
    try:
        body.decode()
    except UnicodeDecodeError as error:
        raise HTTPException(400, f"the body is not UTF-8 at byte {error.start}: {SEND}") from None
    fault = unusable_body(body)
    if fault is not None:
        raise HTTPException(422, fault)


def _refuse_other_type(content_type: str | None) -> None:
    if content_type is None:
        raise HTTPException(415, f"the body has no Content-Type: {SEND}", {"Accept": JSON})
    message = Message()
    message["Content-Type"] = content_type
    kind, charset = message.get_content_type(), message.get_content_charset("utf-8")
    is_json = kind == JSON or (kind.startswith("application/") and kind.endswith("+json"))
    if not is_json or charset not in CHARSETS:
        detail = f"Content-Type: {content_type:.100} found, {JSON} in UTF-8 expected: {SEND}"
        raise HTTPException(415, detail, {"Accept": JSON})
