"""A gateway reduced to its frames, written from the DBC alone."""

from collections.abc import Callable

from dbc.catalogue import Catalogue
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame


class GatewayStub:
    """Makes protected command frames; every call of `frames` advances the alive counters.

    Args:
        question: what the robot controller's watchdog asks now.
    """

    def __init__(self, catalogue: Catalogue, question: Callable[[], int]) -> None:
        self.catalogue = catalogue
        self.requests = catalogue.enumeration("GW_SafetyCommand", "SystemRequest")
        self._protectors: dict[str, E2EProtector] = {}
        self._question = question

    def frame(self, name: str, values: dict[str, float], t_ns: int = 0) -> CanFrame:
        spec = self.catalogue.by_name[name]
        assert spec.e2e_data_id is not None
        protector = self._protectors.setdefault(name, E2EProtector(spec.e2e_data_id))
        return CanFrame(spec.arbitration_id, protector.protect(self.catalogue.encode(name, values)), t_ns)

    def safety(self, request: str, **values: float) -> CanFrame:
        question = self._question()
        watchdog_answer = ((question << 3 | question >> 5) & 0xFF) ^ 0xA7
        defaults = {"SystemRequest": self.requests[request], "WatchdogAnswer": watchdog_answer, "MaxSpeed": 255}
        return self.frame("GW_SafetyCommand", {**defaults, **values})

    def steering(
        self, angle_deg: float, enable: bool = True, mode: str = "AnglePosition", rate_dps: float = 2550.0, **values: float
    ) -> CanFrame:
        modes = self.catalogue.enumeration("SR_Command", "Mode")
        defaults = {"Mode": modes[mode], "Enable": enable, "AngleCommand": angle_deg, "RateLimit": rate_dps, "TorqueLimit": 60.0}
        return self.frame("SR_Command", {**defaults, **values})

    def pedal(
        self, node: str, percent: float, enable: bool = True, rate_mmps: float = 2550.0, mode: str = "Position", **values: float
    ) -> CanFrame:
        name = f"{node}_Command"
        modes = self.catalogue.enumeration(name, "Mode")
        defaults = {"Mode": modes[mode], "Enable": enable, "PositionCommand": percent, "RateLimit": rate_mmps, "ForceLimit": 510.0}
        return self.frame(name, {**defaults, **values})

    def frames(self, request: str, sr_deg: float = 0.0, ar_percent: float = 0.0, br_percent: float = 0.0) -> list[CanFrame]:
        return [self.safety(request), self.steering(sr_deg), self.pedal("AR", ar_percent), self.pedal("BR", br_percent)]
