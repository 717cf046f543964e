"""`jaxtrapolate render`: an embedded scene as an Unreal-style EXR dump."""

import argparse
from typing import Any

from jaxtrapolate.commands.inputs import output_folder, parse_size, progress, terminal
from jaxtrapolate.files import InputError, write_unreal_frame


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
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    from jaxtrapolate.scenes import SceneSequence, scene_names

    size = parse_size(options.size)
    if options.frames < 1:
        raise InputError(f"--frames: expected 1 or more, got {options.frames}")
    if options.scene not in scene_names():
        raise InputError(f"no scene {options.scene!r}; the embedded ones are {', '.join(scene_names())}")
    folder = output_folder(options.output)
    sequence = SceneSequence(options.scene, seed=options.seed, frames=options.frames, size=size)
    console = terminal(stderr=True)
    name = options.scene.title()
    with progress(console) as bar:
        for number in bar.track(sequence.numbers, description="render"):
            if (folder / f"{name}BackwardFlow.{number:04d}.exr").exists():
                continue  # the last file of a frame: an earlier run wrote it
            frame, flows = sequence.frame(number), sequence.keyframe(number)
            write_unreal_frame(folder, name, number, frame, keyframe=flows, unit=100.0)
    console.print(f"{len(sequence.numbers)} frames of {options.scene} in {folder}", soft_wrap=True, highlight=False)
