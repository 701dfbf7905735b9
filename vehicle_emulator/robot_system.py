"""The robot controller with its three robots: gateway frames in, robot positions and status signals out."""

from collections.abc import Sequence
from typing import NamedTuple

from dbc.catalogue import Catalogue
from dbc.frame import CanFrame
from dbc.vehicle import Vehicle
from vehicle_emulator.commands import CommandReceiver
from vehicle_emulator.robots import PedalRobot, SteeringRobot
from vehicle_emulator.supervisor import STANDING_MPS, SafetyInputs, Supervisor, SystemState

STOP_DECELERATION_MPS2 = 3.0
"""Deceleration for which the brake robot has learned its stop position; UN R157 asks for 4.0 at most in such a manoeuvre."""
INTERLOCK_NORM = 0.01
"""Brake demand above which the accelerator is kept at zero."""

SUPERVISOR_MESSAGE = "RC_SafetyStatus"
COMMAND_MESSAGES = ("GW_SafetyCommand", "SR_Command", "AR_Command", "BR_Command")
STATUS_MESSAGES = (SUPERVISOR_MESSAGE, "SR_Status", "AR_Status", "BR_Status")

_HEALTHY = {"RemoteStopLinkUp": 1, "SrReady": 1, "ArReady": 1, "BrReady": 1, "SupplyVoltage": 13.5, "ControllerTemperature": 40}
"""Signals of RC_SafetyStatus that stay as they are in a healthy system."""


class RobotPositions(NamedTuple):
    """Where the robots are: steering-wheel angle [rad], left positive, and pedals, 0 to 1."""

    steering_wheel_rad: float
    accelerator_norm: float
    brake_norm: float


class RobotSystem:
    """Steps everything that stands between the gateway's commands and the car.

    Attributes:
        supervisor: state of the robot controller.
        was_engaged: whether the robots have ever been engaged.
    """

    def __init__(self, vehicle: Vehicle, catalogue: Catalogue, period_s: float) -> None:
        stop_norm = min(1.0, STOP_DECELERATION_MPS2 * vehicle.plant.mass_kg / vehicle.plant.full_brake_force_n)
        self._safety = CommandReceiver(catalogue, "GW_SafetyCommand")
        self._sr = SteeringRobot(catalogue, vehicle.robots.steering, period_s)
        self._ar = PedalRobot(catalogue, "AR", vehicle.robots.accelerator, period_s)
        self._br = PedalRobot(catalogue, "BR", vehicle.robots.brake, period_s, stop_norm)
        self._robots = {robot.status_message: robot for robot in (self._sr, self._ar, self._br)}
        self._receivers = {r.arbitration_id: r for r in (self._safety, *(robot.command for robot in self._robots.values()))}
        self._requests = {raw: name for name, raw in catalogue.enumeration("GW_SafetyCommand", "SystemRequest").items()}
        self._system_states = catalogue.enumeration(SUPERVISOR_MESSAGE, "SystemState")
        self._stop_sources = catalogue.enumeration(SUPERVISOR_MESSAGE, "StopSource")
        self._now_ns = 0
        self._is_dead_man_pressed = True
        self.supervisor = Supervisor()
        self.was_engaged = False

    @property
    def is_engaged(self) -> bool:
        """Whether the robots may follow commands now."""
        return self.supervisor.state is SystemState.ENGAGED

    @property
    def positions(self) -> RobotPositions:
        """Where the robots are."""
        return RobotPositions(self._sr.servo.position, self._ar.servo.position, self._br.servo.position)

    def step(self, now_ns: int, frames: Sequence[CanFrame], speed_mps: float, is_dead_man_pressed: bool = True) -> RobotPositions:
        """Take the frames that arrived, decide, move for one period and return where the robots are."""
        self._now_ns = now_ns
        self._is_dead_man_pressed = is_dead_man_pressed
        for frame in frames:
            if (receiver := self._receivers.get(frame.arbitration_id)) is not None:
                receiver.receive(now_ns, frame)
        self.supervisor.update(self._safety_inputs(now_ns, speed_mps))
        self.was_engaged = self.was_engaged or self.is_engaged
        state = self.supervisor.state
        brake_norm = self._br.demand_norm(state)
        self._sr.step(now_ns, state)
        self._ar.step(state, 0.0 if brake_norm > INTERLOCK_NORM else self._ar.demand_norm(state))
        self._br.step(state, brake_norm)
        return self.positions

    def _safety_inputs(self, now_ns: int, speed_mps: float) -> SafetyInputs:
        safety, is_fresh = self._safety.values, self._safety.is_fresh(now_ns)
        return SafetyInputs(
            request=self._requests.get(int(safety["SystemRequest"]), "None") if is_fresh else "None",
            is_emergency_stop_requested=is_fresh and bool(safety["EmergencyStopRequest"]),
            are_commands_fresh=all(receiver.is_fresh(now_ns) for receiver in self._receivers.values()),
            is_dead_man_pressed=self._is_dead_man_pressed,
            is_standing=abs(speed_mps) < STANDING_MPS,
        )

    def status(self, message: str) -> dict[str, float]:
        """Signals of one of `STATUS_MESSAGES`, in the units of the DBC."""
        if message == SUPERVISOR_MESSAGE:
            return self._supervisor_status()
        robot = self._robots[message]
        is_timed_out = not (self._safety.is_fresh(self._now_ns) and robot.command.is_fresh(self._now_ns))
        return robot.status(self.supervisor.state, is_timed_out)

    def _supervisor_status(self) -> dict[str, float]:
        safety = self._safety.values
        return _HEALTHY | {
            "SystemState": self._system_states[self.supervisor.state],
            "WatchdogResponse": 255 - int(safety["WatchdogChallenge"]),
            "SessionId": safety["SessionId"],
            "StopSource": self._stop_sources[self.supervisor.stop_source],
            "EmergencyStopActive": self.supervisor.state is SystemState.EMERGENCY_STOP,
            "DeadManPressed": self._is_dead_man_pressed,
        }
