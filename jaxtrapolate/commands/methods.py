"""`jaxtrapolate methods`: what there is, and what a method consists of."""

import argparse
from typing import Any

from rich.table import Table

from jaxtrapolate.commands.inputs import terminal
from jaxtrapolate.errors import InputError
from jaxtrapolate.methods import Method, Stage, load, method_description, method_names
from jaxtrapolate.methods.options import written


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "methods",
        help="the methods, or what one of them consists of",
        description="Lists the methods, those of other installed packages too; with a NAME, its options, and its "
        "stages: what each reads, and which are left out where that is missing.",
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help=f"of {', '.join(method_names())}")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    out = terminal()
    if options.name is None:
        table = Table()
        for column in ("method", "kind", "frames", "what it does"):
            table.add_column(column, no_wrap=column != "what it does")
        for name in method_names():
            method, text = _loaded(name)
            table.add_row(name, "" if method is None else method.kind, "" if method is None else _frames(method), text)
        out.print(table)
        out.print("frames: rendered ones that it takes at most, before + after the one to be made", soft_wrap=True)
        return
    if options.name not in method_names():
        raise InputError(f"no method {options.name!r}; there are {', '.join(method_names())}")
    method, text = _loaded(options.name)
    out.print(f"{options.name}: {text}", soft_wrap=True)
    if method is None:
        return
    out.print(f"{method.kind}; rendered frames before + after: {_frames(method)}; size of the output: {method.scale} x")
    if method.options:
        table = Table(
            title=f"options, as in {options.name}:{method.options[0].name}={written(method.options[0].value)}"
        )
        for column in ("option", "default", "may be", "", "what it is"):
            table.add_column(column)
        for option in method.options:
            again = "compiled anew" if option.static else ""
            table.add_row(option.name, written(option.default), option.allowed, again, option.doc)
        out.print(table)
    table = Table(title="stages, in order: what each takes and gives")
    for column in ("stage", "takes", "gives", "buffers", "runs"):
        table.add_column(column)
    for stage in method.stages:
        needs = [f"{stage.past} rendered frames in history"] if stage.past > 1 else []
        needs += [" or ".join(r.split("|")) for r in stage.reads]
        needs += [f'pip install "jaxtrapolate[{stage.extra}]"'] if stage.extra else []
        takes, gives = (", ".join(names) for names in (stage.takes, stage.gives))
        table.add_row(stage.name, takes, gives, "; ".join(needs), _runs(stage, method.stages))
    out.print(table)
    out.print('takes: "?" may be absent; "history", "target", "future" and "carry" are given at first', soft_wrap=True)


def _runs(stage: Stage, stages: tuple[Stage, ...]) -> str:
    """When a stage runs."""
    said = [] if stage.on == "generated" else [{"rendered": "on rendered frames", "both": "on every frame"}[stage.on]]
    if stage.fallback:
        said.append(f"where no stage gave {', '.join(stage.gives)}")
    if stage.optional:
        before = stages[: stages.index(stage)]
        givers = [[s for s in before if name in s.gives] for name in sorted(stage.needs)]
        sole = [found[0].name for found in givers if found and all(s.optional for s in found)]
        fellows = [s.name for s in stages if stage.group and s.group == stage.group and s is not stage]
        others = list(dict.fromkeys([*sole, *fellows]))
        why = (["its buffers"] if stage.reads or stage.past > 1 else []) + others
        said.append(f"left out without {', '.join(why)}")
    return "; ".join(said) or "always"


def _loaded(name: str) -> tuple[Method | None, str]:
    """A method and its description; without it, why it cannot be had."""
    try:
        return load(name), method_description(name)
    except ValueError as error:
        return None, str(error)


def _frames(method: Method) -> str:
    return f"{method.past} + {method.future}"
