"""The terminal view: what the table and the line say."""

import io
import re
import threading
import time

import pytest
from rich.console import Console

from tests.support.processes import free_base_port
from tests.visualiser.feeder import Feeder, running
from tests.visualiser.test_board import encoded
from visualiser.board import Board
from visualiser.watch import WatchOptions, line, run, table

MS = 1_000_000
TOPICS = ("state", "status", "command", "plan", "profile", "parameters", "world", "faults", "scene", "objects")


def full_board(**status: object) -> Board:
    board = Board()
    for topic in TOPICS:
        board.accept(topic, encoded(topic, 0, **(status if topic == "status" else {})), 0)
    return board


def shown(board: Board, now_ns: int) -> str:
    console = Console(width=120, file=io.StringIO(), record=True)
    console.print(table(board, now_ns))
    return console.export_text()


def row(text: str, name: str) -> str:
    return next(one for one in text.splitlines() if one.startswith(name)).rstrip()


def test_the_table_says_mode_motion_solver_counters_and_ages() -> None:
    text = shown(full_board(frames_rejected={"crc": 3, "counter": 1}), 20 * MS)
    assert text.startswith(" ENGAGED ")
    assert "iso3888-1 at stage hil" in text
    assert row(text, "Reason").endswith("the operator has engaged")
    assert row(text, "Speed").split()[1:] == ["80.0", "km/h"]
    assert "casadi-c" in row(text, "Solver")
    assert "of 40 ms" in row(text, "Solver")
    assert "3 SQP, 5 QP iterations" in row(text, "Solver")
    assert row(text, "Disturbance").split()[1:] == ["+0.12", "m/s²"]
    assert row(text, "Objects").split()[1:] == ["1", "considered"]
    assert row(text, "Parameters").split()[1:] == ["version", "2"]
    assert row(text, "Profile").split()[1:] == ["qp", "640", "hessian", "702", "µs", "per", "cycle"]
    assert row(text, "Command   ").split() == ["Command", "OK"]
    assert "4 rejected" in row(text, "Frames")
    assert row(text, "Age plan").split() == ["Age", "plan", "20", "ms", "1", "samples"]


def test_a_lost_link_is_never_shown_as_the_mode_it_had() -> None:
    text = shown(full_board(), 501 * MS)
    assert text.startswith(" NO LINK, last ENGAGED ")
    assert "LOST" in row(text, "Age state")
    assert "LOST" not in row(text, "Age scene")


def test_an_empty_board_says_so() -> None:
    text = shown(Board(), 0)
    assert text.startswith(" NO LINK ")
    assert all("not seen" in row(text, f"Age {topic}") for topic in TOPICS)


def test_the_line_says_the_same_in_short() -> None:
    text = line(full_board(), 20 * MS)
    assert text.startswith("ENGAGED  80.0 km/h x -15.56 m y ")
    assert "command OK solve " in text
    assert "lost" not in text
    assert line(full_board(), 600 * MS).endswith("lost: state, status, command, plan, profile, world, objects")


def test_without_a_terminal_it_prints_lines(capsys: pytest.CaptureFixture[str]) -> None:
    base_port, stop = free_base_port(), threading.Event()
    text = ""
    with running(threading.Thread(target=run, args=(WatchOptions(base_port), stop)), stop), Feeder(base_port):
        deadline = time.monotonic() + 20.0
        while "ENGAGED  " not in text and time.monotonic() < deadline:
            time.sleep(0.2)
            text += capsys.readouterr().out
    assert re.search(r"^ENGAGED  (80\.0|79\.\d) km/h x -?\d+\.\d\d m ", text, re.MULTILINE)
    assert "\x1b" not in text
