"""Reports: one file that loads and runs nothing, holds the numbers it was given, and says what was not checked."""

import contextlib
import hashlib
import io
import json
import math
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

from autotuner.cli import main
from autotuner.commands.files.report import write_report
from autotuner.commands.files.result_files import write_file
from autotuner.core.design import Basis, DesignSpec, DeviceController, PidGains, Requirements, design
from autotuner.core.design.simulation.closed_loop_setup import Installed, handy
from autotuner.core.diagnosis.findings.result import Diagnosis, Misfit, Traces
from autotuner.core.experiment.phases import Phase
from autotuner.core.experiment.settings import ExperimentSettings
from autotuner.core.model.process import Fopdt
from autotuner.core.recording import Recording
from autotuner.errors import InputError
from autotuner.reports.choices import ReportedEffect, choices_of
from autotuner.reports.curves import before_and_after, fit_curves, kept, loop_curves
from autotuner.reports.diagnosis import diagnosis_report
from autotuner.reports.document import Facts, Grid, Section, Words, document
from autotuner.reports.pictures.chart import Chart, Curve, Panel, Span
from autotuner.reports.pictures.svg import svg, ticks
from autotuner.reports.plan import plan
from autotuner.reports.tuning import not_checked

LOADING = {"src", "href", "data", "action", "poster", "background", "srcset"}


