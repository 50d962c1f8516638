"""Reports as pages: HTML files that need no network.

A kind of report is a template of sections, and the functions that it calls. All templates extend
`page.html`, use the parts of `parts.html`, and have the report as `report`.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, pass_context
from jinja2.runtime import Context
from markupsafe import Markup

from amers.services.reports import numbers, scene_words
from amers.services.reports.gallery import chip_uri
from amers.services.reports.plot import Figure
from amers.services.reports.reasons import reason_label
from amers.services.reports.scene_words import flat_options
from amers.services.statements import worth_saying


@dataclass(frozen=True)
class Page:
    """A kind of report as a page.

    Attributes:
        template: its file.
        functions: that the template calls, by their names.
        has_text: whether results include it as plain text.
    """

    template: str
    functions: tuple[Callable[..., Any], ...]
    has_text: bool = False


def format_html(page: Page, report: Any, *, for_text: bool = False) -> str:
    """A report as a self-contained page for screen, phone and paper.

    Args:
        page: its kind.
        report: its content.
        for_text: leave out the figures, and show the tables of the text in place of those of the page.
    """
    functions = {function.__name__: function for function in page.functions}
    return page_template(page.template).render(report=report, for_text=for_text, **functions)


@cache
def page_template(name: str) -> Template:
    """A compiled template; it escapes all values and raises an error for unknown names."""
    environment = Environment(
        loader=PackageLoader("amers.services.reports", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (numbers.number, numbers.metres, numbers.percent, numbers.degrees, numbers.quantile)
    words = (numbers.criterion_value, numbers.criterion_limit, reason_label, scene_words.time_words)
    environment.filters.update({one.__name__: one for one in (*filters, *words, chip_uri)})
    shared = (scene_words.scene_facts, scene_words.centre_words, scene_words.run_foot)
    environment.globals.update(
        {one.__name__: one for one in (figure, flat_options, worth_saying, *shared)}
    )
    return environment.get_template(name)


@pass_context
def figure(context: Context, draw: Callable[[Any], Figure], more: str = "") -> Markup:
    """A figure of the report with its caption, for a template; nothing for text.

    Args:
        context: of the template.
        draw: makes the figure; the paragraph after the first line of its docstring is the caption.
        more: goes on with the caption.
    """
    if context["for_text"]:
        return Markup()
    caption = " ".join((inspect.getdoc(draw) or "").partition("\n")[2].split())
    markup = figure_markup(draw, context["report"])
    return Markup("<figure>{}<figcaption>{}{}</figcaption></figure>").format(markup, caption, more)


def figure_markup(draw: Callable[[Any], Figure], report: Any) -> Markup:
    """A figure as SVG; the first line of the docstring of `draw` describes it to screen readers."""
    return Markup(draw(report).markup((inspect.getdoc(draw) or "").partition("\n")[0]))
