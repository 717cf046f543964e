"""`jaxtrapolate render`: an embedded scene as an Unreal-style EXR dump."""

import argparse
from pathlib import Path
from typing import Any

from jaxtrapolate.commands.inputs import add_fresh, check_count, check_seed, parse_size, progress, terminal
from jaxtrapolate.errors import InputError
from jaxtrapolate.files import write_unreal_frame
from jaxtrapolate.files.listing import list_folder
from jaxtrapolate.files.reader import stored_size
from jaxtrapolate.files.unreal import unreal_files
from jaxtrapolate.runtime.output import open_output


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "render",
        help="an embedded scene as an Unreal-style EXR dump",
        description="Renders an embedded scene with every buffer as an Unreal-style EXR dump.",
    )
    parser.add_argument("scene", metavar="SCENE", help="name of an embedded scene")
    parser.add_argument("--frames", type=int, default=12, metavar="N", help="how many frames (12)")
    parser.add_argument("--size", default="320x180", metavar="WxH", help="width and height in pixels (320x180)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="varies layout, colours, speeds (0)")
    parser.add_argument("--output", required=True, metavar="DIR", help="for the EXR files")
    add_fresh(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    from jaxtrapolate.scenes import SceneSequence, scene_names

    size = parse_size(options.size)
    frames, seed = check_count("--frames", options.frames), check_seed("--seed", options.seed)
    if options.scene not in scene_names():
        raise InputError(f"no scene {options.scene!r}; the embedded ones are {', '.join(scene_names())}")
    sequence = SceneSequence(options.scene, seed=seed, frames=frames, size=size)
    console = terminal(stderr=True)
    name, kept = options.scene.title(), 0
    with (
        open_output(options.output, "render", sequence.identity(), fresh=options.fresh) as output,
        progress(console) as bar,
    ):
        whole = _whole(output.folder, name, size)
        for number in bar.track(sequence.numbers, description="render"):
            if number in whole:
                kept += 1
                continue
            frame, flows = sequence.frame(number), sequence.keyframe(number)
            write_unreal_frame(output.folder, name, number, frame, keyframe=flows, unit=100.0)
    text = f"{frames} frames of {options.scene} in {options.output}" + (f"; {kept} were there already" if kept else "")
    console.print(text, soft_wrap=True, highlight=False)


def _whole(folder: Path, scene: str, size: tuple[int, int]) -> set[int]:
    """The frames whose files are all there, in full: those that any frame has, and the one that is written last."""
    frames, _ = unreal_files(list_folder(folder)).get(scene, ({}, []))
    needed = {"backward_flow"}.union(*frames.values())

    def readable(name: str) -> bool:
        try:
            return stored_size(folder / name) == size
        except InputError:
            return False

    return {n for n, files in frames.items() if needed <= set(files) and all(map(readable, files.values()))}
