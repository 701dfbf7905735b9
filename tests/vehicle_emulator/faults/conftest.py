"""A clock, a bus and an engine: frames of the real DBC, stepped through faults."""

import pytest

from dbc.catalogue import load
from dbc.e2e import E2EProtector
from dbc.frame import CanFrame
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.spec import parse_faults
from vehicle_emulator.plants.interface import PlantState

MS = 1_000_000
START_NS = 5_000_000_000
CATALOGUE = load()


class Bench:
    """Cyclic messages, sent every `period` steps through an engine; `sent` and `passed` are (step, frame)."""

    def __init__(self, *faults, messages=("SR_Status",), period=10, seed=1, is_to_car=False):
        self.engine = FaultEngine(parse_faults(faults), seed, START_NS, CATALOGUE)
        self.situation = Situation(PlantState(), is_engaged=False)
        self.now = 0
        self.active = None
        self.sent, self.passed, self.events, self.actives = [], [], [], []
        self._specs = [CATALOGUE.by_name[name] for name in messages]
        self._protectors = {spec.name: E2EProtector(spec.e2e_data_id) for spec in self._specs if spec.e2e_data_id is not None}
        self._period = period
        self._is_to_car = is_to_car

    def run(self, steps):
        for _ in range(steps):
            now_ns = START_NS + self.now * MS
            self.active = self.engine.update(now_ns, self.situation)
            self.actives.append(self.active)
            frames = [self._frame(spec, now_ns) for spec in self._specs] if self.now % self._period == 0 else []
            self.sent += [(self.now, frame) for frame in frames]
            through = self.engine.incoming if self._is_to_car else self.engine.outgoing
            self.passed += [(self.now, frame) for frame in through(now_ns, frames)]
            self.events += [((event.t_ns - START_NS) // MS, event.name, event.event) for event in self.engine.take_events()]
            self.now += 1
        return self

    def _frame(self, spec, now_ns):
        payload = bytes([0, 0, self.now % 256, self.now // 256, *range(4, spec.length_bytes)])
        protector = self._protectors.get(spec.name)
        return CanFrame(spec.arbitration_id, protector.protect(payload) if protector else payload, now_ns)

    @property
    def times(self):
        """Steps at which frames came through."""
        return [step for step, _ in self.passed]

    @property
    def changed(self):
        """Steps at which a frame came through that was not sent so at that time."""
        return [step for step, frame in self.passed if (step, frame) not in self.sent]


@pytest.fixture
def bench():
    return Bench
