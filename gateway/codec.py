"""Bus values to SI and back: the only module of the gateway that knows message and signal names, degrees and per cent."""

import math
from dataclasses import asdict, dataclass, replace

from dbc.catalogue import Catalogue, CatalogueError, EncodeError
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from dbc.watchdog import answer
from gateway.causes import Cause, Finding
from gateway.limits import Demand, Resolution
from gateway.messages import Mode
from gateway.modes import DRIVING

NAVIGATION_MESSAGES = ("PosLocal", "VelocityLevel", "VelYawLocal", "RateVehicle", "AccelLevel", "MilliTime", "NcomStatus00")
ROBOT_MESSAGES = ("RC_SafetyStatus", "SR_Status", "AR_Status", "BR_Status")
CAR_MESSAGES = ("CAR_WheelSpeeds", "CAR_Powertrain")
NEEDED_MESSAGES = NAVIGATION_MESSAGES + ROBOT_MESSAGES + CAR_MESSAGES
COMMAND_MESSAGES = ("GW_SafetyCommand", "SR_Command", "AR_Command", "BR_Command")
MONITOR_MESSAGES = ("GW_Heartbeat", "GW_Status")
ROBOT_NODES = ("SR", "AR", "BR")

USABLE_POSITION_MODES = ("RTKInteger", "RTKFloat", "GxInteger", "GxFloat", "IxInteger", "IxFloat")
"""Position modes good to about 0.2 m; with any other the car would leave its lane without noticing."""

_NS_PER_MS = 1_000_000
_MPS_PER_KMH = 1.0 / 3.6