class Reader(HTMLParser):
    """Collects what a document would load or run, and its words."""

    def __init__(self, text):
        super().__init__()
        self.loads, self.tags, self.words, self.open = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.loads += [(tag, name) for name, _ in attributes if name in LOADING or name.startswith("on")]
        if tag not in {"meta", "br"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.mark.long  # tests/service has the report of a tuning
def test_a_report_of_a_tuning_from_the_shell(tmp_path, capsys):
    file, recording = tmp_path / "report.html", tmp_path / "recording.csv"
    assert main(["tune", "--report", str(file), "--recording", str(recording)]) == 0
    text = file.read_text(encoding="utf-8")
    read = Reader(text)
    assert (read.loads, read.open) == ([], [])
    assert "script" not in read.tags
    assert "url(" not in text
    assert "@import" not in text
    assert hashlib.sha256(recording.read_bytes()).hexdigest() in text
    words = " ".join(read.words)
    for expected in (
        "fopdt",
        "95 % interval",
        "balanced",
        "What was not checked",
        "relay-autotuner",
        "calm",
        "Effects missing in the model",
    ):
        assert expected in words
    assert "not verified on the loop" in words
    assert len(text) < 300_000
    assert "done: fopdt" in capsys.readouterr().out


@pytest.fixture(scope="module")
def worn_valve(tmp_path_factory, pytestconfig):
    """The result and the report of the example with play in its actuator; structure and rule save two thirds of it."""
    folder = tmp_path_factory.mktemp("worn_valve")
    example = pytestconfig.rootpath / "examples" / "worn_valve.toml"
    out, file = io.StringIO(), folder / "report.html"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setenv("XDG_STATE_HOME", str(folder))
        options = ["--structure", "fopdt", "--rule", "simc_pi", "--json", "--report", str(file)]
        assert main(["tune", "--config", str(example), *options]) == 0
    return json.loads(out.getvalue()), file.read_text(encoding="utf-8")


def test_the_worn_valve_of_the_page_is_found_out(worn_valve, pytestconfig):
    told, _ = worn_valve
    (effect,) = told["diagnosis"]["effects"]
    assert effect["name"] == "backlash"
    warning = next(line for line in told["warnings"] if "dead-band" in line)
    page = pytestconfig.rootpath / "docs" / "how-to" / "read-a-diagnosis.md"
    assert " ".join(warning.split()) in " ".join(page.read_text(encoding="utf-8").split())
    assert told["model"] == pytest.approx({"K": 2.0, "T": 10.0, "D": 1.5}, rel=0.02)
    assert told["estimates"]["least_squares"]["model"]["K"] == pytest.approx(6.0, rel=0.05)


def test_a_model_that_is_drawn_without_its_effects_is_said_to_be(worn_valve):
    words = "|".join(Reader(worn_valve[1]).words)
    assert "The model here is the process alone, without backlash." in words


def test_settings_and_margins_of_a_report_are_written_for_people(worn_valve):
    read = Reader(worn_valve[1])
    words = "|".join(read.words)
    assert "time limit s|86400|" in words
    assert "|pv|none|" in words
    assert "phase margin, degrees" in words
    assert "settling time, with the effects" in words
    for raw in ("gain_margin", "phase_margin_deg", "True", "['backlash']", "none to none", "e+0"):
        assert raw not in words


def sections(text):
    return re.findall(r"<h2>(.*?)</h2>", text)


@pytest.fixture(scope="module")
def verified(tmp_path_factory):
    """The report and the picture of a verified tuning."""
    folder = tmp_path_factory.mktemp("verified")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        patch.chdir(folder)
        assert main(["tune", "--verify", "--report", "report.html", "--picture", "picture.svg"]) == 0
    return folder


def test_gains_come_first_and_the_settings_are_folded(verified):
    text = (verified / "report.html").read_text(encoding="utf-8")
    assert sections(text)[:4] == ["Result", "Gains", "Verification on the loop", "Measured against model"]
    assert re.search(r"<details><summary><h2>Settings and safety limits</h2>", text)
    assert "@page" in text
    words = "|".join(Reader(text).words)
    assert re.search(r"\|Kp\|[\d.]+ %/degC\|Ti\|[\d.]+ s\|Td\|[\d.]+ s\|", words)
    assert "K, degC/%" in words
    assert "|output|0 to 100 %|" in words


def test_a_verified_tuning_is_signed_off(verified):
    words = "|".join(Reader((verified / "report.html").read_text(encoding="utf-8")).words)
    for expected in ("before|written|read back", "verdict|passed", "in the device now|the gains written", "by|shell:"):
        assert expected in words
    before, written, read_back = re.search(r"\|kp\|([\d.]+)\|([\d.]+)\|([\d.]+)\|", words).groups()
    assert (before, written) == ("1", read_back)
    assert re.search(r"step of the set point\|[\d.]+ degC\|", words)
    assert "highest predicted" in words
    assert "Accepted by:" in words


def test_the_whole_record_is_drawn_and_the_unfitted_part_marked(verified):
    text = (verified / "report.html").read_text(encoding="utf-8")
    assert "not fitted" in "".join(Reader(text).words)
    assert re.search(r"No model was fitted from [\d.]+ s on", text)
    assert "not fitted" in (verified / "picture.svg").read_text(encoding="utf-8")


def test_a_report_that_cannot_be_written_is_told(tmp_path):
    told = {"id": "shell", "loop": "heater", "started_at": "2026-01-31T12:00:00Z"}
    tuning = SimpleNamespace(
        recording=lambda: Recording([0.0, 1.0], [0.0, 1.0], [5.0, 6.0]),
        to_dict=lambda: told,
        analysis=None,
        model=None,
        spec=DesignSpec(),
    )
    loop = SimpleNamespace(driver="simulated", pv_unit="degC", output_unit="%")
    with pytest.raises(InputError, match="--report: cannot be written"):
        write_file("--report", tmp_path / "absent" / "report.html", partial(write_report, tuning, loop))
    write_report(tuning, loop, tmp_path / "report.html")
    assert "The tuning still runs." in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_words_from_outside_never_become_markup():
    evil = "<script>alert(1)</script>&\"'"
    parts = [Words(evil), Facts([(evil, evil)]), Grid(evil, [evil], [[evil, evil]])]
    read = Reader(document(evil, evil, [Section(evil, parts)]))
    assert "script" not in read.tags
    assert read.loads == []
    assert evil in read.words


def test_a_picture_is_well_formed_and_draws_what_it_was_given():
    t = np.linspace(0.0, 10.0, 11)
    values = np.where(t == 5.0, np.nan, t)
    chart = Chart(t, [Panel("PV <1>", [Curve("a & b", values)])], 'title "x"', [Span("relay", 2.0, 4.0)])
    root = ET.fromstring(svg(chart))  # noqa: S314 - made a line above
    space = "{http://www.w3.org/2000/svg}"
    paths = [path.get("d") for path in root.iter(f"{space}path") if path.get("class") == "c0"]
    assert paths[0].count("M") == 2
    assert len(re.findall(r"[ML]", paths[0])) == 10
    assert [text.text for text in root.iter(f"{space}text") if "&" in text.text] == ["a & b"]


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-3.0, 170.0), (0.001, 0.0012), (1e5, 3e6), (79.9, 80.1)])
def test_ticks_are_round_and_inside(low, high):
    found = ticks(low, high, 5)
    assert 2 <= len(found) <= 7
    assert all(low - 1e-9 <= value <= high * (1.0 + 1e-9) for value, _ in found)
    assert len({text for _, text in found}) == len(found)
    for value, text in found:
        assert float(text) == pytest.approx(value, rel=1e-6, abs=1e-12)


