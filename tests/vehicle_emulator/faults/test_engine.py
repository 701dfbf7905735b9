"""When faults are active, what they add up to, and that runs repeat to the byte."""

import math
from random import Random

import pytest

from dbc.catalogue import load
from dbc.vehicle import load_vehicle
from vehicle_emulator.driver import Driver
from vehicle_emulator.faults import engine as engine_module
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.effects import NOTHING, Disturbance
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.instance import Fault
from vehicle_emulator.faults.spec import MAX_FAULTS, FaultMistake, fault_of, parse_faults
from vehicle_emulator.ins import NavigationSystem
from vehicle_emulator.plants.interface import PlantState

CATALOGUE = load()
GUST = {"kind": "gust", "push_n": 3000.0}
MS = 1_000_000


def active_steps(run):
    return [step for step, active in enumerate(run.actives) if active.plant.push_n]


@pytest.mark.parametrize(
    ("when", "first", "last"),
    [
        ({}, 0, 499),
        ({"from_s": 0.1}, 100, 499),
        ({"until_s": 0.2}, 0, 199),
        ({"from_s": 0.1, "until_s": 0.2}, 100, 199),
        ({"from_s": 0.1, "duration_s": 0.05}, 100, 149),
        ({"from_s": 0.1, "duration_s": 0.001}, 100, 100),
        ({"from_s": 0.1005, "duration_s": 0.01}, 101, 110),
    ],
)
def test_times_are_exact_to_the_step(bench, when, first, last):
    run = bench({**GUST, **when}).run(500)
    assert active_steps(run) == list(range(first, last + 1))
    ends = [(last + 1, "gust", "ends")] if last < 499 else []
    assert run.events == [(first, "gust", "begins"), *ends]


def drive(run, steps):
    """Move the car by 1 m a step, from wherever it is."""
    for _ in range(steps):
        run.run(1)
        run.situation = run.situation._replace(state=PlantState(x_m=run.situation.state.x_m + 1.0))
    return run


def test_a_condition_is_a_level(bench):
    run = drive(bench({**GUST, "condition": "x_m > 30 and x_m < 60"}), 100)
    assert active_steps(run) == list(range(31, 60))
    assert run.events == [(31, "gust", "begins"), (60, "gust", "ends")]


def test_with_a_duration_a_condition_is_the_beginning_and_counts_once(bench):
    run = drive(bench({**GUST, "condition": "x_m > 30 and x_m < 60", "duration_s": 0.005}), 100)
    assert active_steps(run) == list(range(31, 36))
    assert run.engine.faults[0].state == "over"


def test_a_condition_is_not_asked_before_its_time(bench):
    run = drive(bench({**GUST, "condition": "x_m < 60", "from_s": 0.05, "until_s": 0.055}), 100)
    assert active_steps(run) == list(range(50, 55))


def test_a_condition_about_the_robots(bench):
    run = bench({**GUST, "condition": "engaged"}).run(10)
    run.situation = Situation(PlantState(), is_engaged=True)
    run.run(10)
    assert active_steps(run) == list(range(10, 20))


