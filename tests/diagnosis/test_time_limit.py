"""A limit on the time of a search: what is known until then is a hypothesis. The clock is a count of questions."""

from itertools import count

import numpy as np
import pytest

import autotuner
from autotuner import Recording
from autotuner.application.analysis import diagnosis
from autotuner.core.diagnosis import diagnose
from autotuner.errors import InputError

pytestmark = pytest.mark.usefixtures("without_gains")


def with_play(width, until=400):
    """Return a lag of 8 s, 2 s late, behind a play, by Euler's method in steps of 0.05 s."""
    t = np.arange(until, dtype=float)
    output = 40.0 + 8.0 * np.sign(np.sin(t / 17.0)) * (t > 15.0) * (0.5 + 0.5 * ((t // 60.0) % 2.0))
    x, v, late, pv = 40.0, 0.0, [40.0] * 40, []
    for u in output.tolist():
        pv.append(v)
        for _ in range(20):
            x = min(max(x, u - width / 2.0), u + width / 2.0)
            late.append(x)
            v += 0.05 / 8.0 * (1.5 * (late[-41] - 40.0) - v)
    return Recording(t, output, 60.0 + np.array(pv) + np.random.default_rng(3).normal(0.0, 0.05, until))


def after(questions):
    """Return a limit that is spent after so many questions."""
    asked = count()
    return lambda: next(asked) >= questions


@pytest.mark.long  # the play is in test_effects_are_named
def test_without_a_limit_the_play_explains_the_record_and_the_reader_hears_of_it():
    heard = []
    answer = diagnose(with_play(2.0), on_progress=heard.append)
    assert (answer.verdict, [effect.name for effect in answer.effects]) == ("explained", ["backlash"])
    assert heard
    assert all("times the noise" in sentence for sentence in heard)


@pytest.mark.one_of(2)
@pytest.mark.parametrize("questions", [0, 30])
def test_a_search_that_is_cut_ends_in_unexplained_with_the_best_so_far(questions):
    answer = diagnose(with_play(2.0), is_spent=after(questions))
    assert answer.verdict == "unexplained"
    assert any("time limit" in note for note in answer.notes)
    assert answer.summary.startswith("the time limit ended the search")
    assert answer.model["after"] == answer.model["before"]
    assert all(effect.confidence <= 0.5 for effect in answer.effects)


def test_a_record_that_the_process_alone_explains_needs_no_search():
    assert diagnose(with_play(0.0), is_spent=after(0)).verdict == "adequate"


def test_a_limit_is_a_time():
    with pytest.raises(InputError, match="time_limit_s"):
        autotuner.diagnose(with_play(0.0), time_limit_s=0.0)
    assert autotuner.diagnose(with_play(0.0), time_limit_s=1e-6).verdict == "adequate"


def test_without_a_limit_a_search_ends_after_so_much_processor_time(monkeypatch):
    limits_ms = []

    def spent_at_once(limit_ms):
        limits_ms.append(limit_ms)
        return lambda: True

    monkeypatch.setattr(diagnosis, "processor_time_spent", spent_at_once)
    assert autotuner.diagnose(with_play(2.0)).verdict == "unexplained"
    assert limits_ms == [60_000.0]
