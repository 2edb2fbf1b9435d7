"""`autotuner identify`: process models from recordings."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotuner.commands.files.result_files import PICTURES, check_writable, write_file
from autotuner.commands.terminal.output import exit_code, say, show, writing
from autotuner.commands.terminal.usage import Number, WholeNumber, add_examples, words
from autotuner.commands.tuning.design_options import add_budget, add_structure
from autotuner.configuration import load_configuration
from autotuner.core.notes import notes_among, warnings_among
from autotuner.core.recording import Recording
from autotuner.errors import AutotunerError, InputError

if TYPE_CHECKING:
    import argparse

    from autotuner.core.identification import Identification

ROLES = {"t": "t", "u": "output", "y": "pv", "sp": "set_point"}


@dataclass(frozen=True, slots=True)
class IdentifyCommand:
    """Identify from files."""

    help: str = (
        "Identify a process from CSV recordings (header t,u,y and optionally sp): relay, step, PRBS, closed loop."
    )

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="CSV recordings")
        parser.add_argument(
            "--config", type=Path, metavar="FILE", help="TOML file, for learned.artefacts (default: autotuner.toml)"
        )
        parser.add_argument("--jobs", type=WholeNumber(1), metavar="N", default=1, help="files at once (%(default)s)")
        add_budget(parser, "of a file")
        _add_model(parser.add_argument_group("model"))
        _add_data(parser.add_argument_group("recording"))
        results = parser.add_argument_group("results")
        results.add_argument("--json", action="store_true", help="print one JSON object a line per file")
        results.add_argument(
            "--picture",
            type=Path,
            metavar="FILE",
            help="draw measured, model, output and residual; a folder when there are several recordings",
        )
        add_examples(
            parser,
            "autotuner identify relay.csv",
            "autotuner identify *.csv --columns t=time,u=valve,y=level --json",
            "autotuner identify step.csv --structure fopdt --window 10:250 --picture step.png",
            "autotuner identify relay.csv --budget-ms 20 --json",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Identify each file; a file that fails does not stop the others."""
        import joblib  # noqa: PLC0415 - keeps `--help` quick
        from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415

        from autotuner.application.analysis.learned import use_artefacts  # noqa: PLC0415

        folder = load_configuration(args.config).learned.artefacts
        if folder is not None:
            use_artefacts(folder)
        columns, window = parse_columns(args.columns), parse_window(args.window)
        pictures = parse_pictures(args.picture, args.files)
        results = joblib.Parallel(n_jobs=args.jobs, return_as="generator")(
            joblib.delayed(identify_file)(
                file,
                columns,
                window,
                args.structure,
                args.known_gain,
                args.moments,
                tuple(args.disturbance),
                args.budget_ms,
            )
            for file in args.files
        )
        try:
            return max(
                _show(file, result, picture, as_json=args.json)
                for file, result, picture in zip(args.files, results, pictures, strict=True)
            )
        finally:
            if args.jobs != 1:
                get_reusable_executor().shutdown(wait=True)


command = IdentifyCommand()


def _add_model(group: argparse._ArgumentGroup) -> None:
    add_structure(group)
    group.add_argument("--known-gain", type=Number(), metavar="K", help="known static gain")
    group.add_argument(
        "--moments",
        type=words("auto", "exact", "between"),
        metavar="{auto,exact,between}",
        default="auto",
        help="when the output changed: exact (at its samples), between (them: sampled afterwards), auto (default)",
    )
    group.add_argument(
        "--disturbance",
        action="append",
        default=[],
        metavar="NAME",
        help="a further column that moves the PV too, such as another heater; may be given several times",
    )


def _add_data(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--columns", metavar="t=NAME,u=NAME,y=NAME", help="which columns to use, by title or number from 1"
    )
    group.add_argument("--window", metavar="START:END", help="part of the recording, s")


def identify_file(
    file: Path,
    columns: dict[str, str] | None,
    window: tuple[float, float] | None,
    structure: str,
    known_gain: float | None,
    moments: str = "auto",
    disturbances: tuple[str, ...] = (),
    budget_ms: float | None = None,
) -> tuple[Recording, Identification] | AutotunerError:
    """Read and identify one file; return an error instead of raising, so that it can cross processes."""
    from autotuner.application.analysis.learned import learned_models  # noqa: PLC0415
    from autotuner.core.identification import identify  # noqa: PLC0415 - keeps `--help` quick

    try:
        recording = Recording.from_csv(file, columns)
        if window is not None:
            recording = recording.window(*window)
        if budget_ms is not None:
            return recording, identify_in_time(recording, budget_ms, structure, known_gain)
        return recording, identify(
            recording,
            structure=structure,
            known_gain=known_gain,
            moments=moments,
            learned=learned_models(),
            disturbances=disturbances,
        )
    except AutotunerError as error:
        return error