@pytest.mark.parametrize(
    ("fault", "path", "value"),
    [
        ({"kind": "robot_stuck", "robot": "SR"}, "robots.SR.is_stuck", True),
        ({"kind": "robot_slow", "robot": "AR", "factor": 0.25}, "robots.AR.slow_factor", 0.25),
        ({"kind": "steering_offset", "angle_deg": -90.0}, "robots.SR.offset", -math.pi / 2),
        ({"kind": "pedal_offset", "robot": "BR", "stroke": 0.1}, "robots.BR.offset", 0.1),
        ({"kind": "robot_silent", "robot": "BR"}, "robots.BR.is_silent", True),
        ({"kind": "robot_dtc", "robot": "SR", "code": 16}, "robots.SR.dtc", 16),
        ({"kind": "robot_torque_loss", "robot": "SR"}, "robots.SR.drops_torque", True),
        ({"kind": "dead_man_released"}, "driver.is_dead_man_pressed", False),
        ({"kind": "stop_button"}, "driver.is_stop_button_pressed", True),
        ({"kind": "driver_steering", "torque_nm": -4.0}, "driver.steering_torque_nm", -4.0),
        ({"kind": "driver_pedals", "accelerator": 0.2}, "driver.accelerator_norm", 0.2),
        ({"kind": "driver_pedals", "brake": 0.5}, "driver.brake_norm", 0.5),
        ({"kind": "ins_bias", "x_m": 1.0, "z_m": -2.0}, "ins.position_bias_m", (1.0, 0.0, -2.0)),
        ({"kind": "ins_bias", "y_m": 1.5}, "ins.position_bias_m", (0.0, 1.5, 0.0)),
        ({"kind": "ins_bias", "yaw_deg": 180.0}, "ins.yaw_bias_rad", math.pi),
        ({"kind": "ins_bias", "speed_mps": 1.0}, "ins.velocity_bias_mps", 1.0),
        ({"kind": "ins_bias", "yaw_rate_degps": 18.0}, "ins.yaw_rate_bias_radps", math.pi / 10),
        ({"kind": "ins_bias", "ax_mps2": 0.5}, "ins.acceleration_bias_mps2", 0.5),
        ({"kind": "ins_freeze"}, "ins.is_frozen", True),
        ({"kind": "ins_time_freeze"}, "ins.is_time_frozen", True),
        ({"kind": "ins_dropout"}, "ins.is_silent", True),
        ({"kind": "gnss_mode", "mode": "Blanked"}, "ins.gnss_mode", "Blanked"),
        ({"kind": "ins_latency", "latency_ms": 20.0}, "ins.latency_extra_s", 0.02),
        ({"kind": "ins_noise", "factor": 4.0}, "ins.noise_factor", 4.0),
        ({"kind": "friction", "factor": 0.3}, "friction", 0.3),
        ({"kind": "drive_loss"}, "plant.drive_norm", 0.0),
        ({"kind": "brake_loss", "left": 0.4}, "plant.brake_norm", 0.4),
        (GUST, "plant.push_n", 3000.0),
    ],
)
def test_what_a_fault_changes_and_that_it_ends(bench, fault, path, value):
    run = bench({**fault, "from_s": 0.01, "until_s": 0.02}).run(30)
    assert run.actives[9] == run.actives[20] == NOTHING
    assert looked_up(run.actives[10], path) == looked_up(run.actives[19], path) == pytest.approx(value)
    assert differing(run.actives[10], NOTHING) == {path}


def looked_up(active, path):
    found = active
    for name in path.split("."):
        found = found[name] if name in ("SR", "AR", "BR") else getattr(found, name)
    return found


def differing(left, right, path=""):
    """Paths of everything that is not the same."""
    if left == right:
        return set()
    names = left if hasattr(left, "keys") else getattr(left, "_fields", None)
    if names is None:
        return {path}
    pick = (lambda value, name: value[name]) if hasattr(left, "keys") else getattr
    return set().union(*(differing(pick(left, name), pick(right, name), f"{path}.{name}".strip(".")) for name in names))


def test_faults_add_up(bench):
    run = bench(
        GUST, {**GUST, "push_n": -1000.0}, {"kind": "friction", "factor": 0.5}, {"kind": "friction", "factor": 0.5},
        {"kind": "robot_slow", "robot": "SR", "factor": 0.5}, {"kind": "robot_stuck", "robot": "SR"},
        {"kind": "ins_bias", "x_m": 1.0}, {"kind": "ins_bias", "x_m": 2.0},
        {"kind": "drive_loss", "left": 0.5}, {"kind": "drive_loss", "left": 0.5},
    ).run(1)  # fmt: skip
    active = run.active
    assert (active.plant.push_n, active.friction, active.plant.drive_norm) == (2000.0, 0.25, 0.25)
    assert active.ins.position_bias_m == (3.0, 0.0, 0.0)
    assert (active.robots["SR"].slow_factor, active.robots["SR"].is_stuck, active.robots["AR"].is_stuck) == (0.5, True, False)


def test_what_adds_up_stays_within_what_the_car_is_made_for(bench):
    many = ({"kind": "ins_latency", "latency_ms": 1000.0}, {"kind": "robot_slow", "robot": "SR", "factor": 0.01})
    run = bench(*many, *many, *({"kind": "friction", "factor": 0.05},) * 2, *({"kind": "ins_noise", "factor": 1000.0},) * 2).run(1)
    active = run.active
    NavigationSystem(load_vehicle().ins, CATALOGUE, Random(1), period_ns=MS, start_ns=0, state=PlantState()).faults = active.ins
    assert (active.robots["SR"].slow_factor, active.friction, active.ins.noise_factor) == (0.01, 0.05, 1000.0)


def test_the_driver_does_what_he_does_anyway_and_the_faults():
    person = Driver(steering_torque_nm=1.0, accelerator_norm=0.3, brake_norm=0.1)
    assert NOTHING.driven_by(person) == person
    wrong = NOTHING._replace(driver=Driver(2.0, 0.1, 0.5, is_dead_man_pressed=False))
    assert wrong.driven_by(person) == Driver(3.0, 0.3, 0.5, is_dead_man_pressed=False)


