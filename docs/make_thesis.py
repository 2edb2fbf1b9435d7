"""Make docs/thesis.md and its pictures: every printed figure of the thesis beside the computed one.

    python docs/make_thesis.py       about a minute

The text of the page is here and in `autotuner_models`, nowhere else. `autotuner reproduce thesis` writes the same as
one HTML file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from autotuner_models.reproduce import all_figures
from autotuner_models.thesis.marks import summary_table
from autotuner_models.thesis.pictures import drawings, write_pictures
from autotuner_models.thesis_report import FIGURE_COLUMNS, MEANING, TITLES, figure_rows

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from autotuner_models.thesis.marks import Figure
    from autotuner_models.thesis.pictures import Drawing

DOCS = Path(__file__).resolve().parent
PICTURES = Path("images/thesis")
SIDE_BY_SIDE = 2
"""Pictures in a row: a page is as wide as two of them."""
HEAD = """# The thesis, figure by figure

<!-- Made by `python docs/make_thesis.py`; do not edit. -->

B. Kumar, *Machine Learning for Improved Autotune Identification Method*, M.Tech. thesis, Indian Institute of Technology
Guwahati. This page is for a reader of the thesis who wants to check a printed figure. Each figure of its tables is
beside the result of this program. [The learned correction](learned.md#the-thesis-remade) has the conclusions, and
`autotuner reproduce thesis` repeats all computations.
"""
PICTURES_HEAD = """## Pictures

The thesis prints no data for its pictures, so they can be compared by eye only. Figures 5.1 to 5.16 show the regressor
that the thesis chose: on the training part of its grid, on the test part, and on processes of the same ranges that are
not on the grid. `R2` is 1 for a perfect answer.
"""


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '') for cell in line)} |" for line in lines) + "\n"


def summary(figures: Sequence[Figure]) -> str:
    """Return the marks, and how many figures of each table have which."""
    counted = summary_table(figures)
    marks = table(("mark", "meaning"), [(mark.value, meaning) for mark, meaning in MEANING.items()])
    return f"{marks}\n{table([column.heading for column in counted.columns], counted.texts())}"


def pictures(drawn: Sequence[Drawing]) -> str:
    """Return the pictures, two side by side, those of one target together."""
    first, rest = [d for d in drawn if not d.number.startswith("5.")], [d for d in drawn if d.number.startswith("5.")]
    half = len(rest) // SIDE_BY_SIDE
    in_order = [*first, *(d for pair in zip(rest[:half], rest[half:], strict=True) for d in pair)]
    rows = [in_order[k : k + SIDE_BY_SIDE] for k in range(0, len(in_order), SIDE_BY_SIDE)]
    return f"{PICTURES_HEAD}\n{table(['', ''], [[_picture(d) for d in row] for row in rows])}"


def _picture(drawing: Drawing) -> str:
    caption = f"{drawing.number}: {drawing.caption}"
    return f"![Figure {caption}]({PICTURES / drawing.file_name})<br>{caption}"


def main() -> None:
    """Write the page and the pictures."""
    figures = all_figures()
    printed = [
        f"## Table {n}: {title}\n\n{table(FIGURE_COLUMNS, figure_rows(n, figures))}" for n, title in TITLES.items()
    ]
    parts = [HEAD, summary(figures), *printed, pictures(drawings())]
    write_pictures(DOCS / PICTURES)
    (DOCS / "thesis.md").write_text("\n".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
