"""What the control thread does, 100 times a second and when something arrives; what is slow it leaves to others (`housekeeping`)."""

import logging
import time
from dataclasses import dataclass

from dbc.catalogue import NAVIGATION
from dbc.frame import CanFrame
from dbc.link import BusSet
from gateway.channel import Channel, OperatorServer
from gateway.codec import NAVIGATION_MESSAGES
from gateway.conditions import Surroundings
from gateway.core import StepOutput
from gateway.ending import Ending
from gateway.housekeeping import Notice, Orders, Pulse
from gateway.journal import Glance, StepArguments
from gateway.loop import ArrivalWait, CpuLoad
from gateway.messages import ControlCommand, Mode, Operation, OperatorReply, OperatorRequest, VehicleState
from gateway.modes import QUIET
from gateway.pacing import Pacer
from gateway.preparation import Preparation
from gateway.recorder import Recorder, RecorderStatus
from gateway.samples import VIRTUAL, GatewaySampler, Process
from gateway.telemetry import Publisher, StatusSample

NO_RECORD = RecorderStatus(is_recording=False, disk_free_share=1.0, recorded=0, lost=0, problem="")


@dataclass(frozen=True, slots=True)
class Links:
    """All that a gateway is connected to.

    Args:
        recorder: None where nothing is recorded.
    """

    buses: BusSet
    channel: Channel
    operators: OperatorServer
    telemetry: Publisher
    recorder: Recorder | None

    def wait(self) -> ArrivalWait:
        """What the control thread waits for: what makes a state, and what answers one. The rest is taken along."""
        return ArrivalWait(lambda: self.buses.filenos(NAVIGATION), self.channel.fileno())


