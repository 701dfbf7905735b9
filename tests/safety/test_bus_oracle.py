"""The judge is judged first: every rule of the bus oracle is broken once on purpose, and a good drive breaks none."""

import math
import random

import cantools
import pytest

from gateway.limits import PROFILES
from tests.support.bus_oracle import BusOracle
from tests.support.oracle_limits import ENVELOPES, MS, REACTIONS, Kind
from tests.support.oracle_wire import DBC_FILES, Wire, bit_positions, crc8h2f, profile2_crc, signal_reader

TICK_NS = 10 * MS
WIRE = Wire()


class Script:
    """A gateway that says what it is told to, on a bus that the oracle hears; correct unless a test changes something."""

    def __init__(self, **options):
        self.oracle = BusOracle(**options)
        self.now_ns = 1_000 * MS
        self.speed_mps = 20.0
        self.wheels_mps = 0.0
        self.system_state = "Engaged"
        self.angle_deg = self.drive_percent = self.brake_percent = 0.0
        self.request, self.is_following, self.is_enabled = "Disarm", False, False
        self.age_ms = 20.0
        self.max_speed_kmh = 100.0
        self.status = None
        self.cause = "None"
        self.question = 7
        self.answer = None
        self.measurement_id = 0
        self.edit = lambda name, data: data
        self.repeats = 1
        self._counters = {}

    def car(self, name, values):
        message = WIRE.by_name[name]
        counter = self._counters[name] = self._counters.get(name, -1) + 1
        data = message.compose(values, counter)
        self.oracle.observe(self.now_ns - 2 * MS, message.network, message.arbitration_id, data, is_from_gateway=False)

    def gateway(self, name, values):
        message = WIRE.by_name[name]
        counter = self._counters[name] = self._counters.get(name, -1) + 1
        data = self.edit(name, message.compose(values, counter))
        if data is not None:
            self.oracle.observe(self.now_ns, message.network, message.arbitration_id, data, is_from_gateway=True)

    def tick(self, count=1):
        for _ in range(count):
            self.now_ns += TICK_NS
            self.question = (self.question + 3) % 256
            self.car("VelocityLevel", {"VelForward": self.speed_mps})
            wheel_radps = self.wheels_mps / 0.31
            self.car("CAR_WheelSpeeds", dict.fromkeys(("FrontLeft", "FrontRight", "RearLeft", "RearRight"), wheel_radps))
            self.car("RC_SafetyStatus", {"WatchdogQuestion": self.question, "SystemState": self.system_state})
            for _ in range(self.repeats):
                self.speak()
        return self

    def speak(self):
        answer = (self.question << 3 & 0xFF | self.question >> 5) ^ 0xA7 if self.answer is None else self.answer
        self.gateway("GW_SafetyCommand", {
            "SystemRequest": self.request, "TrajectoryValid": self.is_following, "CommandAge": self.age_ms,
            "MaxSpeed": self.max_speed_kmh, "WatchdogAnswer": answer, "MeasurementId": self.measurement_id % 16,
        })
        self.gateway("SR_Command", {
            "Mode": "AnglePosition" if self.is_enabled else "Standby", "Enable": self.is_enabled, "AngleCommand": self.angle_deg,
        })
        pedal = {"Mode": "Position" if self.is_enabled else "Standby", "Enable": self.is_enabled}
        self.gateway("AR_Command", {**pedal, "PositionCommand": self.drive_percent})
        self.gateway("BR_Command", {**pedal, "PositionCommand": self.brake_percent})
        if self.status is not None:
            self.gateway("GW_Status", {"Mode": self.status, "Cause": self.cause})

    def go(self, request, is_following=False):
        self.request, self.is_following, self.is_enabled = request, is_following, request == "Engage"
        return self

    def ask(self, operation):
        self.oracle.mark_request(self.now_ns, operation)
        return self

    def engage(self):
        self.ask("RESET").tick(5)
        self.ask("ARM").go("Arm").tick(5)
        return self.ask("ENGAGE").go("Engage", is_following=True).tick(5)

    def stop(self, jerk_mps3=1.5, until_mps2=2.5, seconds=3.0):
        self.go("Engage")
        for k in range(round(seconds * 100)):
            self.brake_percent = 10.0 * min(max(self.brake_percent / 10.0, jerk_mps3 * k * 0.01), until_mps2)
            self.tick()
        return self

    @property
    def rules(self):
        return {violation.rule for violation in self.oracle.finish(self.now_ns)}


