"""The code blocks of the documents, and the `amers` commands in them."""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Block(NamedTuple):
    """A code block of a document."""

    document: str
    language: str
    text: str

    @property
    def key(self) -> tuple[str, str]:
        """Document and first line without its comment."""
        return self.document, self.text.partition("\n")[0].split("  #")[0].rstrip()


def blocks_of(document: str) -> list[Block]:
    """The code blocks of a document, a path from the root of the project."""
    text = (ROOT / document).read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    return [Block(document, language, inside) for language, inside in blocks]


def command_lines(text: str) -> list[list[str]]:
    """The words of every `amers` command of a block, and of those inside `$( )`."""
    joined = text.replace("\\\n", " ")
    lines = re.findall(r"^amers .*|(?<=\$\()amers [^)]*", joined, re.MULTILINE)
    return [shlex.split(line.replace("…", "FILE"), comments=True)[1:] for line in lines]
