"""Which messages a fault is about, by the DBC."""

from collections.abc import Iterable
from typing import NamedTuple

from dbc.catalogue import Catalogue, MessageSpec
from vehicle_emulator.faults.spec import FaultMistake, FaultSpec

GATEWAY = "GW"
EVERYTHING = "*"
_NEEDS_PROTECTION = ("bad_crc", "bad_counter")


class Target(NamedTuple):
    """What a fault is about.

    Args:
        messages: by arbitration id.
        is_everything: whether it is about all that is on the bus.
    """

    messages: dict[int, MessageSpec]
    is_everything: bool


def check(specs: Iterable[FaultSpec], catalogue: Catalogue) -> None:
    """Check the names that faults refer to.

    Raises:
        FaultMistake: the DBC does not have one, or the fault means nothing for it; one line per mistake.
    """
    mistakes: list[str] = []
    for spec in specs:
        try:
            target_of(spec, catalogue)
        except FaultMistake as mistake:
            mistakes.append(str(mistake))
    if mistakes:
        raise FaultMistake("\n".join(mistakes))


def target_of(spec: FaultSpec, catalogue: Catalogue) -> Target:
    """What a fault is about; nothing when it is not about messages.

    Raises:
        FaultMistake: see `check`.
    """
    if spec.kind == "robot_dtc":
        _check_code(spec, catalogue)
    key = "messages" if "messages" in spec.values else "node"
    if key not in spec.values:
        return Target({}, is_everything=False)
    messages: dict[int, MessageSpec] = {}
    for name in spec.words(key):
        found = [message for message in catalogue.by_name.values() if _is_meant(message, name, key)]
        if not found:
            raise FaultMistake(f"fault {spec.name or spec.kind}: {key} = {name!r}: allowed: {_known(catalogue, key)}")
        if spec.kind in _NEEDS_PROTECTION and not (found := [message for message in found if message.e2e_data_id is not None]):
            raise FaultMistake(f"fault {spec.name or spec.kind}: {key} = {name!r}: allowed: messages with end-to-end protection")
        messages |= {message.arbitration_id: message for message in found}
    return Target(messages, EVERYTHING in spec.words(key))


def _is_meant(message: MessageSpec, name: str, key: str) -> bool:
    if key == "node":
        return message.sender == name
    return name in (EVERYTHING, message.name, message.sender) or _identifier(name) == message.arbitration_id


def _identifier(name: str) -> int | None:
    try:
        return int(name, 16) if name.lower().startswith("0x") else None
    except ValueError:
        return None


def _known(catalogue: Catalogue, key: str) -> str:
    nodes = sorted({message.sender for message in catalogue.by_name.values()})
    return ", ".join(nodes if key == "node" else [EVERYTHING, *nodes, *catalogue.by_name])


def _check_code(spec: FaultSpec, catalogue: Catalogue) -> None:
    message = f"{spec.values['robot']}_Diag"
    catalogue.require([message], "fault robot_dtc")
    codes = catalogue.enumeration(message, "Dtc")
    if (code := spec.number("code")) not in codes.values():
        known = ", ".join(f"{number} ({name})" for name, number in sorted(codes.items(), key=lambda entry: entry[1]) if number)
        raise FaultMistake(f"fault {spec.name or spec.kind}: code = {code:g}: allowed: {known}")