def test_a_jump_goes_as_far_as_it_should_and_stays(bench):
    run = bench({"kind": "ins_jump", "distance_m": 2.0}).run(20)
    places = {active.ins.position_bias_m for active in run.actives}
    assert len(places) == 1
    assert math.hypot(*places.pop()) == pytest.approx(2.0)


def test_a_drift_grows_evenly(bench):
    run = bench({"kind": "ins_drift", "rate_mps": 10.0, "from_s": 0.01, "duration_s": 0.05}).run(100)
    distances = [math.hypot(*active.ins.position_bias_m) for active in run.actives]
    assert distances == pytest.approx([0.0] * 10 + [0.01 * k for k in range(50)] + [0.0] * 40)


def disturbances(run):
    return {step: active.disturbances for step, active in enumerate(run.actives) if active.disturbances}


def test_bus_errors_are_asked_for_once(bench):
    status = CATALOGUE.by_name["SR_Status"].arbitration_id
    run = bench({"kind": "bus_error", "messages": "SR_Status", "errors": 3, "from_s": 0.01, "duration_s": 0.05}).run(100)
    assert disturbances(run) == {10: (Disturbance(status, 3),), 60: (Disturbance(status, 0),)}
    assert run.events == [(10, "bus_error", "begins"), (60, "bus_error", "ends")]


def test_bus_errors_again_and_again(bench):
    run = bench({"kind": "bus_error", "messages": "*", "period_ms": 20.0, "from_s": 0.01, "until_s": 0.07}).run(100)
    assert disturbances(run) == dict.fromkeys([10, 30, 50], (Disturbance(None, 1),)) | {70: (Disturbance(None, 0),)}


def test_what_is_cleared_leaves_nothing_on_the_wire(bench):
    status = CATALOGUE.by_name["SR_Status"].arbitration_id
    run = bench({"kind": "bus_error", "messages": "SR_Status", "errors": 1000}, {"kind": "bus_error", "messages": "SR_Status", "errors": 7})
    run.run(10)
    run.engine.clear(5_000_000_000 + 10 * MS, "bus_error")
    run.run(10)
    assert list(disturbances(run)) == [0]  # the other one is about the same message
    run.engine.clear(5_000_000_000 + 20 * MS)
    run.run(10)
    assert disturbances(run) == {0: (Disturbance(status, 1000), Disturbance(status, 7)), 20: (Disturbance(status, 0),)}


def test_a_condition_that_comes_and_goes_is_told_a_bounded_number_of_times(bench):
    run = bench({**GUST, "condition": "engaged", "until_s": 0.9}, {"kind": "ins_freeze", "condition": "engaged"})
    for step in range(1000):
        run.situation = run.situation._replace(is_engaged=step % 2 == 1 or step > 800)
        run.run(1)
    most = engine_module.MAX_BEGINNINGS_NOTED
    events = {name: [(step, event) for step, one, event in run.events if one == name] for name in ("gust", "ins_freeze")}
    told = [(step, "begins" if step % 2 else "ends") for step in range(1, 2 * most + 2)]
    assert events == {"gust": [*told, (900, "ends")], "ins_freeze": told}
    run.engine.clear(5_000_000_000 + 1000 * MS)
    assert [event.event for event in run.engine.take_events()] == ["cleared"]


def test_bus_off_takes_as_many_errors_as_the_standard_says_and_a_reserve(bench):
    run = bench({"kind": "bus_off", "node": "SR"}).run(10)
    (step, ((identifier, errors),)), = disturbances(run).items()
    assert (step, errors) == (0, 48)
    assert CATALOGUE.by_id[identifier].sender == "SR"
    assert CATALOGUE.by_id[identifier].cycle_time_ns == min(m.cycle_time_ns for m in CATALOGUE.by_name.values() if m.sender == "SR")


RANDOM = [
    {"kind": "corrupt_bits", "messages": "SR_Status", "probability": 0.5},
    {"kind": "jitter", "messages": "SR_Status", "jitter_ms": 20.0},
    {"kind": "ins_drift", "rate_mps": 1.0},
]


def test_the_same_seed_gives_the_same_bytes(bench):
    first, again, other = (bench(*RANDOM, seed=seed).run(1000) for seed in (1, 1, 2))
    assert (first.passed, first.actives) == (again.passed, again.actives)
    assert first.passed != other.passed
    assert first.actives != other.actives


def test_one_more_fault_changes_nothing_about_the_others(bench):
    alone = bench(RANDOM[2]).run(10)
    together = bench(*RANDOM).run(10)
    assert [active.ins for active in alone.actives] == [active.ins for active in together.actives]


