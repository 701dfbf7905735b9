"""CAN frames bit by bit, written from ISO 11898-1 for the tests alone: slow, and with nothing of the code under test."""

EXTENDED, REMOTE, FD, SWITCH, PASSIVE = 0x01, 0x02, 0x04, 0x10, 0x20
FD_SIZES = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]


def binary(value: int, width: int) -> str:
    return format(value, f"0{width}b")


def header(arbitration_id: int, length_bytes: int, flags: int) -> tuple[str, int]:
    """Unstuffed bits before the data, and the place of BRS among them (behind the end where there is none)."""
    if flags & EXTENDED:
        base, extension = binary(arbitration_id, 29)[:11], binary(arbitration_id, 29)[11:]
        arbitration = "0" + base + "1" + "1" + extension + ("1" if flags & REMOTE else "0")
    else:
        arbitration = "0" + binary(arbitration_id, 11) + ("1" if flags & REMOTE else "0") + "0"
    if flags & FD:
        control = arbitration + "1" + "0" + ("1" if flags & SWITCH else "0")
        return control + ("1" if flags & PASSIVE else "0") + binary(FD_SIZES.index(length_bytes), 4), len(control) - 1
    control = arbitration + ("00" if flags & EXTENDED else "0") + binary(length_bytes, 4)
    return control, len(control)


def crc15(bits: str) -> str:
    register = 0
    for bit in bits:
        feedback = int(bit) ^ (register >> 14)
        register = (register << 1) & 0x7FFF
        if feedback:
            register ^= 0x4599
    return binary(register, 15)


def stuffed(bits: str) -> list[tuple[str, int]]:
    """The bits on the wire, each with the place of the bit that it is, or that it follows as a stuff bit."""
    out: list[tuple[str, int]] = []
    for place, bit in enumerate(bits):
        out.append((bit, place))
        last = "".join(sent for sent, _ in out[-5:])
        if last in ("00000", "11111"):
            out.append(("1" if bit == "0" else "0", place))
    return out


def classical(arbitration_id: int, data: bytes, flags: int, length_bytes: int) -> str:
    """All bits of a classical frame on the wire: delimiters recessive, acknowledged, end of frame."""
    head, _ = header(arbitration_id, length_bytes, flags)
    head += "".join(binary(byte, 8) for byte in data)
    return "".join(bit for bit, _ in stuffed(head + crc15(head))) + "1" + "0" + "1" + "1" * 7


def fd_lengths(arbitration_id: int, data: bytes, flags: int) -> tuple[int, int]:
    """Bits of a CAN FD frame at the nominal rate, and in the data phase."""
    head, switch = header(arbitration_id, len(data), flags)
    wire = stuffed(head + "".join(binary(byte, 8) for byte in data))
    # The CRC field begins with a fixed stuff bit; a stuff bit that the data call for at their end is not sent beside it.
    places = [place for _, place in wire]
    if len(places) > 1 and places[-1] == places[-2]:
        wire.pop()
    checked = "cccc" + "k" * (17 if len(data) <= 16 else 21)
    crc_field = "".join(("f" if place % 4 == 0 else "") + kind for place, kind in enumerate(checked))
    # Of the place of BRS only the bit itself is nominal: its stuff bit comes after the switch.
    nominal_bits = sum(1 for _, place in wire if place < switch) + 1
    after = len(wire) - nominal_bits + len(crc_field) + 1
    tail = 2 + 7
    return (nominal_bits + tail, after) if flags & SWITCH else (nominal_bits + after + tail, 0)
