"""Faults while the emulator runs: the operations that its service offers on them."""

from collections.abc import Iterable, Mapping
from functools import partial

from dbc.catalogue import Catalogue
from vehicle_emulator.faults.engine import FaultEngine
from vehicle_emulator.faults.instance import Fault
from vehicle_emulator.faults.spec import FaultMistake, FaultSpec, fault_of
from vehicle_emulator.faults.targets import check
from vehicle_emulator.operation import Action, Operation

ADD, LIST, CLEAR = "fault_add", "fault_list", "fault_clear"


def fault_operations(engine: FaultEngine, catalogue: Catalogue) -> dict[str, Operation]:
    """The operations on the faults of a running engine, by name.

    `ADD` takes the keys of one fault, `LIST` nothing, `CLEAR` a `name` or nothing for all. All answer with the faults concerned.
    """

    def add(arguments: Mapping[str, object]) -> Action:
        spec = fault_of(arguments)
        check([spec], catalogue)
        return partial(_add, engine, spec)

    def listing(arguments: Mapping[str, object]) -> Action:
        _refuse_others(arguments, ())
        return lambda _: _told(engine.faults)

    def clear(arguments: Mapping[str, object]) -> Action:
        _refuse_others(arguments, ("name",))
        name = arguments.get("name")
        if name is not None and not isinstance(name, str):
            raise FaultMistake(f"name = {name!r}: allowed: the name of a fault")
        return lambda now_ns: _told(engine.clear(now_ns, name))

    return {ADD: add, LIST: listing, CLEAR: clear}


def _add(engine: FaultEngine, spec: FaultSpec, now_ns: int) -> object:
    return _told(engine.add(now_ns, [spec]))


def _told(faults: Iterable[Fault]) -> list[dict[str, object]]:
    return [
        {"name": fault.spec.name, "fault": fault.spec.text, "state": fault.state, "hits": fault.hits}
        for fault in faults
    ]


def _refuse_others(arguments: Mapping[str, object], known: tuple[str, ...]) -> None:
    if unknown := sorted(str(key) for key in arguments.keys() - set(known)):
        raise FaultMistake(f"{unknown[0]}: unknown key; allowed: {', '.join(known) or 'none'}")
