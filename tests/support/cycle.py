"""Runs the gateway's control cycle in virtual time: a stub car on the buses, a scripted controller and operator on the sockets."""

from collections import deque
from pathlib import Path
from types import SimpleNamespace

from dbc.catalogue import GNSS_IMU_DBC, ROBOTS_DBC
from dbc.health import LinkHealth
from dbc.traffic import Traffic
from dbc.vehicle import FOCUS
from gateway.core import TICK_NS
from gateway.cycle import ControlCycle, Links
from gateway.housekeeping import Orders, Pulse
from gateway.messages import HORIZON_STEPS, CommandStatus, ControlCommand, Mode, Operation, OperatorRequest
from gateway.pacing import Pacer
from gateway.preparation import prepare
from gateway.rig import make_rig
from tests.support.robots import StubCar

TREE = {
    "name": "virtual",
    "profile": "proving_ground",
    "buses": {"robots": "virtual:robots"},
    "car": {"dbc": [str(ROBOTS_DBC), str(GNSS_IMU_DBC)], "vehicle": str(FOCUS)},
}


class EveryTick(Pacer):
    """Steps whenever it is asked, so that a tick of the bench is a step."""

    def is_due(self, now_ns):
        return True


class StubBuses:
    """The car's end of the buses."""

    def __init__(self, bench):
        self._bench = bench
        self.dead, self.dropped, self.unsent = [], {}, {}
        self.bus_errors, self.refusals = {"robots": 0}, {}
        self.recoveries = 0
        self.links = {"robots": LinkHealth(), "navigation": LinkHealth()}
        self.loads = {"robots": Traffic(0.25, {bench.preparation.catalogue.by_name["SR_Status"].arbitration_id: 100.0})}

    def receive(self):
        return self._bench.car.speak(self._bench.now_ns)

    def send(self, frames):
        self._bench.frames += frames
        self._bench.car.hear(frames)

    def health(self):
        return self.links

    def traffic(self):
        return self.loads

    def recover(self):
        self.recoveries += 1


class CycleBench:
    """A gateway's cycle and all around it; `tick` lets time pass."""

    def __init__(self, recorder=None, realtime=None, **daemon):
        self.preparation = prepare(make_rig(Path("test"), TREE | {"daemon": daemon}, Path("/")))
        self.car = StubCar(self.preparation.catalogue, is_following=True, vx_mps=5.0)
        self.now_ns = 1_000_000_000
        self.frames, self.states, self.replies, self.samples = [], [], [], []
        self.requests = deque()
        self.plan_steer_rad = 0.0
        self.pulse, self.orders = Pulse(), Orders()
        self.pulse.realtime = realtime or {}
        self.buses = StubBuses(self)
        links = Links(
            buses=self.buses,
            channel=SimpleNamespace(newest=self._command, send=self.states.append, rejected=0),
            operators=SimpleNamespace(next_request=self._request, reply=self.replies.append, rejected=0),
            telemetry=SimpleNamespace(post=self.samples.append),
            recorder=recorder,
        )
        self.pacer = EveryTick(self.now_ns, TICK_NS)
        self.cycle = ControlCycle(self.preparation, 1, links, self.pulse, self.orders)

    @property
    def mode(self):
        return self.states[-1].mode

    def ask(self, operation):
        self.requests.append(OperatorRequest(9, self.now_ns, operation, self.now_ns + TICK_NS))

    def tick(self, count=1):
        """Let time pass until it has, or the cycle is over; how many ticks that were."""
        for k in range(count):
            if self.cycle.is_over:
                return k
            self.now_ns += TICK_NS
            self.cycle.look(self.now_ns, self.pacer)
        return count

    def engage(self):
        self.tick(210)
        for operation, mode in ((Operation.ARM, Mode.READY), (Operation.ENGAGE, Mode.ENGAGED)):
            self.ask(operation)
            self.tick(2)
            assert self.mode is mode, self.replies[-1]
        return self

    def events(self):
        taken = []
        while (event := self.pulse.take()) is not None:
            taken.append(event)
        return taken

    def _request(self):
        return self.requests.popleft() if self.requests else None

    def _command(self, _):
        if not self.states or len(self.states) % 4:
            return None
        plan, steers = (0.0,) * HORIZON_STEPS, (self.plan_steer_rad,) * HORIZON_STEPS
        return ControlCommand(
            boot_id=7, seq=len(self.states), state_seq=self.states[-1].seq, t_ns=self.now_ns, status=CommandStatus.OK, solve_time_ns=0,
            lateral_error_m=0.0, heading_error_rad=0.0, steer_rad=self.plan_steer_rad, drive_norm=0.0,
            plan_steer_rad=steers, plan_drive_norm=plan,
        )  # fmt: skip
