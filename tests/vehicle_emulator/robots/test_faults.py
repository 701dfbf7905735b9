"""Faults of the robots: what they do, what is reported of them, and how they are cleared."""

import math
from itertools import pairwise

import pytest

from tests.vehicle_emulator.robots.bench import CATALOGUE, DTC, VEHICLE, Bench
from vehicle_emulator.driver import Driver
from vehicle_emulator.robots.faults import HEALTHY, RobotFaults
from vehicle_emulator.robots.reports import FaultMemory
from vehicle_emulator.robots.states import SOFT_CODES

HARD, SOFT = DTC["EncoderFault"], DTC["SpeedLimit"]
PEDAL = VEHICLE.robots.accelerator
NODE_OF = {raw: name for name, raw in CATALOGUE.enumeration("RC_FaultReport", "Robot").items()}


def report(bench: Bench) -> dict[str, dict[str, float]]:
    """One round of the fault report: pages 0 by robot and code, and the pages of limits."""
    pages: dict[str, dict[str, float]] = {}
    for _ in range(40):
        page = bench.status("RC_FaultReport")
        key = f"{NODE_OF[int(page['Robot'])]} {int(page['Dtc'])}" if page["Page"] == 0 else f"page {int(page['Page'])}"
        pages[key] = page
        bench.ms += 99
        bench.step()
    return pages


@pytest.mark.parametrize("code", [HARD, SOFT, DTC["MotorOverTemp"], 255])
@pytest.mark.parametrize("node", ["SR", "AR", "BR"])
def test_a_trouble_code_is_a_fault_that_stops_the_car(node: str, code: int):
    bench = Bench().engage().run(300, sr_deg=20.0, br_percent=50.0)
    bench.system.faults[node] = RobotFaults(dtc=code)
    bench.run(600, sr_deg=20.0, br_percent=50.0)
    assert (bench.state, bench.stop_source) == ("ControlledStop", "RobotFault")
    is_hard = code not in SOFT_CODES
    assert bench.robot_state(node) == ("FaultHard" if is_hard else "FaultSoft")
    assert {name for name in ("SR", "AR", "BR") if bench.status(f"{name}_Status")["Fault"]} == {node}
    assert bench.status(f"{node}_Diag")["Dtc"] == code
    status = bench.status("RC_SafetyStatus")
    assert [status[f"{name}Ready"] for name in ("Sr", "Ar", "Br")].count(1) == 0 or not status[f"{node.capitalize()}Ready"]
    lost_brake = node == "BR" and is_hard
    assert status["BrakeFallback"] == lost_brake
    assert bench.inputs.brake_norm == (0.0 if lost_brake else pytest.approx(0.3247, abs=2e-3))


def test_a_hard_fault_lets_go_at_once_and_a_soft_one_fades():
    for code, limit_nm in ((HARD, 0.0), (SOFT, 60.0)):
        bench = Bench().engage().run(300, sr_deg=20.0)
        bench.system.faults["SR"] = RobotFaults(dtc=code)
        bench.step()
        bench.step()
        assert bench.inputs.steering.torque_limit_nm == pytest.approx(limit_nm, abs=0.5)


def test_a_hard_fault_replaces_a_soft_one_and_not_the_other_way_round():
    bench = Bench().engage()
    bench.system.faults["BR"] = RobotFaults(dtc=SOFT)
    bench.run(600)
    assert (bench.robot_state("BR"), bench.status("BR_Diag")["Dtc"]) == ("FaultSoft", SOFT)
    for code in (HARD, SOFT):
        bench.system.faults["BR"] = RobotFaults(dtc=code)
        bench.run(600)
        assert (bench.robot_state("BR"), bench.status("BR_Diag")["Dtc"]) == ("FaultHard", HARD)
    assert bench.inputs.brake_norm == 0.0
    pages = report(bench)
    shown = {code: (pages[f"BR {code}"]["Active"], pages[f"BR {code}"]["Latched"]) for code in (SOFT, HARD)}
    assert shown == {SOFT: (0, 0), HARD: (1, 1)}


