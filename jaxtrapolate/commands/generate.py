"""`jaxtrapolate generate`: generate the frames between the rendered ones."""

import argparse
import dataclasses
from collections.abc import Collection, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate._version import __version__
from jaxtrapolate.commands.inputs import (
    add_fresh,
    add_input,
    add_weights,
    check_factor,
    open_input,
    open_methods,
    progress,
    terminal,
)
from jaxtrapolate.errors import InputError
from jaxtrapolate.evaluation.player import play
from jaxtrapolate.evaluation.schedule import Slot, missing_slots, needed_slots, virtual_slots
from jaxtrapolate.evaluation.windows import arguments, load
from jaxtrapolate.files import Sequence, write_frame
from jaxtrapolate.files.reader import stored_size
from jaxtrapolate.methods import BEST_FIRST, method_names
from jaxtrapolate.methods.frames import rendered
from jaxtrapolate.methods.method import Method
from jaxtrapolate.methods.options import written
from jaxtrapolate.runtime.output import open_output, write_json
from jaxtrapolate.weights import fingerprint


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "generate",
        help="generate the frames between the rendered ones",
        description="A frame that has buffers but no colour is generated. Where all have colour, FACTOR - 1 frames are "
        "put after each: between it and the next by methods that interpolate, else by its motion carried on.",
    )
    add_input(parser)
    parser.add_argument(
        "--method", metavar="M", help=f"of {', '.join(method_names())} (the best that can run: {', '.join(BEST_FIRST)})"
    )
    add_weights(parser)
    parser.add_argument("--output", required=True, metavar="DIR", help="for the frames: EXR for HDR input, else PNG")
    parser.add_argument("--factor", type=int, default=2, metavar="N", help="frame rate out over frame rate in (2)")
    add_fresh(parser)
    parser.set_defaults(run=run)


NO_HISTORY = "too little history: rendered frames before them, without a gap"
NO_FUTURE = "no rendered frame follows them without a gap"


@dataclasses.dataclass(frozen=True)
class Work:
    """What is to be generated with a method.

    Attributes:
        sequence: the input.
        method: the method.
        slots: all frames in order of display, the rendered ones too.
        how: how the targets are had, for the user.
        factor: frame rate out over frame rate in.
    """

    sequence: Sequence
    method: Method
    slots: list[Slot]
    how: str
    factor: int

    @classmethod
    def plan(cls, sequence: Sequence, method: Method, factor: int) -> "Work":
        """Frames without colour where there are any, else frames between or after the rendered ones."""
        past, future = max(1, method.past), method.future
        if not all(map(sequence.has_color, sequence.numbers)):
            slots, how = missing_slots(sequence, past=past, future=future), "from the buffers drawn for them"
        elif method.kind == "interpolation":
            slots, how = (
                virtual_slots(sequence, "between", past=past, factor=factor),
                "between each two rendered frames",
            )
        else:
            slots = virtual_slots(sequence, "onward", past=past, factor=factor)
            how = "after each rendered frame, by its motion carried on: no buffers were drawn for them"
        return cls(sequence, method, slots, how, factor)

    @property
    def targets(self) -> list[Slot]:
        """The frames that are not rendered."""
        return [slot for slot in self.slots if not slot.rendered]

    def reads(self) -> list[int]:
        """The numbers of the frames that are read, whatever is there already."""
        wanted = [not slot.rendered for slot in self.slots]
        needed = needed_slots(self.slots, wanted, memory=self.method.memory)
        return sorted({n for slot, flag in zip(self.slots, needed, strict=True) if flag for n in slot.numbers})

    def name(self, slot: Slot) -> str:
        """Of a frame's file, without the ending: the frame's number, and the fraction after it: 0012.5, 0012.333."""
        return f"{slot.number:04d}" + (_fraction(slot.fraction) if slot.virtual is not None else "")

    def lacks(self, slot: Slot) -> str | None:
        """Why a frame cannot be generated, without reading anything; `None` where it can as far as that tells.

        Raises:
            InputError: no frame of the sequence can.
        """
        if self.method.future and not slot.behind:
            return NO_FUTURE
        colored = (*slot.before, slot.number) if slot.virtual is not None else slot.before
        return None if any(map(self.sequence.has_color, colored)) else NO_HISTORY

    def refused(self, slot: Slot) -> str | None:
        """Why a frame cannot be generated, by its own buffers; `None` where it can.

        Raises:
            InputError: the method lacks what no other frame of the sequence will have either.
        """
        if (reason := self.lacks(slot)) is not None:
            return reason
        if slot.virtual == "onward" and self.sequence.frame(slot.number).motion is None:
            raise InputError(f"{self.sequence.name}: frame {slot.number} has no motion vectors to carry on")
        ((_, window),) = load(self.sequence, [slot])
        given = arguments(self.method, window)
        if not rendered(given[0]):
            return NO_HISTORY
        try:
            self.method.active(*given)
        except ValueError as error:
            if "rendered frames in history" in str(error):
                return NO_HISTORY
            raise InputError(str(error)) from None
        return None

    def images(self, wanted: Collection[str]) -> Iterator[tuple[str, Any]]:
        """The frames of these names, in order of display."""
        methods = {self.method.name: self.method}
        for slot, _, found in play(self.sequence, self.slots, methods, wanted=lambda _, s: self.name(s) in wanted):
            yield self.name(slot), found[self.method.name].image