def test_a_good_drive_breaks_no_rule():
    script = Script().engage()
    for k in range(200):
        script.angle_deg = 15.0 * math.sin(0.01 * k)
        script.drive_percent = min(script.drive_percent + 1.0, 60.0)
        script.measurement_id = k // 4
        script.tick()
    script.drive_percent = 0.0
    script.stop()
    script.speed_mps = 0.0
    script.tick(20)
    script.brake_percent = 26.0
    script.tick(1)
    script.brake_percent = 27.0
    script.tick(50)
    script.brake_percent = script.angle_deg = 0.0
    script.go("Disarm").tick(5)
    script.ask("ARM").go("Arm").tick(5)
    assert script.oracle.finish(script.now_ns) == []


def engaged(**changes):
    """A violation that is a wrong value of one or more fields in a drive."""

    def break_it():
        script = Script().engage()
        for name, value in changes.items():
            setattr(script, name, value)
        return script.tick(2)

    return break_it


def edited(name, edit):
    """A violation that is a wrong payload of one message."""

    def break_it():
        script = Script().engage()
        script.edit = lambda sent, data: edit(data) if sent == name else data
        return script.tick(2)

    return break_it


def _wrong_crc(data):
    return bytes([data[0] ^ 1]) + data[1:]


def _other_counter(step):
    message = WIRE.by_name["SR_Command"]

    def edit(data):
        changed = bytes([0, data[1] & 0xF0 | (data[1] + step) % 16]) + data[2:]
        return bytes([profile2_crc(changed, message.data_id)]) + changed[1:]

    return edit


def _ids():
    script = Script().engage()
    script.oracle.observe(script.now_ns, "robots", 0x7FF, bytes(8), is_from_gateway=True)
    return script


def _other_bus():
    script = Script().engage()
    script.oracle.observe(script.now_ns, "navigation", WIRE.by_name["SR_Command"].arbitration_id, bytes(8), is_from_gateway=True)
    return script


def _foreign_message():
    script = Script().engage()
    script.oracle.observe(script.now_ns, "robots", WIRE.by_name["SR_Status"].arbitration_id, bytes(8), is_from_gateway=True)
    return script


def _lost_counter():
    script = Script().engage()
    script.edit = lambda sent, data: None if sent == "SR_Command" else data
    script.tick(2)
    script.edit = lambda sent, data: data
    return script.tick(2)


def _flood():
    script = Script().engage()
    script.repeats = 2
    return script.tick(100)


def _unasked_arm():
    return Script().ask("RESET").tick(5).go("Arm").tick(1)


def _refused_request_kept():
    script = Script().ask("RESET").tick(5).ask("ARM").go("Arm").tick(5).ask("ENGAGE").tick(20)
    return script.go("Engage", is_following=True).tick(1)


def _not_silent():
    return Script().tick(1)


def _one_step():
    return Script().ask("RESET").tick(5).ask("ENGAGE").go("Engage", is_following=True).tick(1)


def _again():
    script = Script().engage().stop(seconds=0.5)
    return script.ask("ENGAGE").go("Engage", is_following=True).tick(1)


def _after_restart():
    script = Script().engage()
    script.oracle.mark_restart()
    return script.tick(1)


def _enabled_while_armed():
    script = Script().ask("RESET").tick(5).ask("ARM").go("Arm").tick(2)
    script.is_enabled = True
    return script.tick(1)


def _demand_while_armed(name):
    def break_it():
        script = Script().ask("RESET").tick(5).ask("ARM").go("Arm").tick(2)
        setattr(script, name, 1.0)
        return script.tick(1)

    return break_it


def _abandoned_stop():
    return Script().engage().stop(seconds=0.5).go("Disarm").tick(1)


def _abandoned_drive():
    return Script().engage().go("Disarm").tick(1)


def _half_engaged():
    script = Script().engage()
    script.is_enabled = False
    return script.tick(1)