def test_a_robot_forgets_when_its_own_command_clears_its_faults():
    bench = Bench().engage()
    bench.system.faults |= dict.fromkeys(("AR", "BR"), RobotFaults(dtc=SOFT))
    bench.run(50)
    bench.system.faults |= dict.fromkeys(("AR", "BR"), HEALTHY)
    bench.speed_mps = 0.0
    bench.run(50, "Disarm")
    bench.send(50, lambda: [*bench.gateway.frames("Disarm")[:3], bench.gateway.pedal("BR", 0.0, False, ClearFault=1)])
    assert [(entry.node, entry.dtc, entry.is_latched) for entry in bench.system.memory.entries] == [("AR", SOFT, True)]
    assert (bench.robot_state("AR"), bench.robot_state("BR")) == ("FaultSoft", "Standby")


@pytest.mark.parametrize("code", [HARD, SOFT])
@pytest.mark.parametrize("how", ["ClearFaults", "ClearFault"])
def test_faults_stay_until_cleared_with_the_cause_gone_and_the_system_disarmed(code: int, how: str):
    bench = Bench().engage()
    gateway = bench.gateway

    def clear(milliseconds: int) -> None:
        request = "ClearFaults" if how == "ClearFaults" else "Disarm"
        bit = {"ClearFault": how == "ClearFault"}
        bench.send(
            milliseconds,
            lambda: [gateway.safety(request), gateway.steering(0.0, False, **bit), *(gateway.pedal(n, 0.0, False) for n in ("AR", "BR"))],
        )

    bench.system.faults["SR"] = RobotFaults(dtc=code)
    bench.run(50)
    bench.system.faults["SR"] = HEALTHY
    clear(50)
    assert bench.state == "ControlledStop"  # still rolling
    assert bench.status("SR_Status")["Fault"] == 1
    bench.speed_mps = 0.0
    bench.run(50, "Disarm")
    assert (bench.state, bench.robot_state("SR")) == ("Fault", "FaultHard" if code == HARD else "FaultSoft")
    bench.run(50, "Arm")
    assert bench.state == "Fault"
    bench.system.faults["SR"] = RobotFaults(dtc=code)
    clear(50)
    assert bench.status("SR_Status")["Fault"] == 1  # the cause is still there
    bench.system.faults["SR"] = HEALTHY
    bench.run(50, "Disarm")
    assert bench.status("SR_Status")["Fault"] == 1  # it does not go by itself
    clear(50)
    assert (bench.state, bench.robot_state("SR")) == ("Disarmed", "Standby")
    bench.run(50, "Arm").run(50, "Engage")
    assert bench.state == "Engaged"


def test_a_stuck_steering_robot_holds_the_wheel_and_is_found_out():
    bench = Bench().engage().run(300, sr_deg=10.0)
    at_rad = bench.wheel.angle_rad
    bench.system.faults["SR"] = RobotFaults(is_stuck=True)
    bench.run(200, sr_deg=200.0)
    assert bench.wheel.angle_rad == pytest.approx(at_rad, abs=0.01)
    assert bench.state == "Engaged"
    bench.run(200, sr_deg=200.0)
    assert (bench.state, bench.stop_source) == ("ControlledStop", "RobotFault")
    assert bench.status("SR_Diag")["Dtc"] == DTC["FollowingErrorLimit"]
    bench.silence(1000)
    assert bench.wheel.angle_rad == pytest.approx(at_rad, abs=0.01)  # seized: nothing turns it
    bench.system.faults["SR"] = HEALTHY
    bench.silence(3000)
    assert abs(bench.wheel.angle_rad) < 0.5 * at_rad  # let go, it returns


@pytest.mark.parametrize("node", ["AR", "BR"])
def test_a_stuck_pedal_stays_where_it_is(node: str):
    bench = Bench().engage().run(600, **{f"{node.lower()}_percent": 40.0})
    bench.system.faults[node] = RobotFaults(is_stuck=True)
    bench.run(200)
    assert bench.system.pedals[("AR", "BR").index(node)] == pytest.approx(0.4, abs=0.01)
    bench.run(600)
    assert bench.status(f"{node}_Status")["Fault"] == 1
    assert bench.state == "ControlledStop"


