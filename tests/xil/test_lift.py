"""`xilgate lift`: a running emulator's car goes up and down when it may, and every refusal is one line."""

import threading
from contextlib import contextmanager

import can
import pytest

from dbc.catalogue import load
from dbc.errors import SetupFailure
from dbc.frame import CanFrame
from dbc.link import bus_names
from gateway.telemetry import Publisher, Source, Subscriber, decode
from tests.support.processes import free_base_port, wait_until, xilgate
from vehicle_emulator import app
from vehicle_emulator.app import EmulatorOptions
from vehicle_emulator.emulator import StartPose
from vehicle_emulator.service import SERVICE, EmulatorService
from xil import lift

CATALOGUE = load()


@contextmanager
def running(start: StartPose):
    """An emulator on a bus and on telemetry: the ports, what it tells of its world, and who listens on the bus."""
    base_port, stop, worlds = free_base_port(), threading.Event(), []
    options = EmulatorOptions(bus_names(f"virtual:lift-{base_port}"), start=start, telemetry_base_port=base_port)
    worker = threading.Thread(target=app.run, args=(options, stop))
    with can.Bus(channel=f"lift-{base_port}", interface="virtual") as listener:
        worker.start()
        try:
            with Subscriber(lambda topic, payload: worlds.append(decode(topic, payload)), ["world"], base_port):
                wait_until(lambda: worlds, 10.0, "the emulator runs")
                yield base_port, worlds, listener
        finally:
            stop.set()
            worker.join(timeout=10.0)


def command(movement: str, base_port: int):
    finished = xilgate("lift", movement, "--telemetry-port", str(base_port))
    return finished.returncode, finished.stdout, finished.stderr


def wheel_speeds(listener) -> list[dict[str, float]]:
    spec = CATALOGUE.by_name["CAR_WheelSpeeds"]
    received = [message for message in iter(lambda: listener.recv(timeout=0), None) if message.arbitration_id == spec.arbitration_id]
    return [CATALOGUE.decode(spec, CanFrame(spec.arbitration_id, bytes(message.data), 0)) for message in received]


def test_a_standing_car_goes_up_and_comes_down_where_it_was():
    with running(StartPose(x_m=7.0)) as (base_port, worlds, listener):
        assert command("raise", base_port) == (0, "the car hangs on the lift\n", "")
        wait_until(lambda: worlds[-1].is_lifted, 10.0, "the world shows the lifted car")
        assert lift.move("lower", base_port) == "the car stands on the road"
        wait_until(lambda: not worlds[-1].is_lifted, 10.0, "the world shows the car on the road")
        told = wheel_speeds(listener)
    assert max(abs(world.x_m - 7.0) for world in worlds) < 1e-3  # the safety driver holds the brake, on the lift as well
    assert told
    assert max(abs(speed) for wheels in told for speed in wheels.values()) < 0.5


def test_a_rolling_car_stays_where_it_is():
    with running(StartPose(speed_mps=5.0)) as (base_port, worlds, _):
        code, out, err = command("raise", base_port)
        assert (code, out) == (2, "")
        assert err.startswith("xilgate: the car cannot be raised: a wheel turns at 1")
        assert err.count("\n") == 1
        seen = len(worlds)
        wait_until(lambda: len(worlds) > seen, 10.0, "the world goes on")
        assert not worlds[-1].is_lifted


def test_without_an_emulator_there_is_one_line():
    code, out, err = command("lower", free_base_port())
    assert (code, out) == (3, "")
    assert err.startswith("xilgate: no emulator")
    assert err.count("\n") == 1


def test_a_movement_that_no_lift_makes_is_the_users_mistake():
    code, _, err = command("tilt", free_base_port())
    assert code == 2
    assert "'raise'" in err


def test_an_answer_of_another_version_is_told():
    base_port, stop = free_base_port(), threading.Event()
    service = EmulatorService({name: lambda _: lambda _: {"height_m": 1.8} for name in lift.OPERATIONS.values()})

    def step():
        while not stop.wait(0.001):
            service.run_due(1)

    car = threading.Thread(target=step)
    with Publisher(Source.EMULATOR, base_port) as publisher:
        publisher.serve(SERVICE, service.answer)
        car.start()
        try:
            with pytest.raises(SetupFailure, match=r"does not tell where the car is: .*is_lifted.*another version"):
                lift.move("raise", base_port)
        finally:
            stop.set()
            car.join()