def identify_in_time(
    recording: Recording, budget_ms: float, structure: str = "auto", known_gain: float | None = None
) -> Identification:
    """Identify within so much processor time of this process, ms."""
    from autotuner.application.analysis.learned import learned_models  # noqa: PLC0415
    from autotuner.control.clock.ticker import processor_time_spent  # noqa: PLC0415
    from autotuner.core.identification import identify_within  # noqa: PLC0415 - keeps `--help` quick

    models = learned_models()
    return identify_within(recording, processor_time_spent(budget_ms), structure, known_gain, models)


def _show(
    file: Path,
    result: tuple[Recording, Identification] | AutotunerError,
    picture: Path | None,
    *,
    as_json: bool,
) -> int:
    if isinstance(result, AutotunerError):
        say(result)
        if as_json:
            show(json.dumps({"file": str(file), "error": result.to_dict()}) + "\n")
        return exit_code(result)
    recording, identification = result
    if picture is not None:
        from autotuner.reports.pictures.chart import fit_chart  # noqa: PLC0415
        from autotuner.reports.pictures.figure import draw  # noqa: PLC0415 - matplotlib is slow to load

        chart = fit_chart(recording, identification, "", "")
        write_file("--picture", picture, partial(draw, chart))
    quick = _quick_gains(recording, identification)
    if as_json:
        early = {"gains": quick} if quick else {}
        show(json.dumps({"file": str(file), **identification.to_dict(), **early}) + "\n")
    else:
        with writing():
            _print(file, recording, identification, picture)
        if quick:
            values = ", ".join(f"{name} {quick[name]:.4g}" for name in ("Kp", "Ti", "Td") if quick[name] is not None)
            show(f"gains: {values} ({quick['rule']} at the cautious end of the model's errors)\n")
    return 0 if identification.model is not None else 1


def _quick_gains(recording: Recording, identification: Identification) -> dict[str, Any] | None:
    """Return gains for a model that had to be had in no time: the search for better ones would not have it either."""
    if identification.recommended != "learned":
        return None
    from autotuner.application.analysis.early_gains import in_no_time  # noqa: PLC0415 - keeps `--help` quick

    return in_no_time(identification, recording.sample_interval_s)


def _print(file: Path, recording: Recording, identification: Identification, picture: Path | None) -> None:
    from autotuner.commands.terminal.show import (  # noqa: PLC0415
        results_console,
        show_chart,
        show_identification,
        show_messages,
        show_verdict,
    )

    console = results_console()
    console.print(f"[bold]{file}[/bold]: {len(recording)} samples, {recording.duration_s:g} s")
    show_identification(console, identification)
    for one in identification.disturbances:
        gain, late = f"gain {one.gain:.4g} +- {one.gain_error:.2g}", f"dead time {one.D:.4g} +- {one.D_error:.2g} s"
        console.print(f"measured disturbance {one.name}: {gain}, {late}, through the lags of the process")
    show_chart(console, recording)
    show_messages(console, warnings_among(identification.warnings), notes_among(identification.warnings))
    if picture is not None:
        console.print(f"picture: {picture}")
    show_verdict(console, identification.verdict)


def parse_columns(text: str | None) -> dict[str, str] | None:
    """Return `t=time,u=voltage,y=4` as roles of `Recording` with the columns' titles or numbers."""
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    for role, equals, title in pairs:
        if role.strip() not in ROLES or not equals or not title:
            raise InputError(
                "is not understood",
                field="--columns",
                value=text,
                remedy="Write t=NAME,u=NAME,y=NAME, optionally sp=NAME.",
            )
    return {ROLES[role.strip()]: title.strip() for role, _, title in pairs}


def parse_window(text: str | None) -> tuple[float, float] | None:
    """Return `10:250`, `10:` or `:250` as start and end, s."""
    if text is None:
        return None
    start, colon, end = text.partition(":")
    try:
        window = (float(start or "-inf"), float(end or "inf"))
    except ValueError:
        window = (0.0, 0.0)
    if not colon or not window[0] < window[1]:
        raise InputError("is no window", field="--window", value=text, remedy="Write START:END in seconds.")
    return window


def parse_pictures(place: Path | None, files: list[Path]) -> list[Path | None]:
    """Return the picture of each file: the one named, or with several files one of each file's name in that folder."""
    if place is None:
        return [None] * len(files)
    if len(files) == 1:
        check_writable("--picture", place, PICTURES)
        return [place]
    if place.suffix:
        raise InputError(
            "is one picture for several recordings",
            field="--picture",
            value=str(place),
            remedy="Name a folder, or give one file.",
        )
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot be made: {error.strerror}", field="--picture", value=str(place), remedy="Choose another place."
        ) from error
    names = [file.stem for file in files]
    stems = [name if names.count(name) == 1 else f"{name}-{i + 1}" for i, name in enumerate(names)]
    return [place / f"{stem}.png" for stem in stems]
