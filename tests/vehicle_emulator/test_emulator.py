import math
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC, CatalogueError, load
from dbc.e2e import E2EReceiver, E2EStatus
from dbc.frame import CanFrame
from dbc.vehicle import load_vehicle
from tests.vehicle_emulator.gateway_stub import GatewayStub
from vehicle_emulator.emulator import STEP_NS, Emulator, EmulatorSetup, GroundTruth, PlantLost, StartPose
from vehicle_emulator.faults.spec import parse_faults
from vehicle_emulator.road import RoadDescription

CATALOGUE = load()
VEHICLE = load_vehicle()
OWN = {spec.name: spec for spec in CATALOGUE.by_name.values() if spec.sender != "GW" and spec.cycle_time_ns > 0}
MOVING = StartPose(speed_mps=22.2)


def emulator(start: StartPose = MOVING, seed: int = 1, start_ns: int = 0, **setup) -> Emulator:
    faults = parse_faults(setup.pop("faults", []))
    return Emulator(EmulatorSetup(VEHICLE, start, seed=seed, faults=faults, **setup), CATALOGUE, start_ns)


def run(car: Emulator, milliseconds: int, frames_at=lambda _: (), start_ns: int = 0) -> list[CanFrame]:
    sent: list[CanFrame] = []
    for k in range(1, milliseconds + 1):
        sent += car.step(start_ns + k * STEP_NS, frames_at(k))
    return sent


class Gateway(GatewayStub):
    """Arms, engages after 200 ms and commands from 300 ms on, every 10 ms."""

    def __init__(self, car: Emulator) -> None:
        super().__init__(CATALOGUE, lambda: car._robots.watchdog_question)

    def __call__(self, k: int) -> list[CanFrame]:
        if k % 10:
            return []
        request = "Disarm" if k < 100 else "Arm" if k < 200 else "Engage"
        return self.frames(request, sr_deg=15.0, ar_percent=20.0) if k >= 300 else self.frames(request)


def test_sends_every_message_of_the_car_exactly_at_its_cycle_time():
    start_ns = 5_000_000_007
    times: dict[int, list[int]] = defaultdict(list)
    for frame in run(emulator(start_ns=start_ns), 400, start_ns=start_ns):
        times[frame.arbitration_id].append(frame.t_ns)
    assert set(times) == {spec.arbitration_id for spec in OWN.values()}
    for spec in OWN.values():
        stamps = times[spec.arbitration_id]
        assert {b - a for a, b in pairwise(stamps)} == {spec.cycle_time_ns}, spec.name
        assert len(stamps) == 400 * STEP_NS // spec.cycle_time_ns, spec.name


def test_one_status_channel_of_the_navigation_system_per_cycle():
    status_ids = {spec.arbitration_id for name, spec in OWN.items() if name.startswith("NcomStatus")}
    sent = [frame for frame in run(emulator(), 400) if frame.arbitration_id in status_ids]
    stamps = [frame.t_ns for frame in sent]
    assert len(set(stamps)) == len(stamps)
    assert {b - a for a, b in pairwise(stamps)} == {10 * STEP_NS}


def test_a_stall_of_the_caller_brings_no_burst():
    car = emulator()
    run(car, 100)
    late = car.step(1_000 * STEP_NS, ())
    assert len({frame.arbitration_id for frame in late}) == len(late)
    assert car.step(1_001 * STEP_NS, ()) == []


def test_frames_carry_good_end_to_end_protection_and_decode():
    receivers = {spec.arbitration_id: E2EReceiver(spec.e2e_data_id) for spec in OWN.values() if spec.e2e_data_id is not None}
    judged = 0
    car = emulator()
    for frame in run(car, 300, Gateway(car)):
        CATALOGUE.decode(CATALOGUE.by_id[frame.arbitration_id], frame)
        if (receiver := receivers.get(frame.arbitration_id)) is not None:
            assert receiver.check(frame.data) in (E2EStatus.INITIAL, E2EStatus.OK)
            judged += 1
    assert judged == 4 * 30


def test_same_seed_and_frames_give_the_same_bytes():
    def record(seed: int) -> list[CanFrame]:
        car = emulator(seed=seed)
        return run(car, 1000, Gateway(car))

    first = record(3)
    assert first == record(3)
    assert first != record(4)


def test_follows_the_gateway():
    car = emulator()
    run(car, 1500, Gateway(car))
    truth = car.truth()
    assert truth.are_robots_engaged
    assert math.degrees(truth.sr_angle_rad) == pytest.approx(15.0, abs=0.3)  # half the lash of the robot, and its encoder
    assert truth.ar_position_norm == pytest.approx(0.2, abs=1e-3)
    assert truth.state.yaw_rate_radps > 0.05
    assert truth.state.y_m > 0.5


