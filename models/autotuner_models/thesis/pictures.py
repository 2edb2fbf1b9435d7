"""Figures 5.1 to 5.16 of the thesis remade: prediction error and residuals of its own family, with off-grid plants."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner_models.thesis.data_sets import OFF_GRID
from autotuner_models.thesis.learned_table import SCORES
from autotuner_models.thesis.regressors import other_rows, trained

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from autotuner_models.thesis.regressors import Trained

SHOWN = {"train": ("0.75", "training part"), "test": ("C0", "test part"), OFF_GRID: ("C3", "off the grid")}


def write_pictures(folder: Path) -> list[Path]:
    """Write all pictures as PNG and return their paths, in the order of the thesis."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for shift, draw in ((1, _prediction), (1 + len(SCORES), _residuals)):
        for i, score in enumerate(SCORES):
            path = folder / f"figure-5-{shift + i:02d}.png"
            target = other_rows(score.name, OFF_GRID).targets[score.column]
            _write(
                path, draw, trained(score.name, score.column, score.family), f"{score.name}: {target}, {score.family}"
            )
            written.append(path)
    return written


def _write(path: Path, draw: object, one: Trained, title: str) -> None:
    from matplotlib.figure import Figure  # noqa: PLC0415 - only pictures need it

    figure = Figure(figsize=(5.0, 4.0), layout="constrained")
    axes = figure.subplots()
    assert callable(draw)  # noqa: S101 - one of the two below
    draw(axes, one)
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=80, metadata={"Software": None})


def _prediction(axes: Axes, one: Trained) -> None:
    for where, (colour, label) in SHOWN.items():
        axes.plot(
            one.truth[where], one.predicted[where], ".", color=colour, ms=4, label=f"{label}, R2 {one.r2(where):.4f}"
        )
    ends = [float(f(one.truth["train"])) for f in (np.min, np.max)]
    axes.plot(ends, ends, "k--", lw=0.8)
    axes.set_xlabel("truth")
    axes.set_ylabel("predicted")


def _residuals(axes: Axes, one: Trained) -> None:
    for where, (colour, label) in SHOWN.items():
        axes.plot(one.predicted[where], one.predicted[where] - one.truth[where], ".", color=colour, ms=4, label=label)
    axes.axhline(0.0, color="k", lw=0.8)
    axes.set_xlabel("predicted")
    axes.set_ylabel("predicted minus truth")
