"""python-can interface `xilgate`: a node on the emulated bus, for any tool that speaks python-can.

It behaves as SocketCAN does: a node does not hear itself unless it asks to, `send` without a timeout fails at once when the bus takes
no more, and error frames tell what fault confinement makes of the node. The bit rate is the hub's.
"""

import contextlib
import select
import time
from collections.abc import Iterator

import can
from can.typechecking import CanFilter, CanFilters

from dbc.can_io import ERROR_FLAG, EXTENDED_FLAG, Arrival
from vehicle_emulator.bus import error_frames, wire
from vehicle_emulator.bus.channel import BusError, address_of, open_socket
from vehicle_emulator.bus.confinement import ErrorState
from vehicle_emulator.bus.connection import Connection, connection_of
from vehicle_emulator.bus.frame import BITRATE_SWITCH, ERROR, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

DEFAULT_CHANNEL = "robots"

_JOIN_TIMEOUT_S = 5.0
_FLAG_OF_ATTRIBUTE = {
    "is_extended_id": EXTENDED,
    "is_remote_frame": REMOTE,
    "is_fd": FD,
    "bitrate_switch": BITRATE_SWITCH,
    "error_state_indicator": ERROR_STATE_INDICATOR,
}
_BUS_STATE = {
    ErrorState.ACTIVE: can.BusState.ACTIVE,
    ErrorState.WARNING: can.BusState.ACTIVE,
    ErrorState.PASSIVE: can.BusState.PASSIVE,
    ErrorState.BUS_OFF: can.BusState.ERROR,
}


