"""The thesis's figures remade: 1.2, 3.1, 4.1, 4.2 and 5.1 to 5.16.

The thesis prints no data for them, so each can be compared by eye only. Figures 5.1 to 5.16 show the family that the
thesis chose: the training part of its grid, the test part, and plants of the same ranges off the grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from autotuner_models.estimates import H
from autotuner_models.thesis.data_sets import OFF_GRID, Plants, band_passed, noisy_records
from autotuner_models.thesis.draws import PRINTED_TARGETS
from autotuner_models.thesis.learned_table import SCORES
from autotuner_models.thesis.regressors import trained
from autotuner_sim.relay.batch import relay_tests, run_relay_tests

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from matplotlib.axes import Axes

    from autotuner_models.thesis.regressors import Trained

SHOWN = {
    OFF_GRID: ("#eba28c", 3, "off the grid"),
    "train": ("0.55", 3, "training part"),
    "test": ("C0", 5, "test part"),
}
"""Colour, size and name of the points, large groups drawn below small ones; the thesis shows the test part."""
UNITS = {"m": "s²"}
"""Units of the targets that are not in seconds."""
PLANT = (1.0, 10.0, 2.0)
"""K, T (s) and D (s) of eq. 2.1, the process of figures 1.2, 4.1 and 4.2."""
SET_TITLES = {
    "fopdt": "FOPDT",
    "fopdt_noise": "FOPDT with noise",
    "overdamped": "overdamped SOPDT",
    "underdamped": "underdamped SOPDT",
}
DPI = 80
"""Resolution of the pictures, dots per inch: readable in a page, small in a repository."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """One figure: its number, its caption and its drawing function."""

    number: str
    caption: str
    draw: Callable[[Axes], None]

    @property
    def file_name(self) -> str:
        """Return the name of its file."""
        chapter, number = self.number.split(".")
        return f"figure-{chapter}-{int(number):02d}.png"


def drawings() -> list[Drawing]:
    """Return all figures in the order of the thesis; nothing is computed before one is drawn."""
    listed = [
        Drawing("1.2", "Limit cycle under an ideal relay, process of eq. 2.1", _limit_cycle),
        Drawing("3.1", "Autotune identification scheme", _scheme),
        Drawing("4.1", "Relay test with noise in the loop, 20 dB, process of eq. 2.1", partial(_noisy, both=False)),
        Drawing("4.2", "Noisy and denoised PV of the same test", partial(_noisy, both=True)),
    ]
    for shift, kind, draw in ((1, "Prediction error", _prediction), (1 + len(SCORES), "Residuals", _residuals)):
        for i, score in enumerate(SCORES):
            target = PRINTED_TARGETS[score.name][score.column]
            caption = f"{kind} of {target}, {SET_TITLES[score.name]}, {score.family}"
            of_score = partial(_of_score, draw, score.name, score.column, score.family)
            listed.append(Drawing(f"5.{shift + i}", caption, of_score))
    return listed


def png(drawing: Drawing) -> bytes:
    """Return a figure as PNG."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - only pictures need it

    figure = Figure(figsize=(5.0, 3.8), layout="constrained")
    axes = figure.subplots()
    drawing.draw(axes)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    out = BytesIO()
    figure.savefig(out, dpi=DPI, metadata={"Software": None})
    return out.getvalue()


