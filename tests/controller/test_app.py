"""The process: it answers a gateway's states over real sockets, and ends when told to."""

import socket
import threading
import time

import pytest

from controller.app import ControllerOptions, run
from controller.reference import ReferencePathError
from dbc.vehicle import FOCUS
from gateway.channel import Channel
from gateway.messages import CommandStatus, ControlCommand, Mode, VehicleState


@pytest.fixture
def options(tmp_path, wavy_path, library):
    wavy_path.to_csv(tmp_path / "path.csv")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return ControllerOptions(tmp_path / "path.csv", FOCUS, str(tmp_path / "gateway"), str(tmp_path / "controller"), "casadi-c", port)


def test_states_are_answered_until_told_to_stop(options, wavy_path):
    stop = threading.Event()
    thread = threading.Thread(target=run, args=(options, stop), daemon=True)
    commands: list[ControlCommand] = []
    with Channel(options.gateway_socket, options.controller_socket) as gateway:
        thread.start()
        deadline_s = time.monotonic() + 60.0
        while len(commands) < 5 and time.monotonic() < deadline_s:
            seq = len(commands) + 1
            gateway.send(
                VehicleState(1, seq, time.monotonic_ns(), Mode.READY, True, float(wavy_path.x_m[5]), float(wavy_path.y_m[5]),
                             float(wavy_path.yaw_rad[5]), 60 / 3.6, 0.0, 0.0, 0.0, 0.0, 0.1)
            )  # fmt: skip
            time.sleep(0.01)
            if (command := gateway.newest(ControlCommand)) is not None:
                commands.append(command)
        stop.set()
        thread.join(timeout=10.0)
    assert not thread.is_alive()
    assert len(commands) == 5
    assert CommandStatus.OK in {command.status for command in commands}
    assert len({command.boot_id for command in commands}) == 1
    assert [command.seq for command in commands] == sorted({command.seq for command in commands})
    assert all(command.solve_time_ns > 0 for command in commands if command.status is CommandStatus.OK)


def test_a_missing_path_is_the_users_mistake(options, tmp_path):
    (tmp_path / "path.csv").unlink()
    with pytest.raises(ReferencePathError, match=r"path\.csv"):
        run(options, threading.Event())
