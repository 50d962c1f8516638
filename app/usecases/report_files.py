"""The files of a report, the same for every kind."""

from pathlib import Path

from amers.services.reports.document import Report, format_report
from amers.services.reports.html import Page, format_html
from amers.services.reports.text import format_text

REPORT_FILES = ("report.json", "report.html", "report.txt")


def write_report(folder: Path, page: Page, report: Report, name: str = "report") -> dict[str, Path]:
    """Write a report as a document, as a page and, where its kind has one, as text.

    Args:
        folder: created when missing; files of the same names are replaced.
        page: the kind of report.
        report: its content.
        name: of the files.

    Returns:
        The files by name.
    """
    texts = {f"{name}.json": format_report(report), f"{name}.html": format_html(page, report)}
    if page.has_text:
        texts[f"{name}.txt"] = format_text(page, report)
    return write_texts(folder, texts)


def write_texts(folder: Path, texts: dict[str, str]) -> dict[str, Path]:
    """Write texts, by file name, into a folder, created when missing; returns the files by name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return {name: folder / name for name in texts}
