"""A cascade tuned by one command: a flow inside, the temperature of a tank outside."""

import asyncio
import contextlib
import json
from pathlib import Path

import pytest

from autotuner.cli import main
from autotuner.commands.tuning.cascade import check_cascade
from autotuner.configuration import parse_configuration
from autotuner.errors import DeviceTimeoutError, LinkError
from autotuner.ports import AUTO, OUTPUT, SET_POINT
from autotuner_drivers.simulated import create

EXAMPLE = (Path(__file__).parents[2] / "examples" / "heated-tank.toml").read_text()
FLOW = {"K": 4.0, "T": 2.0, "D": 0.4}
TANK_K, TANK_TIME_S = 0.2, 60.0 + 12.0 + 5.0
LOOP = {"driver": "simulated", "sample_time_s": 0.1, "limits": {"output": [0.0, 100.0]}, "device": {}}
INNER_TIME_S = 1.5
"""Longest sum of lag and dead time that the closed inner loop adds, s: its dead time is 0.4 s."""


def tune(folder, *more, config=EXAMPLE):
    (folder / "loops.toml").write_text(config)
    return main(["tune", "FIC-7", "--cascade", "TIC-7", "--config", str(folder / "loops.toml"), *more])


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """Return both results, and the folder of their recordings."""
    folder = tmp_path_factory.mktemp("cascade")
    with (folder / "out.json").open("w") as out, contextlib.redirect_stdout(out):
        assert tune(folder, "--json", "--rule", "simc_pi", "--recording", str(folder / "tank.csv")) == 0
    return json.loads((folder / "out.json").read_text()), folder


def test_both_processes_are_those_of_the_plant(tuned):
    found, _ = tuned
    inner, outer = found["FIC-7"]["model"], found["TIC-7"]["model"]
    for name, value in FLOW.items():
        assert inner[name] == pytest.approx(value, rel=0.05)
    assert outer["K"] == pytest.approx(TANK_K, rel=0.02)
    assert TANK_TIME_S < sum(value for name, value in outer.items() if name[0] in "TD") < TANK_TIME_S + INNER_TIME_S


def test_the_inner_loop_holds_its_gains_and_the_outer_one_is_left_in_manual(tuned):
    found, folder = tuned
    assert found["FIC-7"]["device_gains"]["kp"] == pytest.approx(found["FIC-7"]["gains"]["Kp"], rel=1e-5)
    assert found["TIC-7"]["applied"] is None
    assert found["TIC-7"]["restored"]
    assert found["TIC-7"]["before"]["output"] == pytest.approx(200.0, abs=1.0)
    assert (folder / "tank.csv").is_file()
    assert (folder / "tank-FIC-7.csv").is_file()


@pytest.mark.long  # the files of both loops are named above, and reports of one loop are in tests/reports
def test_each_loop_has_its_report(tmp_path):
    assert tune(tmp_path, "--json", "--report", str(tmp_path / "tank.html")) == 0
    assert "Tuning of TIC-7" in (tmp_path / "tank.html").read_text()
    assert "Tuning of FIC-7" in (tmp_path / "tank-FIC-7.html").read_text()


OUTER, INNER = 'drives = "steam flow"', 'named = "steam flow"'
REFUSED = {
    "itself": (("--cascade", "FIC-7"), {}, "the inner loop itself"),
    "an option of one loop": (("--amplitude", "5"), {}, "[loops.TIC-7.relay]"),
    "inner gains that are nowhere": ((), {"[loops.FIC-7.gains]": "[loops.TIC-8]\n[loops.TIC-8.gains]"}, "TIC-8"),
    "outer in auto": ((), {OUTER: f"{OUTER}\nauto = true"}, "wind up"),
    "no inner plant": ((), {INNER: ""}, INNER),
    "not joined": ((), {INNER: "auto = true", OUTER: "", "output0 = 200.0": "output0 = 120.0"}, "Map"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_cascade_is_refused_before_anything_moves(tmp_path, capsys, case):
    options, changes, why = REFUSED[case]
    config = EXAMPLE
    for old, new in changes.items():
        assert old in config
        config = config.replace(old, new)
    assert tune(tmp_path, *options, config=config) in {1, 2}
    assert why in " ".join(capsys.readouterr().err.split())


@pytest.mark.long  # both loops of a plant are tuned above
def test_the_result_of_the_inner_loop_is_shown_where_the_outer_one_cannot_be_tuned(tmp_path, capsys):
    apart = EXAMPLE.replace(OUTER, "").replace("output0 = 200.0", "output0 = 120.0")
    assert tune(tmp_path, config=apart) == 1
    shown = capsys.readouterr()
    assert "FIC-7" in shown.out
    assert "Map the output of TIC-7" in " ".join(shown.err.split())


class Silent:
    """A device that connects and never answers."""

    readable = writable = frozenset({SET_POINT, OUTPUT, AUTO})
    closed = False

    async def open(self):
        pass

    async def read(self, _names):
        await asyncio.Event().wait()

    async def close(self):
        self.closed = True
        raise LinkError("the link is broken", remedy="Mend it.")


@pytest.mark.virtual_time
@pytest.mark.asyncio
async def test_a_silent_device_ends_in_advice():
    device, loop = Silent(), parse_configuration({"loops": {"FIC-7": LOOP}}, "test").loop("FIC-7")
    with pytest.raises(DeviceTimeoutError) as raised:
        await check_cascade(device, device, ("FIC-7", "TIC-7"), loop)
    assert raised.value.remedy
    assert device.closed


@pytest.mark.parametrize("role", ["named", "drives"])
def test_neither_loop_of_a_simulated_cascade_is_taken_to_another_process(role):
    plant = {"structure": "fopdt", "K": 1.0, "T": 5.0, "D": 1.0}
    assert create({"plant": plant}).carried() is not None
    assert create({"plant": plant, role: "steam flow"}).carried() is None