def test_two_faults_do_not_draw_the_same(bench):
    jump = {"kind": "ins_jump", "distance_m": 2.0}
    assert math.hypot(*bench(jump, jump).run(1).active.ins.position_bias_m) != pytest.approx(4.0, abs=1e-3)


def test_faults_work_in_the_order_in_which_they_are_given(bench):
    status = {"messages": "SR_Status"}
    cut, late = {"kind": "wrong_length", "length": 2, **status}, {"kind": "delay", "delay_ms": 5.0, **status}
    run = bench(cut, late, {"kind": "duplicate", **status, "from_s": 0.015}).run(40)
    assert [(step, len(frame.data)) for step, frame in run.passed] == [(5, 2), (15, 2), (15, 2), (25, 2), (25, 2), (35, 2), (35, 2)]


def test_frames_of_any_shape_pass_through_everything(bench):
    kinds = ("bad_crc", "bad_counter", "freeze_payload", "corrupt_bits")
    cuts = [{"kind": "wrong_length", "length": n, "messages": "SR_Status", "from_s": n * 0.05} for n in (0, 1, 2)]
    run = bench(*cuts, *({"kind": kind, "messages": "SR_Status"} for kind in kinds)).run(150)
    assert len(run.passed) == 15


def test_what_is_added_later_counts_from_then(bench):
    run = bench(GUST).run(100)
    (added,) = run.engine.add(5_000_000_000 + 100 * MS, [fault_of({**GUST, "from_s": 0.02, "duration_s": 0.03})])
    assert (added.spec.name, added.state) == ("gust-2", "waiting")
    run.run(100)
    assert run.events == [(0, "gust", "begins"), (120, "gust-2", "begins"), (150, "gust-2", "ends")]
    assert active_steps(run) == list(range(200))


def test_clear_takes_one_back_or_all(bench):
    run = bench(GUST, {"kind": "ins_freeze"}, {"kind": "delay", "messages": "SR_Status", "delay_ms": 20.0}).run(15)
    assert [fault.spec.name for fault in run.engine.clear(5_000_000_000 + 15 * MS, "gust")] == ["gust"]
    run.run(1)
    assert (run.active.plant.push_n, run.active.ins.is_frozen) == (0.0, True)
    assert [fault.spec.name for fault in run.engine.clear(5_000_000_000 + 16 * MS)] == ["ins_freeze", "delay"]
    run.run(30)
    assert run.active == NOTHING
    assert run.times == [20, 20, 30, 30, 40]  # what was on its way has arrived
    assert run.events[3:] == [(15, "gust", "cleared"), (16, "ins_freeze", "cleared"), (16, "delay", "cleared")]
    assert list(run.engine.faults) == []


def test_what_cannot_be_added_or_cleared_is_told_and_changes_nothing(bench):
    run = bench(GUST)
    with pytest.raises(FaultMistake, match="name = 'gust': allowed: a name that no fault has"):
        run.engine.add(0, [fault_of({"kind": "ins_freeze"}), fault_of({**GUST, "name": "gust"})])
    with pytest.raises(FaultMistake, match=f"{MAX_FAULTS + 1} faults: allowed: {MAX_FAULTS}"):
        run.engine.add(0, [fault_of(GUST)] * MAX_FAULTS)
    with pytest.raises(FaultMistake, match="messages = 'SRS'"):
        run.engine.add(0, [fault_of(GUST), fault_of({"kind": "drop", "messages": "SRS"})])
    with pytest.raises(FaultMistake, match="fault 'gst' is unknown; known: gust"):
        run.engine.clear(0, "gst")
    assert [fault.spec.name for fault in run.engine.faults] == ["gust"]


def test_an_engine_with_nothing_to_do_does_nothing(monkeypatch):
    """The cost of a millisecond: no fault is looked at before its time, and frames pass untouched."""
    later = {"from_s": 10.0}
    specs = parse_faults([{**GUST, **later}, {"kind": "drop", "messages": "*", **later}, {"kind": "ins_freeze", "until_s": 0.5}])
    engine = FaultEngine(specs, 1, 0, CATALOGUE)
    situation, frames, looked = Situation(PlantState(), is_engaged=False), [], []
    original = Fault.update
    monkeypatch.setattr(Fault, "update", lambda self, *arguments: (looked.append(self.spec.name), original(self, *arguments)))
    for step in range(1000):
        engine.update(step * MS, situation)
        assert engine.incoming(step * MS, frames) is frames
        assert engine.outgoing(step * MS, frames) is frames
    assert len(looked) == 2 * len(specs)
    assert engine_module.FaultEngine([], 1, 0, CATALOGUE).update(0, situation) is NOTHING
