"""The result of the solver bench for people."""

from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table

Result = dict[str, Any]


def to_table(result: Result) -> Group:
    """All that was measured, the targets last."""
    parts: list[RenderableType] = [_times(result)]
    for key, make in (
        ("profile", _profile),
        ("limit", _limit),
        ("hard", _hard),
        ("agreement", _agreement),
        ("instructions", _instructions),
    ):
        if result[key]:
            parts.append(make(result))
    return Group(*parts, _libraries(result), _targets(result))


def _times(result: Result) -> Table:
    unit = result["unit"]
    caption = f"unit: quiet mean of {unit['solver']} on the nominal set, {unit['quiet_mean_us']:.0f} us; quiet: smallest of the rounds"
    columns = ("mean", "p99", "max", "mean\nus", "raw p99\nus", "SQP its\nmean", "p95", "QP its\nmean", "work\nmean", "max", "con-\nverged")
    table = _table("Solve time", ("solver", "set"), ("prob-\nlems", "rounds", *columns), caption)
    keys = (
        *("ratio_mean", "ratio_p99", "ratio_max", "quiet_mean_us", "raw_p99_us"),
        *("sqp_iterations_mean", "sqp_iterations_p95", "qp_iterations_mean", "work_mean", "work_max"),
    )
    formats = ("{:.3f}",) * 3 + ("{:.0f}",) * 2 + ("{:.2f}", "{:.1f}", "{:.2f}", "{:.1f}", "{:.1f}")
    for row in result["rows"]:
        figures = (_formatted(row[key], form) for key, form in zip(keys, formats, strict=True))
        table.add_row(row["solver"], row["set"], str(row["instances"]), str(row["rounds"]), *figures, f"{row['converged']:.1%}")
    return table


def _profile(result: Result) -> Table:
    """Rows as in the paper's table, a column for each solver and the last one for the paper's generated code."""
    solvers = tuple(dict.fromkeys(row["solver"] for row in result["profile"]))
    caption = "us of a solve (of one evaluation); line search holds its calls of cost and constraints"
    table = _table("Where the time goes, nominal set", ("part",), (*solvers, "paper, generated"), caption)
    found = {(row["solver"], row["part"]): row for row in result["profile"]}
    for part in dict.fromkeys(row["part"] for row in result["profile"]):
        rows = [found.get((solver, part)) for solver in solvers]
        paper = next((row["paper"] for row in rows if row), None)
        times = [(row["solve_ms"], row["call_ms"]) if row else (None, None) for row in rows]
        times.append((paper["generated_ms"], paper["generated_call_ms"]) if paper else (None, None))
        table.add_row(part, *("-" if solve is None or call is None else f"{1000 * solve:.1f} ({1000 * call:.1f})" for solve, call in times))
    return table


def _limit(result: Result) -> Table:
    columns = (
        "stage\nsweep us",
        "adjoint\nsweep us",
        "Riccati\nus",
        "nominal mean\nalone us",
        "of sweep\n+ Riccati",
        "among\nothers us",
        "of sweep\n+ Riccati",
    )
    table = _table("The limit: parts alone, and the nominal set", ("solver",), columns)
    for row in result["limit"]:
        keys = ("stage_sweep_us", "adjoint_sweep_us", "riccati_us", "alone_mean_us", "alone_ratio", "nominal_mean_us", "nominal_ratio")
        table.add_row(row["solver"], *(_formatted(row[key], "{:.2f}" if key.endswith("ratio") else "{:.1f}") for key in keys))
    return table


def _hard(result: Result) -> Table:
    columns = ("starts", "finite", "status\ntrue", "false\nclaims", "con-\nverged", "longest", "us", "work\nmax")
    kinds = tuple(result["hard"][0]["converged_by_kind"])
    table = _table("Hard starts", ("solver",), (*columns, *(kind.replace("infeasible", "infeas.") for kind in kinds)))
    for row in result["hard"]:
        shares = (f"{row['converged_by_kind'][kind]:.2%}" for kind in kinds)
        table.add_row(
            *(row["solver"], str(row["starts"]), f"{row['finite']:.2%}", f"{row['true_status']:.2%}", str(row["false_claims"])),
            *(f"{row['converged']:.2%}", f"{row['ratio_longest']:.2f}", f"{row['longest_quiet_us']:.0f}"),
            *(_formatted(row["work_max"], "{:.0f}"), *shares),
        )
    return table


def _agreement(result: Result) -> Table:
    columns = ("asked", "both\nconverged", "same\nminimum", "first\ninput", "plan,\nscaled")
    table = _table("Largest differences of answers", ("solver", "with"), columns)
    for row in result["agreement"]:
        counts = (str(row[key]) for key in ("instances", "both_converged", "same_minimum"))
        table.add_row(row["solver"], row["with"], *counts, *(_formatted(row[key], "{:.1e}") for key in ("first_input", "plan")))
    return table


def _instructions(result: Result) -> Table:
    table = _table("Instructions by callgrind", ("solver",), ("problems", "instructions\nper solve"))
    for row in result["instructions"]:
        table.add_row(row["solver"], str(row["instances"]), f"{row['instructions_per_solve']:,}")
    return table


def _libraries(result: Result) -> Table:
    table = _table("Libraries", ("solver",), ("lanes", "memory kB", "of it work"), result["machine"])
    table.add_column("compiler and flags", overflow="fold")
    for row in result["solvers"]:
        sizes = (f"{row[key] / 1000:.0f}" for key in ("memory_bytes", "work_bytes"))
        table.add_row(row["solver"], str(row["lanes"]), *sizes, f"{row['compiler']} {row['flags']}")
    return table


def _targets(result: Result) -> Table:
    table = _table("Targets", ("what",), ("target", "measured", "met"))
    for row in result["targets"]:
        verdict = {None: "not measured", True: "yes", False: "[bold red]no[/bold red]"}[row["met"]]
        table.add_row(row["what"], row["target"], _formatted(row["measured"], "{:.4g}"), verdict)
    return table


def _table(title: str, left: tuple[str, ...], right: tuple[str, ...], caption: str | None = None) -> Table:
    table = Table(title=title, caption=caption, box=box.SIMPLE, padding=(0, 1, 0, 0))
    for heading in left:
        table.add_column(heading, no_wrap=True)
    for heading in right:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _formatted(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
