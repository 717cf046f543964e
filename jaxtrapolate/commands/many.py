"""Evaluating several inputs: each in its own folder, and their means in the folder above."""

from collections.abc import Callable
from pathlib import Path

from jaxtrapolate.commands.inputs import Input, Step
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.score import mean_over_inputs
from jaxtrapolate.report import write_report
from jaxtrapolate.results import InputResult, MethodResult, Results
from jaxtrapolate.runtime.compiled import spare_memory_maps
from jaxtrapolate.runtime.output import open_output, write_json
from jaxtrapolate.runtime.timing import machine


def evaluate_many(
    inputs: list[Input], evaluate: Callable[..., Results], folder: Path, *, fresh: bool = False, step: Step
) -> tuple[Results | None, dict[str, str]]:
    """Evaluates inputs one after the other, and writes what they have in common to `folder`.

    Args:
        inputs: as `named_inputs` gives them.
        evaluate: of a sequence, with `folder`, `reuse` and `step`.
        folder: gets a folder for each input, with its own results.json and report.html. An input that an earlier run
            finished is not run again.
        fresh: delete the results over all inputs of an earlier run (`evaluate` does that of each input's).
        step: told how many inputs are done, with fractions.

    Returns:
        The results over all inputs, None where none could be used; and, by argument, why an input could not be used,
        which starts with its name.
    """
    with open_output(folder, "evaluate", {"inputs": "several"}, fresh=fresh):
        done, failed = _each(inputs, evaluate, folder, step)
        if not done:
            return None, failed
        results = over_all(list(done.values()), failed)
        write_json(folder / "results.json", results.to_json())
        write_report(results, folder)
    return results, failed


def _each(
    inputs: list[Input], evaluate: Callable[..., Results], folder: Path, step: Step
) -> tuple[dict[str, tuple[InputResult, Results]], dict[str, str]]:
    """What the results of all inputs say about each, by name, and why the others could not be used, by argument."""
    done: dict[str, tuple[InputResult, Results]] = {}
    failed: dict[str, str] = {}
    for index, entry in enumerate(inputs):
        furthest = float(index)

        def follow(text: str, now: float | int, of: float | int, index: int = index, name: str = entry.name) -> None:
            nonlocal furthest
            furthest = max(furthest, index + (now / of if text == "evaluate" and of else 0.0))
            step(f"{name}: {text}", furthest, len(inputs))

        try:
            follow("read", 0, 1)
            spare_memory_maps()
            results = evaluate(entry.open(), folder=folder / entry.name, reuse=True, step=follow)
            done[entry.name] = (_summary(entry.name, results), results)
        except InputError as error:
            reason = " ".join(error.on_command_line.split())
            failed[entry.text] = (
                reason if reason.startswith(entry.text.removesuffix(":0")) else f"{entry.text}: {reason}"
            )
    return done, failed


def _summary(name: str, results: Results) -> InputResult:
    """What the results over all inputs say about one: everything but single frames and stages."""
    return InputResult(
        input=results.input,
        folder=name,
        size=results.size,
        hdr=results.hdr,
        frames=len(results.frames),
        methods=results.methods,
        skipped=results.skipped,
    )


def over_all(done: list[tuple[InputResult, Results]], failed: dict[str, str]) -> Results:
    """The results over all inputs: their table, and for each method the means of `mean_over_inputs`."""
    inputs, first = [entry for entry, _ in done], done[0][1]
    common = ("version", "code", "methods", "metrics", "factor", "frames", "pictures", "video")
    settings = {k: first.settings[k] for k in common if k in first.settings}
    methods = mean_over_inputs([i.methods for i in inputs], metrics=first.metrics)
    named = [*settings["methods"]]
    skipped = {}
    for name in named:
        if reasons := [i.skipped[name] for i in inputs if name in i.skipped]:
            skipped[name] = f"on {len(reasons)} of {len(inputs)} inputs: {reasons[0]}"
    return Results(
        input=f"{len(inputs)} of {len(inputs) + len(failed)} inputs" if failed else f"{len(inputs)} inputs",
        machine=machine(),
        size=first.size if len({i.size for i in inputs}) == 1 else None,
        hdr=first.hdr if len({i.hdr for i in inputs}) == 1 else None,
        settings=settings,
        metrics=first.metrics,
        methods={name: methods[name] for name in named if name in methods},
        notes=tuple(_notes(inputs, methods)),
        skipped=skipped,
        inputs=tuple(inputs),
        failed=failed,
    )


def _notes(inputs: list[InputResult], methods: dict[str, MethodResult]) -> list[str]:
    notes = []
    counts = {m.inputs for m in methods.values()}
    if counts != {len(inputs)}:
        over = str(counts.pop()) if len(counts) == 1 else "differing numbers"
        notes.append(f"means are over {over} of {len(inputs)} inputs: those on which every method ran, none exactly")
    if len({i.size for i in inputs}) > 1:
        notes.append("milliseconds are means over inputs of different sizes")
    return notes
