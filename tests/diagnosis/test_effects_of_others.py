"""Physics from another package: the example of the documentation, installed, checked, and found on a record."""

import importlib
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotuner import Recording, diagnose
from autotuner.core.diagnosis.findings.controller_view import controller_view
from autotuner.core.diagnosis.findings.result import FoundEffect
from autotuner.core.effect_plugins import installed_effects
from autotuner.core.model.process import Fopdt
from autotuner.effects import EffectPlugin, check_effect
from autotuner.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("without_gains")

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "add-your-own-physics.md"
SHARE, LATER_S = 0.4, 45.0


@pytest.fixture
def announce(tmp_path, monkeypatch):
    """Install a module with an entry point, as an installer would."""

    def install(source, target="my_physics:plugin"):
        (tmp_path / "my_physics.py").write_text(source, encoding="utf-8")
        info = tmp_path / "my_physics-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-physics\nVersion: 1.0\n", encoding="utf-8")
        (info / "entry_points.txt").write_text(f"[autotuner.effects]\nsecond_pass = {target}\n", encoding="utf-8")
        monkeypatch.syspath_prepend(str(tmp_path))
        importlib.invalidate_caches()
        installed_effects.cache_clear()

    yield install
    sys.modules.pop("my_physics", None)
    installed_effects.cache_clear()


def example():
    return re.search(r"```python\n(\"\"\"my_physics.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)


def with_second_pass(share=SHARE):
    """A lag of 15 s with dead time 4 s, whose answer comes back 45 s later; by Euler's method in steps of 0.1 s."""
    random = np.random.default_rng(6)
    output = 40.0 + np.repeat(random.choice([-8.0, 0.0, 8.0], 40), 20)
    output[:20] = 40.0
    fine, h = np.repeat(output - 40.0, 10), 0.1
    w, x = np.zeros(fine.size), 0.0
    for k in range(1, fine.size):
        x += h / 15.0 * (fine[max(k - 41, 0)] - x)
        w[k] = x
    late = np.concatenate((np.zeros(int(LATER_S / h)), w))[: w.size]
    pv = 60.0 + (1.5 * (w + share * late))[::10] + random.normal(0.0, 0.05, output.size)
    return Recording(np.arange(float(output.size)), output, pv)


def test_the_example_of_the_page_conforms_and_is_found(announce, among):
    among("second_pass", "recycle", "slow_mode", "extra_lag", "inverse_response")
    announce(example())
    plugin = installed_effects()["second_pass"]
    assert check_effect(plugin) == []
    found = diagnose(with_second_pass())
    assert found.verdict == "explained", found.summary
    assert [effect.name for effect in found.effects] == ["second_pass"]
    sizes = found.effects[0].parameters
    assert sizes["share"] == pytest.approx(SHARE, rel=0.05)
    assert sizes["later_s"] == pytest.approx(LATER_S, abs=1.0)
    assert pytest.approx(1.5, rel=0.03) == found.process.K
    assert "40% of the heat comes back" in found.effects[0].advice


def test_without_the_package_nothing_has_that_name():
    assert "second_pass" not in installed_effects()


def test_a_controller_meets_the_process_as_the_plug_in_says(announce):
    announce(
        example() + "\nfrom dataclasses import replace\nplugin = replace(plugin, controller_view=lambda process, sizes:"
        ' replace(process, K=process.K * (1.0 + sizes["share"])))\n'
    )
    effect = FoundEffect("second_pass", "process", {"share": 0.5, "later_s": 45.0}, {}, 0.9)
    met = controller_view(Fopdt(2.0, 10.0, 1.0), np.eye(3), (effect,))
    assert met.model == Fopdt(3.0, 10.0, 1.0)


@pytest.mark.parametrize(
    ("source", "word"), [("plugin = 3\n", "not an EffectPlugin"), ("raise OSError('no licence')\n", "no licence")]
)
def test_a_plug_in_that_cannot_be_used_is_named(announce, source, word):
    announce(source)
    with pytest.raises(ConfigurationError, match=word) as refused:
        installed_effects()
    assert "autotuner.effects.second_pass" in str(refused.value)


def test_the_kit_says_what_is_wrong(announce):
    announce(example())
    plugin = installed_effects()["second_pass"]

    def changed(**fields):
        return replace(plugin, make=lambda dataset, base: [replace(e, **fields) for e in plugin.make(dataset, base)])

    def with_other_form(dataset, base):
        return [replace(e, other_forms=(replace(e, name="other"),)) for e in plugin.make(dataset, base)]

    def wrong(plugin: EffectPlugin):
        return " ".join(check_effect(plugin))

    assert "named other" in wrong(changed(name="other"))
    assert "named other" in wrong(replace(plugin, make=with_other_form))
    assert "outside of the bounds" in wrong(changed(starts=[(0.9,)]))
    assert "one value for each" in wrong(changed(starts=[(0.1, 0.2)]))
    assert "not finite" in wrong(changed(sizes=lambda *_: {"share": float("nan")}))
    assert "changes nothing" in wrong(changed(columns=None))
    assert "cannot be written" in wrong(replace(plugin, advice="{unknown}"))
    assert "catalogue has" in wrong(replace(changed(name="backlash"), name="backlash"))
    assert "not at rest" in wrong(replace(plugin, element=lambda _: lambda u: u + 1.0))
    assert "no form" in wrong(replace(plugin, make=lambda *_: []))
