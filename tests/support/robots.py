"""A car for gateway tests: answers on the bus as configured, remembers what it was told. Written from the DBC alone."""

from dataclasses import dataclass, field

from dbc.catalogue import Catalogue
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame

TICK_NS = 10_000_000


@dataclass
class StubCar:
    """Every field is a signal value that the next cycle of frames carries."""

    catalogue: Catalogue
    vx_mps: float = 20.0
    steering_wheel_deg: float = 0.0
    accelerator_percent: float = 0.0
    brake_percent: float = 0.0
    position_mode: str = "RTKInteger"
    system_state: str | None = None  # None: follow the gateway's request, as a robot controller does
    dead_man: int = 1
    override: int = 0
    fault: int = 0
    command_timeout: int = 0
    is_time_frozen: bool = False
    silent: set[str] = field(default_factory=set)
    corrupt: set[str] = field(default_factory=set)

    def __post_init__(self):
        self._protectors = {s.name: E2EProtector(s.e2e_data_id) for s in self.catalogue.by_name.values() if s.e2e_data_id}
        self._time_ms = 0
        self._state = "Disarmed"
        self.told: dict[str, dict[str, float]] = {}

    def hear(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            spec = self.catalogue.by_id[frame.arbitration_id]
            self.told[spec.name] = self.catalogue.decode(spec, frame)
        requests = {raw: name for name, raw in self.catalogue.enumeration("GW_SafetyCommand", "SystemRequest").items()}
        request = requests[self.told["GW_SafetyCommand"]["SystemRequest"]]
        self._state = {"Disarm": "Disarmed", "Arm": "Armed", "Engage": "Engaged"}[request]

    def speak(self, now_ns: int) -> list[CanFrame]:
        self._time_ms += 0 if self.is_time_frozen else 10
        robot = {"Fault": self.fault, "CommandTimeout": self.command_timeout}
        states = self.catalogue.enumeration("RC_SafetyStatus", "SystemState")
        messages = {
            "PosLocal": {"PosLocalX": 12.5, "PosLocalY": -3.25},
            "VelocityLevel": {"VelForward": self.vx_mps, "VelLateral": 0.5},
            "VelYawLocal": {"AngleLocalYaw": 10.0},
            "RateVehicle": {"AngRateZ": -5.0},
            "AccelLevel": {},
            "NcomStatus00": {"PosMode": self.catalogue.enumeration("NcomStatus00", "PosMode")[self.position_mode]},
            "RC_SafetyStatus": {
                "SystemState": states[self.system_state or self._state],
                "DeadManPressed": self.dead_man,
                "DriverOverride": self.override,
                "SrReady": 1, "ArReady": 1, "BrReady": 1,
            },
            "SR_Status": {"AngleActual": self.steering_wheel_deg, **robot},
            "AR_Status": {"PositionActual": self.accelerator_percent, **robot},
            "BR_Status": {"PositionActual": self.brake_percent, **robot},
            "MilliTime": {"MilliTime": self._time_ms},
        }
        return [self._frame(name, values, now_ns) for name, values in messages.items() if name not in self.silent]

    def _frame(self, name, values, now_ns):
        payload = self.catalogue.encode(name, values)
        if name in self._protectors:
            payload = self._protectors[name].protect(payload)
        if name in self.corrupt:
            payload = bytes([payload[0] ^ 0xFF]) + payload[1:]
        return CanFrame(self.catalogue.by_name[name].arbitration_id, payload, now_ns)
