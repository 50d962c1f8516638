"""The process that parses filters with the library `cql2`: a crash of the library ends it alone.

It runs without the rest of the application: `python -I -S cql2_parser.py FOLDER`, where FOLDER has the
library. It reads requests from its standard input, a socket, replies there, and ends with the socket.
A request is a letter (`t` for text, `j` for JSON), a length in 4 bytes and a filter in UTF-8. A reply
is a sign (`+` for the filter as CQL2 JSON, `-` for a message), a length and a text.
"""

import json
import os
import resource
import sys
import time

MEMORY_BYTES = 256 << 20
CPU_S = 1


def main() -> None:
    """Reply to requests until the socket is closed."""
    _limit(resource.RLIMIT_AS, MEMORY_BYTES)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_FSIZE, 0)
    sys.path.insert(0, sys.argv[1])
    import cql2

    parsers = {b"t": cql2.parse_text, b"j": cql2.parse_json}
    while head := _read(5):
        text = _read(int.from_bytes(head[1:], "big")).decode()
        # The system ends this process when the filter takes more than one to two seconds of CPU.
        _limit(resource.RLIMIT_CPU, int(time.process_time()) + 1 + CPU_S)
        try:
            sign, reply = b"+", json.dumps(parsers[head[:1]](text).to_json())
        except BaseException as error:  # A panic of the library is no Exception.
            sign, reply = b"-", str(error)
        content = reply.encode(errors="replace")
        _write(sign + len(content).to_bytes(4, "big") + content)


def _limit(kind: int, value: int) -> None:
    """Set the soft limit of a resource, within the hard limit that this process has inherited."""
    _, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def _read(size: int) -> bytes:
    content = b""
    while len(content) < size:
        piece = os.read(0, size - len(content))
        if not piece:
            return b""
        content += piece
    return content


def _write(content: bytes) -> None:
    while content:
        content = content[os.write(0, content) :]


if __name__ == "__main__":
    main()