@dataclass(slots=True)
class Measurement:
    """Everything the gateway knows of the car, in SI units and ISO 8855 axes; updated in place as messages arrive.

    Args:
        wheel_speed_radps: front left, front right, rear left, rear right.
        accelerator_norm, brake_norm: where the pedal robots are, shares of the stroke.
        accelerator_pedal_norm, brake_pedal_norm: where the pedals are; a driver's foot may be deeper than the robot.
        faulty_robots, deaf_robots, overridden_robots: nodes that report a fault, missing commands, a driver who takes over.
        watchdog_question: the newest of the robot controller.
        measurement_id: that the robot controller echoes.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    ax_mps2: float = 0.0
    navigation_time_ms: int = -1
    is_navigation_precise: bool = False
    steering_wheel_rad: float = 0.0
    steering_wheel_rate_radps: float = 0.0
    steering_torque_nm: float = 0.0
    accelerator_norm: float = 0.0
    brake_norm: float = 0.0
    wheel_speed_radps: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    accelerator_pedal_norm: float = 0.0
    brake_pedal_norm: float = 0.0
    is_in_drive: bool = False
    faulty_robots: tuple[str, ...] = ()
    deaf_robots: tuple[str, ...] = ()
    overridden_robots: tuple[str, ...] = ()
    watchdog_question: int = 0
    measurement_id: int = 0
    is_armed: bool = False
    is_engaged: bool = False
    is_emergency_stopped: bool = False
    is_stopped_by_robots: bool = False
    is_dead_man_pressed: bool = False
    is_driver_override: bool = False
    are_robots_ready: bool = False
    stop_source: str = "None"

    @property
    def wheels_radps(self) -> float:
        """Speed of the wheels: their median, which one of them cannot spoil."""
        _, slower, faster, _ = sorted(self.wheel_speed_radps)
        return (slower + faster) / 2.0


@dataclass(frozen=True, slots=True)
class RobotLimits:
    """Limits that travel with every command for the robots to apply themselves."""

    steering_wheel_rate_radps: float
    max_speed_mps: float
    steering_torque_nm: float = 40.0
    pedal_rate_mps: float = 1.0
    accelerator_force_n: float = 200.0
    brake_force_n: float = 1000.0


@dataclass(frozen=True, slots=True)
class Cycle:
    """What the safety command says besides mode and demand.

    Args:
        command_age_ms: time since a command was admitted [ms].
        measurement_id: of the measurement that the demands answer.
        watchdog_question: that is to be answered.
    """

    command_age_ms: float
    measurement_id: int
    watchdog_question: int
    is_navigation_valid: bool


@dataclass(frozen=True, slots=True)
class Monitors:
    """What bus monitors are told.

    Args:
        bus_load_norm, cpu_load_norm: see `conditions.Surroundings`.
        rejected: frames that were not taken.
        tx_error_count: of the CAN controllers, the largest; 0 or less where none tells.
        finding: why the last engagement ended; None when none has.
    """

    uptime_s: float
    bus_load_norm: float
    cpu_load_norm: float
    rejected: int
    tx_error_count: int
    mode: Mode
    finding: Finding | None


class Codec:
    """Decodes measurements and encodes demands by the catalogue.

    Attributes:
        resolution: of the demands.

    Raises:
        CatalogueError: the catalogue is not what the gateway needs; one line says what it lacks.
    """

    def __init__(self, catalogue: Catalogue, limits: RobotLimits) -> None:
        catalogue.require(NEEDED_MESSAGES + COMMAND_MESSAGES + MONITOR_MESSAGES, "gateway")
        self._catalogue = catalogue
        self._limits = limits
        self._protectors: dict[str, E2EProtector] = {}
        self._robots: dict[str, dict[str, float]] = {}
        # From then on a value outside a site's range becomes the nearest one in it: better than no command at all.
        self._is_rehearsed = False
        try:
            self._read_tables()
            self._rehearse()
            self.resolution = self._resolution()
        except (KeyError, EncodeError) as error:
            raise CatalogueError(f"{', '.join(catalogue.sha256)}: not what the gateway needs: {error}") from error
        self._robots.clear()
        self._is_rehearsed = True
        self._protectors = {
            spec.name: E2EProtector(spec.e2e_data_id) for spec in catalogue.by_name.values() if spec.e2e_data_id is not None
        }

    def _read_tables(self) -> None:
        catalogue = self._catalogue
        self._system_states = catalogue.enumeration("RC_SafetyStatus", "SystemState")
        self._stop_sources = {raw: name for name, raw in catalogue.enumeration("RC_SafetyStatus", "StopSource").items()}
        self._requests = catalogue.enumeration("GW_SafetyCommand", "SystemRequest")
        modes = catalogue.enumeration("NcomStatus00", "PosMode")
        self._usable_position_modes = {modes[name] for name in USABLE_POSITION_MODES}
        self._steer_modes = catalogue.enumeration("SR_Command", "Mode")
        self._pedal_modes = catalogue.enumeration("AR_Command", "Mode")
        self._drive = catalogue.enumeration("CAR_Powertrain", "Selector")["D"]
        mode_codes, cause_codes = (catalogue.enumeration("GW_Status", signal) for signal in ("Mode", "Cause"))
        self._mode_codes = {mode: mode_codes[_camel(mode.name)] for mode in Mode}
        self._cause_codes = {cause: cause_codes[_camel(cause.name)] for cause in Cause}

    def _rehearse(self) -> None:
        """Use every signal and every table entry once, so that a site's DBC that lacks one is refused now, not on the road."""
        self.update(Measurement(), {name: dict.fromkeys(self._catalogue.signals(name), 0.0) for name in NEEDED_MESSAGES})
        for mode in Mode:
            self.encode(_REHEARSAL_NS, mode, _REHEARSED_DEMAND, _REHEARSED_CYCLE)
            self.encode_monitors(_REHEARSAL_NS, replace(_REHEARSED_MONITORS, mode=mode))

    def _resolution(self) -> Resolution:
        steps: dict[str, float] = {}
        for demand, (name, signal, unit) in _DEMANDS.items():
            step, offset = self._catalogue.resolution(name, signal)
            if not step:  # in floating point our own are fine enough
                continue
            if not math.isclose(math.remainder(offset, step), 0.0, abs_tol=_ROUNDING * step):
                raise EncodeError(f"{name}.{signal}: steps of {step:.6g} from {offset:.6g} do not meet 0")
            steps[demand] = step * unit
        return Resolution(**steps)

    def check_resolution(self, coarsest: Resolution, reason: str) -> None:
        """Refuse a DBC whose steps are too coarse.

        Args:
            coarsest: steps that are allowed.
            reason: who does not allow more, for the message.

        Raises:
            CatalogueError: a step is larger; one line for all of them.
        """
        steps, allowed = asdict(self.resolution), asdict(coarsest)
        wrong = [
            f"{name}.{signal}: steps of {steps[demand] / unit:.4g}, {reason} up to {allowed[demand] / unit:.4g}"
            for demand, (name, signal, unit) in _DEMANDS.items()
            if steps[demand] > allowed[demand]
        ]
        if wrong:
            raise CatalogueError(f"{', '.join(self._catalogue.sha256)}: {'; '.join(wrong)}")

    def update(self, measurement: Measurement, values: dict[str, dict[str, float]]) -> None:
        """Take the newest values of each message into the measurement."""
        for name, decode in _DECODERS.items():
            if name in values:
                decode(measurement, values[name])
        if status := values.get("RC_SafetyStatus"):
            self._update_supervisor(measurement, status)
        if navigation := values.get("NcomStatus00"):
            measurement.is_navigation_precise = int(navigation["PosMode"]) in self._usable_position_modes
        for node in ROBOT_NODES:
            if robot := values.get(f"{node}_Status"):
                self._robots[node] = robot
        measurement.faulty_robots = self._nodes_with("Fault")
        measurement.deaf_robots = self._nodes_with("CommandTimeout")
        measurement.overridden_robots = self._nodes_with("DriverOverride")
        if powertrain := values.get("CAR_Powertrain"):
            measurement.is_in_drive = int(powertrain["Selector"]) == self._drive

    def _nodes_with(self, flag: str) -> tuple[str, ...]:
        return tuple(node for node, robot in self._robots.items() if robot[flag])

    def _update_supervisor(self, measurement: Measurement, status: dict[str, float]) -> None:
        state = int(status["SystemState"])
        measurement.is_armed = state == self._system_states["Armed"]
        measurement.is_engaged = state == self._system_states["Engaged"]
        measurement.is_emergency_stopped = bool(status["EmergencyStopActive"]) or state == self._system_states["EStop"]
        measurement.is_stopped_by_robots = state in {self._system_states[s] for s in ("ControlledStop", "Fault")}
        measurement.is_dead_man_pressed = bool(status["DeadManPressed"])
        measurement.is_driver_override = bool(status["DriverOverride"])
        measurement.are_robots_ready = bool(status["SrReady"] and status["ArReady"] and status["BrReady"])
        measurement.stop_source = self._stop_sources.get(int(status["StopSource"]), "unknown")
        measurement.watchdog_question = int(status["WatchdogQuestion"])
        measurement.measurement_id = int(status["MeasurementId"])

    def encode(self, now_ns: int, mode: Mode, demand: Demand, cycle: "Cycle") -> list[CanFrame]:
        """The cyclic frames of one tick: safety command and the three robot commands."""
        limits = self._limits
        is_active = mode in DRIVING
        steer_mode = self._steer_modes["AnglePosition" if is_active else "Standby"]
        pedal_mode = self._pedal_modes["Position" if is_active else "Standby"]
        messages: dict[str, dict[str, float]] = {
            "GW_SafetyCommand": {
                "SystemRequest": self._requests[_REQUEST_OF_MODE[mode]],
                "WatchdogAnswer": answer(cycle.watchdog_question),
                "MaxSpeed": limits.max_speed_mps / _MPS_PER_KMH,
                "NavigationValid": cycle.is_navigation_valid,
                "TrajectoryValid": mode is Mode.ENGAGED,
                "CommandAge": cycle.command_age_ms,
                "MeasurementId": cycle.measurement_id,
            },
            "SR_Command": {
                "Mode": steer_mode,
                "Enable": is_active,
                "AngleCommand": math.degrees(demand.steering_wheel_rad),
                "RateLimit": math.degrees(limits.steering_wheel_rate_radps),
                "TorqueLimit": limits.steering_torque_nm,
            },
            "AR_Command": _pedal_command(pedal_mode, is_active, demand.accelerator_norm, limits, limits.accelerator_force_n),
            "BR_Command": _pedal_command(pedal_mode, is_active, demand.brake_norm, limits, limits.brake_force_n),
        }
        return [self._frame(name, values, now_ns) for name, values in messages.items()]

    def encode_monitors(self, now_ns: int, monitors: "Monitors") -> list[CanFrame]:
        """Life sign and status, for bus monitors."""
        finding = monitors.finding
        status: dict[str, float] = {"Mode": self._mode_codes[monitors.mode]}
        if finding is not None:
            status |= {"Cause": self._cause_codes[finding.cause], "Value": finding.value, "Limit": finding.limit}
        heartbeat = {
            "UpTime": monitors.uptime_s,
            "BusLoad": 100.0 * min(monitors.bus_load_norm, 1.0),
            "CpuLoad": 100.0 * min(monitors.cpu_load_norm, 1.0),
            "RxErrorCount": monitors.rejected,
            "TxErrorCount": monitors.tx_error_count,
        }
        return [self._frame("GW_Heartbeat", heartbeat, now_ns), self._frame("GW_Status", status, now_ns)]

    def _frame(self, name: str, values: dict[str, float], now_ns: int) -> CanFrame:
        payload = self._catalogue.encode(name, values, saturates=self._is_rehearsed)
        if protector := self._protectors.get(name):
            payload = protector.protect(payload)
        return CanFrame(self._catalogue.by_name[name].arbitration_id, payload, now_ns)


