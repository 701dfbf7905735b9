"""Runs a gateway core against the stub car in virtual time, with a scripted controller."""

from dbc.catalogue import load
from dbc.vehicle import load_vehicle
from gateway.core import TICK_NS, GatewayCore
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Mode, Operation, OperatorRequest
from tests.support.robots import StubCar


class GatewayDrive:
    """One gateway, one car, one controller that sends `steer_rad`, `drive_norm` every 40 ms while `is_controller_alive`."""

    def __init__(self):
        self.catalogue = load()
        self.core = GatewayCore(self.catalogue, load_vehicle(), boot_id=1)
        self.car = StubCar(self.catalogue)
        self.now_ns = 1_000_000_000
        self.is_controller_alive = True
        self.status = CommandStatus.OK
        self.steer_rad = 0.0
        self.drive_norm = 0.0
        self.plan_steer_rad = None
        self.command_boot_id = 7
        self.output = None
        self.transitions = []
        self._ticks = 0
        self._requests = 0
        self._to_send = None

    def ask(self, operation: Operation) -> None:
        self._requests += 1
        self._to_send = OperatorRequest(9, self._requests, operation, self.now_ns)

    def command(self) -> ControlCommand:
        return ControlCommand(
            boot_id=self.command_boot_id, seq=self._ticks, state_seq=self.core.ticks, t_ns=self.now_ns, status=self.status, solve_time_ns=0,
            lateral_error_m=0.0, heading_error_rad=0.0, steer_rad=self.steer_rad, drive_norm=self.drive_norm,
            plan_steer_rad=self.plan_steer_rad or (self.steer_rad,) * HORIZON_STEPS,
            plan_drive_norm=(self.drive_norm,) * HORIZON_STEPS,
        )

    def tick(self, count: int = 1):
        for _ in range(count):
            self.now_ns += TICK_NS
            command = self.command() if self.is_controller_alive and self._ticks % 4 == 0 else None
            self._ticks += 1
            self.output = self.core.step(self.now_ns, self.car.speak(self.now_ns), command, self._to_send)
            self._to_send = None
            self.car.hear(self.output.frames)
            if self.output.transition is not None:
                self.transitions.append(self.output.transition)
        return self

    def arm(self):
        self.tick(210)
        self.ask(Operation.ARM)
        self.tick(2)
        assert self.core.mode is Mode.READY, self.core.blockers
        return self

    def engage(self):
        self.arm()
        self.ask(Operation.ENGAGE)
        self.tick(1)
        assert self.core.mode is Mode.ENGAGED
        return self