def _ramp(name, step, ticks, **changes):
    def break_it():
        script = Script().engage()
        for key, value in changes.items():
            setattr(script, key, value)
        for _ in range(ticks):
            setattr(script, name, getattr(script, name) + step)
            script.tick()
        return script

    return break_it


def test_robots_that_do_not_follow_are_not_abandoned():
    script = Script().engage()
    script.system_state = "Armed"
    script.tick(20)
    assert script.go("Disarm").tick(20).rules == set()


@pytest.mark.parametrize(("profile", "rules"), [("nominal", {"lateral jerk", "lateral acceleration"}), ("bench", set())])
def test_the_wheels_count_where_they_are_on_the_road(profile, rules):
    """Navigation says that the car stands."""
    script = Script(profile=profile)
    script.max_speed_kmh = 30.0
    script.engage()
    script.speed_mps, script.wheels_mps = 0.0, 20.0
    script.tick(20)
    for _ in range(40):
        script.angle_deg += 1.0
        script.tick()
    assert script.rules == rules


def _window():
    """Each step is within what ten milliseconds allow, but there are more steps than there is time for."""
    script = Script().engage()
    script.speed_mps = 0.0
    script.tick(20)
    for _ in range(50):
        script.angle_deg += 7.0
        script.now_ns += 2 * MS
        script.speak()
    return script


def _released():
    script = Script().engage()
    for percent in (*range(21), 0):
        script.brake_percent = percent
        script.tick()
    return script


def _stop(**options):
    def break_it():
        return Script().engage().stop(**options)

    return break_it


def _stop_with_accelerator():
    script = Script().engage()
    script.drive_percent = 5.0
    return script.go("Engage").tick(2)


def _standstill():
    script = Script().engage().stop()
    script.speed_mps = 0.0
    script.tick(20)
    script.brake_percent = 60.0
    return script.tick(1)


def _tail():
    script = Script().engage().stop()
    for _ in range(5):
        script.angle_deg += 0.5
        script.tick()
    return script


def _comfort():
    script = Script().engage()
    script.status, script.cause = "ComfortStop", "OperatorStop"
    script.edit = lambda sent, data: data if sent != "GW_Status" or script.now_ns // TICK_NS % 10 == 0 else None
    return script.stop()


def _weak_safe_stop():
    script = Script().engage()
    script.status, script.cause = "SafeStop", "CommandLost"
    script.edit = lambda sent, data: data if sent != "GW_Status" or script.now_ns // TICK_NS % 10 == 0 else None
    return script.stop(jerk_mps3=0.35, until_mps2=1.0, seconds=4.0)


def _wrong_status():
    script = Script().engage()
    script.status = "Ready"
    return script.tick(1)


def _status_without_cause():
    script = Script().engage().stop(seconds=0.3)
    script.status = "SafeStop"
    return script.tick(1)


BROKEN = [
    ("allow-list", _ids), ("allow-list", _other_bus), ("allow-list", _foreign_message),
    ("allow-list", edited("SR_Command", lambda data: data[:7])),
    ("crc", edited("SR_Command", _wrong_crc)), ("crc", edited("GW_SafetyCommand", _wrong_crc)),
    ("counter", edited("SR_Command", _other_counter(1))), ("counter", edited("SR_Command", _other_counter(-1))), ("counter", _lost_counter),
    ("message rate", _flood),
    ("unasked", _unasked_arm), ("unasked", _refused_request_kept), ("unasked", _not_silent), ("unasked", _after_restart),
    ("authority", _one_step), ("authority", _again), ("authority", _after_restart),
    ("not neutral", _enabled_while_armed), ("not neutral", _demand_while_armed("angle_deg")),
    ("not neutral", _demand_while_armed("drive_percent")), ("not neutral", _demand_while_armed("brake_percent")),
    ("abandoned", _abandoned_stop), ("abandoned", _abandoned_drive),
    ("authority", _half_engaged), ("authority", engaged(request="Arm", is_enabled=False)),
    ("stale command", engaged(age_ms=101.0)), ("max speed", engaged(max_speed_kmh=200.0)), ("watchdog", engaged(answer=0)),
    ("measurement id", engaged(measurement_id=2)),
    ("steering angle", _ramp("angle_deg", 4.0, 120, speed_mps=0.0)), ("steering rate", _ramp("angle_deg", 8.2, 1, speed_mps=0.0)),
    ("steering window", _window),
    ("lateral acceleration", _ramp("angle_deg", 0.2, 100)), ("lateral jerk", _ramp("angle_deg", 0.5, 1)),
    ("both pedals", engaged(drive_percent=1.0, brake_percent=1.0)),
    ("acceleration", _ramp("drive_percent", 1.0, 65)), ("deceleration", engaged(brake_percent=36.0)),
    ("brake jerk", engaged(brake_percent=10.0)), ("brake jerk", _released), ("drive jerk", engaged(drive_percent=20.0)),
    ("stop accelerates", _stop_with_accelerator), ("stop deceleration", _stop(until_mps2=3.0)), ("stop jerk", _stop(jerk_mps3=3.0)),
    ("stop too weak", _stop(until_mps2=0.5)), ("stop too weak", _stop(jerk_mps3=0.05)), ("stop too weak", _weak_safe_stop),
    ("standstill brake", _standstill), ("steering tail", _tail), ("comfort stop", _comfort),
    ("status", _wrong_status), ("status", _status_without_cause),
]


