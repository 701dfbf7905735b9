"""Prints CasADi's SX functions as C functions that work on several stages at once.

An SX function is a list of scalar instructions. Each becomes one line of C on the type `lanes` (see `c/lanes.h`): one double, or
two or four of them, one for each of as many stages. Equal instructions are printed once, a divisor is inverted once, and sine and
cosine of the same angle are computed together.

One SX function can become several C functions, its phases, for inputs that are known one after the other. What an earlier phase has
computed and a later one needs again is left on a tape.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import casadi as ca

from dbc.errors import SetupFailure

_C = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SQRT: "lanes_sqrt({0})",
    ca.OP_ATAN: "lanes_atan({0})",
    ca.OP_SIN: "{0}_sin",
    ca.OP_COS: "{0}_cos",
}


class EmitError(SetupFailure):
    """A model uses an operation that the printer does not know."""


@dataclass(frozen=True)
class Phase:
    """A C function that computes a part of what an SX function does; see `Printed.of`.

    Args:
        inputs: of the SX function, that are known from this phase on.
        outputs: of the SX function, that this phase gives.
        tape: name of the array with all that this phase has computed and later ones need; the last phase has none.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    tape: str = ""


@dataclass(frozen=True)
class _Node:
    """A value: an input, a number, or the result of an operation on others.

    Args:
        operation: CasADi's code; OP_INPUT and OP_CONST for the first two.
        operands: places of other nodes.
        text: how C calls it, of an input or a number.
        phase: in which it can be computed first; -1 for a number.
    """

    operation: int
    operands: tuple[int, ...]
    text: str
    phase: int


class _Graph:
    """The values that an SX function computes, each once."""

    def __init__(self, function: ca.Function, phases: tuple[Phase, ...]) -> None:
        self.nodes: list[_Node] = []
        self.outputs: dict[str, list[int]] = {name: [-1] * function.nnz_out(name) for name in function.name_out()}
        self._places: dict[_Node, int] = {}
        phase_of = {name: number for number, phase in enumerate(phases) for name in phase.inputs}
        names_in, names_out = function.name_in(), function.name_out()
        registers: dict[int, int] = {}  # CasADi reuses them
        for k in range(function.n_instructions()):
            operation, inputs, outputs = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_OUTPUT:
                self.outputs[names_out[outputs[0]]][outputs[1]] = registers[inputs[0]]
            elif operation == ca.OP_INPUT:
                name = names_in[inputs[0]]
                registers[outputs[0]] = self._place(_Node(operation, (), f"{name}[{inputs[1]}]", phase_of[name]))
            elif operation == ca.OP_CONST:
                registers[outputs[0]] = self._number(float(function.instruction_constant(k)))
            else:
                registers[outputs[0]] = self._result(operation, [registers[i] for i in inputs])

    def _result(self, operation: int, operands: list[int]) -> int:
        if operation == ca.OP_DIV:
            return self._result(ca.OP_MUL, [operands[0], self._result(ca.OP_INV, operands[1:])])
        if operation not in _C:
            raise EmitError(f"CasADi operation {operation}: no C code is known for it")
        values = [self.nodes[i] for i in operands]
        if operation == ca.OP_INV and values[0].operation == ca.OP_CONST:
            return self._number(1.0 / float(values[0].text.strip("()")))
        if operation in {ca.OP_ADD, ca.OP_MUL}:
            operands = sorted(operands)
        return self._place(_Node(operation, tuple(operands), "", max(value.phase for value in values)))

    def _number(self, value: float) -> int:
        return self._place(_Node(ca.OP_CONST, (), f"({value!r})", -1))

    def _place(self, node: _Node) -> int:
        if node not in self._places:
            self._places[node] = len(self.nodes)
            self.nodes.append(node)
        return self._places[node]


@dataclass(frozen=True)
class Printed:
    """C functions.

    Args:
        definitions: signature and lines of the body of each.
        tape_sizes: of their tapes, by the name of the macro.
    """

    definitions: list[tuple[str, list[str]]]
    tape_sizes: dict[str, int]

    @classmethod
    def of(cls, function: ca.Function, phases: tuple[Phase, ...]) -> "Printed":
        """The phases of an SX function.

        Each computes all that it can of what is needed. Its arguments are the tapes of the phases before, the inputs of them and its
        own, its outputs, its tape.

        Raises:
            EmitError: the function contains an operation that is not known here.
        """
        graph = _Graph(function, phases)
        needed = _needed(graph)
        tapes = [_tape(graph, needed, number) for number in range(len(phases))]
        definitions = [_definition(graph, needed, phases, tapes, number) for number in range(len(phases))]
        sizes = {f"{phase.name.upper()}_TAPE": max(1, len(tape)) for phase, tape in zip(phases, tapes, strict=True) if phase.tape}
        return cls(definitions, sizes)


