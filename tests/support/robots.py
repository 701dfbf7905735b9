"""A car for gateway tests: answers on the bus as configured, remembers what it was told. Written from the DBC alone."""

import math
from dataclasses import dataclass, field

from dbc.catalogue import Catalogue
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame

TICK_NS = 10_000_000
WHEEL_RADIUS_M, WHEELBASE_M, STEERING_RATIO = 0.31, 2.648, 14.7  # dbc/focus.toml, as are those in `_follow`


@dataclass
class StubCar:
    """Every field is a signal value that the next cycle of frames carries; the position is where speed and yaw rate lead.

    Attributes:
        is_following: whether the robots follow their commands and the car its robots; else speed and yaw rate are as they are set.
        foot_percent: where the driver has the brake while the robots are not engaged; with `is_following` only.
        wheel_speed_offset_mps: error of the wheel-speed sensors.
        override_of: robots ("SR", "AR", "BR") at which the driver takes over.
        is_asking: whether the robot controller asks new watchdog questions.
        is_echoing: whether it tells which measurement the robots follow.
        silent, corrupt: messages that do not come, or with a wrong first byte.
        told: newest values of each message of the gateway.
    """

    catalogue: Catalogue
    vx_mps: float = 20.0
    steering_wheel_deg: float = 0.0
    steering_wheel_rate_dps: float = 0.0
    accelerator_percent: float = 0.0
    brake_percent: float = 0.0
    foot_percent: float = 0.0
    acceleration_mps2: float = 0.0
    is_following: bool = False
    vy_mps: float = -0.5
    x_m: float = 12.5
    y_m: float = -3.25
    yaw_rad: float = math.radians(10.0)
    yaw_rate_radps: float = math.radians(5.0)
    wheel_speed_offset_mps: float = 0.0
    position_mode: str = "RTKInteger"
    selector: str = "D"
    system_state: str | None = None  # None: follow the gateway's request, as a robot controller does
    dead_man: int = 1
    ready: int = 1
    override: int = 0
    fault: int = 0
    command_timeout: int = 0
    emergency_stop: int = 0
    override_of: set[str] = field(default_factory=set)
    is_time_frozen: bool = False
    is_asking: bool = True
    is_echoing: bool = True
    silent: set[str] = field(default_factory=set)
    corrupt: set[str] = field(default_factory=set)

    def __post_init__(self):
        self._protectors = {s.name: E2EProtector(s.e2e_data_id) for s in self.catalogue.by_name.values() if s.e2e_data_id}
        self._requests = {raw: name for name, raw in self.catalogue.enumeration("GW_SafetyCommand", "SystemRequest").items()}
        self._states = self.catalogue.enumeration("RC_SafetyStatus", "SystemState")
        self._position_modes = self.catalogue.enumeration("NcomStatus00", "PosMode")
        self._selectors = self.catalogue.enumeration("CAR_Powertrain", "Selector")
        self._time_ms = 0
        self._question = 0
        self._state = "Disarmed"
        self._payloads: dict[str, tuple[dict[str, float], bytes]] = {}
        self.told: dict[str, dict[str, float]] = {}

    def hear(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            spec = self.catalogue.by_id[frame.arbitration_id]
            self.told[spec.name] = self.catalogue.decode(spec, frame)
            if spec.name != "GW_SafetyCommand":
                continue
            request = self._requests[self.told[spec.name]["SystemRequest"]]
            self._state = {"Disarm": "Disarmed", "None": "Disarmed", "Arm": "Armed", "Engage": "Engaged"}[request]

    @property
    def is_engaged(self) -> bool:
        return self._state == "Engaged"

    def let_go(self) -> None:
        """The robots miss their commands."""
        self._state = "Disarmed"

    def speak(self, now_ns: int) -> list[CanFrame]:
        """The frames of one cycle of 10 ms."""
        self._move(TICK_NS * 1e-9)
        self._time_ms += 0 if self.is_time_frozen else 10
        self._question = (self._question + 37) % 256 if self.is_asking else self._question
        return [self._frame(name, values, now_ns) for name, values in self._messages().items() if name not in self.silent]

    def _move(self, dt_s: float) -> None:
        if self.is_following:
            self._follow(dt_s)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        self.x_m += (self.vx_mps * cos - self.vy_mps * sin) * dt_s
        self.y_m += (self.vx_mps * sin + self.vy_mps * cos) * dt_s
        self.yaw_rad = math.remainder(self.yaw_rad + self.yaw_rate_radps * dt_s, 2.0 * math.pi)

    def _follow(self, dt_s: float) -> None:
        """The robots follow their commands, and the car its robots."""
        lagging = 1.0 - math.exp(-dt_s / 0.03)
        steering_deg, drive_percent, brake_percent = self.steering_wheel_deg, 0.0, self.foot_percent
        if self.is_engaged:
            steering_deg = self.told["SR_Command"]["AngleCommand"]
            drive_percent, brake_percent = (self.told[name]["PositionCommand"] for name in ("AR_Command", "BR_Command"))
        self.steering_wheel_rate_dps = (steering_deg - self.steering_wheel_deg) * lagging / dt_s
        self.steering_wheel_deg += self.steering_wheel_rate_dps * dt_s
        self.accelerator_percent += (drive_percent - self.accelerator_percent) * lagging
        self.brake_percent += (brake_percent - self.brake_percent) * lagging
        before_mps = self.vx_mps
        self.vx_mps = max(0.0, before_mps + (48.387 * self.accelerator_percent - 150.0 * self.brake_percent) / 1500.0 * dt_s)
        self.acceleration_mps2 = (self.vx_mps - before_mps) / dt_s
        self.yaw_rate_radps = self.vx_mps * math.tan(math.radians(self.steering_wheel_deg) / STEERING_RATIO) / WHEELBASE_M

    def _messages(self) -> dict[str, dict[str, float]]:
        wheel_radps = (self.vx_mps + self.wheel_speed_offset_mps) / WHEEL_RADIUS_M
        safety = self.told.get("GW_SafetyCommand", {})
        return {
            "PosLocal": {"PosLocalX": self.x_m, "PosLocalY": self.y_m},
            "VelocityLevel": {"VelForward": self.vx_mps, "VelLateral": -self.vy_mps},  # the instrument counts to the right
            "VelYawLocal": {"AngleLocalYaw": math.degrees(self.yaw_rad)},
            "RateVehicle": {"AngRateZ": -math.degrees(self.yaw_rate_radps)},
            "AccelLevel": {"AccelForward": self.acceleration_mps2},
            "NcomStatus00": {"PosMode": self._position_modes[self.position_mode]},
            "RC_SafetyStatus": {
                "SystemState": self._states[self.system_state or self._state],
                "EmergencyStopActive": self.emergency_stop,
                "DeadManPressed": self.dead_man,
                "DriverOverride": self.override,
                "SrReady": self.ready, "ArReady": self.ready, "BrReady": self.ready,
                "WatchdogQuestion": self._question,
                "MeasurementId": safety.get("MeasurementId", 0) if self.is_echoing else 0,
            },
            "SR_Status": {"AngleActual": self.steering_wheel_deg, "RateActual": self.steering_wheel_rate_dps, **self._robot("SR")},
            "AR_Status": {"PositionActual": self.accelerator_percent, **self._robot("AR")},
            "BR_Status": {"PositionActual": self.brake_percent, **self._robot("BR")},
            "CAR_WheelSpeeds": dict.fromkeys(("FrontLeft", "FrontRight", "RearLeft", "RearRight"), wheel_radps),
            "CAR_Powertrain": {
                "Selector": self._selectors[self.selector],
                "AcceleratorPedal": self.accelerator_percent, "BrakePedal": self.brake_percent,
            },
            "MilliTime": {"MilliTime": self._time_ms},
        }

    def _robot(self, node: str) -> dict[str, float]:
        return {"Fault": self.fault, "CommandTimeout": self.command_timeout, "DriverOverride": node in self.override_of}

    def _frame(self, name: str, values: dict[str, float], now_ns: int) -> CanFrame:
        payload = self._payload(name, values)
        if name in self._protectors:
            payload = self._protectors[name].protect(payload)
        if name in self.corrupt:
            payload = bytes([payload[0] ^ 0xFF]) + payload[1:]
        return CanFrame(self.catalogue.by_name[name].arbitration_id, payload, now_ns)

    def _payload(self, name: str, values: dict[str, float]) -> bytes:
        """Payload of these values; that of the previous cycle when nothing has changed."""
        before = self._payloads.get(name)
        if before is None or before[0] != values:
            before = self._payloads[name] = (values, self.catalogue.encode(name, values, saturates=True))
        return before[1]
