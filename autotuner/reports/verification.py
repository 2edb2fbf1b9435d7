"""Report of a verification: written gains, step and verdict.

Invariant: every number is one that the verification reported; nothing is simulated again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from autotuner.reports.document import Facts, Grid, Picture, Section, Words
from autotuner.reports.numbers import named, number, with_unit
from autotuner.reports.pictures.chart import Chart, Curve, Panel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from autotuner.core.model.arrays import FloatArray
    from autotuner.reports.document import Part

DIGITS = 6
"""Significant digits of gains, as in the registers of most devices."""
SIGNATURE = "Accepted by: ______________________________   Date: ____________________"


def sign_off(result: Mapping[str, Any], pv_unit: str, output_unit: str) -> list[Section]:
    """Return the section of the latest verification; none where there was no verification.

    Parameters
    ----------
    result : mapping
        As `VerificationRun.to_dict` makes it, in `verification` of a tuning.
    pv_unit, output_unit : str
        Units of the loop.
    """
    run = result.get("verification")
    if not run or not run.get("verdict"):
        return []
    verdict = run["verdict"]
    parts: list[Part] = [Words(f"{verdict['message']}. {verdict.get('remedy') or ''}".strip(), verdict["outcome"])]
    parts += _gains(run.get("gains"))
    parts.append(Facts(_facts(run, pv_unit)))
    parts += _response(run, pv_unit, output_unit)
    return [Section("Verification on the loop", [*parts, Words(SIGNATURE)])]


def _gains(gains: Mapping[str, Any] | None) -> list[Grid]:
    if not gains:
        return []
    columns = ("before", "written", "read_back")
    rows = [[name, *(number(gains[column].get(name), DIGITS) for column in columns)] for name in gains["written"]]
    return [Grid(f"Gains in the device ({gains['form']})", ["", "before", "written", "read back"], rows)]


def _facts(run: Mapping[str, Any], pv_unit: str) -> list[tuple[str, str]]:
    in_device = "the gains before" if run.get("rolled_back") else "the gains written"
    return [
        ("verdict", "passed" if run.get("passed") else "not passed"),
        ("in the device now", in_device),
        ("step of the set point", with_unit(number(run.get("step")), pv_unit)),
        ("watched for", f"{number(run.get('duration_s'))} s"),
        ("overshoot, measured", _percent(run.get("overshoot"))),
        ("overshoot, predicted", _percent(run.get("predicted_overshoot"))),
        ("by", str(run.get("actor") or "–")),
        ("from", str(run.get("started_at") or "–")),
        ("to", str(run.get("ended_at") or "–")),
    ]


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{number(100.0 * share, 3)} %"


def _response(run: Mapping[str, Any], pv_unit: str, output_unit: str) -> list[Picture]:
    """Return the response inside its predicted band; none before the step."""
    rows = run.get("response") or []
    if len(rows) < 2:
        return []
    t, pv, output = np.array(rows, dtype=np.float64).T
    panels = [
        Panel(named("PV", pv_unit), [Curve("measured", pv, 0, "dots"), *_band(run.get("predicted"), t)]),
        Panel(
            named("output", output_unit),
            [Curve("output", output, 2, "step"), *_band(run.get("predicted_output"), t)],
            110.0,
        ),
    ]
    drawn = Chart(t, panels, "Response to the step inside the predicted band")
    return [Picture(drawn, "Time from the step. The band is that of the model with its uncertainty.")]


def _band(rows: Sequence[Sequence[float]] | None, t: FloatArray) -> list[Curve]:
    if not rows:
        return []
    when, low, high = np.array(rows, dtype=np.float64).T
    edges = {"lowest predicted": low, "highest predicted": high}
    return [Curve(name, np.interp(t, when, edge, right=np.nan), 4) for name, edge in edges.items()]