class ControlCycle:
    """One gateway with its connections.

    Attributes:
        is_over: whether the loop is to end.
        due_ns: when the next navigation data are to come, which make a state [ns].
        successor: the configuration to go on with after that, None when there is none.
    """

    def __init__(self, preparation: Preparation, boot_id: int, links: Links, pulse: Pulse, orders: Orders) -> None:
        self._links = links
        self._pulse = pulse
        self._orders = orders
        self._stop_within_ns = round(preparation.rig.daemon.stop_within_s * 1e9)
        self._boot_id = boot_id
        self._core = preparation.new_core(boot_id)
        self._sampler = GatewaySampler()
        self._hashes = dict(preparation.hashes)
        self._names = {arbitration_id: spec.name for arbitration_id, spec in preparation.catalogue.by_id.items()}
        self._realtime = {name: str(grant) for name, grant in pulse.realtime.items()}
        self._record = NO_RECORD
        self._ending: Ending | None = None
        self._command: ControlCommand | None = None
        self._glances: list[Glance] = []
        self._navigation_ns = min(preparation.catalogue.by_name[name].cycle_time_ns for name in NAVIGATION_MESSAGES)
        self._sent_seq = self._valid_ns = 0
        self._cpu_load = CpuLoad()
        self.is_over = False
        self.due_ns = 0
        self.successor: Preparation | None = None

    def look(self, now_ns: int, pacer: Pacer) -> None:
        """See what has arrived: a new state goes to the controller at once, and the step is taken when it is due."""
        cpu_start_ns = time.thread_time_ns()
        frames, command = self._links.buses.receive(), self._links.channel.newest(ControlCommand)
        if command is not None:
            self._command = command
            pacer.command_arrived(now_ns)
        if pacer.is_due(now_ns):
            self._pulse.lateness.observe(max(now_ns - pacer.deadline_ns, 0))
            pacer.stepped(now_ns)
            self._step(now_ns, frames, pacer.overruns, cpu_start_ns)
        elif frames:
            self._glances.append(Glance(now_ns, frames))
            if (state := self._core.sense(now_ns, frames)) is not None:
                self._send(state, now_ns)

    def _step(self, now_ns: int, frames: list[CanFrame], overruns: int, cpu_start_ns: int) -> None:
        """One tick: decide, speak; then tell whoever wants to know."""
        links = self._links
        command, glances, request = self._command, self._glances, self._request(now_ns)
        self._command, self._glances = None, []
        surroundings = self._surroundings(now_ns, cpu_start_ns)
        output = self._core.step(now_ns, frames, command, request, surroundings)
        links.buses.send(output.frames)
        if output.state.seq != self._sent_seq:
            self._send(output.state, now_ns)
        arguments = StepArguments(now_ns, frames, command, request, surroundings, glances)
        if links.recorder is not None:
            links.recorder.record(arguments, output)
        if output.reply is not None:
            self._answer(output.reply)
        cpu_ns = time.thread_time_ns() - cpu_start_ns
        self._pulse.step_cpu.observe(cpu_ns)
        self._tell(now_ns, output, overruns, cpu_ns)
        self._heed_orders(now_ns, output)
        self._pulse.ticks += 1

    def _send(self, state: VehicleState, now_ns: int) -> None:
        self._links.channel.send(state)
        self._sent_seq = state.seq
        if state.t_ns != self._valid_ns:  # made of new navigation data: the next come a cycle later
            self._valid_ns, self.due_ns = state.t_ns, now_ns + self._navigation_ns

    def _surroundings(self, now_ns: int, cpu_ns: int) -> Surroundings:
        buses = self._links.buses
        if self._links.recorder is not None:
            self._record = self._links.recorder.poll(now_ns)
        is_recording = self._record.is_recording or self._links.recorder is None
        load_norm = max((traffic.load_norm for traffic in buses.traffic().values()), default=0.0)
        return Surroundings(buses.health(), is_recording, self._record.disk_free_share, load_norm, self._cpu_load.update(now_ns, cpu_ns))

    def _answer(self, reply: OperatorReply) -> None:
        # A bus-off that is still there must not keep a reset from being granted. While robots listen there is none to leave, and a
        # request that is refused anyway must not make the link forget which of its frames have not got through.
        if reply.operation is Operation.RESET and reply.mode in (*QUIET, Mode.FAULT):
            self._links.buses.recover()
        if reply.boot_id != self._boot_id:
            self._links.operators.reply(reply)

    def _request(self, now_ns: int) -> OperatorRequest | None:
        """What an operator wants, or what has to be done before the process may end."""
        request = self._links.operators.next_request()
        if request is None and self._ending is not None and (operation := self._ending.request(self._core.mode)) is not None:
            return OperatorRequest(self._boot_id, self._core.ticks, operation, now_ns)
        return request

    def _tell(self, now_ns: int, output: StepOutput, overruns: int, cpu_ns: int) -> None:
        if output.transition is not None:
            self._pulse.post(output.transition)
        process = self._process(overruns, cpu_ns) if self._sampler.is_status_due(self._core, output) else VIRTUAL
        for sample in self._sampler.sample(self._core, output, now_ns, process):
            self._links.telemetry.post(sample)
            if isinstance(sample, StatusSample):
                self._pulse.status = sample

    def _process(self, overruns: int, cpu_ns: int) -> Process:
        buses = self._links.buses
        traffic = buses.traffic()
        # Of a DBC with more messages than the kernel takes filters, a link hears strangers too.
        rates_hz = {number: rate_hz for one in traffic.values() for number, rate_hz in one.rates_hz.items() if number in self._names}
        rejected = {"controller": self._links.channel.rejected, "operator": self._links.operators.rejected}
        return Process(
            ticks_late=overruns,
            step_cpu_ms=cpu_ns * 1e-6,
            dead_buses=buses.dead,
            frames_dropped=buses.dropped,
            frames_unsent=buses.unsent,
            links=buses.health(),
            bus_errors=buses.bus_errors,
            bus_refusals=buses.refusals,
            datagrams_rejected={f"no datagram of the {sender}'s": count for sender, count in rejected.items() if count},
            ticks_unrecorded=self._record.lost,
            record_problem=self._record.problem,
            realtime=self._realtime,
            hashes=self._hashes,
            bus_load={network: one.load_norm for network, one in traffic.items()},
            message_rates_hz={self._names[arbitration_id]: rate_hz for arbitration_id, rate_hz in rates_hz.items()},
        )

    def _heed_orders(self, now_ns: int, output: StepOutput) -> None:
        mode = self._core.mode
        if self._orders.ends > 0 and self._ending is None:
            self._ending = Ending(now_ns, self._stop_within_ns)
            self._pulse.post(Notice(logging.INFO, f"asked to end in mode {mode.name}", {"mode": mode.name}))
        if self._ending is not None:
            state, is_in_haste = output.state, self._orders.ends > 1
            self.is_over = is_in_haste or self._ending.is_over(now_ns, mode, state.vx_mps, state.is_valid)
            if is_in_haste:
                text = f"asked again: ends at once, in mode {mode.name} at {state.vx_mps:.1f} m/s"
                self._pulse.post(Notice(logging.WARNING, text, {"mode": mode.name, "value": state.vx_mps, "unit": "m/s"}))
        elif (successor := self._pulse.successor) is not None:
            self._pulse.successor = None
            if mode in QUIET:
                self.is_over, self.successor = True, successor
            else:
                self._pulse.post(Notice(logging.WARNING, f"reload refused: mode {mode.name}", {"mode": mode.name}))
