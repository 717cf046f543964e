"""`jaxtrapolate methods`: what there is, and what a method consists of."""

import argparse
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from jaxtrapolate.commands.inputs import parse_size, progress, terminal
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.times import MethodTimes, keep_times, kept_times, measure_methods
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
    parser.add_argument(
        "--measure",
        action="store_true",
        help="time the methods, or the one that is named, on this machine, on a frame of an embedded scene; the times "
        "are kept in the user's cache folder and shown from then on",
    )
    parser.add_argument("--size", metavar="WxH", help="with --measure: width and height in pixels (1280x720)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    out = terminal()
    if options.size is not None and not options.measure:
        raise InputError("--size: is of the frames that --measure times; give both")
    if options.name is not None and options.name not in method_names():
        raise InputError(f"no method {options.name!r}; there are {', '.join(method_names())}")
    if options.measure:
        _measure([options.name] if options.name else list(method_names()), parse_size(options.size or "1280x720"))
    times = kept_times()
    if options.name is None:
        loaded = {name: _loaded(name) for name in method_names()}
        kinds = {name: "not to be had here" if method is None else method.kind for name, (method, _) in loaded.items()}
        for kind in dict.fromkeys(kinds.values()):
            table = Table(title=kind, title_justify="left", box=SIMPLE_HEAD)
            for column in ("method", "frames", *(["ms"] if times else [])):
                table.add_column(column, no_wrap=True, justify="right" if column == "ms" else "left")
            table.add_column("what it does")
            for name in (name for name in kinds if kinds[name] == kind):
                method, text = loaded[name]
                frames = "" if method is None else _frames(method)
                table.add_row(name, frames, *([_ms(times, name)] if times else []), text)
            out.print(table)
        out.print("frames: rendered ones that it takes at most, before + after the one to be generated", soft_wrap=True)
        out.print(f"ms: {times or 'not measured here yet; --measure does'}", soft_wrap=True)
        return
    method, text = _loaded(options.name)
    out.print(f"{options.name}: {text}", soft_wrap=True)
    if method is None:
        return
    out.print(f"{method.kind}; rendered frames before + after: {_frames(method)}; size of the output: {method.scale} x")
    if method.memory:
        out.print("it remembers: handed every frame in order of display, the rendered ones too (`init`, `step`)")
    if times and options.name in times.ms:
        out.print(f"{_ms(times, options.name)} ms: {times}", soft_wrap=True)
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


def _measure(names: list[str], size: tuple[int, int]) -> None:
    """Times methods on a frame of an embedded scene, and keeps the times."""
    from jaxtrapolate.scenes import SceneSequence

    methods = {name: method for name in names if (method := _loaded(name)[0]) is not None}
    if not methods:
        raise InputError(f"--measure: {_loaded(names[0])[1]}")
    past, future = max(m.past for m in methods.values()), max(m.future for m in methods.values())
    with progress(terminal(stderr=True)) as bar:
        bar.add_task("measure", total=None)
        keep_times(measure_methods(SceneSequence("demo", frames=2 * (past + future), size=size), methods))


def _ms(times: MethodTimes, name: str) -> str:
    median = times.ms[name].median if name in times.ms else None
    return "-" if median is None else f"{median:.1f}"


def _runs(stage: Stage, stages: tuple[Stage, ...]) -> str:
    """When a stage runs."""
    said = [] if stage.on == "generated" else [{"rendered": "on rendered frames", "both": "on every frame"}[stage.on]]
    if stage.needed:
        said.append(f"where {stage.needed.where}")
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
