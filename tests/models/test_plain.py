"""Plain forms say what scikit-learn's objects say, and need nothing but Python."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from sklearn.ensemble import RandomForestRegressor
from sklearn.tree import DecisionTreeRegressor

from autotuner_models.learned.artefacts import ARRAYS, SHIPPED, load, load_objects
from autotuner_models.learned.draw import STRUCTURES, rows_of
from autotuner_models.learned.plain import answers, load_networks
from autotuner_models.thesis.plain_trees import answer, as_plain, load_plain, save_plain


@pytest.mark.parametrize(
    "regressor", [DecisionTreeRegressor(random_state=2), RandomForestRegressor(20, random_state=2)]
)
def test_plain_trees_answer_to_the_last_bit(regressor, tmp_path):
    rng = np.random.default_rng(0)
    X = rng.normal(size=(300, 4))
    regressor.fit(X, X[:, 0] * X[:, 1] + X[:, 2])
    save_plain(tmp_path / "trees.json", as_plain(regressor))
    trees = load_plain(tmp_path / "trees.json")
    new = np.concatenate((X, rng.normal(size=(300, 4))))
    plain = [answer(trees, row) for row in new.tolist()]
    assert plain == pytest.approx(regressor.predict(new), rel=1e-15, abs=1e-15)


def test_a_row_on_the_very_threshold_goes_the_same_way():
    """scikit-learn rounds the row to single precision; numbers a hair above a threshold still go left."""
    tree = DecisionTreeRegressor().fit([[0.0], [0.2]], [0.0, 1.0])
    threshold = tree.tree_.threshold[0]
    near = [threshold]
    for step in (-np.inf, np.inf):
        single = np.float32(threshold)
        for _ in range(3):
            near += [float(single), float(np.nextafter(np.float64(single), step))]
            above = np.nextafter(single, np.float32(step))
            middle = (float(single) + float(above)) / 2.0
            near += [middle, float(np.nextafter(middle, -np.inf)), float(np.nextafter(middle, np.inf))]
            single = above
    rows = np.array(near)[:, None]
    assert [answer(as_plain(tree), row) for row in rows.tolist()] == tree.predict(rows).tolist()


@pytest.mark.parametrize("structure", STRUCTURES)
def test_networks_say_the_same_in_all_three_forms(small, structure):
    X = rows_of(structure, 16, (8, STRUCTURES.index(structure), 0)).X
    objects = load_objects(small)[structure]
    theirs = np.stack([pipeline.predict(X) for pipeline in objects])
    assert load(small).corrections[structure].networks(X) == pytest.approx(theirs, abs=1e-9)
    plain = load_networks(small, structure)
    assert np.array([answers(plain, row) for row in X.tolist()]).swapaxes(0, 1) == pytest.approx(theirs, abs=1e-9)


def test_what_is_shipped_says_the_same_as_its_objects():
    rows = rows_of("fopdt", 64, (8, 0, 1))
    models, plain = load(SHIPPED), load_networks(SHIPPED, "fopdt")
    there = models.corrections["fopdt"].networks(rows.X)
    assert np.array([answers(plain, row) for row in rows.X.tolist()]).swapaxes(0, 1) == pytest.approx(there, abs=1e-9)


def test_plain_forms_load_no_library():
    code = (
        "import sys\n"
        "import autotuner_models.learned.plain, autotuner_models.thesis.plain_trees\n"
        "print([name for name in ('numpy', 'scipy', 'sklearn', 'joblib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_file_that_the_manifest_does_not_vouch_for_is_not_believed(small, tmp_path):
    folder = shutil.copytree(small, tmp_path / "learned")
    (folder / ARRAYS).write_bytes((folder / ARRAYS).read_bytes()[:-8])
    with pytest.raises(ValueError, match="vouches"):
        load_networks(folder, "fopdt")
