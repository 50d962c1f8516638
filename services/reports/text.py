"""Reports as plain text: the lines, tables and steps of their pages, without figures and notes."""

import io
from html.parser import HTMLParser
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from amers.services.reports.html import Page, format_html

_WIDTH = 140
"""Characters of a line where it is not that of a terminal."""
_LEFT = ("words", "way", "unit")
"""Classes of cells that are aligned to the left."""
_INLINE = ("a", "b", "code", "small", "span")


def format_text(page: Page, report: Any) -> str:
    """A report as plain text."""
    text = io.StringIO()
    # In a notebook, rich would otherwise show the report below the cell instead of writing it.
    console = Console(file=text, width=_WIDTH, no_color=True, force_terminal=False, force_jupyter=False)
    _print(page, report, console)
    return text.getvalue()


def print_text(page: Page, report: Any) -> None:
    """Print a report on standard output."""
    _print(page, report, Console(width=None if Console().is_terminal else _WIDTH))


def _print(page: Page, report: Any, console: Console) -> None:
    _Printer(console).feed(format_html(page, report, for_text=True))


class _Printer(HTMLParser):
    """Prints the tables of a page, its paragraphs of the class "text", and steps with their commands."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self.console = console
        self.heading = self.caption = self.kind = self.words = ""
        self.rows: list[list[str]] = []
        self.left: set[int] = set()
        self.has_heads = self.in_steps = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Begin a text or a table; quiet words stand on a line of their own."""
        kind = dict(attrs).get("class") or ""
        if tag in ("th", "td") and any(name in kind.split() for name in _LEFT):
            self.left.add(len(self.rows[-1]))
        if tag == "table":
            self.rows, self.left, self.has_heads, self.caption = [], {0}, False, ""
        elif tag == "tr":
            self.rows.append([])
        elif tag == "ol":
            self.in_steps = True
            self.console.print(f"\n{escape(self.heading)}")
        elif tag == "pre":
            self._print_step()
        self.kind = kind if tag == "p" else self.kind
        if tag == "small":
            self.words += "\n"
        elif tag not in _INLINE:
            self.words = ""

    def handle_data(self, data: str) -> None:
        """Go on with a text."""
        self.words += data

    def handle_endtag(self, tag: str) -> None:
        """End a text, which is printed or kept for its table."""
        if tag in ("h2", "h3"):
            self.heading = self.words
        elif tag == "caption":
            self.caption = self.words
        elif tag in ("th", "td"):
            self.rows[-1].append(self.words)
        elif tag == "thead":
            self.has_heads = True
        elif tag == "table":
            self._print_table()
        elif tag == "p" and self.kind == "text":
            self.console.print(escape(self.words))
        elif tag == "pre":
            self.console.print(f"      {escape(self.words)}", soft_wrap=True)
            self.words = ""
        elif tag == "li":
            self._print_step()
        elif tag == "ol":
            self.in_steps = False
            self.console.print()

    def _print_step(self) -> None:
        if self.in_steps and self.words.strip():
            self.console.print(f"* {escape(self.words.strip())}")

    def _print_table(self) -> None:
        title = escape(self.caption or self.heading)
        table = Table(title=title, title_justify="left", show_header=self.has_heads)
        heads, *rows = self.rows if self.has_heads else [[""] * len(self.rows[0]), *self.rows]
        for k, head in enumerate(heads):
            justify: Literal["left", "right"] = "left" if k in self.left else "right"
            table.add_column(escape(head.strip()), justify=justify, overflow="fold")
        for row in rows:
            table.add_row(*(escape(cell.strip()) for cell in row))
        self.console.print(table)
