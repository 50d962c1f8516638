"""Write docs/inputs.md: what Amers reads, and what it assumes; `--check` compares."""

import sys
from pathlib import Path

from amers.services.formats.reader_rows import Reader
from amers.services.formats.readers import READERS

PAGE = Path(__file__).parents[1] / "docs" / "inputs.md"
HEAD = """# What Amers reads, and what it assumes

What a file states of itself is *used*; or it is *named* as not used, on the terminal, in `--json` and in
the report; or the file is *refused*, with a sentence that says what to do. What a file does not state is
*assumed* only where this page says so, and then named, too.

`scripts/make_inputs_page.py` writes this page from the readers; each line of it has a test
(`tests/services/formats/test_statement_matrix.py`).
"""


def section(reader: Reader) -> str:
    """Markdown of one reader."""
    rows = "".join(f"| {t.subject} | {t.outcome} | {t.how} |\n" for t in reader.treatments)
    never = f"\nCannot be stated: {', '.join(reader.never)}.\n" if reader.never else ""
    return f"\n## {reader.name}\n\n| statement | becomes | how |\n|---|---|---|\n{rows}{never}"


def inputs_page() -> str:
    """Markdown of the page."""
    return HEAD + "".join(map(section, READERS))


def main(arguments: list[str]) -> int:
    """Write or compare the page; 1 if they differ."""
    text = inputs_page()
    if arguments != ["--check"]:
        PAGE.write_text(text, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != text:
        print(f"{PAGE.name} is not that of the readers: run scripts/make_inputs_page.py")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