def test_thinning_keeps_the_extremes_and_the_ends():
    values = np.sin(np.arange(100_000) / 50.0)
    values[12_345], values[54_321] = 7.0, -7.0
    indices = kept(values, 1000)
    assert indices.size <= 1000
    assert (indices[0], indices[-1]) == (0, 99_999)
    assert {12_345, 54_321} <= set(indices.tolist())
    assert np.all(np.diff(indices) > 0)
    assert np.array_equal(kept(values[:10], 1000), np.arange(10))


def test_responses_of_a_loop_end_where_theory_says():
    """With integral action the PV ends at the set point and the load is cancelled; without it P leaves 1/(1 + K Kp)."""
    model = Fopdt(2.0, 10.0, 1.5)
    full, proportional = loop_curves(model, [PidGains(1.0, 10.0), PidGains(1.0)])
    assert full["step_pv"][-1] == pytest.approx(1.0, abs=0.02)
    assert full["load_output"][-1] == pytest.approx(-1.0, abs=0.02)
    assert proportional["step_pv"][-1] == pytest.approx(2.0 / 3.0, abs=0.02)
    assert full["t_s"] == proportional["t_s"]


def test_responses_are_of_the_loop_as_it_is_installed():
    """The output keeps its room and its slew; with play the PV comes later than without."""
    model, gains = Fopdt(2.0, 10.0, 1.5), PidGains(1.0, 10.0)
    installed = Installed(0.1, (-2.0, 3.0), 1.0, set_point_step=5.0, load_step=2.0)
    (bound,) = loop_curves(model, [gains], installed)
    assert max(bound["step_output"]) == pytest.approx(3.0)
    assert max(np.diff(bound["step_output"]) / np.diff(bound["t_s"])) <= 1.0 + 1e-9
    assert (bound["set_point_step"], bound["load_step"], bound["effects"]) == (5.0, 2.0, [])
    stuck = replace(
        installed, effects=(ReportedEffect("backlash", {"width": 1.0}), ReportedEffect("drift", {"slope": 1.0}))
    )
    (late,) = loop_curves(model, [gains], stuck)
    assert late["effects"] == ["backlash"]
    assert late["step_pv"][60] < bound["step_pv"][60]


@pytest.mark.parametrize(("size", "expected"), [(7.3, 5.0), (-0.2, 0.2), (0.0, 1.0), (math.inf, 1.0), (1999.0, 1000.0)])
def test_a_step_has_a_round_size(size, expected):
    assert handy(size) == pytest.approx(expected)


def test_a_plan_counts_the_phases_of_the_experiment():
    planned = plan(ExperimentSettings(amplitude=5.0, ratio=1.0, check=False), 50.0, "%", "degC")
    assert [step.phase for step in planned.steps] == [Phase.QUIET, Phase.RELAY, Phase.CHECK, Phase.RESTORE]
    assert (planned.levels.low, planned.levels.high) == (45.0, 55.0)
    assert "Left out" in planned.steps[2].text
    assert planned.to_dict()["steps"][0]["phase"] == "quiet"


@pytest.mark.parametrize(
    ("told", "count"),
    [
        ({}, 5),
        ({"restored": True, "error": {}, "diagnosis": {"verdict": "adequate"}, "verification": {"passed": True}}, 1),
        ({"restored": True, "error": {}, "settings": {"check": False}}, 4),
    ],
)
def test_what_was_not_checked_follows_from_what_was_done(told, count):
    assert len(not_checked(told)) == count


