"""Compare the figures that documents quote with benchmarks/figures, and write docs/figures.md from them.

A document quotes a figure by an HTML comment directly after the number, which no page shows:
`463<!-- distorted_simulated.delivered -->`. Zero to ten may be words. The line
`<!-- table: distorted_simulated -->` above a table of families compares all numbers of its rows with the
families of that figure, in their order. `--check` compares everything and writes nothing.
"""

import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FIGURES = ROOT / "benchmarks" / "figures"
PAGE = ROOT / "docs" / "figures.md"
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/README.md")])
WORDS = {
    word: number
    for number, word in enumerate(
        ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    )
}
NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?!\w)")
QUOTE = re.compile(r"(?P<quoted>[\w,.]*)\**<!-- (?P<path>\w+(?:\.\w+)+) -->")
TABLE = re.compile(r"^<!-- table: (?P<name>\w+) -->\n\n?(?P<rows>(?:\|.*\n)+)", re.MULTILINE)
HEAD = """# Figures

Each section is a file in [benchmarks/figures](../benchmarks/figures/README.md), from which
`scripts/figures.py` writes this page. Documents quote these files; a test fails when a quoted number
differs. Speeds are CPU times of one thread on a machine of two cores that had other work as well,
unless the section says otherwise.
"""

Figures = Mapping[str, Mapping[str, Any]]
"""The content of each file by its name."""


def read_figures(folder: Path = FIGURES) -> dict[str, dict[str, Any]]:
    """The figures in a folder, by the names of their files."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def number_of(text: str) -> float | None:
    """The number that a text such as `1,192` or `two` states; None when it states none."""
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    return float(text.replace(",", "")) if NUMBER.fullmatch(text) else None


def differences(text: str, figures: Figures) -> list[str]:
    """What a document quotes otherwise than the figures have it, one sentence each."""
    return [*_quote_differences(text, figures), *_table_differences(text, figures)]


def _quote_differences(text: str, figures: Figures) -> Iterator[str]:
    for match in QUOTE.finditer(text):
        name, _, key = match["path"].partition(".")
        kept = figures.get(name, {}).get("values", {}).get(key)
        if kept is None:
            yield f"{match['path']}: benchmarks/figures has no such value"
        elif number_of(match["quoted"]) != kept["value"]:
            yield f"{match['path']} is {kept['value']}, the document has {match['quoted']!r}"


def _table_differences(text: str, figures: Figures) -> Iterator[str]:
    for match in TABLE.finditer(text):
        rows = dict(_table_rows(match["rows"]))
        families = figures.get(match["name"], {}).get("families", {})
        if list(rows) != list(families):
            yield f"{match['name']} has the families {list(families)}, the table has {list(rows)}"
        for name, quoted in rows.items():
            kept = list(families.get(name, {}).values())
            if name in families and quoted != kept:
                yield f"{match['name']}, {name}: the figures are {kept}, the table has {quoted}"


def _table_rows(rows: str) -> Iterator[tuple[str, list[float]]]:
    """The family and the numbers of each row of a table below its head."""
    for row in rows.splitlines()[2:]:
        label, *cells = row.strip("|").split("|")
        numbers = NUMBER.findall(" ".join(cells))
        yield label.partition(":")[0].strip(" `"), [float(text.replace(",", "")) for text in numbers]


def page(figures: Figures) -> str:
    """Markdown of docs/figures.md."""
    return HEAD + "".join(map(_section, figures.values()))


def _section(figure: Mapping[str, Any]) -> str:
    values = "\n".join(f"* {one['value']:,} {one['what']}" for one in figure["values"].values())
    run = f"Command: `{figure['command']}`. Commit {figure['commit']}, {figure['date']}"
    outcome = f"Out of: {figure['denominator']}. {run}; {figure['record']}."
    return f"\n## {figure['claim']}\n\n{values}\n\n{outcome}\n"


def main(arguments: list[str]) -> int:
    """Write or compare the page, and compare the documents; 1 if anything differs."""
    figures = read_figures()
    if arguments != ["--check"]:
        PAGE.write_text(page(figures), encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != page(figures):
        print(f"{PAGE.name} is not that of the figures: run scripts/figures.py")
        return 1
    found = [
        f"{path.relative_to(ROOT)}: {one}"
        for path in DOCUMENTS
        for one in differences(path.read_text(encoding="utf-8"), figures)
    ]
    print("\n".join(found) or "no document differs from the figures")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
