"""The robot controller with its three robots, one millisecond at a time: frames, the car and the driver in, what acts on the car out.

A robot follows its command while the system is Engaged, the dead-man switch is pressed, its own Enable bit is set with an active
Mode, and its command is fresh. A frame counts only with the right length, CRC, alive counter, ranges and tables, when it does not
change the active Mode of an engaged robot, and when it does not change the session of an armed or engaged system. What does not
count never arrived. The system stops when any of the four commands has not come for GenMsgTimeout, or when its watchdog
question has not been answered for as long. What the robots do in a stop is told in `steering` and `pedal`.
"""

import math
from collections import deque
from collections.abc import Sequence
from random import Random
from typing import NamedTuple

from dbc.catalogue import Catalogue
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle
from dbc.watchdog import QUESTIONS, answer
from vehicle_emulator.driver import Driver
from vehicle_emulator.plants.interface import PlantInputs, PlantState
from vehicle_emulator.robots.faults import HEALTHY, RobotFaults
from vehicle_emulator.robots.pedal import PedalRobot
from vehicle_emulator.robots.receiver import CommandReceiver, Values
from vehicle_emulator.robots.reports import SOFTWARE_VERSION, WARMING_NS, FaultMemory, FaultReport, Thermometer, controller_degc, supply_v
from vehicle_emulator.robots.robot import Robot, View
from vehicle_emulator.robots.states import FAULTED, STARTING, Dtc, RobotState
from vehicle_emulator.robots.steering import SteeringRobot
from vehicle_emulator.robots.supervisor import RELEASED, STANDING_MPS, STOPS, SafetyInputs, Supervisor, SystemState

NODES = ("SR", "AR", "BR")
SUPERVISOR_MESSAGE = "RC_SafetyStatus"
REPORT_MESSAGE = "RC_FaultReport"
COMMAND_MESSAGES = ("GW_SafetyCommand", *(f"{node}_Command" for node in NODES))
STATUS_MESSAGES = (SUPERVISOR_MESSAGE, REPORT_MESSAGE, *(f"{node}_{kind}" for kind in ("Status", "Diag") for node in NODES))

INTERLOCK_NORM = 0.01
"""Brake demand above which the accelerator is kept at zero."""
QUESTIONS_OPEN = 4
"""Questions that may be answered at a time: status, gateway and command take up to three of their periods."""
_KMH_PER_MPS = 3.6


class PedalPositions(NamedTuple):
    """Where the pedal robots are, shares of the stroke; the driver's feet may be deeper."""

    accelerator_norm: float
    brake_norm: float


