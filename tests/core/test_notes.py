"""Warnings ask for action, notes do not: how they are parted, and which of a model's misses is which."""

import pickle

import pytest

from autotuner.core.identification.held_out import HeldOut
from autotuner.core.notes import Doubt, Note, notes_among, settled, warnings_among

MESSAGES = ("raise the amplitude", Note("K and T cannot be separated"), "the sensor repeats itself")


def test_messages_are_parted_in_their_order():
    assert warnings_among(MESSAGES) == ["raise the amplitude", "the sensor repeats itself"]
    assert notes_among(MESSAGES) == ["K and T cannot be separated"]


def test_a_note_is_still_one_on_the_other_side_of_a_socket():
    assert notes_among(pickle.loads(pickle.dumps(MESSAGES))) == notes_among(MESSAGES)  # noqa: S301 - our own bytes


def test_where_the_gains_hold_only_what_was_doubted_becomes_a_note():
    messages = (*MESSAGES, Doubt("the model misses the tail"))
    assert warnings_among(messages) == ["raise the amplitude", "the sensor repeats itself", "the model misses the tail"]
    assert warnings_among(settled(messages)) == ["raise the amplitude", "the sensor repeats itself"]


@pytest.mark.parametrize(("motion", "is_a_note"), [(0.0, False), (1.0, False), (10.0, True)])
def test_a_miss_that_is_small_beside_the_motion_of_the_pv_is_a_note(motion, is_a_note):
    """0.2 missed with noise of 0.01: of a motion of 10 that is 2 %, of 1 it is 20 %."""
    missed = HeldOut(0.01, 0.2, 0.01, motion).warning
    assert missed is not None
    assert isinstance(missed, Note) is is_a_note
    assert HeldOut(0.01, 0.01, 0.01, motion).warning is None


@pytest.mark.parametrize(
    ("fitted", "held_out", "is_small"),
    [(0.014, 0.014, True), (0.016, 0.014, False), (0.014, 0.016, False), (0.3, 0.01, False)],
)
def test_misses_of_both_parts_within_half_again_of_the_noise_are_small(fitted, held_out, is_small):
    """Noise of 0.01 and a motion of 0.1, of which 5 % are less than what 0.014 is beyond the noise."""
    assert HeldOut(fitted, held_out, 0.01, 0.1).is_small_throughout is is_small


def test_a_miss_of_little_motion_is_small_whatever_the_noise():
    assert HeldOut(0.049, 0.049, 0.001, 1.0).is_small_throughout
    assert not HeldOut(0.051, 0.049, 0.001, 1.0).is_small_throughout
