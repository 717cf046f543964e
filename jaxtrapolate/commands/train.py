"""`jaxtrapolate train`: train a network as a configuration says."""

import argparse
import sys
import tomllib
from typing import Any

from jaxtrapolate.commands.inputs import add_fresh, steps, terminal
from jaxtrapolate.errors import InputError


def add_parser(subparsers: Any) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "train",
        help="train a network",
        description="Trains a network as a configuration says, from the workdir's last checkpoint on, on all devices. "
        "Over several hosts the command is run on each, with a workdir that they share.",
    )
    parser.add_argument("config", metavar="CONFIG", help="a TOML file, or the name of a shipped configuration")
    parser.add_argument("--workdir", required=True, metavar="DIR", help="for checkpoints, metrics, images, the model")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting in place of the configuration's, as steps=3000, start=default (begins with the weights that "
        "come with the package) or options.windows.dumps='[\"FOLDER\"]' (learns from your frames); may be repeated",
    )
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="over several hosts, as the cluster's environment says (Slurm, Open MPI, Kubernetes, Cloud TPU)",
    )
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="over several hosts: where the first can be reached")
    parser.add_argument("--processes", type=int, metavar="N", help="with --coordinator: how many there are")
    parser.add_argument("--process", type=int, metavar="I", help="with --coordinator: which this one is, from 0 on")
    add_fresh(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Runs the command; 1 where the run broke off, because its loss was not finite."""
    _join(options)
    from jaxtrapolate.training import TrainingError, load_config, train_and_evaluate

    console = terminal(stderr=True)
    config = load_config(options.config, dict(map(_setting, options.set)))
    try:
        with steps(console) as report:
            scores = train_and_evaluate(config, options.workdir, report=report, fresh=options.fresh)
    except TrainingError as error:
        print(f"jaxtrapolate: {error}", file=sys.stderr)
        return 1
    text = ", ".join(f"{name} {value:.4g}" for name, value in scores.items() if value is not None)
    console.print(
        f"{config.steps} steps of {config.task}: {text}; in {options.workdir}", soft_wrap=True, highlight=False
    )
    return 0


def _setting(text: str) -> tuple[str, Any]:
    """A key and a value as TOML has it; a word without quotes stands for itself."""
    key, equals, value = (part.strip() for part in text.partition("="))
    if not (key and equals and value):
        raise InputError(f"--set: expected KEY=VALUE, got {text!r}")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError as error:
        if value[0] in "[{\"'":
            raise InputError(f"--set: {key}: {error}") from error
        return key, value


def _join(options: argparse.Namespace) -> None:
    """Joins the processes of a run over several hosts, before anything is computed."""
    given = (options.coordinator, options.processes, options.process)
    if any(value is not None for value in given) and any(value is None for value in given):
        raise InputError("--coordinator, --processes, --process: belong together; give all three or none")
    if options.coordinator is None and not options.distributed:
        return
    import jax

    try:
        jax.distributed.initialize(*given)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"--{'coordinator' if options.coordinator else 'distributed'}: {error}") from error
