"""Hooks of mkdocs: pages from outside docs/, the reference of the library, links, formulas as MathML.

The documents link to source files by their path in the repository, so that the links work on the page of
a repository. The site has no source files. A link to a module of `services` leads to its reference. A
link to a page that the site has under another name leads to that page. A link to any other file outside
docs/ becomes the path of the file, set as code.
"""

import html
import posixpath
import re
from pathlib import Path
from typing import Any

import griffe
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/README.md": "benchmarks.md",
    "examples/README.md": "examples.md",
}
"""Documents outside docs/ and the names of their pages."""

LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]*)(?P<anchor>#[^)\s]*)?\)")
PICTURE = re.compile(r"!\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")
FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?P<open>[(\[])(?P<latex>.*?)\\[)\]]</(?P=tag)>', re.DOTALL
)

FOR_READERS, FOR_PROGRAMMERS = 4.0, 0.25
"""Weights in the search of the site: pages that answer questions, and references and records."""
ANSWERS = re.compile(r"(guide|questions|inputs|connect|limits|operations|glossary|methods/.*)\.md")

SHARED = re.compile(
    r"^(?P<indent> +)(?P<names>\w+(?:,\s+\w+)+): (?P<text>.*(?:\n(?P=indent) +.*)*)", re.MULTILINE
)
"""A line of a docstring that describes several parameters or attributes at once."""


class SharedDescriptions(griffe.Extension):
    """Reads `line, sample: (n,) pixels` in a docstring as one description for each of the names."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Rewrite the docstring of one object before it is parsed."""
        if obj.docstring:
            obj.docstring.value = SHARED.sub(one_for_each, obj.docstring.value)


def one_for_each(match: re.Match[str]) -> str:
    """A description of its own for each name of a match of `SHARED`."""
    names = re.split(r",\s+", match["names"])
    return "\n".join(f"{match['indent']}{name}: {match['text']}" for name in names)


def library() -> dict[str, list[str]]:
    """Pages of the reference and the modules on each: the library, and each package of `services`."""
    front = [f"amers.{path.stem}" for path in sorted((ROOT / "amers").glob("*.py"))]
    pages: dict[str, list[str]] = {
        "amers": [name for name in front if "__" not in name],
        "services": [],
    }
    for path in sorted((ROOT / "services").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        if any(part.startswith("_") for part in parts):
            continue
        page = parts[1] if len(parts) > 2 else "services"
        pages.setdefault(page, []).append(".".join(("amers", *parts)))
    return pages


def reference_page(page: str, modules: list[str]) -> str:
    """Markdown of one page of the reference."""
    title = {"amers": "The library", "services": "Basics"}.get(page, page.capitalize())
    return "\n\n".join([f"# {title}", *(f"::: {module}" for module in modules)]) + "\n"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill the entries of the navigation that stand for all pages of a folder."""
    decisions = sorted(f"decisions/{path.name}" for path in (ROOT / "docs/decisions").glob("*.md"))
    filled = {"decisions/": decisions, "library/": [f"library/{page}.md" for page in library()]}
    for section in config.nav or []:
        for title, entries in section.items():
            if isinstance(entries, list):
                section[title] = [page for entry in entries for page in filled.get(str(entry), [entry])]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the documents that lie outside docs/ and the pages of the reference."""
    for source, page in PAGES.items():
        files.append(
            File.generated(config, page, content=(ROOT / source).read_text() + listings(source))
        )
    for page, modules in library().items():
        name = f"library/{page}.md"
        files.append(File.generated(config, name, content=reference_page(page, modules)))
    return files


def listings(source: str) -> str:
    """Markdown of the scripts beside a document: the examples; nothing for other documents."""
    if source != "examples/README.md":
        return ""
    scripts = sorted((ROOT / source).parent.glob("*.py"))
    return "".join(f"\n## {path.name}\n\n```python\n{path.read_text()}```\n" for path in scripts)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links to files of the repository into links that the site can follow; weigh the page."""
    is_answer = ANSWERS.fullmatch(page.file.src_uri)
    page.meta["search"] = {"boost": FOR_READERS if is_answer else FOR_PROGRAMMERS}
    names = {name: source for source, name in PAGES.items()}
    here = names.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    if page.file.src_uri.startswith("library/"):
        return markdown
    if not here.startswith("docs/"):
        markdown = PICTURE.sub(lambda picture: site_picture(picture, here), markdown)
    return LINK.sub(lambda link: site_link(link, here, page.file.src_uri), markdown)


def site_picture(picture: re.Match[str], here: str) -> str:
    """A picture in a document outside docs/, as its page has it: the site has the files of docs/."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(here), picture["target"]))
    return f"![{picture['text']}]({path.removeprefix('docs/')})"


def site_link(link: re.Match[str], here: str, page: str) -> str:
    """One link of a document, as the page of the site has it.

    Args:
        link: a match of `LINK`.
        here: path of the document in the repository.
        page: path of its page in the site.
    """
    text, target, anchor = link["text"], link["target"], link["anchor"] or ""
    if not target or ":" in target:
        return link[0]
    path = posixpath.normpath(posixpath.join(posixpath.dirname(here), target))
    if not (ROOT / path).exists():
        raise FileNotFoundError(f"{here}: the link to {target} leads nowhere")
    found = site_page(path)
    if found is None:
        return text if text.startswith("`") else f"`{text}`"
    name, place = found
    return f"[{text}]({posixpath.relpath(name, posixpath.dirname(page) or '.')}{anchor or place})"


def site_page(path: str) -> tuple[str, str] | None:
    """The page of the site, and the place on it, for a path of the repository; None when it has none."""
    if path in PAGES:
        return PAGES[path], ""
    if path == "docs/decisions":
        return min(f"decisions/{file.name}" for file in (ROOT / path).glob("*.md")), ""
    if path == "docs/methods":
        return "methods/registration.md", ""
    if path.startswith("docs/"):
        return path.removeprefix("docs/"), ""
    module = "amers." + path.removesuffix(".py").replace("/", ".")
    for page, modules in library().items():
        if module in modules:
            return f"library/{page}.md", f"#{module}"
        if module == f"amers.services.{page}":
            return f"library/{page}.md", ""
    return None


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Set formulas as MathML, which browsers show by themselves: no script, no font from elsewhere."""
    return FORMULA.sub(formula, content)


def formula(match: re.Match[str]) -> str:
    """MathML of one formula that arithmatex has marked."""
    return convert(html.unescape(match["latex"]), display="block" if match["open"] == "[" else "inline")