class XilgateBus(can.BusABC):
    """Connection to the hub of one channel.

    Args:
        channel: name of the channel, or tcp://127.0.0.1:PORT.
        can_filters: see `can.BusABC.set_filters`; the hub applies them, so that a node is not woken for what it does not want.
        fd: whether frames with up to 64 bytes may be sent.
        receive_own_messages: whether it hears its own frames, when they are through and with `is_rx` False.
        berr_reporting: whether every bus error is reported, as `ip link set ... berr-reporting on` does, and not changes of the
            state alone.
        restart_ms: time after which the node leaves bus-off by itself [ms], 0: only by `restart`; None: as the hub has it.
        kwargs: settings of other interfaces, such as a bit rate, which mean nothing here.

    Raises:
        can.CanInitializationError: no hub serves the channel, or it does not answer.
    """

    def __init__(
        self,
        channel: str = DEFAULT_CHANNEL,
        can_filters: CanFilters | None = None,
        fd: bool = False,
        receive_own_messages: bool = False,
        *,
        berr_reporting: bool = False,
        restart_ms: int | None = None,
        **kwargs: object,
    ) -> None:
        self._channel = str(channel)
        self._error_state = ErrorState.ACTIVE
        self._named_ids: frozenset[int] = frozenset()
        self._own_messages, self._bus_errors, self._restart_ms = receive_own_messages, berr_reporting, restart_ms
        self.channel_info = f"xilgate channel '{self._channel}'"
        self._connection = _connect(self._channel)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    @property
    def state(self) -> can.BusState:
        """State of fault confinement, as of the frames read so far: ERROR is bus-off."""
        return _BUS_STATE[self._error_state]

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise NotImplementedError("fault confinement sets the state; `restart` leaves bus-off")

    def fileno(self) -> int:
        """File descriptor that is readable when a frame has arrived or the hub has gone."""
        return self._connection.fileno()

    def restart(self) -> None:
        """Leave bus-off, as `ip link set ... type can restart` does: the node takes part again after 128 x 11 recessive bits.

        Raises:
            can.CanOperationError: the hub has gone, or takes no more.
        """
        self._transfer(wire.pack_control(wire.Restart()), 0.0)

    def disturb(self, arbitration_id: int | None, count: int) -> None:
        """Destroy the next attempts to send a frame on the wire by a bit error, whoever sends it; see `BusCore.disturb`.

        Args:
            arbitration_id: of the frames to destroy; None for any.
            count: attempts, retransmissions included, 0 (take back) to 1,000,000; 32 in a row take a sender to bus-off.

        Raises:
            can.CanOperationError: the hub has gone, or takes no more.
        """
        self._transfer(wire.pack_control(wire.Disturb(arbitration_id, count)), 0.0)

    def _apply_filters(self, filters: CanFilters | None) -> None:
        settings = wire.Settings(_wire_filters(filters), self._own_messages, self._bus_errors, self._restart_ms)
        self._named_ids = wire.named_ids(settings.filters or ())
        self._transfer(wire.pack_control(settings), _JOIN_TIMEOUT_S)

    def arrivals(self) -> Iterator[Arrival]:
        """Frames that have arrived, as `dbc.can_io` counts them: what `recv` says without a wait, in a fraction of its time.

        Raises:
            can.CanOperationError: the hub has gone.
        """
        with contextlib.suppress(BlockingIOError):
            while True:
                frame, t_ns, is_own = self._next()
                if self._is_asked_for(frame) or self._matches_filters(self._message(frame, t_ns, is_own)):
                    yield _identifier(frame), frame.data, is_own

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            frame, t_ns, is_own = self._next()
        except BlockingIOError:
            if not self._wait(select.POLLIN, timeout):
                return None, False
            # Without a wait this time: another thread may have taken the frame, and the caller keeps count of its time.
            return self._recv_internal(0.0)
        return self._message(frame, t_ns, is_own), self._is_asked_for(frame)

    def _next(self) -> tuple[BusFrame, int, bool]:
        """The next frame that has arrived, its time [ns], and whether it is our own.

        Raises:
            BlockingIOError: none has.
            can.CanOperationError: the hub has gone.
        """
        try:
            self._connection.flush()
            while not isinstance(content := wire.unpack(self._packet()), tuple):
                pass  # the hub says nothing but frames to a node that has joined
        except BlockingIOError:
            raise
        except (OSError, wire.WireError) as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error
        frame = content[0]
        if frame.flags & ERROR and (state := error_frames.state_in(frame)) is not None:
            self._error_state = state
        return content

    def _packet(self) -> bytes:
        if not (packet := self._connection.receive()):
            raise can.CanOperationError(f"{self.channel_info}: the hub has gone")
        return packet

    def _is_asked_for(self, frame: BusFrame) -> bool:
        """Whether a frame is surely one that the filters let pass.

        They are applied again, for frames that were on their way when they were changed, but for those that a filter names; error
        frames pass whatever they are, as with SocketCAN.
        """
        is_named = frame.arbitration_id in self._named_ids and not frame.flags & EXTENDED
        return is_named or bool(frame.flags & ERROR)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to the bus.

        Args:
            msg: the frame.
            timeout: longest wait for room in the transmit buffer [s]; none without it.

        Raises:
            can.CanOperationError: not a frame that this bus carries, transmit buffer full, bus-off, or the hub has gone.
        """
        if self._error_state is ErrorState.BUS_OFF:
            raise can.CanOperationError(f"{self.channel_info}: bus-off")
        self._transfer(self._packed(msg), timeout or 0.0)

    def shutdown(self) -> None:
        """Leave the bus; can be called again."""
        super().shutdown()
        self._connection.close()

    def _transfer(self, packet: bytes, timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        try:
            while True:
                try:
                    self._connection.send(packet)
                    break
                except BlockingIOError as error:
                    if not self._wait(select.POLLOUT, deadline_s - time.monotonic()):
                        raise can.CanOperationError(f"{self.channel_info}: transmit buffer full") from error
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: the hub has gone", error.errno) from error

    def _wait(self, event: int, timeout_s: float | None) -> bool:
        """Whether the socket is ready for an event, or at its end, before the timeout [s]."""
        if timeout_s is not None and timeout_s <= 0.0:
            return False
        poll = select.poll()
        poll.register(self._connection.fileno(), event)
        return bool(poll.poll(None if timeout_s is None else timeout_s * 1000.0))

    def _packed(self, msg: can.Message) -> bytes:
        if msg.is_error_frame:
            raise can.CanOperationError(f"{self.channel_info}: an error frame cannot be sent; `disturb` makes errors")
        if msg.is_fd and self._can_protocol is not can.CanProtocol.CAN_FD:
            raise can.CanOperationError(f"{self.channel_info}: opened without fd=True, cannot send a CAN FD frame")
        flags = sum(flag for attribute, flag in _FLAG_OF_ATTRIBUTE.items() if getattr(msg, attribute))
        frame = BusFrame(msg.arbitration_id, b"" if msg.is_remote_frame else bytes(msg.data), flags, msg.dlc)
        try:
            wire.check(frame)
        except wire.WireError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error
        return wire.pack(frame, time.monotonic_ns())

    def _message(self, frame: BusFrame, t_ns: int, is_own: bool) -> can.Message:
        flags = frame.flags
        return can.Message(
            timestamp=t_ns * 1e-9,
            arbitration_id=frame.arbitration_id,
            is_extended_id=bool(flags & EXTENDED),
            is_remote_frame=bool(flags & REMOTE),
            is_error_frame=bool(flags & ERROR),
            is_fd=bool(flags & FD),
            is_rx=not is_own,
            bitrate_switch=bool(flags & BITRATE_SWITCH),
            error_state_indicator=bool(flags & ERROR_STATE_INDICATOR),
            channel=self._channel,
            dlc=frame.length_bytes,
            data=frame.data,
        )


def _identifier(frame: BusFrame) -> int:
    """With the flags of linux/can.h; that of an extended one stands for all that is no classical data frame with 11 bits."""
    if not frame.flags:
        return frame.arbitration_id
    return (ERROR_FLAG if frame.flags & ERROR else EXTENDED_FLAG) | frame.arbitration_id


def _wire_filters(filters: CanFilters | None) -> tuple[wire.Filter, ...] | None:
    """Filters for the hub; None, everything, where there are more than it takes: `can.BusABC` applies them all the same."""
    if filters is None or len(filters) > wire.MAX_FILTERS:
        return None
    return tuple(wire.Filter(one["can_id"], one["can_mask"], _extended(one)) for one in filters)


def _extended(one: CanFilter) -> bool | None:
    return bool(one["extended"]) if "extended" in one else None


def _connect(channel: str) -> Connection:
    """Connection of a node that has joined the channel."""
    try:
        address = address_of(channel)
    except BusError as error:
        raise can.CanInitializationError(str(error)) from error
    place = f"port {address[1]}" if isinstance(address, tuple) else str(address)
    connected = open_socket(address)
    connected.settimeout(_JOIN_TIMEOUT_S)
    try:
        connected.connect(address if isinstance(address, tuple) else str(address))
        connection = connection_of(connected)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        connected.close()
        raise can.CanInitializationError(f"no hub serves xilgate channel {channel!r} ({place}); `xilgate bus` starts one") from error
    except OSError as error:
        connected.close()
        raise can.CanInitializationError(f"the hub of xilgate channel {channel!r} does not answer ({place}): {error}") from error
    try:
        _say_hello(connection)
    except (OSError, wire.WireError) as error:
        connection.close()
        is_silent = isinstance(error, TimeoutError)
        what = "does not answer" if is_silent else "refuses: full, or of another version"
        raise can.CanInitializationError(f"the hub of xilgate channel {channel!r} {what} ({place})") from error
    return connection


def _say_hello(connection: Connection) -> None:
    """Join.

    Raises:
        TimeoutError: no answer.
        OSError, WireError: an answer that is no welcome.
    """
    connection.send(wire.pack_control(wire.Hello(wire.VERSION)))
    poll = select.poll()
    poll.register(connection.fileno(), select.POLLIN)
    deadline_s = time.monotonic() + _JOIN_TIMEOUT_S
    while (left_s := deadline_s - time.monotonic()) > 0.0:
        poll.poll(left_s * 1000.0)
        try:
            if wire.unpack(connection.receive()) == wire.Hello(wire.VERSION):
                return
        except BlockingIOError:
            continue
        raise ConnectionRefusedError
    raise TimeoutError