class RobotSystem:
    """Steps everything that stands between the gateway's commands and the car.

    Args:
        random: of jitter and sensor noise.

    Attributes:
        supervisor: state of the robot controller.
        was_engaged: whether the robots have ever been engaged.
        faults: what is wrong with each robot, by its node; values may be replaced at any time.
        memory: troubles since the start.
        watchdog_question: that the gateway has to answer now.
    """

    def __init__(self, vehicle: Vehicle, catalogue: Catalogue, period_s: float, random: Random) -> None:
        robots = vehicle.robots
        self._sr = SteeringRobot(catalogue, robots.steering, vehicle.multibody.steering.inertia_kgm2, period_s, random)
        self._ar = PedalRobot(catalogue, "AR", robots.accelerator, period_s=period_s, random=random)
        stop_n = robots.brake.stop_force_n
        self._br = PedalRobot(catalogue, "BR", robots.brake, period_s=period_s, random=random, stop_force_n=stop_n)
        self._robots: dict[str, Robot] = {robot.node: robot for robot in (self._sr, self._ar, self._br)}
        self._safety = CommandReceiver(catalogue, "GW_SafetyCommand", self._accepts)
        self._receivers = {r.arbitration_id: r for r in (self._safety, *(robot.command for robot in self._robots.values()))}
        self._requests = {raw: name for name, raw in catalogue.enumeration("GW_SafetyCommand", "SystemRequest").items()}
        self._system_states = catalogue.enumeration(SUPERVISOR_MESSAGE, "SystemState")
        self._stop_sources = catalogue.enumeration(SUPERVISOR_MESSAGE, "StopSource")
        self._question_period_ns = catalogue.by_name[SUPERVISOR_MESSAGE].cycle_time_ns
        self._watchdog_timeout_ns = catalogue.by_name["GW_SafetyCommand"].timeout_ns
        self._report = FaultReport(robots, catalogue.enumeration(REPORT_MESSAGE, "Robot"))
        self._codes = catalogue.enumeration(REPORT_MESSAGE, "Dtc")
        self._thermometers = {node: Thermometer() for node in NODES}
        self._start_ns: int | None = None
        self._now_ns = 0
        self._open_answers = deque([answer(0)], maxlen=QUESTIONS_OPEN)
        self._answered_ns = 0
        self._driver = Driver()
        self._conditions: tuple[object, ...] = ()
        self._next_warming_ns = 0
        self.faults: dict[str, RobotFaults] = dict.fromkeys(NODES, HEALTHY)
        self.supervisor = Supervisor()
        self.watchdog_question = 0
        self.memory = FaultMemory()
        self.was_engaged = False

    @property
    def is_engaged(self) -> bool:
        """Whether the robots may follow commands now."""
        return self.supervisor.state is SystemState.ENGAGED

    @property
    def pedals(self) -> PedalPositions:
        """Where the pedal robots are."""
        return PedalPositions(self._ar.position_norm, self._br.position_norm)

    @property
    def rejected(self) -> dict[str, dict[Dtc, int]]:
        """Command frames that did not count, by node and cause; RC stands for the safety command."""
        return {"RC": dict(self._safety.rejected), **{node: dict(robot.command.rejected) for node, robot in self._robots.items()}}

    def step(self, now_ns: int, frames: Sequence[CanFrame], feedback: PlantState, driver: Driver) -> PlantInputs:
        """Take the frames that arrived, decide, move for one period and return what acts on the car until the next step.

        Args:
            feedback: the car as the last step of its plant has left it.
        """
        self._start_ns = now_ns if self._start_ns is None else self._start_ns
        self._now_ns, self._driver = now_ns, driver
        self._ask(now_ns)
        self._receive(now_ns, frames)
        inputs = self._safety_inputs(now_ns, math.hypot(feedback.vx_mps, feedback.vy_mps))
        self.supervisor.update(inputs)
        self.was_engaged = self.was_engaged or self.is_engaged
        clears_faults = inputs.request == "ClearFaults"
        view = View(now_ns, self.supervisor.state, self._safety.is_fresh(now_ns), inputs.is_overridden, clears_faults)
        for node, robot in self._robots.items():
            robot.faults = self.faults[node]
        self._ar.decide(view, driver.accelerator_norm)
        self._br.decide(view, driver.brake_norm)
        steering = self._sr.step(view, feedback, driver)
        brake_norm = self._br.demand_norm(view)
        accelerator_norm = self._ar.move(view, 0.0 if brake_norm > INTERLOCK_NORM else self._ar.demand_norm(view))
        brake_norm = self._br.move(view, brake_norm)
        self._remember(view)
        return PlantInputs(steering, accelerator_norm, brake_norm, driver.selector)

    def _accepts(self, values: Values) -> bool:
        """A session changes in standby only; in a stop as well, so that a gateway that was restarted can end it."""
        is_bound = self.supervisor.state in (SystemState.ARMED, SystemState.ENGAGED)
        return int(values["SystemRequest"]) in self._requests and not (is_bound and values["SessionId"] != self._safety.values["SessionId"])

    def _ask(self, now_ns: int) -> None:
        """Ask a new question with every period of the status; a few before it stay open, as new ones may cross the answer on the bus."""
        question = now_ns // self._question_period_ns % QUESTIONS
        if question != self.watchdog_question:
            self.watchdog_question = question
            self._open_answers.append(answer(question))

    def _receive(self, now_ns: int, frames: Sequence[CanFrame]) -> None:
        for frame in frames:
            receiver = self._receivers.get(frame.arbitration_id)
            if receiver is None or not receiver.receive(now_ns, frame) or receiver is not self._safety:
                continue
            if int(receiver.values["WatchdogAnswer"]) in self._open_answers:
                self._answered_ns = now_ns

    def _safety_inputs(self, now_ns: int, speed_mps: float) -> SafetyInputs:
        safety, is_safety_fresh = self._safety.values, self._safety.is_fresh(now_ns)
        stale = [receiver for receiver in self._receivers.values() if not receiver.is_fresh(now_ns)]
        states = self._sr.state, self._ar.state, self._br.state
        return SafetyInputs(
            request=self._requests[int(safety["SystemRequest"])] if is_safety_fresh else "None",
            is_stop_button_pressed=self._driver.is_stop_button_pressed,
            is_stop_requested=is_safety_fresh and bool(safety["EmergencyStopRequest"]),
            are_commands_fresh=not stale,
            are_frames_bad=any(receiver.trouble in (Dtc.COMMAND_CRC, Dtc.COMMAND_COUNTER) for receiver in stale),
            is_watchdog_answered=now_ns - self._answered_ns <= self._watchdog_timeout_ns,
            is_dead_man_pressed=self._driver.is_dead_man_pressed,
            have_robots_started=STARTING.isdisjoint(states),
            has_robot_fault=not FAULTED.isdisjoint(states),
            is_overridden=self._is_overridden,
            is_too_fast=_KMH_PER_MPS * speed_mps > safety["MaxSpeed"],
            is_standing=speed_mps < STANDING_MPS,
        )

    @property
    def _is_overridden(self) -> bool:
        return self._sr.is_overridden or self._ar.is_overridden or self._br.is_overridden

    def _remember(self, view: View) -> None:
        """Keep the fault memory and, now and then, the temperatures up to date."""
        rc_trouble = (self._safety.trouble, self._safety.is_overdue(view.now_ns))
        conditions = (rc_trouble, self._sr.condition, self._ar.condition, self._br.condition)
        if conditions != self._conditions:
            self._conditions = conditions
            names = (rc_trouble[0], Dtc.COMMAND_TIMEOUT if rc_trouble[1] else None)
            self.memory.note(self._elapsed_s, "RC", frozenset(self._codes[name] for name in names if name is not None), 0)
            for node, robot in self._robots.items():
                self.memory.note(self._elapsed_s, node, robot.troubles, robot.latched)
        if view.clears_faults and view.state in RELEASED:
            self.memory.clear("RC")
        for node, robot in self._robots.items():
            if robot.clears(view):
                self.memory.clear(node)
        if view.now_ns >= self._next_warming_ns:
            self._next_warming_ns = view.now_ns + WARMING_NS
            for node, robot in self._robots.items():
                self._thermometers[node].step(robot.effort)

    @property
    def _elapsed_s(self) -> float:
        return 0.0 if self._start_ns is None else (self._now_ns - self._start_ns) * 1e-9

    def is_silent(self, message: str) -> bool:
        """Whether the sender of one of `STATUS_MESSAGES` sends nothing now."""
        node = message.partition("_")[0]
        return node in self.faults and self.faults[node].is_silent

    def status(self, message: str) -> dict[str, float]:
        """Signals of one of `STATUS_MESSAGES`, in the units of the DBC."""
        if message == SUPERVISOR_MESSAGE:
            return self._supervisor_status()
        if message == REPORT_MESSAGE:
            return self._report.signals(self.memory)
        node, _, kind = message.partition("_")
        return self._diagnosis(node) if kind == "Diag" else self._robots[node].status()

    def _diagnosis(self, node: str) -> dict[str, float]:
        robot = self._robots[node]
        return self._thermometers[node].signals(robot.effort) | {
            "SupplyVoltage": self._supply_v,
            "Dtc": robot.dtc,
            "CommandErrorCount": min(robot.command.rejected.total(), 255),
            "SoftwareVersion": SOFTWARE_VERSION,
        }

    @property
    def _supply_v(self) -> float:
        return supply_v(self._elapsed_s, (robot.effort for robot in self._robots.values()))

    def _supervisor_status(self) -> dict[str, float]:
        state = self.supervisor.state
        return {
            "SystemState": self._system_states[state],
            "WatchdogQuestion": self.watchdog_question,
            "SessionId": self._safety.values["SessionId"],
            "StopSource": self._stop_sources[self.supervisor.stop_source],
            "EmergencyStopActive": state is SystemState.EMERGENCY_STOP,
            "DeadManPressed": self._driver.is_dead_man_pressed,
            "RemoteStopLinkUp": 1,
            "DriverOverride": self._is_overridden,
            "SrReady": self._sr.is_ready,
            "ArReady": self._ar.is_ready,
            "BrReady": self._br.is_ready,
            "MeasurementId": self._safety.values["MeasurementId"],
            "BrakeFallback": state in STOPS and self._br.state is RobotState.FAULT_HARD,
            "SupplyVoltage": self._supply_v,
            "ControllerTemperature": controller_degc(self._elapsed_s),
        }