def test_what_the_bus_says_is_the_truth_of_a_moment_ago():
    car = emulator()
    past: list[tuple[float, float]] = []
    navigation = CATALOGUE.by_name["PosLocal"]
    gateway = Gateway(car)
    for k in range(1, 1501):
        frames = car.step(k * STEP_NS, gateway(k))
        past.append((car.truth().state.x_m, car.truth().state.y_m))
    last = next(frame for frame in frames if frame.arbitration_id == navigation.arbitration_id)
    position = CATALOGUE.decode(navigation, last)
    x_m, y_m = past[-1 - math.ceil(1e3 * VEHICLE.ins.latency_s)]
    assert math.hypot(position["PosLocalX"] - x_m, position["PosLocalY"] - y_m) < 0.06
    status = OWN["SR_Status"]
    steering = CATALOGUE.decode(status, next(frame for frame in frames if frame.arbitration_id == status.arbitration_id))
    assert math.radians(steering["AngleActual"]) == pytest.approx(car.truth().sr_angle_rad, abs=math.radians(0.026))


def test_safety_driver_holds_speed_and_line_until_the_first_engagement():
    car = emulator(StartPose(x_m=3.0, y_m=2.0, yaw_rad=0.5, speed_mps=22.2))
    run(car, 5000)
    truth = car.truth()
    assert truth.state.vx_mps == pytest.approx(22.2, abs=0.1)
    assert truth.state.x_m - 3.0 == pytest.approx(5.0 * 22.2 * math.cos(0.5), rel=0.03)
    assert (truth.state.y_m - 2.0) / (truth.state.x_m - 3.0) == pytest.approx(math.tan(0.5))
    assert truth.ar_position_norm == 0.0  # it is the driver's foot
    assert not truth.are_robots_engaged


def test_a_car_that_starts_at_rest_stays_at_rest():
    car = emulator(StartPose(x_m=1.0))
    run(car, 1000)
    state = car.truth().state
    assert (state.x_m, state.y_m) == (pytest.approx(1.0, abs=1e-3), pytest.approx(0.0, abs=1e-4))  # the creep bends brakes and tyres
    assert abs(state.vx_mps) < 1e-3


def test_stops_by_itself_when_the_gateway_dies():
    car = emulator()
    gateway = Gateway(car)
    run(car, 12_000, lambda k: gateway(k) if k < 1000 else ())
    truth = car.truth()
    assert abs(truth.state.vx_mps) < 1e-2
    assert not truth.are_robots_engaged
    assert truth.br_position_norm > 0.2


junk = st.one_of(
    st.builds(CanFrame, st.sampled_from(sorted(CATALOGUE.by_id)), st.binary(max_size=8), st.just(0)),
    st.builds(CanFrame, st.integers(0, 0x7FF), st.binary(max_size=8), st.just(0)),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(junk, max_size=6), max_size=40))
def test_junk_on_the_bus_moves_nothing_and_raises_nothing(ticks: list[list[CanFrame]]):
    car = emulator()
    for k, frames in enumerate(ticks, start=1):
        car.step(k * STEP_NS, frames)
        truth = car.truth()
        assert abs(truth.sr_angle_rad) < 1e-6
        assert (truth.ar_position_norm, truth.br_position_norm) == (0.0, 0.0)
        assert not truth.are_robots_engaged


def test_without_engagement_commands_move_nothing():
    car = emulator()
    stub = GatewayStub(CATALOGUE, lambda: car._robots.watchdog_question)
    for request in ("None", "Disarm", "ControlledStop", "ClearFaults", "Arm"):
        run(car, 100, lambda k, request=request: stub.frames(request, sr_deg=90.0, ar_percent=50.0, br_percent=50.0) if k % 10 == 0 else ())
    truth = car.truth()
    assert abs(truth.sr_angle_rad) < 1e-6
    assert (truth.ar_position_norm, truth.br_position_norm) == (0.0, 0.0)


def test_a_dbc_that_does_not_fit_is_refused_with_one_line(tmp_path: Path):
    with pytest.raises(CatalogueError, match=r"robots\.dbc: no message .*PosLocal.*, which the emulator needs"):
        Emulator(EmulatorSetup(VEHICLE, MOVING), load([ROBOTS_DBC]), 0)
    foreign = tmp_path / "foreign.dbc"
    foreign.write_text('VERSION ""\nBU_: GW ESC\nBO_ 99 WheelSpeeds: 8 ESC\n SG_ FrontLeft : 0|16@1+ (0.01,0) [0|655] "" GW\n')
    with pytest.raises(CatalogueError, match=r"foreign\.dbc: message WheelSpeeds, which the emulator cannot fill"):
        Emulator(EmulatorSetup(VEHICLE, MOVING), load([ROBOTS_DBC, GNSS_IMU_DBC, foreign]), 0)
    silent = tmp_path / "robots.dbc"
    silent.write_text(ROBOTS_DBC.read_text().replace('"GenMsgCycleTime" BO_ 528 10', '"GenMsgCycleTime" BO_ 528 0'))
    with pytest.raises(CatalogueError, match="message SR_Status: no GenMsgCycleTime"):
        Emulator(EmulatorSetup(VEHICLE, MOVING), load([silent, GNSS_IMU_DBC]), 0)