@pytest.mark.req("G1")
@pytest.mark.parametrize(("rule", "break_it"), BROKEN, ids=[f"{k}-{rule}" for k, (rule, _) in enumerate(BROKEN)])
def test_each_violation_is_seen(rule, break_it):
    assert rule in break_it().rules


def reaction(fault, after_ticks, then):
    """Time of `fault` 3 ms before a tick; `then` changes what the gateway does from the given tick on."""
    script = Script().engage()
    script.oracle.mark_fault(script.now_ns + 7 * MS, fault)
    script.tick(after_ticks)
    then(script)
    script.tick(40)
    return script


def _lets_go(script):
    script.go("Disarm")


def _stops(script):
    script.go("Engage").edit = lambda sent, data: data


def _is_quiet(script):
    script.edit = lambda sent, data: None


@pytest.mark.parametrize("fault", [name for name, entry in REACTIONS.items() if entry.kind is Kind.STOP and entry.within_ns])
def test_a_stop_in_time_is_accepted_and_measured_and_a_late_one_is_not(fault):
    in_time = (REACTIONS[fault].within_ns - 3 * MS) // TICK_NS
    good = reaction(fault, in_time, _stops)
    assert "reaction" not in good.rules
    assert [(answer.fault, answer.latency_ns) for answer in good.oracle.reactions] == [(fault, in_time * TICK_NS + 3 * MS)]
    assert "reaction" in reaction(fault, in_time + 1, _stops).rules


def test_the_first_frame_after_waking_must_be_safe():
    script = Script().engage()
    script.now_ns += 500 * MS
    script.oracle.mark_fault(script.now_ns + TICK_NS, "F13")
    assert "reaction" in script.tick(2).rules


def test_a_gateway_that_was_stopped_answers_with_its_first_frame():
    script = Script().engage()
    script.oracle.mark_fault(script.now_ns, "F6")
    script.oracle.mark_gap(script.now_ns, script.now_ns + 510 * MS)
    script.now_ns += 500 * MS
    assert "reaction" not in script.go("Engage").tick(3).rules
    late = Script().engage()
    late.oracle.mark_fault(late.now_ns, "F6")
    late.oracle.mark_gap(late.now_ns, late.now_ns + 510 * MS)
    late.now_ns += 500 * MS
    assert "reaction" in late.tick(2).rules


def test_no_reaction_is_accepted_where_none_is_due_and_one_is_reported():
    assert reaction("F3", 10, lambda script: None).rules == set()
    assert "false reaction" in reaction("F3", 10, _stops).rules
    assert "false reaction" in reaction("F15", 10, _lets_go).rules


@pytest.mark.parametrize("react", [_lets_go, _is_quiet])
def test_silence_and_letting_go_are_both_reactions_to_a_dead_bus(react):
    in_time = reaction("F10", 5, react)
    assert "reaction" not in in_time.rules
    assert [answer.latency_ns for answer in in_time.oracle.reactions] == [53 * MS]
    assert "reaction" in reaction("F10", 7, react).rules