def _needed(graph: _Graph) -> set[int]:
    """Nodes that outputs depend on."""
    found = {place for places in graph.outputs.values() for place in places}
    for place in range(len(graph.nodes) - 1, -1, -1):
        if place in found:
            found.update(graph.nodes[place].operands)
    return found


def _tape(graph: _Graph, needed: set[int], number: int) -> list[int]:
    """Nodes of a phase that later ones use."""
    used = {i for place in needed if graph.nodes[place].phase > number for i in graph.nodes[place].operands}
    return sorted(i for i in used if graph.nodes[i].phase == number and graph.nodes[i].operation != ca.OP_INPUT)


def _definition(graph: _Graph, needed: set[int], phases: tuple[Phase, ...], tapes: list[list[int]], number: int) -> tuple[str, list[str]]:
    phase = phases[number]
    sources = [(before.tape, tape) for before, tape in zip(phases[:number], tapes, strict=False)]
    inputs = [name for known in phases[: number + 1] for name in known.inputs]
    names = [*(name for name, _ in sources), *inputs]
    arguments = [f"const lanes *restrict {name}" for name in names]
    arguments += [f"lanes *restrict {name}" for name in (*phase.outputs, *((phase.tape,) if phase.tape else ()))]
    signature = f"void {phase.name}({', '.join(arguments)})"
    known = {place: f"{name}[{i}]" for name, tape in sources for i, place in enumerate(tape)}
    own = [place for place in sorted(needed) if graph.nodes[place].phase == number and graph.nodes[place].operation != ca.OP_INPUT]
    results = {f"{name}[{i}]": place for name in phase.outputs for i, place in enumerate(graph.outputs[name])}
    results |= {f"{phase.tape}[{i}]": place for i, place in enumerate(tapes[number])} if phase.tape else {}
    lines = _Body(graph, known).lines_of(own, results)
    text = "\n".join(lines)
    unused = [name for name in (*names, *filter(None, [phase.tape])) if f" {name}[" not in text]
    return signature, [*(f"    (void){name};" for name in unused), *lines]


class _Body:
    """The lines of one function."""

    def __init__(self, graph: _Graph, known: dict[int, str]) -> None:
        self._graph, self._known = graph, known
        self._names: dict[int, str] = {}
        self._lines: list[str] = []

    def lines_of(self, own: Iterable[int], results: dict[str, int]) -> list[str]:
        ready: dict[int, list[str]] = {}
        for target, place in results.items():
            ready.setdefault(place, []).append(target)
        for place in own:
            self._name(place)
            for target in ready.pop(place, ()):
                self._lines.append(f"    {target} = lanes_of({self._names[place]});")
        for place, targets in ready.items():
            self._lines += [f"    {target} = lanes_of({self._name(place)});" for target in targets]
        return self._lines

    def _name(self, place: int) -> str:
        """Name of a value; the line that computes it is added where there is none yet."""
        if place not in self._names:
            node = self._graph.nodes[place]
            if node.operation == ca.OP_CONST:
                self._names[place] = node.text
            elif place in self._known or node.operation == ca.OP_INPUT:
                self._names[place] = self._line(f"v{place}", self._known.get(place, node.text))
            elif node.operation in {ca.OP_SIN, ca.OP_COS}:
                self._names[place] = _C[node.operation].format(self._angle(node.operands[0]))
            else:
                operands = [self._name(i) for i in node.operands]
                self._names[place] = self._line(f"v{place}", _C[node.operation].format(*operands))
        return self._names[place]

    def _line(self, name: str, expression: str) -> str:
        self._lines.append(f"    const lanes {name} = {expression};")
        return name

    def _angle(self, place: int) -> str:
        angle = self._name(place)
        line = f"    lanes_sincos({angle}, &{angle}_sin, &{angle}_cos);"
        if line not in self._lines:
            self._lines += [f"    lanes {angle}_sin, {angle}_cos;", line]
        return angle