def _fraction(fraction: Fraction) -> str:
    return f".{float(fraction):.3f}".rstrip("0").replace("0.", "", 1)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    console = terminal(stderr=True)
    factor = check_factor(options.factor)
    sequence = open_input(options.input, motion=options.motion, strict=options.strict)
    if options.method is None:
        work = _best(sequence, factor, options.weights)
    else:
        method = _one(*open_methods(options.method, option="--method", weights=options.weights))
        work = Work.plan(sequence, method, factor)
    method, targets = work.method, work.targets
    settings = {
        **sequence.identity(),
        "method": method.name,
        "options": {o.name: written(o.value) for o in method.options if o.value != o.default},
        "weights": fingerprint(method.weights) if jax.tree.leaves(method.weights) else None,
        "factor": factor if any(slot.virtual for slot in targets) else None,
    }
    with open_output(options.output, "generate", settings, fresh=options.fresh) as output:
        suffix = ".exr" if sequence.hdr else ".png"
        paths = {work.name(slot): output.folder / f"{work.name(slot)}{suffix}" for slot in targets}
        generated, kept, reasons = 0, 0, dict[str, int]()
        wanted: set[str] = set()
        with progress(console) as bar:
            hashing = bar.add_task("read input", total=None)
            output.agree_frames(
                sequence, work.reads(), step=lambda text, done, total: bar.update(hashing, completed=done, total=total)
            )
            bar.remove_task(hashing)
            checked = False
            for slot in targets:
                if _whole(paths[work.name(slot)], sequence.size, method.scale):
                    kept += 1
                    continue
                reason = work.lacks(slot) if checked and slot.full else work.refused(slot)
                if reason is not None:
                    reasons[reason] = reasons.get(reason, 0) + 1
                    continue
                checked = checked or slot.full
                wanted.add(work.name(slot))
            task = bar.add_task("generate", total=len(wanted))
            for name, image in work.images(wanted):
                write_frame(paths[name], np.asarray(image), sequence.hdr)
                generated += 1
                bar.advance(task)
        if not generated + kept:
            causes = "; ".join(f"{count}: {reason}" for reason, count in reasons.items())
            text = f"no frame can be generated with {method.name} ({causes or 'too few frames'})"
            raise InputError(f"{sequence.name}: {text}")
        summary = {
            "version": __version__,
            "input": sequence.name,
            "method": method.name,
            "frames": len(targets),
            "generated": generated,
            "kept from an earlier run": kept,
            "left out": reasons,
            "how": work.how,
            "notes": list(sequence.notes),
        }
        write_json(output.folder / "generate.json", summary)
    text = f"{generated} frames generated with {method.name}, {work.how}; in {output.folder}"
    text += f"; {kept} were there already" if kept else ""
    text += "".join(f"; {count} left out: {reason}" for reason, count in reasons.items())
    console.print(text, soft_wrap=True, highlight=False)
    for note in sequence.notes:
        console.print(f"note: {note}", soft_wrap=True, highlight=False)


def _best(sequence: Sequence, factor: int, weights: list[str]) -> Work:
    """The first of `BEST_FIRST` that can generate the frame in the middle, and what is to be generated with it."""
    reasons = []
    for name in BEST_FIRST:
        own = [w for w in weights if w.startswith(f"{name}=")]
        methods, unavailable = open_methods(name, option="--method", weights=own)
        for method in methods.values():
            work = Work.plan(sequence, method, factor)
            targets = work.targets
            try:
                reason = work.refused(targets[len(targets) // 2]) if targets else "too few frames"
            except InputError as error:
                reason = str(error)
            if reason is None:
                return work
            reasons.append(f"{name}: {reason}")
        reasons += [f"{name}: {reason}" for reason in unavailable.values()]
    raise InputError(f"{sequence.name}: no method can run: {'; '.join(reasons)}")


def _whole(path: Path, size: tuple[int, int], scale: int) -> bool:
    """Whether a frame's file is there, in full and of the right size."""
    if not path.is_file():
        return False
    try:
        return stored_size(path) == (size[0] * scale, size[1] * scale)
    except InputError:
        return False


def _one(methods: dict[str, Method], unavailable: dict[str, str]) -> Method:
    if len(methods) + len(unavailable) != 1:
        raise InputError(f"--method: expected one name, got {', '.join((*methods, *unavailable))}")
    for reason in unavailable.values():
        raise InputError(reason)
    return next(iter(methods.values()))