def test_a_driver_or_an_operator_may_have_the_car():
    for sign in ("RC_SafetyStatus", "SR_Status"):
        script = Script().engage()
        script.car(sign, {"DriverOverride": 1})
        assert script.go("Disarm").tick(1).rules == set()
    assert Script().engage().ask("DISENGAGE").go("Disarm").tick(1).rules == set()


def test_a_stop_by_the_gateway_is_no_answer_to_the_driver():
    assert "reaction" in reaction("E3", 0, _stops).rules
    assert "reaction" not in reaction("E3", 0, _lets_go).rules


def test_lost_frames_are_forgiven_where_the_oracle_may_lose_some_and_repeated_ones_never():
    script = Script(is_lossless=False).engage()
    script.edit = lambda sent, data: None if sent == "SR_Command" else data
    script.tick(3)
    script.edit = lambda sent, data: data
    assert script.tick(3).rules == set()
    script.edit = lambda sent, data: _other_counter(-1)(data) if sent == "SR_Command" else data
    assert "counter" in script.tick(1).rules


def test_after_questions_have_been_missing_the_last_one_may_be_answered_for_a_little_longer():
    for ticks, is_forgiven in ((6, True), (8, False)):
        script = Script().engage()
        script.answer = (script.question << 3 & 0xFF | script.question >> 5) ^ 0xA7
        script.car, car = lambda name, values: None, script.car
        script.tick(10)
        script.car = car
        assert script.tick(ticks).rules == (set() if is_forgiven else {"watchdog"}), ticks


def test_a_status_may_be_ahead_of_its_commands_by_two_of_them_where_a_bus_can_be_blocked():
    for ticks, is_forgiven in ((1, True), (2, True), (4, False)):
        script = Script(is_lossless=False).engage()
        script.status, script.cause = "SafeStop", "BusBlocked"
        script.tick(ticks)
        script.go("Engage").tick(4)
        assert script.rules == (set() if is_forgiven else {"status"}), ticks


def test_crc_is_the_one_of_the_standard():
    assert crc8h2f(b"123456789") == 0xDF  # check value of CRC-8H2F, AUTOSAR SWS_CRCLibrary
    rng = random.Random(1)
    for _ in range(200):
        payload, data_id = rng.randbytes(8), rng.randrange(1, 256)
        assert profile2_crc(payload, data_id) == crc8h2f(payload[1:] + bytes([data_id]))


def test_bits_are_read_as_cantools_reads_them():
    rng = random.Random(2)
    for path in DBC_FILES:
        for message in cantools.database.load_file(path, encoding="latin-1", strict=False).messages:
            if message.is_multiplexed():
                continue
            for _ in range(20):
                payload = rng.randbytes(message.length)
                decoded = message.decode(payload, decode_choices=False)
                assert {name: read(payload) for name, read in WIRE.by_name[message.name].readers.items()} == pytest.approx(decoded)


def test_motorola_bits_are_read_as_the_dbc_counts_them():
    assert bit_positions(7, 10, is_motorola=True) == [(0, 7 - k) for k in range(8)] + [(1, 7), (1, 6)]
    read = signal_reader(5, 12, is_motorola=True, is_signed=True, scale=0.5, offset=1.0)
    # Bits 5 to 0 of byte 0, then 7 to 2 of byte 1: 111111 111110 is -2.
    assert read(bytes([0xFF, 0xF8])) == -2 * 0.5 + 1.0


@pytest.mark.parametrize("name", PROFILES)
def test_the_limits_written_down_twice_are_the_same(name):
    """A limit that is changed on purpose is changed in two places; the oracle never reads the product's."""
    profile, envelope = PROFILES[name], ENVELOPES[name]
    angle_deg = min(math.degrees(profile.steering_wheel_limit_rad), 463.3)
    ours = (
        angle_deg, math.degrees(profile.steering_wheel_rate_radps), profile.lateral_acceleration_mps2, profile.lateral_jerk_mps3,
        profile.acceleration_mps2, profile.deceleration_mps2, profile.drive_jerk_mps3, profile.brake_jerk_mps3,
        3.6 * 1.1 * profile.max_speed_mps, profile.are_wheels_on_the_road,
    )
    assert ours == pytest.approx(tuple(vars(envelope).values()), rel=0.01)
    assert set(ENVELOPES) == set(PROFILES)
