"""`jaxtrapolate demo`: an embedded scene, a few methods, error against run time, pictures, a report."""

import argparse
from pathlib import Path
from typing import Any

from jaxtrapolate.commands.evaluate import Request, evaluate_into
from jaxtrapolate.commands.inputs import add_fresh, check_count, open_methods, parse_size, steps, terminal
from jaxtrapolate.commands.tables import print_table

METHODS = ("repeat", "warp", "guided_warp", "guided_net", "blend", "bidirectional_image", "bidirectional_guided")
"""What the demo compares: from simple to best, of both kinds. `jaxtrapolate evaluate scenes:demo` runs every method and
times its stages, too, which takes minutes of compilation."""


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "demo",
        help="a few methods on an embedded scene: table, pictures, HTML report; needs no data",
        description="Renders a small embedded scene and evaluates some methods on it, from the simplest to the best. "
        "No data, no network. `jaxtrapolate evaluate scenes:demo --output DIR` runs every method, "
        "stage by stage, too.",
    )
    parser.add_argument("--output", default="demo", metavar="DIR", help="for results, pictures and report (demo)")
    parser.add_argument("--frames", type=int, default=16, metavar="N", help="how many frames (16)")
    parser.add_argument("--size", default="480x270", metavar="WxH", help="width and height in pixels (480x270)")
    add_fresh(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    """Runs the command."""
    from jaxtrapolate.scenes import SceneSequence

    folder = Path(options.output)
    frames = check_count("--frames", options.frames)
    sequence = SceneSequence("demo", frames=frames, size=parse_size(options.size))
    methods, unavailable = open_methods(METHODS)
    console = terminal(stderr=True)
    with steps(console) as step:
        request = Request(methods, unavailable, fresh=options.fresh, stages=False)
        results = evaluate_into(sequence, request, folder, step=step)
    print_table(results, terminal())
    console.print(
        f"open {folder / 'report.html'}; numbers in {folder / 'results.json'}", soft_wrap=True, highlight=False
    )
