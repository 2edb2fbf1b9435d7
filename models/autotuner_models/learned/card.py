"""Model card: training data, accuracy and limits of use, with a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.identification.limit_cycle.harmonic_start import COORDINATES
from autotuner_models.learned.training import COMPARED_ROWS

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from autotuner_models.learned.training import Trained

CARD, PICTURE, COMPARISON = "model-card.md", "model-card.svg", "comparison.md"
PERCENT = 100.0
"""Per cent in one."""


def write_card(folder: Path, manifest: Mapping[str, object], trained: Mapping[str, Trained]) -> None:
    """Write `model-card.md` and its picture into the folder of the artefacts."""
    _picture(folder / PICTURE, trained)
    (folder / CARD).write_text(card(manifest, trained), encoding="utf-8")


def card(manifest: Mapping[str, object], trained: Mapping[str, Trained]) -> str:
    """Return the model card, Markdown."""
    versions = manifest["versions"]
    assert isinstance(versions, dict)  # noqa: S101 - written by us just before
    lines = [
        "# Learned correction of relay identification",
        "",
        f"Trained on {manifest['experiments']} simulated relay experiments with seed {manifest['seed']}:",
        f"`autotuner train --seed {manifest['seed']} --experiments {manifest['experiments']}`.",
        f"Data SHA-256 `{manifest['data_sha256']}`; "
        + ", ".join(f"{name} {number}" for name, number in versions.items())
        + ".",
        "",
        "Input: harmonics of PV and output over the last whole cycles, static gain with its error. Output: corrected",
        "parameters with predicted standard errors. All quantities are dimensionless, so one model serves any time",
        "scale and gain. The correction refuses features outside the range and the scatter of its training data.",
        "",
        "## Errors on experiments that were not trained on",
        "",
        f"Family: {manifest.get('family', 'network')}. Sampling 20 to 400 a period, 3 to 12 switches, noise up to",
        f"{PERCENT * _most_noise(manifest):g} % of the amplitude, hysteresis to 40 % of it,",
        "bias to 60 % of the relay's amplitude, gains given, shown by asymmetry or given wrongly. Errors of",
        "logarithms are relative errors, those of wD are of the phase in rad; `start` is the model that the harmonics",
        "give without correction. Errors have longer tails than a normal distribution; the 95 % intervals of an",
        "estimate allow for that, 1.96 standard errors do not.",
        "",
        "| structure | coordinate | median, start | median, corrected | p95, start | p95, corrected | within 1.96 se |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in trained.items():
        before, after, within = (one.metrics[key] for key in ("start", "corrected", "within_1_96_se"))
        assert isinstance(before, dict)  # noqa: S101 - as `training` makes them
        assert isinstance(after, dict)  # noqa: S101
        assert isinstance(within, list)  # noqa: S101
        for i, coordinate in enumerate(COORDINATES[name]):
            cells = [before["median"][i], after["median"][i], before["p95"][i], after["p95"][i]]
            row = " | ".join(f"{PERCENT * cell:.3g} %" for cell in cells)
            lines.append(f"| {name} | {coordinate} | {row} | {PERCENT * within[i]:.1f} % |")
    lines += _use()
    lines += _families(trained)
    lines += ["", "## Structures distinguished by the shape of the wave", "", "| structure | right |", "|---|---|"]
    classes = manifest["metrics"]["classes"]  # type: ignore[index]
    lines += [f"| {name} | {PERCENT * share:.0f} % |" for name, share in classes.items()]
    lines += ["", f"![Errors before and after the correction]({PICTURE})", ""]
    return "\n".join(lines)


def _families(trained: Mapping[str, Trained]) -> list[str]:
    if not all(one.metrics["families"] for one in trained.values()):
        return []
    lines = [
        "",
        "## Families compared",
        "",
        "Mean square of the error after the correction, relative to that of the start (first coordinate, in its",
        f"own spread), over three folds of {COMPARED_ROWS} rows. A value of 1 means that nothing was learned.",
        "Boosted trees are slightly better for some structures. The networks are used because one small network",
        "returns all parameters and their errors.",
        "",
        "| structure | linear | boosted trees | network |",
        "|---|---|---|---|",
    ]
    for name, one in trained.items():
        families = one.metrics["families"]
        assert isinstance(families, dict)  # noqa: S101
        lines.append(f"| {name} | " + " | ".join(f"{value:.3f}" for value in families.values()) + " |")
    return lines


def _most_noise(manifest: Mapping[str, object]) -> float:
    noise = manifest.get("noise")
    return float(noise[1]) if isinstance(noise, list) else 0.25


def _use() -> list[str]:
    return [
        "",
        "## Use",
        "",
        f"[{COMPARISON}]({COMPARISON}) compares all estimators on the same records. Least squares uses the whole",
        "record. It is more accurate in every row there, takes about fifteen times longer, and is recommended wherever",
        "it has an answer. The learned correction is for the time before: after each half period while the relay runs,",
        "and when there is no time for a fit.",
    ]


def _picture(path: Path, trained: Mapping[str, Trained]) -> None:
    """Draw the medians before and after, by structure and coordinate."""
    import matplotlib as mpl  # noqa: PLC0415 - only the card needs it
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axes, (name, one) in zip(figure.subplots(1, len(trained), sharey=True), trained.items(), strict=True):
        for key, shift in (("start", -0.2), ("corrected", 0.2)):
            sizes = one.metrics[key]
            assert isinstance(sizes, dict)  # noqa: S101
            places = [i + shift for i in range(len(sizes["p95"]))]
            axes.bar(places, [PERCENT * value for value in sizes["p95"]], 0.4, label=key)
        axes.set_xticks(range(len(COORDINATES[name])), COORDINATES[name], rotation=40)
        axes.set_title(name, fontsize=9)
        axes.set_yscale("log")
    figure.axes[0].set_ylabel("95 % of errors are under, %")
    figure.axes[0].legend(fontsize=8)
    with mpl.rc_context({"svg.hashsalt": "card", "svg.fonttype": "none"}):
        figure.savefig(path, metadata={"Date": None, "Creator": None})
