"""Write docs/connect.md from the recipes of the service; `--check` compares instead of writing."""

import sys
from pathlib import Path

from amers.app.api.connect import EXAMPLE, as_markdown

PAGE = Path(__file__).parents[1] / "docs" / "connect.md"


def main(arguments: list[str]) -> int:
    """Write or compare the page; 1 if they differ."""
    text = as_markdown(EXAMPLE)
    if arguments == ["--check"]:
        if PAGE.read_text(encoding="utf-8") == text:
            return 0
        print(f"{PAGE.name} is not that of the recipes: run scripts/make_connect_page.py")
        return 1
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
