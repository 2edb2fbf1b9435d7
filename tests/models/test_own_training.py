"""A range of the user's own: trained, saved, used in a tuning through the service; tampered files are refused."""

import json
import shutil
import signal

import pytest

from autotuner.application.analysis import learned as registry
from autotuner.cli import main
from autotuner.configuration import parse_configuration
from autotuner.errors import ConfigurationError
from autotuner_models.learned.artefacts import load
from autotuner_models.learned.training import FAMILIES
from tests.control.processes import PATIENCE_S
from tests.service.conftest import HEATER, configure, serving
from tests.service.test_serve_process import FAST, check_ended, serve, start

__all__ = ["configure", "serving", "start"]

EXPERIMENTS = "8192"
RANGE = ("--range", "D/T=0.05..8", "--noise", "0..0.1")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a function that trains a family, once, and returns its folder."""
    base = tmp_path_factory.mktemp("own")
    made = {}

    def of(family):
        if family not in made:
            made[family] = base / family
            words = ["--experiments", EXPERIMENTS, "--work", str(base / "chunks"), "--out", str(made[family])]
            assert main(["train", *RANGE, "--family", family, *words]) == 0
        return made[family]

    return of


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """What a test makes the process use is forgotten after it."""
    monkeypatch.setenv(registry.ARTEFACTS, "")
    registry.learned_models.cache_clear()
    yield
    registry.learned_models.cache_clear()


@pytest.mark.parametrize(
    "family", ["linear", *(pytest.param(family, marks=pytest.mark.long) for family in ("tree", "forest"))]
)
def test_a_family_is_saved_with_its_range_and_used_again(folders, family, record):
    from autotuner.core.identification.learned.correction import by_learned
    from autotuner_sim import Fopdt

    manifest = json.loads((folders(family) / "manifest.json").read_text())
    assert manifest["family"] == family
    assert manifest["ranges"]["D/T"] == [0.05, 8.0]
    assert manifest["noise"] == [0.0, 0.1]
    assert manifest["machine"]["libraries"]
    plant = Fopdt(1.65, 20.0, 10.0)
    estimate = by_learned(record(plant), "fopdt", (plant.K, 0.0), load(folders(family)))
    assert estimate.refusal is None
    assert estimate.model.parameters() == pytest.approx({"K": 1.65, "T": 20.0, "D": 10.0}, rel=0.03)
    outside = by_learned(record(Fopdt(1.0, 1.0, 12.0)), "fopdt", (1.0, 0.0), load(folders(family)))
    assert outside.model is None


def test_every_family_of_the_thesis_can_be_chosen():
    assert {"tree", "forest", "linear", "network"} <= set(FAMILIES)


@pytest.mark.long  # the family is used again in the test above
@pytest.mark.usefixtures("without_diagnosis")
@pytest.mark.virtual_time
async def test_a_tuning_through_the_service_uses_the_folder_of_the_configuration(folders, serving, tmp_path):
    values = {
        "service": {"data_directory": str(tmp_path / "data")},
        "learned": {"artefacts": str(folders("tree"))},
        "loops": {"heater": HEATER},
    }
    async with serving(parse_configuration(values, "test")) as service:
        started = await service.client.post("/v1/loops/heater/tunings", json={"rule": "simc_pi"})
        await service.client.get(started.json()["links"]["events"])
        result = (await service.client.get(started.json()["links"]["self"])).json()
    used = registry.learned_models()
    assert used.about["family"] == "tree"
    learned = result["estimates"]["learned"]
    assert learned["refusal"] is None
    assert learned["model"]["D"] == pytest.approx(1.5, rel=0.05)


@pytest.mark.realtime
@pytest.mark.long  # the tuning through the service and the refusal at the start have tests of their own here
def test_a_service_process_uses_the_folder_and_refuses_it_once_a_file_was_tampered_with(folders, start, tmp_path):
    folder = shutil.copytree(folders("tree"), tmp_path / "own")
    config = f'[learned]\nartefacts = "{folder}"\n{FAST}'
    process, client = serve(start, config)
    with client:
        started = client.post("/v1/loops/fast/tunings").json()
        client.get(started["links"]["events"])
        result = client.get(started["links"]["self"]).json()
    process.send_signal(signal.SIGTERM)
    check_ended(process)
    assert result["verdict"]["outcome"] == "done"
    learned = result["estimates"]["learned"]
    assert learned["refusal"] is None
    assert learned["model"]["D"] == pytest.approx(0.2, rel=0.1)
    flip_a_bit(folder / "learned.joblib")
    process, line = start("serve", "--json", "--port", "0", config=config)
    _, err = process.communicate(timeout=PATIENCE_S)
    assert (line, process.returncode) == ("", 2), err
    assert "learned.artefacts" in err
    assert str(folder / "learned.joblib") in err
    assert "autotuner train" in err
    assert "Traceback" not in err


def flip_a_bit(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize("name", ["learned.arrays", "learned.joblib"])
def test_a_tampered_file_is_refused_at_the_start(folders, name, tmp_path):
    folder = shutil.copytree(folders("tree"), tmp_path / "tampered")
    flip_a_bit(folder / name)
    with pytest.raises(ConfigurationError, match="is not the file that its manifest vouches for"):
        registry.use_artefacts(str(folder))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--range", "T/T=1..2"], "is not a ratio"),
        (["--range", "D/T=2..1"], "range above zero"),
        (["--range", "D/T=a..b"], "LOW..HIGH"),
        (["--noise", "0..5"], "within 0..1"),
    ],
)
def test_a_range_that_cannot_be_is_wrong_usage(words, said, capsys):
    assert main(["train", *words]) == 2
    assert said in capsys.readouterr().err