_DEMANDS = {
    "steering_wheel_rad": ("SR_Command", "AngleCommand", math.radians(1.0)),
    "accelerator_norm": ("AR_Command", "PositionCommand", 0.01),
    "brake_norm": ("BR_Command", "PositionCommand", 0.01),
}
"""The signal of each demand, and its unit in SI."""
_ROUNDING = 1e-6
"""Part of a step by which decimal factors and offsets may miss each other as floats."""

_REHEARSAL_NS = 0
_REHEARSED_DEMAND = Demand(0.0, 0.0, 0.0)
_REHEARSED_CYCLE = Cycle(0.0, 0, 0, is_navigation_valid=True)
_REHEARSED_MONITORS = Monitors(0.0, 0.0, 0.0, 0, 0, Mode.SILENT, Finding(Cause.TICK_GAP, 0.0, 0.0, ""))

_REQUEST_OF_MODE = {
    Mode.SILENT: "None",
    Mode.STANDBY: "Disarm",
    Mode.READY: "Arm",
    Mode.ENGAGED: "Engage",
    Mode.COMFORT_STOP: "Engage",
    Mode.SAFE_STOP: "Engage",
    Mode.FAULT: "None",
}


def _camel(name: str) -> str:
    """How the DBC spells the name of a mode or a cause."""
    return "".join(word.capitalize() for word in name.split("_"))


