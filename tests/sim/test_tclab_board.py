"""The TCLab board: every command as its firmware answers it."""

import math
import struct

import pytest

from autotuner_sim.coupled import coupled_plants
from autotuner_sim.devices.tclab_board import TclabBoard
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant


@pytest.fixture
def plant():
    return SteppedPlant(Fopdt(2.0, 10.0, 1.5), pv0=23.154)


@pytest.fixture
def board(plant):
    return TclabBoard(plant)


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        (b"T1\n", b"23.154\r\n"),
        (b"t1\r\n", b"23.154\r\n"),
        (b"T2\n", b"23.154\r\n"),
        (b"Q1 40.5\n", b"40.500\r\n"),
        (b"Q1 140\n", b"100.000\r\n"),
        (b"Q1 -3\n", b"0.000\r\n"),
        (b"Q1 ten\n", b"0.000\r\n"),
        (b"Q2 7\n", b"7.000\r\n"),
        (b"R1\n", b"0.000\r\n"),
        (b"P1 300\n", b"255.00\r\n"),
        (b"LED 50\n", b"50.00\r\n"),
        (b"VER\n", b"TCLab Firmware 2.0.1 Arduino Uno\r\n"),
        (b"A\n", b"Start\r\n"),
        (b"X\n", b"Stop\r\n"),
        (b"s1 5\n", b"S1\r\n"),
        (b"T1\nT2\n", b"23.154\r\n23.154\r\n"),
        (b"T1B\n", struct.pack("<f", 23.154)),
        (b"SCAN\n", b"23.154\r\n23.154\r\n0.000\r\n0.000\r\n"),
        (b"\r\n\n", b""),
        (b"T1", b""),
    ],
)
def test_answers(board, command, answer):
    assert board.receive(command) == answer


def test_a_command_may_come_in_pieces(board):
    assert board.receive(b"Q1 4") == b""
    assert board.receive(b"0\n") == b"40.000\r\n"


def test_heater_1_warms_the_plant(board, plant):
    board.receive(b"Q1 40\n")
    board.advance(11.5)
    assert plant.pv == pytest.approx(23.154 + 80.0 * (1.0 - math.exp(-1.0)))
    assert board.receive(b"R1\n") == b"40.000\r\n"


def test_the_duty_scales_the_heater(board, plant):
    board.receive(b"Q1 40\nP1 100\n")
    assert plant.output == 20.0


@pytest.mark.parametrize("command", [b"S1\n", b"A\n", b"X\n", b"T1T2\n"])
def test_what_switches_the_heaters_off(board, plant, command):
    board.receive(b"Q1 40\nQ2 30\n")
    board.receive(command)
    assert plant.output == 0.0
    assert board.receive(b"R1\nR2\n") == b"0.000\r\n0.000\r\n"


def test_the_firmware_s_own_fault_is_kept(board, plant):
    assert board.receive(b"Q2B 25\n") == struct.pack("<f", 25.0)
    assert plant.output == 25.0


def test_opening_the_port_resets_the_board(board, plant):
    board.receive(b"Q1 40\nT1")
    board.advance(5.0)
    board.reset()
    assert plant.output == 0.0
    board.advance(6.9)
    assert board.receive(b"T1\n") == b""
    board.advance(7.0)
    assert board.receive(b"R1\n") == b"0.000\r\n"


def test_nobody_watches_over_a_silent_master(board, plant):
    board.receive(b"Q1 40\n")
    board.advance(36000.0)
    assert plant.output == 40.0


def test_the_sensor_ends():
    hot = TclabBoard(SteppedPlant(Fopdt(2.0, 10.0, 1.5), pv0=1000.0))
    assert hot.receive(b"T1\n") == b"279.000\r\n"


def test_each_of_two_heaters_warms_both():
    first, second = coupled_plants(pv0=(23.0, 23.0), limits=(0.0, 100.0))
    board = TclabBoard(first, second)
    board.advance(2.5)
    board.receive(b"Q2 50\n")
    board.advance(5000.0)
    temperatures = [float(board.receive(command)) for command in (b"T1\n", b"T2\n")]
    assert temperatures == pytest.approx([23.0 + 0.25 * 50.0, 23.0 + 0.55 * 50.0], abs=0.01)
    assert board.receive(b"P2 50\n") == b"50.00\r\n"
    assert second.output == 25.0
