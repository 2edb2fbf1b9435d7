"""A report as one HTML file: sections as data in, a document out that loads nothing and runs nothing.

Invariants:

1. Whatever comes from outside is escaped; only pictures of `autotuner.reports.pictures.svg` go in as they are.
2. It is readable on a phone, in the dark and on paper.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal

from autotuner.reports.pictures.svg import svg

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.reports.pictures.chart import Chart

Kind = Literal["", "done", "refused", "aborted", "failed"]


@dataclass(frozen=True, slots=True)
class Words:
    """A paragraph; with a `kind` it is in a box of that colour."""

    text: str
    kind: Kind = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """Names with their values."""

    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Grid:
    """A table; the first cell of a row is its head."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """A chart, or an `<svg>` element of the caller, with its caption."""

    drawn: Chart | str
    caption: str


Part = Words | Facts | Grid | Picture


@dataclass(frozen=True, slots=True)
class Section:
    """A heading with its content; `folded` until it is opened, but open on paper."""

    title: str
    parts: Sequence[Part]
    folded: bool = False


STYLE = """
:root{color-scheme:light dark;--t:#16212b;--m:#5a6875;--e:#d5dde3;--b:#fff;--s:#eef4f7}
@media (prefers-color-scheme:dark){
:root{--t:#e6edf2;--m:#a0b0bc;--e:#34434e;--b:#10161b;--s:#1a262e}
.c0{stroke:#56bcd9}
.c1{stroke:#ff7fab}
.c2{stroke:#f0984a}
.c3{stroke:#b5d46a}
.c4{stroke:#c39be0}
.c5{stroke:#6fd39b}
.k0{fill:#56bcd9}
.k1{fill:#ff7fab}
.k2{fill:#f0984a}
.k3{fill:#b5d46a}
.k4{fill:#c39be0}
.k5{fill:#6fd39b}
.grid{stroke:#34434e}
}
body{font:15px/1.5 system-ui,"Segoe UI",Roboto,Arial,sans-serif;font-variant-numeric:tabular-nums;color:var(--t);
background:var(--b);max-width:960px;margin:0 auto;padding:24px 16px}
h1{font-size:1.6em;margin:0}
h2{font-size:1.15em;margin:1.8em 0 .5em;border-bottom:2px solid var(--e);padding-bottom:.2em}
p{margin:.4em 0}
.sub{color:var(--m)}
dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));
gap:8px 20px;margin:0}
dt{color:var(--m);font-size:.85em}
dd{margin:0;font-weight:600;overflow-wrap:anywhere}
.box{border-left:4px solid var(--m);background:var(--s);padding:8px 14px}
.done{border-color:#1c7a46}
.failed{border-color:#b3261e}
.refused,.aborted{border-color:#b07a00}
figure{margin:1em 0}
figcaption,caption{color:var(--m);font-size:.85em;text-align:left}
svg{width:100%;height:auto}
.w{overflow-x:auto}
table{border-collapse:collapse;width:100%;margin:.6em 0;font-size:.93em}
th,td{text-align:left;padding:4px 12px 4px 0;border-bottom:1px solid var(--e);vertical-align:top}
summary{cursor:pointer}
summary h2{display:inline-block;width:calc(100% - 1.5em)}
@page{size:A4;margin:15mm}
@media print{
:root{color-scheme:light;--t:#000;--m:#444;--e:#bbb;--b:#fff;--s:#f3f3f3}
body{max-width:none;padding:0;font-size:11px}
details::details-content{content-visibility:visible;display:block;height:auto}
summary{list-style:none}
figure,tr,dl>div,.box{break-inside:avoid}
thead{display:table-header-group}
h2{break-after:avoid;margin-top:1.2em}
}
"""
POLICY = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    f"style-src 'sha256-{base64.b64encode(hashlib.sha256(STYLE.encode()).digest()).decode()}'"
)
"""Content security policy under which a report is served: its own style sheet, nothing else."""


def document(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """Return a report as HTML."""
    body = "".join(_section(section) for section in sections)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f'<body><header><h1>{escape(title)}</h1><p class="sub">{escape(subtitle)}</p></header>{body}</body></html>\n'
    )


def _section(section: Section) -> str:
    title, parts = f"<h2>{escape(section.title)}</h2>", "".join(_part(part) for part in section.parts)
    if section.folded:
        return f"<details><summary>{title}</summary>{parts}</details>"
    return f"<section>{title}{parts}</section>"


def _part(part: Part) -> str:
    match part:
        case Words(text, ""):
            return f"<p>{escape(text)}</p>"
        case Words(text, kind):
            return f'<p class="box {kind}">{escape(text)}</p>'
        case Facts(rows):
            pairs = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in rows)
            return f"<dl>{pairs}</dl>"
        case Grid():
            return _grid(part)
        case Picture(drawn, caption):
            words = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
            return f"<figure>{drawn if isinstance(drawn, str) else svg(drawn)}{words}</figure>"


def _grid(grid: Grid) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in grid.head)
    rows = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>'
        for row in grid.rows
    )
    caption = f"<caption>{escape(grid.caption)}</caption>"
    return f'<div class="w"><table>{caption}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
