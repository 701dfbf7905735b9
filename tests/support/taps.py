"""What buses and nodes do to the car's frames: taps through which a world's frames go from a given time on."""

import random
from collections.abc import Callable, Iterable
from functools import cache

from dbc.frame import CanFrame
from tests.support.campaign import MS, Frames, Tap, catalogue
from tests.support.oracle_wire import Wire, WireMessage, counter_of

Edit = Callable[[WireMessage, bytes], bytes]
"""What becomes of the payload of a message."""


@cache
def wire() -> Wire:
    """The messages, as the oracle reads them."""
    return Wire()



def lose(names: Iterable[str]) -> Tap:
    """These messages do not come."""
    lost = {catalogue().by_name[name].arbitration_id for name in names}
    return lambda t_ns, frame, rng: [] if frame.arbitration_id in lost else [(t_ns, frame)]


def rewrite(name: str, edit: Edit) -> Tap:
    """The payload of one message becomes what `edit` makes of it."""
    message = wire().by_name[name]

    def tap(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
        if frame.arbitration_id == message.arbitration_id:
            frame = frame._replace(data=edit(message, frame.data))
        return [(t_ns, frame)]

    return tap


def shift(name: str, signal: str, by: float) -> Tap:
    """A signal is off by a constant; the node that sends it does not know and protects it as ever."""

    def edit(message: WireMessage, data: bytes) -> bytes:
        changed = message.changed(data, {signal: message.value(data, signal) + by})
        return message.sealed(changed, counter_of(data))

    return rewrite(name, edit)


def fix(name: str, signal: str, value: float) -> Tap:
    """A signal has one value for ever, well protected."""
    return rewrite(name, lambda message, data: message.sealed(message.changed(data, {signal: value}), counter_of(data)))


def freeze(name: str) -> Tap:
    """A node repeats its last content with a counter that goes on."""
    frozen: list[bytes] = []

    def edit(message: WireMessage, data: bytes) -> bytes:
        frozen.append(data)
        return message.sealed(frozen[0], counter_of(data))

    return rewrite(name, edit)


def randomly(share: float, name: str | None, act: Callable[[int, CanFrame, random.Random], Frames]) -> Tap:
    """A share of the frames, of one message or of all, meets something."""
    identifier = None if name is None else catalogue().by_name[name].arbitration_id

    def tap(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
        is_meant = identifier in (None, frame.arbitration_id)
        return act(t_ns, frame, rng) if is_meant and rng.random() < share else [(t_ns, frame)]

    return tap


def flipped(frame: CanFrame, rng: random.Random, bits: int = 1) -> CanFrame:
    """The frame with some wrong bits."""
    data = bytearray(frame.data)
    for position in rng.sample(range(8 * len(data)), bits):
        data[position // 8] ^= 1 << position % 8
    return frame._replace(data=bytes(data))


def noisy(bit_error_rate: float) -> Tap:
    """Bits are wrong at random, and the controller does not notice."""

    def tap(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
        wrong = sum(rng.random() < bit_error_rate for _ in range(8 * len(frame.data)))
        return [(t_ns, flipped(frame, rng, wrong) if wrong else frame)]

    return tap


def overtaken(t_ns: int, frame: CanFrame, rng: random.Random) -> Frames:
    """The frame comes up to 25 ms late, after others that were sent later."""
    return [(t_ns + rng.randrange(25 * MS), frame)]


def late(delay_ns: int) -> Tap:
    """Everything comes later."""
    return lambda t_ns, frame, rng: [(t_ns + delay_ns, frame)]


def later_and_later(names: Iterable[str], since_ns: int, growth: float) -> Tap:
    """These messages come ever later: something on their way is too slow for them."""
    slow = {catalogue().by_name[name].arbitration_id for name in names}
    return lambda t_ns, frame, rng: [(t_ns + round(growth * (t_ns - since_ns) * (frame.arbitration_id in slow)), frame)]


def wrong_crc(message: WireMessage, data: bytes) -> bytes:
    """An edit: the CRC does not fit; twice wrong is not right."""
    is_right = len(data) == message.length and message.sealed(data, counter_of(data)) == data
    return bytes([data[0] ^ 0x5A]) + data[1:] if is_right else data


def same_counter(message: WireMessage, data: bytes) -> bytes:
    """An edit: the counter stands still."""
    return message.sealed(data, 3)


def jumping_counter(message: WireMessage, data: bytes) -> bytes:
    """An edit: the counter goes on by five."""
    return message.sealed(data, 5 * counter_of(data))


def too_short(message: WireMessage, data: bytes) -> bytes:
    """An edit: a byte is missing."""
    return data[:-1]
