"""What the gateway tells of its process besides what its core knows."""

from gateway.samples import STATUS_EVERY_TICKS, GatewaySampler, Process
from gateway.telemetry import StatusSample
from tests.support.drive import GatewayDrive


def status(process: Process) -> StatusSample:
    drive = GatewayDrive().tick(STATUS_EVERY_TICKS)
    drive.core.supervisor.rejected["unknown id"] = 2
    samples = GatewaySampler().sample(drive.core, drive.output, drive.now_ns, process)
    (sample,) = [sample for sample in samples if isinstance(sample, StatusSample)]
    return sample


def test_a_dead_bus_and_dropped_frames_are_told():
    sample = status(Process(ticks_late=3, step_cpu_ms=0.5, dead_buses=["navigation"], frames_dropped={"wrong bus": 7}))
    assert sample.dead_buses == ["navigation"]
    assert sample.frames_rejected == {"unknown id": 2, "wrong bus": 7}
    assert (sample.ticks_late, sample.step_cpu_ms) == (3, 0.5)


def test_errors_on_the_bus_and_a_bus_off_that_cannot_be_left_are_told():
    sample = status(Process(bus_errors={"robots": 4}, bus_refusals={"robots": "Operation not permitted"}))
    assert (sample.bus_errors, sample.bus_refusals) == ({"robots": 4}, {"robots": "Operation not permitted"})


def test_in_virtual_time_there_is_nothing_to_tell():
    sample = status(Process())
    assert sample.dead_buses == []
    assert sample.frames_rejected == {"unknown id": 2}
    assert (sample.ticks_late, sample.step_cpu_ms) == (0, 0.0)