def _pedal_command(mode: int, is_active: bool, position_norm: float, limits: RobotLimits, force_n: float) -> dict[str, float]:
    return {
        "Mode": mode,
        "Enable": is_active,
        "PositionCommand": 100.0 * position_norm,
        "RateLimit": 1000.0 * limits.pedal_rate_mps,
        "ForceLimit": force_n,
    }


def _decode_position(m: Measurement, v: dict[str, float]) -> None:
    m.x_m, m.y_m = v["PosLocalX"], v["PosLocalY"]


def _decode_velocity(m: Measurement, v: dict[str, float]) -> None:
    m.vx_mps, m.vy_mps = v["VelForward"], -v["VelLateral"]  # the instrument counts lateral to the right


def _decode_yaw(m: Measurement, v: dict[str, float]) -> None:
    m.yaw_rad = math.radians(v["AngleLocalYaw"])


def _decode_yaw_rate(m: Measurement, v: dict[str, float]) -> None:
    m.yaw_rate_radps = -math.radians(v["AngRateZ"])  # about the axis that points down


def _decode_acceleration(m: Measurement, v: dict[str, float]) -> None:
    m.ax_mps2 = v["AccelForward"]


def _decode_time(m: Measurement, v: dict[str, float]) -> None:
    m.navigation_time_ms = int(v["MilliTime"])


def _decode_steering(m: Measurement, v: dict[str, float]) -> None:
    m.steering_wheel_rad = math.radians(v["AngleActual"])
    m.steering_wheel_rate_radps = math.radians(v["RateActual"])
    m.steering_torque_nm = v["TorqueActual"]


def _decode_accelerator(m: Measurement, v: dict[str, float]) -> None:
    m.accelerator_norm = 0.01 * v["PositionActual"]


def _decode_brake(m: Measurement, v: dict[str, float]) -> None:
    m.brake_norm = 0.01 * v["PositionActual"]


def _decode_wheels(m: Measurement, v: dict[str, float]) -> None:
    m.wheel_speed_radps = (v["FrontLeft"], v["FrontRight"], v["RearLeft"], v["RearRight"])


def _decode_pedals(m: Measurement, v: dict[str, float]) -> None:
    m.accelerator_pedal_norm, m.brake_pedal_norm = 0.01 * v["AcceleratorPedal"], 0.01 * v["BrakePedal"]


_DECODERS = {
    "PosLocal": _decode_position,
    "VelocityLevel": _decode_velocity,
    "VelYawLocal": _decode_yaw,
    "RateVehicle": _decode_yaw_rate,
    "AccelLevel": _decode_acceleration,
    "MilliTime": _decode_time,
    "SR_Status": _decode_steering,
    "AR_Status": _decode_accelerator,
    "BR_Status": _decode_brake,
    "CAR_WheelSpeeds": _decode_wheels,
    "CAR_Powertrain": _decode_pedals,
}
