"""Files that were tampered with, are missing or of another version: a sentence with a remedy, nothing unpickled."""

import json
import shutil

import joblib
import numpy as np
import pytest

from autotuner.application.analysis import learned as registry
from autotuner.core.identification.learned.correction import LearnedModels
from autotuner.errors import ConfigurationError
from autotuner_models.learned import artefacts
from autotuner_models.learned.artefacts import ARRAYS, MANIFEST, OBJECTS, SHIPPED, load, load_objects, read_manifest

RETRAIN = "autotuner train"


@pytest.fixture
def folder(small, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(small, tmp_path / "learned")


def changed(path, **entries):
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps(manifest | entries))


class Trap:
    """Sets off when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("was unpickled",))


def test_what_was_saved_is_what_is_loaded(folder):
    models, objects = load(folder), load_objects(folder)
    rows = np.random.default_rng(0).normal(size=(3, models.corrections["fopdt"].domain.mean.size))
    plain = models.corrections["fopdt"].networks(rows)
    assert plain == pytest.approx(np.stack([one.predict(rows) for one in objects["fopdt"]]), abs=1e-9)


@pytest.mark.parametrize("name", [ARRAYS, OBJECTS])
def test_a_changed_byte_is_noticed_before_the_file_is_read(folder, name):
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(data)
    with pytest.raises(ConfigurationError, match="not the file that its manifest vouches for") as error:
        (load if name == ARRAYS else load_objects)(folder)
    assert RETRAIN in str(error.value)


def test_a_planted_pickle_is_never_unpickled(folder):
    joblib.dump(Trap(), folder / OBJECTS)
    with pytest.raises(ConfigurationError, match="vouches"):
        load_objects(folder)


@pytest.mark.parametrize("name", [MANIFEST, ARRAYS])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(ConfigurationError, match="cannot be read: No such file") as error:
        load(folder)
    assert str(folder / name) in str(error.value)
    assert RETRAIN in str(error.value)


@pytest.mark.parametrize("text", ["", "[1]", "{"])
def test_a_broken_manifest_is_named(folder, text):
    (folder / MANIFEST).write_text(text)
    with pytest.raises(ConfigurationError, match=MANIFEST) as error:
        load(folder)
    assert RETRAIN in str(error.value)


def test_another_format_is_refused_with_the_command_to_train_again(folder):
    changed(folder / MANIFEST, format=artefacts.FORMAT + 1)
    with pytest.raises(ConfigurationError, match=f"format {artefacts.FORMAT + 1}") as error:
        load(folder)
    assert RETRAIN in str(error.value)


def test_objects_of_another_library_are_refused_and_arrays_are_not(folder):
    versions = read_manifest(folder)["versions"]
    changed(folder / MANIFEST, versions=versions | {"scikit-learn": "0.1.0"})
    with pytest.raises(ConfigurationError, match=r"trained with scikit-learn 0\.1\.0") as error:
        load_objects(folder)
    assert RETRAIN in str(error.value)
    assert isinstance(load(folder), LearnedModels)


def test_what_is_shipped_is_whole_small_and_described():
    models = load(SHIPPED)
    assert set(models.corrections) == {"fopdt", "sopdt_overdamped", "sopdt_underdamped", "integrating"}
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 5_000_000
    manifest = read_manifest(SHIPPED)
    assert manifest["experiments"] >= 200_000
    card = (SHIPPED / "model-card.md").read_text()
    assert str(manifest["experiments"]) in card
    assert manifest["data_sha256"] in card


@pytest.fixture
def fresh():
    """The registry of trained corrections, asked anew before and after."""
    registry.learned_models.cache_clear()
    yield registry.learned_models
    registry.learned_models.cache_clear()


def test_the_tuner_finds_what_is_shipped(fresh):
    assert isinstance(fresh(), LearnedModels)


def test_a_folder_of_ones_own_comes_first(fresh, folder, monkeypatch):
    monkeypatch.setenv(registry.ARTEFACTS, str(folder))
    assert fresh().about["seed"] == 3


def test_without_it_there_is_a_sentence_instead(fresh, tmp_path, monkeypatch):
    monkeypatch.setenv(registry.ARTEFACTS, str(tmp_path / "nowhere"))
    reason = fresh()
    assert isinstance(reason, str)
    assert "nowhere" in reason
    assert RETRAIN in reason