@pytest.mark.parametrize("climb", [12.0, -12.0])
def test_the_safety_driver_holds_a_standing_car_on_a_slope(climb: float):
    car = emulator(StartPose(), road=RoadDescription(grade_percent=climb))
    run(car, 1500)
    before = car.truth().state
    run(car, 3000, start_ns=1500 * STEP_NS)
    state = car.truth().state
    assert math.hypot(before.x_m, before.y_m) < 3e-3  # brakes and tyres give way
    assert math.hypot(state.x_m - before.x_m, state.y_m - before.y_m) < 3e-4
    assert state.pitch_rad == pytest.approx(-math.atan(0.01 * climb), abs=0.02)


def test_faults_reach_the_part_that_they_are_about():
    at_once = {"from_s": 0.0}
    gust = {"name": "gust", "kind": "gust", "push_n": 4000.0, **at_once}
    ice = {"name": "ice", "kind": "friction", "factor": 0.05, **at_once}
    silence = {"name": "ins", "kind": "ins_dropout", **at_once}
    stuck = {"name": "stuck", "kind": "robot_stuck", "robot": "SR", **at_once}
    released = {"name": "dead man", "kind": "dead_man_released", "from_s": 1.2}
    pushed, gone = emulator(faults=[gust]), emulator(faults=[silence])
    run(pushed, 1000)
    assert pushed.truth().state.y_m > 0.5
    assert {CATALOGUE.by_id[frame.arbitration_id].sender for frame in run(gone, 100)} == {"SR", "AR", "BR", "RC", "CAR"}
    held, slippery, stopped = emulator(faults=[stuck]), emulator(faults=[ice]), emulator(faults=[released])
    for car in (held, slippery, stopped):
        run(car, 1500, Gateway(car))
    assert abs(held.truth().sr_angle_rad) < 0.01
    assert slippery.truth().state.yaw_rate_radps < 0.03
    assert not stopped.truth().are_robots_engaged
    assert [event.event for event in stopped.faults.take_events()] == ["begins"]


def test_frames_of_both_directions_pass_the_faults():
    lost = {"name": "lost", "kind": "drop", "messages": "SR_Command", "from_s": 0.0}
    deaf = emulator(faults=[lost])
    run(deaf, 1500, Gateway(deaf))
    assert not deaf.truth().are_robots_engaged
    assert deaf.faults.faults[0].hits > 100


def test_on_the_lift_the_bench_turns_and_the_virtual_car_drives():
    car, start = emulator(is_lifted=True), StartPose()
    run(car, 1500, Gateway(car))
    truth = car.truth()
    assert truth.is_lifted
    assert math.degrees(truth.sr_angle_rad) == pytest.approx(15.0, abs=0.3)  # half the lash of the robot, and its encoder
    assert truth.state.yaw_rate_radps > 0.05
    assert truth.state.x_m - start.x_m > 25.0
    front, rear = truth.state.wheel_speeds_radps[:2], truth.state.wheel_speeds_radps[2:]
    assert min(front) > 1.0 > max(map(abs, rear))  # nothing drives the rear wheels in the air
    assert max(truth.state.wheel_loads_n) == 0.0


def test_a_car_that_is_disarmed_does_not_creep_away_and_is_handed_over_to_the_robots_again():
    car = emulator(StartPose())
    gateway = GatewayStub(CATALOGUE, lambda: car._robots.watchdog_question)
    now = 0

    def ask(milliseconds: int, request: str, **commands: float) -> GroundTruth:
        nonlocal now
        run(car, milliseconds, lambda k: gateway.frames(request, **commands) if k % 10 == 0 else (), now)
        now += milliseconds * STEP_NS
        return car.truth()

    for request in ("Disarm", "Arm"):
        ask(150, request)
    assert ask(3000, "Engage", ar_percent=30.0).state.vx_mps > 2.0
    for request in ("Disarm", "Arm"):
        held = ask(15_000, request).state
        assert car.inputs.brake_norm == 0.3
        assert abs(held.vx_mps) < 1e-3
    again = ask(2000, "Engage", ar_percent=20.0)
    assert again.are_robots_engaged
    assert again.ar_position_norm == pytest.approx(0.2, abs=0.01)  # nobody has taken over
    assert again.state.vx_mps > 1.0
    assert car.inputs.brake_norm == 0.0


def test_a_car_that_flies_apart_is_one_line():
    axle = VEHICLE.multibody.front.model_copy(update={"spring_npm": 1e10})
    vehicle = VEHICLE.model_copy(update={"multibody": VEHICLE.multibody.model_copy(update={"front": axle})})
    with pytest.raises(PlantLost, match=r"^vehicle focus: the emulated car has no finite state any more; its numbers do not make a car$"):
        run(Emulator(EmulatorSetup(vehicle), CATALOGUE, 0), 200)