def test_a_pedal_that_seized_on_its_way_goes_on_from_rest():
    bench = Bench().engage().run(220, ar_percent=100.0)
    bench.system.faults["AR"] = RobotFaults(is_stuck=True)
    bench.run(1, ar_percent=100.0)
    at_norm = bench.system.pedals.accelerator_norm
    assert 0.7 < at_norm < 0.98  # it was moving
    bench.run(2000, "Disarm")
    assert bench.system.pedals.accelerator_norm == at_norm
    held_n = PEDAL.preload_n + (PEDAL.full_stroke_n - PEDAL.preload_n) * at_norm  # at rest: no friction
    assert bench.status("AR_Status")["ForceActual"] == pytest.approx(held_n, abs=2.0)
    bench.system.faults["AR"] = HEALTHY
    track = [at_norm] + [bench.run(1, "Disarm").system.pedals.accelerator_norm for _ in range(500)]
    steps = [before - after for before, after in pairwise(track)]
    assert steps[0] < 0.5e-3 * PEDAL.rate_limit_per_s
    assert 0.0 <= min(steps) <= max(steps) < 1.1e-3 * PEDAL.rate_limit_per_s
    assert track[-1] == 0.0


def test_a_slow_robot_moves_at_its_share():
    healthy, slow = Bench().engage(), Bench().engage()
    slow.system.faults |= dict.fromkeys(("SR", "AR"), RobotFaults(slow_factor=0.1))
    for bench in (healthy, slow):
        bench.run(120, sr_deg=100.0, ar_percent=90.0)
    assert slow.wheel.angle_rad == pytest.approx(0.1 * 27.9 * 0.057, abs=0.01)  # 100 ms, less 14 to speed up and 29 of lag
    assert slow.wheel.angle_rad < 0.2 * healthy.wheel.angle_rad
    assert 0.0 < slow.inputs.accelerator_norm < 0.25 * healthy.inputs.accelerator_norm


def test_an_offset_moves_the_robot_beside_its_command():
    bench = Bench().engage()
    bench.system.faults["SR"] = RobotFaults(offset=math.radians(10.0))
    bench.system.faults["BR"] = RobotFaults(offset=0.1)
    bench.run(800, sr_deg=20.0, br_percent=30.0)
    assert math.degrees(bench.wheel.angle_rad) == pytest.approx(30.0, abs=0.3)
    assert bench.inputs.brake_norm == pytest.approx(0.4, abs=2e-3)


def test_a_silent_robot_works():
    bench = Bench().engage()
    bench.system.faults["SR"] = RobotFaults(is_silent=True)
    bench.run(300, sr_deg=20.0)
    assert math.degrees(bench.wheel.angle_rad) == pytest.approx(20.0, abs=0.3)
    silent = {name for name in ("SR_Status", "SR_Diag", "AR_Status", "RC_SafetyStatus", "RC_FaultReport") if bench.system.is_silent(name)}
    assert silent == {"SR_Status", "SR_Diag"}


def test_a_robot_without_torque_lets_go():
    bench = Bench().engage().run(600, sr_deg=60.0, ar_percent=40.0)
    bench.system.faults |= dict.fromkeys(("SR", "AR"), RobotFaults(drops_torque=True))
    bench.run(200, sr_deg=60.0, ar_percent=40.0)
    assert bench.inputs.steering.torque_limit_nm == 0.0
    assert bench.inputs.accelerator_norm < 0.1
    assert bench.status("AR_Status")["ForceActual"] == 0.0


