"""Faults on the wire with the emulated bus: what they do to the error counters of controllers, and that nothing is left of them."""

import pytest

from dbc.catalogue import load
from vehicle_emulator.bus.confinement import ErrorState
from vehicle_emulator.bus.core import BusCore
from vehicle_emulator.bus.frame import BusFrame
from vehicle_emulator.faults.condition import Situation
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.spec import parse_faults
from vehicle_emulator.plants.interface import PlantState

CATALOGUE = load()
MS = 1_000_000
GATEWAY = "GW"
CYCLIC = [spec for spec in CATALOGUE.by_name.values() if spec.cycle_time_ns]
NODES = sorted({spec.sender for spec in CYCLIC} - {GATEWAY})


class Car:
    """The cyclic messages of the whole DBC on one bus per network; the car has one controller on each, or one for every node."""

    def __init__(self, fault, *, is_one_node):
        self._engine = FaultEngine(parse_faults([fault]), 1, 0, CATALOGUE)
        names = (GATEWAY, *NODES)
        self._place = {name: min(place, 1) if is_one_node else place for place, name in enumerate(names)}
        self.cores = {spec.network: BusCore(500_000) for spec in CYCLIC}
        for core in self.cores.values():
            for place in sorted(set(self._place.values())):
                core.join(place)
        self.now_ns = 0

    def run(self, steps):
        for _ in range(steps):
            active = self._engine.update(self.now_ns, Situation(PlantState(), is_engaged=False))
            for spec in CYCLIC:
                if self.now_ns % spec.cycle_time_ns == 0:
                    sent = BusFrame(spec.arbitration_id, bytes(spec.length_bytes), 0, spec.length_bytes)
                    self.cores[spec.network].transmit(self._place[spec.sender], sent, self.now_ns)
            for arbitration_id, transmissions in active.disturbances:
                for core in self.cores.values():
                    core.disturb(arbitration_id, transmissions)
            self.now_ns += MS
            for core in self.cores.values():
                core.advance(self.now_ns)
        return self

    def statistics(self, node):
        network = next(spec.network for spec in CYCLIC if spec.sender == node)
        return self.cores[network].nodes[self._place[node]]


@pytest.mark.parametrize("is_one_node", [True, False])
@pytest.mark.parametrize("node", NODES)
@pytest.mark.parametrize("from_s", [0.3, 0.303, 0.307])
def test_bus_off_is_reached_whoever_shares_the_controller(node, is_one_node, from_s):
    car = Car({"kind": "bus_off", "node": node, "from_s": from_s, "duration_s": 0.4}, is_one_node=is_one_node).run(300)
    assert car.statistics(node).tec == 0
    car.run(450)
    assert car.statistics(node).state is ErrorState.BUS_OFF
    assert not any(core.disturbed_ids for core in car.cores.values())


def test_errors_end_with_their_fault():
    car = Car(
        {"kind": "bus_error", "messages": "SR_Status", "errors": 5, "period_ms": 10.0, "from_s": 0.1, "duration_s": 0.2}, is_one_node=False
    ).run(299)
    errors = car.statistics("SR").errors
    assert errors >= 20
    car.run(3)
    assert not any(core.disturbed_ids for core in car.cores.values())
    errors = car.statistics("SR").errors
    car.run(300)
    assert car.statistics("SR").errors == errors