def test_a_recording_without_a_model_has_curves_too():
    curves = fit_curves(Recording([0.0, 1.0], [0.0, 1.0], [5.0, 6.0]), None)
    assert (curves["pv"], curves["model"], curves["residual"]) == ([5.0, 6.0], None, None)


def test_a_diagnosis_is_written_in_sentences_of_plain_words():
    errors = dict.fromkeys(("fitted", "selection", "held_out"), Misfit(3.0, 2.0, 1.0, 1.0))
    model = {"before": None, "after": None}
    found = Diagnosis("partly_explained", (), None, errors, model, model, ("this record is blind",), summary="a load")
    words = Reader(diagnosis_report(found, "record.csv")).words
    assert "Partly explained: a load." in words
    assert "This record is blind." in words
    assert {"part that was fitted", "part that chose the explanation", "part kept for the test"} <= set(words)
    assert not any("_" in word for word in words)


def test_curves_before_and_after_hold_what_the_diagnosis_simulated():
    t = np.arange(5000.0)
    pv = np.sin(t / 40.0)
    traces = Traces(t, np.zeros(5000), pv, pv - 1.0, pv - 0.25, 4000.0)
    curves = before_and_after(traces, 500)
    assert len(curves["t_s"]) <= 500
    assert set(np.round(curves["residual_before"], 9)) == {1.0}
    assert set(np.round(curves["residual_after"], 9)) == {0.25}
    assert curves["held_out_from_s"] == 4000.0


@pytest.mark.one_of(2)
@pytest.mark.parametrize(("b", "most"), [(1.0, 0.13), (0.25, 0.13)])
def test_what_is_offered_is_predicted_as_the_device_holds_it(b, most):
    """Figures, chart and the step's first output agree, and are those of the device: rounded, with its own weight."""
    device = DeviceController(b=b, N=8.0, resolution={"gain": 0.5}, scan_s=0.1)
    basis = Basis(Fopdt(2.0, 10.0, 1.5), sample_time_s=0.1, device=device)
    (choice,) = (made for made in choices_of(basis, DesignSpec(), Installed(0.1)) if made["name"] == "balanced")
    held, drawn = choice["device"]["gains"], choice["responses"]
    assert (held["b"], held["N"], held["Tf"]) == (b, 8.0, 0.0)
    assert held["Kp"] % 0.5 == 0.0
    assert drawn["step_output"][0] == pytest.approx(b * held["Kp"] * drawn["set_point_step"])
    assert choice["overshoot"] == choice["predicted"]["overshoot"] < most
    assert max(drawn["step_pv"]) / drawn["set_point_step"] - 1.0 == pytest.approx(choice["overshoot"], abs=0.002)


def test_a_fixed_set_point_weight_costs_what_the_warning_says():
    """With the weight 1 the gains for the least load error overshoot by a third; less overshoot costs load error."""
    device = DeviceController(b=1.0, N=8.0)
    model = Fopdt(2.0, 10.0, 1.5)
    free = design(model, Requirements(device=device))
    held = design(model, Requirements(device=device, overshoot=0.1))
    assert free.overshoot > 0.25
    assert held.overshoot == pytest.approx(0.1, abs=0.01)
    assert held.load_error_cost == pytest.approx(held.iae / free.iae)
    assert f"{held.load_error_cost:.2f} times" in held.warnings[-1]
    assert held.margins.Ms <= 1.401


def test_a_row_of_a_diagnosis_says_something(tmp_path):
    """No number without a value, and no fit of a part whose spread is not known."""
    t = np.arange(120.0)
    output = np.where(t < 10.0, 40.0, 50.0)
    noise = np.random.default_rng(1).normal(0.0, 0.05, t.size)
    pv = 60.0 - 10.0 * np.expm1(-np.maximum(t - 15.0, 0.0) / 20.0) + noise
    file, report = tmp_path / "step.csv", tmp_path / "step.html"
    file.write_text(Recording(t, output, pv).to_csv(), encoding="utf-8")
    assert main(["diagnose", str(file), "--report", str(report)]) == 0
    text = report.read_text(encoding="utf-8")
    assert "- to -" not in text
    assert not re.search(r"</th>(<td></td>)+</tr>", text)
