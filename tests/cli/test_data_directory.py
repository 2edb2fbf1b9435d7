"""`--data-directory`: where state is kept, for every command that uses it, and what is left over in it."""

import pytest

from autotuner.cli import main
from autotuner.configuration import load_configuration
from autotuner.control.records.journal import Journal
from tests.control.test_leases import head

LOOP = """
[loops.TIC]
driver = "simulated"
device = { plant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 } }
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "loops.toml"
    path.write_text(LOOP)
    return path


@pytest.fixture
def left(tmp_path, file):
    """A data directory with a lease that has no end, of a program that is gone."""
    folder = tmp_path / "elsewhere"
    key = load_configuration(file).loop("TIC").device_key
    lease = Journal(folder, in_place=True).begin(head(device=key, loop="TIC"))
    lease.store.close()
    lease.lock.release()
    return folder


@pytest.mark.parametrize("words", [["check", "{file}"], ["probe", "TIC", "--seconds", "0.1", "--config", "{file}"]])
def test_what_was_left_is_reported(file, left, capsys, words):
    words = [word.format(file=file) for word in words]
    assert main([*words, "--data-directory", str(left)]) == 0
    assert "TIC: tuning T1 of now was interrupted" in capsys.readouterr().err
    assert main(words) == 0
    assert "interrupted" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", [["tune"], ["apply"], ["rollback"], ["serve"], ["check"], ["probe"], ["token", "add"], ["token", "list"]]
)
def test_every_command_with_state_has_the_option(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    assert "--data-directory" in capsys.readouterr().out


def test_tokens_are_kept_there(tmp_path, capsys):
    folder = str(tmp_path / "there")
    assert main(["token", "add", "panel", "--role", "viewer", "--data-directory", folder]) == 0
    capsys.readouterr()
    main(["token", "list", "--data-directory", folder])
    assert "panel" in capsys.readouterr().out
    main(["token", "list"])
    assert "panel" not in capsys.readouterr().out
