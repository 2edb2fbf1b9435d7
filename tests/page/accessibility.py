"""Checks of a page for people who see little, use a keyboard, or hear the page: axe where it is at hand, and our own.

`AUTOTUNER_AXE` names the file axe.min.js of the package axe-core; without it the checks below stand alone: names of
everything that can be used, labels of fields, one main heading and no level left out, landmarks, unique identifiers,
contrast of every text against what is behind it (WCAG 2.2 AA), and no element that takes the focus out of turn.
"""

import os
from pathlib import Path

SERIOUS = {"serious", "critical"}

OWN = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")


def problems(browser):
    """Return what is wrong with what the browser shows now, in words."""
    return [*browser.run(OWN), *axe_problems(browser)]


def axe_problems(browser):
    """Return what axe finds serious; nothing where it is not at hand."""
    file = os.environ.get("AUTOTUNER_AXE")
    if not file:
        return []
    browser.run(Path(file).read_text(encoding="utf-8") + ";0")
    told = "r.violations.map((v) => [v.impact, v.id, v.nodes.map((n) => n.html.slice(0, 120))])"
    violations = browser.run(f"axe.run(document, {{ resultTypes: ['violations'] }}).then((r) => {told})")
    return [f"{rule}: {nodes}" for impact, rule, nodes in violations if impact in SERIOUS]


def focus_order(browser, steps):
    """Return where the focus stands after each of so many presses of the tab key from the top of the page."""
    browser.run("(document.activeElement?.blur(), window.scrollTo(0, 0), 1)")
    found = []
    for _ in range(steps):
        browser.press("Tab", "Tab", 9)
        found.append(
            browser.run("(document.activeElement.textContent || document.activeElement.name || '').trim().slice(0, 30)")
        )
    return found