def write_pictures(folder: Path) -> list[Path]:
    """Write all pictures as PNG and return their paths, in the order of the thesis."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for drawing in drawings():
        path = folder / drawing.file_name
        path.write_bytes(png(drawing))
        written.append(path)
    return written


def _limit_cycle(axes: Axes) -> None:
    K, T, D = PLANT
    one = np.ones(1)
    Pu = float(run_relay_tests(relay_tests(K * one, 0.0 * one, T * one, D * one, -H, H), switches=200).period_s[0])
    dt = Pu / 1000.0
    t = np.arange(0.0, 5.0 * Pu, dt)
    y, u = np.zeros(t.size), np.empty(t.size)
    delay, decay = round(D / dt), float(np.exp(-dt / T))
    for k in range(t.size):
        u[k] = H if y[k] <= 0.0 else -H
        if k + 1 < t.size:
            y[k + 1] = decay * y[k] + (1.0 - decay) * K * (u[k - delay] if k >= delay else 0.0)
    axes.plot(t, y, label="PV")
    axes.plot(t, 0.2 * u, lw=0.8, color="0.6", label="output times 0.2")
    _over_time(axes)


def _scheme(axes: Axes) -> None:
    box = {"boxstyle": "square,pad=0.6", "fc": "white", "ec": "black"}
    for x, text in ((0.3, "relay\n$\\pm h$"), (0.68, "process\n$G(s)$")):
        axes.text(x, 0.6, text, ha="center", va="center", bbox=box)
    axes.text(
        0.08, 0.6, "$\\Sigma$", ha="center", va="center", bbox={"boxstyle": "circle", "fc": "white", "ec": "black"}
    )
    for begin, end, text in ((0.11, 0.22, "E"), (0.38, 0.58, "U"), (0.78, 0.96, "Y")):
        axes.annotate(text, (begin, 0.62))
        axes.annotate("", (end, 0.6), (begin, 0.6), arrowprops={"arrowstyle": "->"})
    axes.annotate("", (0.0, 0.6), (0.05, 0.6), arrowprops={"arrowstyle": "<-"})
    axes.annotate("R = 0", (-0.04, 0.63))
    axes.plot([0.9, 0.9, 0.08], [0.6, 0.2, 0.2], "k-", lw=1.0)
    axes.annotate("", (0.08, 0.53), (0.08, 0.2), arrowprops={"arrowstyle": "->"})
    axes.annotate("-", (0.1, 0.5))
    axes.set_xlim(-0.06, 1.0)
    axes.set_ylim(0.0, 1.0)
    axes.axis("off")


def _noisy(axes: Axes, *, both: bool) -> None:
    K, T, D = (np.array([value]) for value in PLANT)
    plants = Plants(K, D, np.zeros(1), T)
    cycle = run_relay_tests(relay_tests(K, 0.0 * K, T, D, -H, H), switches=200)
    records, sample_s, sigma = noisy_records(plants, cycle, np.random.default_rng(1))
    t = np.arange(records.pv.shape[0]) * sample_s[0]
    axes.plot(
        t, records.pv[:, 0], color="0.6" if both else "C0", lw=0.7, label=f"PV, noise variance {sigma[0] ** 2:.3g}"
    )
    if both:
        axes.plot(t, band_passed(records.pv)[:, 0], color="C3", lw=1.2, label="after the band-pass")
    _over_time(axes)


def _over_time(axes: Axes) -> None:
    axes.set_xlabel("t, s")
    axes.set_ylabel("PV")
    axes.margins(y=0.2)  # room for the legend


def _of_score(draw: Callable[[Axes, Trained, str], None], name: str, column: int, family: str, axes: Axes) -> None:
    target = PRINTED_TARGETS[name][column]
    draw(axes, trained(name, column, family), f"{target}, {UNITS.get(target, 's')}")


def _prediction(axes: Axes, one: Trained, quantity: str) -> None:
    for where, (colour, size, label) in SHOWN.items():
        named = f"{label}, R2 {one.r2(where):.4f}"
        axes.plot(one.truth[where], one.predicted[where], ".", color=colour, ms=size, label=named)
    ends = [float(f(one.truth["train"])) for f in (np.min, np.max)]
    axes.plot(ends, ends, "k--", lw=0.8)
    axes.set_xlabel(f"true {quantity}")
    axes.set_ylabel(f"predicted {quantity}")


def _residuals(axes: Axes, one: Trained, quantity: str) -> None:
    for where, (colour, size, label) in SHOWN.items():
        residual = one.predicted[where] - one.truth[where]
        axes.plot(one.predicted[where], residual, ".", color=colour, ms=size, label=label)
    axes.axhline(0.0, color="k", lw=0.8)
    axes.set_xlabel(f"predicted {quantity}")
    axes.set_ylabel("predicted minus true")
