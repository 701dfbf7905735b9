"""Steering robot (SR), accelerator robot (AR) and brake robot (BR): command in, motion, status out.

A robot follows its command only while the robot controller is Engaged, its own Enable bit is set and its Mode is position control.
What it does otherwise:

    released   steering returns to straight ahead, the pedal is retracted
    stop       steering holds for `RAMP_OUT_NS` while its torque fades, then returns to straight ahead as tyres pull a free wheel;
               accelerator retracted; brake at its learned stop position, also at standstill

A frozen steering angle would be right in a long bend and wrong in a lane change; a free wheel is what a robot leaves that takes its
torque away. Torque and force limits of the commands are not modelled, their rate limits are.
"""

import math

from dbc.catalogue import Catalogue
from dbc.vehicle import PedalRobot as PedalRobotParameters
from dbc.vehicle import SteeringRobot as SteeringRobotParameters
from vehicle_emulator.actuators import Servo
from vehicle_emulator.commands import CommandReceiver
from vehicle_emulator.supervisor import STOPS, SystemState

RAMP_OUT_NS = 300_000_000
"""Assumption: time in which the steering robot fades its torque out."""
CENTRING_RADPS = 1.0
"""Assumption: steering-wheel rate at which a released wheel returns to the centre."""

_STATES = {
    SystemState.DISARMED: "Standby",
    SystemState.ARMED: "Armed",
    SystemState.ENGAGED: "Engaged",
    SystemState.CONTROLLED_STOP: "SafeStop",
    SystemState.EMERGENCY_STOP: "EStop",
}
"""State that a robot reports, an entry of the DBC's table; an engaged robot without Enable reports Armed."""


class Robot:
    """What the three robots have in common.

    Args:
        node: the robot's node in the DBC; its messages are NODE_Command and NODE_Status.
        position_mode: entry of the command's Mode table that means position control.
    """

    def __init__(self, catalogue: Catalogue, node: str, position_mode: str, servo: Servo) -> None:
        self.command = CommandReceiver(catalogue, f"{node}_Command")
        self.status_message = f"{node}_Status"
        self.servo = servo
        self._position_mode = catalogue.enumeration(f"{node}_Command", "Mode")[position_mode]
        self._states = catalogue.enumeration(self.status_message, "State")

    def follows(self, state: SystemState) -> bool:
        """Whether the robot may do what its command says."""
        values = self.command.values
        return state is SystemState.ENGAGED and bool(values["Enable"]) and values["Mode"] == self._position_mode

    def _common_status(self, state: SystemState, is_timed_out: bool) -> dict[str, float]:
        is_following = self.follows(state)
        name = "Armed" if state is SystemState.ENGAGED and not is_following else _STATES[state]
        return {
            "State": self._states[name],
            "LimitRate": self.servo.is_at_rate_limit,
            "Tracking": is_following,
            "CommandTimeout": is_timed_out,
        }


class SteeringRobot(Robot):
    """Turns the steering wheel."""

    def __init__(self, catalogue: Catalogue, parameters: SteeringRobotParameters, period_s: float) -> None:
        p = parameters
        servo = Servo(
            period_s,
            bandwidth_hz=p.bandwidth_hz,
            damping_ratio=p.damping_ratio,
            dead_time_s=p.dead_time_s,
            rate_limit=p.rate_limit_radps,
            low=-p.range_rad,
            high=p.range_rad,
        )
        super().__init__(catalogue, "SR", "AnglePosition", servo)
        self._demand_rad = 0.0
        self._stop_began_ns: int | None = None

    def step(self, now_ns: int, state: SystemState) -> None:
        """Move for one period."""
        if state not in STOPS:
            self._stop_began_ns = None
        elif self._stop_began_ns is None:
            self._stop_began_ns = now_ns
        rate_limit_radps = CENTRING_RADPS
        if self.follows(state):
            self._demand_rad = math.radians(self.command.values["AngleCommand"])
            rate_limit_radps = math.radians(self.command.values["RateLimit"])
        elif self._stop_began_ns is None or now_ns - self._stop_began_ns >= RAMP_OUT_NS:
            self._demand_rad = 0.0
        self.servo.step(self._demand_rad, rate_limit_radps)

    def status(self, state: SystemState, is_timed_out: bool) -> dict[str, float]:
        """Signals of SR_Status, in the units of the DBC."""
        return self._common_status(state, is_timed_out) | {
            "AngleActual": math.degrees(self.servo.position),
            "RateActual": math.degrees(self.servo.rate),
            "LimitAngle": self.servo.is_at_end_stop,
        }


class PedalRobot(Robot):
    """Presses one pedal; positions are shares of the learned stroke.

    Args:
        stop_norm: position in a stop.
    """

    def __init__(
        self, catalogue: Catalogue, node: str, parameters: PedalRobotParameters, period_s: float, stop_norm: float = 0.0
    ) -> None:
        p = parameters
        servo = Servo(
            period_s,
            bandwidth_hz=p.bandwidth_hz,
            damping_ratio=p.damping_ratio,
            dead_time_s=p.dead_time_s,
            rate_limit=p.rate_limit_per_s,
            low=0.0,
            high=1.0,
        )
        super().__init__(catalogue, node, "Position", servo)
        self._stroke_m = p.stroke_m
        self._stop_norm = stop_norm

    def demand_norm(self, state: SystemState) -> float:
        """Position wanted now."""
        if state in STOPS:
            return self._stop_norm
        return 0.01 * self.command.values["PositionCommand"] if self.follows(state) else 0.0

    def step(self, state: SystemState, demand_norm: float) -> None:
        """Move for one period; on its own the robot moves as fast as it can."""
        rate_limit_per_s = 1e-3 * self.command.values["RateLimit"] / self._stroke_m if self.follows(state) else math.inf
        self.servo.step(demand_norm, rate_limit_per_s)

    def status(self, state: SystemState, is_timed_out: bool) -> dict[str, float]:
        """Signals of AR_Status or BR_Status, in the units of the DBC."""
        return self._common_status(state, is_timed_out) | {
            "PositionActual": 100.0 * self.servo.position,
            "PositionStroke": 1e3 * self._stroke_m * self.servo.position,
            "LimitPosition": self.servo.is_at_end_stop,
        }
