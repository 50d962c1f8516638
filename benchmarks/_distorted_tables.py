"""What distorted scenes became: delivered, right, wrong, and which criteria told."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._distortions import Drawn
from benchmarks._outcome import WRONG, WRONG_PART, Outcome

FALSE_ALARMS = 0.01
FOLLOWED, NAMED = 0.8, 0.9
"""Shares that must be delivered and right where a distortion can be followed, and named elsewhere."""

_BREAKS = ("breaks", "lost or repeated lines")
LACK_OF_FIT = {
    "jitter": ("structure_lines", "structure_steps"),
    "bow": ("structure_lines", "structure_samples", "structure_image"),
    "steps": ("structure_lines", "structure_steps", "points_elsewhere", *_BREAKS),
    "moved": ("points_elsewhere", "structure_image"),
    "wrong_model": (
        "line_of_sight",
        "another view",
        "another scene",
        "swapped",
        "mirrored",
        "upside",
    ),
    "otherwise": ("structure_", "points_elsewhere", *_BREAKS),
    "parts": ("structure_", "points_elsewhere", *_BREAKS),
}
"""Parts of the names of findings, or of why a scene is refused, that tell what a family is."""
_OF_ANY = (*LACK_OF_FIT["otherwise"], "line_of_sight")

Pair = tuple[Drawn, Outcome]


@dataclass(frozen=True)
class Distorted:
    """Figures of distorted scenes.

    Attributes:
        scenes, good, usable, failed, refused: numbers.
        right: delivered, and wrong neither in the whole nor in part.
        good_but_wrong, wrong: of the good and of the delivered, see `Outcome.wrong`.
        wrong_in_part: of the delivered.
        normalised: mean of the delivered; NaN without any.
        of_predicted: true over predicted CE90 of the delivered: median, largest; NaN without any.
        followable, followed: scenes whose distortion the points resolve, and those of them right.
        not_followed, named: scenes refused, or off by more than three times what they predict whatever
            their verdict is, and those of them with a criterion of their family.
        told_by: how often each criterion was not met in scenes that are not right.
    """

    scenes: int
    good: int
    usable: int
    failed: int
    refused: int
    right: int
    good_but_wrong: int
    wrong: int
    wrong_in_part: int
    normalised: float
    of_predicted: tuple[float, float]
    followable: int
    followed: int
    not_followed: int
    named: int
    told_by: dict[str, int]


def is_right(outcome: Outcome) -> bool:
    """Whether a scene is delivered, and wrong neither in the whole nor in part."""
    return outcome.delivered and not outcome.wrong and not outcome.wrong_in_part


def figures_of(family: str, outcomes: Sequence[Outcome]) -> Distorted:
    """The figures of some scenes of a family."""
    delivered = [o for o in outcomes if o.delivered]
    not_right = [o for o in outcomes if not is_right(o)]
    not_followed = [o for o in outcomes if o.wrong or o.wrong_in_part]
    followable = [o for o in outcomes if o.followable]
    ratio = [o.ce90_m / o.predicted_m for o in delivered]
    number = Counter(o.verdict for o in outcomes)
    return Distorted(
        scenes=len(outcomes),
        good=number["good"],
        usable=number["usable"],
        failed=number["failed"],
        refused=number["refused"],
        right=sum(map(is_right, outcomes)),
        good_but_wrong=sum(o.wrong for o in delivered if o.verdict == "good"),
        wrong=sum(o.wrong for o in delivered),
        wrong_in_part=sum(o.wrong_in_part for o in delivered),
        normalised=_mean([o.normalised for o in delivered]),
        of_predicted=(float(np.median(ratio)), max(ratio)) if ratio else (float("nan"),) * 2,
        followable=len(followable),
        followed=sum(map(is_right, followable)),
        not_followed=len(not_followed),
        named=sum(_is_named(family, o) for o in not_followed),
        told_by=dict(Counter(name for o in not_right for name in _told(o)).most_common()),
    )


def by_kind(family: str, pairs: Iterable[Pair]) -> dict[str, Distorted]:
    """Figures of all scenes of a family, and of those of each kind of distortion."""
    of_kind: dict[str, list[Outcome]] = defaultdict(list)
    for drawn, outcome in pairs:
        of_kind["all"].append(outcome)
        of_kind[drawn.kind or "none"].append(outcome)
    return {kind: figures_of(family, outcomes) for kind, outcomes in of_kind.items()}


def accused(outcomes: Sequence[Outcome]) -> tuple[str, bool, str]:
    """Whether lack of fit is told of hardly any scene that is not distorted."""
    told = Counter(name for o in outcomes for name in _told(o) if any(p in name for p in _OF_ANY))
    number = sum(any(part in o.reason for part in _OF_ANY) for o in outcomes)
    return (
        f"lack of fit is told of less than {FALSE_ALARMS:.0%} of scenes that are not distorted",
        number < FALSE_ALARMS * len(outcomes) or number == 0,
        f"{number} of {len(outcomes)}: {_listed(told)}",
    )


def distorted_acceptance(family: str, outcomes: Sequence[Outcome]) -> list[tuple[str, bool, str]]:
    """What a distorted family must show beside what all must: requirement, whether it holds, figures."""
    figures = figures_of(family, outcomes)
    lines = [
        (
            f"none delivered is wrong by more than {WRONG:g} times what is predicted there "
            f"in more than {WRONG_PART:.0%} of its image",
            figures.wrong_in_part == 0,
            f"{figures.wrong_in_part} wrong in part",
        )
    ]
    if figures.followable:
        lines.append(
            (
                f"delivered and right in {FOLLOWED:.0%} where the points resolve the distortion",
                figures.followed >= FOLLOWED * figures.followable,
                f"{figures.followed} of {figures.followable}",
            )
        )
    if figures.not_followed:
        lines.append(
            (
                f"what is not followed is named by a criterion of the family in {NAMED:.0%}",
                figures.named >= NAMED * figures.not_followed,
                f"{figures.named} of {figures.not_followed}; not met where not right: "
                f"{_listed(figures.told_by)}",
            )
        )
    return lines


def show_distorted(title: str, rows: dict[str, Distorted]) -> None:
    """Print the figures of each kind of distortion."""
    headings = (
        "kind  scenes  good  usable  failed  refused  right  good, wrong  wrong  in part  "
        "true/predicted  largest  normalised  followable  followed  named  of"
    )
    table = Table(*headings.split("  "), title=title)
    for kind, row in rows.items():
        counts = row.scenes, row.good, row.usable, row.failed, row.refused, row.right
        wrong = row.good_but_wrong, row.wrong, row.wrong_in_part
        figures = [f"{value:.2f}" for value in (*row.of_predicted, row.normalised)]
        told = row.followable, row.followed, row.named, row.not_followed
        cells = [*map(str, counts), *map(str, wrong), *figures, *map(str, told)]
        table.add_row(kind, *cells)
    console = Console(width=200)
    console.print(table)
    for kind, row in rows.items():
        console.print(f"{kind}, not met where not right: {_listed(row.told_by)}", highlight=False)


def _is_named(family: str, outcome: Outcome) -> bool:
    return any(part in outcome.reason for part in LACK_OF_FIT.get(family, ()))


def _told(outcome: Outcome) -> list[str]:
    """The criteria that a scene does not meet; "refused" where there is none, "-" where all are met."""
    if outcome.verdict == "refused":
        return ["refused"]
    return outcome.reason.split("; ") if outcome.reason else ["-"]


def _listed(told_by: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in told_by.items()) or "-"


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