def test_the_report_has_every_trouble_and_the_learned_limits():
    bench = Bench().engage()
    bench.run(600, sr_deg=700.0)  # beyond what was learned: a warning
    bench.system.faults["BR"] = RobotFaults(dtc=HARD)
    bench.run(50)
    pages = report(bench)
    end_stop, fault = pages[f"SR {DTC['EndStopReached']}"], pages[f"BR {HARD}"]
    assert (end_stop["Active"], end_stop["Latched"], end_stop["Count"]) == (0, 0, 1)
    assert (fault["Active"], fault["Latched"], fault["Count"]) == (1, 1, 1)
    assert 0.15 <= end_stop["TimeStamp"] < 0.17
    assert 0.74 < fault["TimeStamp"] < 0.76
    sr, ar, br = VEHICLE.robots.steering, VEHICLE.robots.accelerator, VEHICLE.robots.brake
    assert pages["page 1"] == {
        "Page": 1,
        "MaxAngle": pytest.approx(math.degrees(sr.learned_range_rad), abs=0.1),
        "MaxRate": pytest.approx(math.degrees(sr.rate_limit_radps), abs=1.0),
        "MaxTorque": sr.torque_limit_nm,
    }
    assert pages["page 2"] == {"Page": 2, "ArStroke": 1e3 * ar.stroke_m, "ArMaxForce": ar.force_limit_n}
    assert pages["page 3"] == {"Page": 3, "BrStroke": 1e3 * br.stroke_m, "BrMaxForce": br.force_limit_n}


@pytest.mark.parametrize("cycle_ms", [10, 100, 137, 200])
def test_pages_take_turns_at_any_cycle_time(cycle_ms: int):
    bench = Bench()
    pages = []
    for _ in range(8):
        bench.silence(cycle_ms)
        pages.append(int(bench.status("RC_FaultReport")["Page"]))
    assert pages == [0, 1, 0, 2, 0, 3, 0, 1]
    assert bench.status("RC_FaultReport")["Robot"] == 0


def test_memory_counts_comings_and_forgets_what_is_gone():
    memory = FaultMemory()
    for k in range(300):
        memory.note(k * 1.0, "SR", frozenset({4}), 0)
        memory.note(k + 0.5, "SR", frozenset(), 0)
    (entry,) = memory.entries
    assert (entry.count, entry.first_s, entry.is_active) == (255, 0.0, False)
    memory.note(400.0, "AR", frozenset({2}), 0)
    memory.note(400.0, "SR", frozenset({33}), 33)
    memory.clear("SR")
    assert [(e.node, e.dtc, e.is_latched) for e in memory.entries] == [("AR", 2, False), ("SR", 33, True)]


def test_memory_notes_that_a_warning_has_become_the_fault():
    memory = FaultMemory()
    memory.note(0.0, "BR", frozenset({1}), 0)
    memory.note(1.0, "BR", frozenset({1}), 1)
    assert [(e.dtc, e.count, e.is_active, e.is_latched) for e in memory.entries] == [(1, 1, True, True)]


def test_diagnosis_is_plausible_and_slow():
    bench = Bench().engage()
    bench.send(3000, lambda: [*bench.gateway.frames("Engage")[:3], bench.gateway.pedal("BR", 100.0, ForceLimit=2040.0)])
    diagnosis, status = bench.status("BR_Diag"), bench.status("RC_SafetyStatus")
    assert diagnosis["MotorCurrent"] == pytest.approx(30.0 * 400.0 / 1200.0, abs=0.5)
    assert 25 <= diagnosis["MotorTemperature"] <= 27
    assert 12.0 < status["SupplyVoltage"] < 14.0
    assert bench.status("AR_Diag")["MotorCurrent"] == 0.0
    voltages = []
    for _ in range(60):
        bench.ms += 999
        bench.step()
        voltages.append(bench.status("RC_SafetyStatus")["SupplyVoltage"])
    assert len(set(voltages)) > 1
    assert max(abs(a - b) for a, b in pairwise(voltages)) <= 0.5


def test_the_driver_is_stronger_than_no_robot_when_it_is_stuck():
    bench = Bench().engage()
    bench.system.faults["AR"] = RobotFaults(is_stuck=True)
    bench.driver = Driver(accelerator_norm=0.04)
    bench.run(50)
    assert bench.inputs.accelerator_norm == 0.04  # the foot can still press deeper
