"""python-can interface `xilgate`: a node on the emulated bus, for any tool that speaks python-can.

It behaves as SocketCAN does: a node does not hear itself, and `send` without a timeout fails at once when the bus takes no
more. There is no bit rate to set.
"""

import contextlib
import select
import socket
import time

import can
from can.typechecking import CanFilters

from vehicle_emulator.bus import wire
from vehicle_emulator.bus.channel import BusError, socket_path
from vehicle_emulator.bus.core import BITRATE_SWITCH, ERROR, ERROR_STATE_INDICATOR, EXTENDED, FD, REMOTE, BusFrame

DEFAULT_CHANNEL = "bus0"

_JOIN_TIMEOUT_S = 5.0
_FLAG_OF_ATTRIBUTE = {
    "is_extended_id": EXTENDED,
    "is_remote_frame": REMOTE,
    "is_fd": FD,
    "is_error_frame": ERROR,
    "bitrate_switch": BITRATE_SWITCH,
    "error_state_indicator": ERROR_STATE_INDICATOR,
}


class XilgateBus(can.BusABC):
    """Connection to the hub of one channel.

    Args:
        channel: name of the channel.
        can_filters: see `can.BusABC.set_filters`; applied in this process.
        fd: whether frames with up to 64 bytes may be sent.
        receive_own_messages: not supported, because the hub delivers a frame to every node but its sender.
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
        **kwargs: object,
    ) -> None:
        if receive_own_messages:
            raise can.CanInitializationError("interface xilgate cannot receive its own messages")
        self._channel = str(channel)
        self._socket = _connect(self._channel)
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self.channel_info = f"xilgate channel '{self._channel}'"
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def fileno(self) -> int:
        """File descriptor that is readable when a frame has arrived or the hub has gone."""
        return self._socket.fileno()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            packet = self._socket.recv(wire.PACKET_BYTES)
        except BlockingIOError:
            if not self._wait(select.POLLIN, timeout):
                return None, False
            # Without a wait this time: another thread may have taken the frame, and the caller keeps count of its time.
            return self._recv_internal(0.0)
        except OSError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error.strerror}", error.errno) from error
        if not packet:
            raise can.CanOperationError(f"{self.channel_info}: the hub has gone")
        return self._message(packet), False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to the bus.

        Args:
            msg: the frame.
            timeout: longest wait for room in the transmit buffer [s]; none without it.

        Raises:
            can.CanOperationError: not a frame that this bus carries, transmit buffer full, or the hub has gone.
        """
        packet = self._packet(msg)
        deadline_s = time.monotonic() + (timeout or 0.0)
        while True:
            try:
                self._socket.send(packet)
                return
            except BlockingIOError as error:
                if not self._wait(select.POLLOUT, deadline_s - time.monotonic()):
                    raise can.CanOperationError(f"{self.channel_info}: transmit buffer full") from error
            except OSError as error:
                raise can.CanOperationError(f"{self.channel_info}: the hub has gone", error.errno) from error

    def shutdown(self) -> None:
        """Leave the bus; can be called again."""
        super().shutdown()
        # Closing alone would leave another thread waiting in `recv`.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _wait(self, event: int, timeout_s: float | None) -> bool:
        """Whether the socket is ready for an event, or at its end, before the timeout [s]."""
        if timeout_s is not None and timeout_s <= 0.0:
            return False
        poll = select.poll()
        poll.register(self._socket, event)
        return bool(poll.poll(None if timeout_s is None else timeout_s * 1000.0))

    def _packet(self, msg: can.Message) -> bytes:
        if msg.is_fd and self._can_protocol is not can.CanProtocol.CAN_FD:
            raise can.CanOperationError(f"{self.channel_info}: opened without fd=True, cannot send a CAN FD frame")
        flags = sum(flag for attribute, flag in _FLAG_OF_ATTRIBUTE.items() if getattr(msg, attribute))
        data = b"" if msg.is_remote_frame else bytes(msg.data)
        try:
            return wire.pack(BusFrame(msg.arbitration_id, data, flags, msg.dlc), 0)
        except wire.WireError as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error

    def _message(self, packet: bytes) -> can.Message:
        frame, t_ns = wire.unpack(packet)
        return can.Message(
            timestamp=t_ns * 1e-9,
            arbitration_id=frame.arbitration_id,
            is_extended_id=bool(frame.flags & EXTENDED),
            is_remote_frame=bool(frame.flags & REMOTE),
            is_error_frame=bool(frame.flags & ERROR),
            is_fd=bool(frame.flags & FD),
            bitrate_switch=bool(frame.flags & BITRATE_SWITCH),
            error_state_indicator=bool(frame.flags & ERROR_STATE_INDICATOR),
            channel=self._channel,
            dlc=frame.length_bytes,
            data=frame.data,
        )


def _connect(channel: str) -> socket.socket:
    """Socket of a node that has joined the channel."""
    try:
        path = socket_path(channel)
    except BusError as error:
        raise can.CanInitializationError(str(error)) from error
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.settimeout(_JOIN_TIMEOUT_S)
    try:
        connection.connect(str(path))
        greeting = connection.recv(wire.PACKET_BYTES)
    except (FileNotFoundError, ConnectionRefusedError) as error:
        connection.close()
        raise can.CanInitializationError(f"no hub serves xilgate channel {channel!r} ({path}); `xilgate bus` starts one") from error
    except OSError as error:
        connection.close()
        raise can.CanInitializationError(f"the hub of xilgate channel {channel!r} does not answer ({path}): {error}") from error
    if greeting != wire.HELLO:
        connection.close()
        raise can.CanInitializationError(f"the hub of xilgate channel {channel!r} refuses: full, or of another version ({path})")
    connection.setblocking(False)
    return connection
