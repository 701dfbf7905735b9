"""The one way onto a CAN bus: python-can behind three calls that never raise on what the bus does.

A bus is named as python-can names it, `INTERFACE:CHANNEL`: `socketcan:vcan0`, `xilgate:bus0`.
"""

import time
from types import TracebackType
from typing import Self

import can

from dbc.errors import SetupFailure
from dbc.frame import CanFrame

MAX_FRAMES_PER_RECEIVE = 512
"""Bound on one call, so that a flood of frames cannot hold the caller's loop."""


class LinkError(SetupFailure):
    """The bus cannot be opened; one line that says why."""


class CanLink:
    """A CAN bus that is polled, never waited for.

    Frames carry the monotonic time of the poll that fetched them. What is not a classical data frame with an 11-bit
    identifier is counted and dropped.

    Args:
        bus_name: `INTERFACE:CHANNEL`.

    Attributes:
        is_alive: False from the first refusal of the bus until it next delivers or accepts a frame. It stays False when the
            interface was removed or the hub has gone.
        send_errors: frames that the bus refused.
        receive_errors: polls that the bus refused.
        ignored_frames: frames dropped because of their kind.

    Raises:
        LinkError: no such bus, or it does not open.
    """

    def __init__(self, bus_name: str) -> None:
        interface, separator, channel = bus_name.partition(":")
        if not (separator and interface and channel):
            raise LinkError(f"bus {bus_name!r}: expected INTERFACE:CHANNEL, for example socketcan:vcan0")
        try:
            # A python-can configuration file of the user's must not change what was asked for.
            self._bus = can.Bus(channel=channel, interface=interface, ignore_config=True)
        except (can.CanError, OSError, ValueError, ImportError, NotImplementedError, NameError) as error:
            # NameError: what python-can's Kvaser interface raises where the maker's library is not installed.
            raise LinkError(f"bus {bus_name!r} does not open: {error}") from error
        self.name = bus_name
        self.is_alive = True
        self.send_errors = 0
        self.receive_errors = 0
        self.ignored_frames = 0

    def receive(self) -> list[CanFrame]:
        """All frames that have arrived since the last call, oldest first."""
        now_ns = time.monotonic_ns()
        frames: list[CanFrame] = []
        is_refused = False
        for _ in range(MAX_FRAMES_PER_RECEIVE):
            try:
                message = self._bus.recv(timeout=0)
            except (can.CanError, OSError):
                # SocketCAN reports an error ahead of the frames that came before it; a second error says there are none.
                if is_refused:
                    break
                is_refused = True
                continue
            if message is None:
                break
            if message.is_error_frame or message.is_remote_frame or message.is_extended_id or message.is_fd:
                self.ignored_frames += 1
                continue
            frames.append(CanFrame(message.arbitration_id, bytes(message.data), now_ns))
        if is_refused:
            self.receive_errors += 1
            self.is_alive = False
        elif frames:
            self.is_alive = True
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Hand frames to the bus; what it refuses is counted and dropped, because a later frame supersedes it."""
        for frame in frames:
            try:
                self._bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False))
            except (can.CanError, OSError):
                self.send_errors += 1
                self.is_alive = False
            else:
                self.is_alive = True

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
