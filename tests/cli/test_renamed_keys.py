"""A key of an earlier version is accepted under its old name, with a warning that states the new one."""

import logging

import pytest

from autotuner.configuration import RENAMED, LoopTable, SafetyTable, load_configuration
from autotuner.errors import ConfigurationError

LOOP = """
[loops.demo]
driver = "simulated"
sample_time_s = 0.1
{}

[loops.demo.safety]
{}
"""
SAFETY = {"blind_s": "pv_timeout_s", "late_s": "max_lateness_s"}


def written(folder, *safety, loop=""):
    path = folder / "loops.toml"
    path.write_text(LOOP.format(loop, "\n".join(safety)), encoding="utf-8")
    return path


@pytest.mark.parametrize(("old", "new"), SAFETY.items())
def test_an_old_name_is_accepted_with_a_warning(tmp_path, caplog, old, new):
    with caplog.at_level(logging.WARNING):
        safety = load_configuration(written(tmp_path, f"{old} = 7.5")).loops["demo"].safety
    assert getattr(safety, new) == 7.5
    assert f"{old} is now called {new}" in caplog.text


def test_the_old_name_of_the_process_action_is_accepted_with_a_warning(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        loop = load_configuration(written(tmp_path, loop='action = "reverse"')).loops["demo"]
    assert loop.process_action == "reverse"
    assert "action is now called process_action" in caplog.text


def test_both_names_at_once_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="blind_s"):
        load_configuration(written(tmp_path, "blind_s = 5.0", "pv_timeout_s = 6.0"))


def test_the_present_names_give_no_warning(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        load_configuration(written(tmp_path, "pv_timeout_s = 5.0"))
    assert not caplog.text
    assert set(RENAMED.values()) <= set(SafetyTable.model_fields) | set(LoopTable.model_fields)
