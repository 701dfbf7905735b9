"""Worst-case response times and load of a set of periodic messages, for classical CAN with priority queueing in every node.

Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and revised",
Real-Time Systems 35 (2007). The older form of Tindell does not look at all instances in the busy period and is optimistic.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from dbc.frame_length import classical_bounds
from vehicle_emulator.bus.frame import EXTENDED, BusFrame, arbitration_key

ERROR_SIGNALLING_BITS = 31
"""Longest error signalling with the intermission: two flags, delimiter, and the suspended transmission of a passive node."""


@dataclass(frozen=True, slots=True)
class MessageTiming:
    """One periodic message.

    Args:
        name: its name.
        arbitration_id: identifier.
        length_bytes: payload.
        period_ns: least time between two requests, before jitter [ns].
        jitter_ns: by how much a request may be late [ns].
        is_extended: 29-bit identifier.
    """

    name: str
    arbitration_id: int
    length_bytes: int
    period_ns: int
    jitter_ns: int = 0
    is_extended: bool = False


@dataclass(frozen=True, slots=True)
class ResponseTime:
    """Bound on the time from the nominal request of a message to the end of its frame.

    Args:
        message: the message.
        bound_ns: the bound, with the intermission after the frame [ns]; None where there is none, because the bus is overloaded.
    """

    message: MessageTiming
    bound_ns: int | None


def bus_load(messages: Sequence[MessageTiming], bitrate_bps: int) -> tuple[float, float]:
    """Share of time in which the bus is busy, without stuff bits and with the most that there can be; above 1 it is overloaded."""
    bounds = [(classical_bounds(one.length_bytes, is_extended=one.is_extended), one.period_ns) for one in messages]
    least, most = (sum(bits[which] * 1e9 / (period_ns * bitrate_bps) for bits, period_ns in bounds) for which in (0, 1))
    return least, most


def response_times(
    messages: Sequence[MessageTiming], bitrate_bps: int, *, error_interval_ns: int | None = None
) -> list[ResponseTime]:
    """Bounds on the response times of all messages on one bus, in the order of their priority.

    Args:
        messages: all messages of the bus; each has an identifier of its own and a period above 0.
        bitrate_bps: bit rate [bit/s].
        error_interval_ns: least time between two errors that each destroy a frame [ns]; None: no errors.
    """
    tasks = sorted((_Task(one, bitrate_bps) for one in messages), key=lambda task: task.priority)
    bit_ns = Fraction(1_000_000_000, bitrate_bps)
    return [
        ResponseTime(task.message, _bound_ns(tasks[: index + 1], tasks[index + 1 :], bit_ns, error_interval_ns))
        for index, task in enumerate(tasks)
    ]


class _Task:
    """A message with what the analysis needs of it: priority, C, T and J."""

    def __init__(self, message: MessageTiming, bitrate_bps: int) -> None:
        self.message = message
        flags = EXTENDED if message.is_extended else 0
        self.priority = arbitration_key(BusFrame(message.arbitration_id, b"", flags, 0))
        bits = classical_bounds(message.length_bytes, is_extended=message.is_extended)[1]
        self.c_ns = Fraction(bits * 1_000_000_000, bitrate_bps)
        self.t_ns, self.j_ns = message.period_ns, message.jitter_ns


def _bound_ns(hep: list[_Task], lower: list[_Task], bit_ns: Fraction, error_interval_ns: int | None) -> int | None:
    """Bound of the last of `hep`, the messages of its priority and above."""
    own, higher = hep[-1], hep[:-1]
    blocking_ns = max((task.c_ns for task in lower), default=Fraction(0))
    recovery_ns = ERROR_SIGNALLING_BITS * bit_ns + max(task.c_ns for task in hep)
    utilisation = sum((task.c_ns / task.t_ns for task in hep), Fraction(0))
    if error_interval_ns is not None:
        utilisation += recovery_ns / error_interval_ns
    if utilisation >= 1:
        return None

    def errors_ns(t_ns: Fraction) -> Fraction:
        return recovery_ns * _ceil(t_ns / error_interval_ns) if error_interval_ns is not None else Fraction(0)

    busy_ns = own.c_ns
    while (longer_ns := blocking_ns + errors_ns(busy_ns) + _demand_ns(hep, busy_ns)) > busy_ns:
        busy_ns = longer_ns
    worst_ns = Fraction(0)
    for instance in range(_ceil((busy_ns + own.j_ns) / own.t_ns)):
        base_ns = blocking_ns + instance * own.c_ns
        wait_ns = base_ns
        while (longer_ns := base_ns + errors_ns(wait_ns + own.c_ns) + _demand_ns(higher, wait_ns + bit_ns)) > wait_ns:
            wait_ns = longer_ns
        worst_ns = max(worst_ns, own.j_ns + wait_ns - instance * own.t_ns + own.c_ns)
    return _ceil(worst_ns)


def _demand_ns(tasks: list[_Task], t_ns: Fraction) -> Fraction:
    """Bus time that messages can ask for in a time, with their jitter."""
    return sum((_ceil((t_ns + task.j_ns) / task.t_ns) * task.c_ns for task in tasks), Fraction(0))


def _ceil(value: Fraction) -> int:
    return -(-value.numerator // value.denominator)
