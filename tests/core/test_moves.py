"""Turns of the output, counted by hand."""

import pytest

from autotuner.core.signals.output_reversals import Moves

ROWS = {  # outputs, rows at which a turn is seen, longest time between two turns
    "relay": ([40, 40, 50, 50, 50, 30, 30, 50], [2, 5, 7], 3.0),
    "ramp": ([40, 40, 42, 44, 46, 44, 42, 40], [2, 5], 3.0),
    "staircase": ([40, 45, 45, 50, 45, 45, 40], [1, 4], 3.0),
    "rounding": ([40, 40, 50.0, 49.9, 50.1, 30.0, 30.1, 50.0], [2, 5, 7], 3.0),
    "controller beside it": ([40, 40, 50, 48, 49, 47, 30, 32, 31, 33, 50], [2, 6, 10], 4.0),
    "fine ramp": ([40, 41, 42, 43, 44, 45, 44, 43, 42, 41, 40], [1, 7], 5.0),
    "rest": ([40] * 8, [], 0.0),
}


@pytest.mark.parametrize("row", ROWS)
def test_turns_and_their_times(row):
    outputs, turns, longest_s = ROWS[row]
    moves = Moves()
    assert [k for k, u in enumerate(outputs) if moves.step(float(k), float(u))] == turns
    assert moves.turns == len(turns)
    assert moves.longest_s == longest_s
    if turns:
        assert moves.first_s == turns[0] - 1.0
        left = {"controller beside it": 6.0, "fine ramp": 5.0, "rounding": 5.0}
        assert moves.turned_s == left.get(row, turns[-1] - 1.0)


def test_what_noise_made_of_a_controllers_output_at_rest_were_no_moves():
    moves = Moves()
    for k, output in enumerate([40.0, 40.01, 39.99, 40.01, 39.99, 53.0, 53.01, 53.0, 33.0, 33.0, 53.0]):
        moves.step(float(k), output)
    assert (moves.turns, moves.first_s, moves.longest_s) == (3, 4.0, 3.0)
