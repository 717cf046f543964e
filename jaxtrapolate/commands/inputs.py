"""What the commands have in common: inputs, methods, output folders, progress."""

import argparse
import contextlib
import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError
from jaxtrapolate.files import Sequence, open_sequence
from jaxtrapolate.files.listing import folder_name
from jaxtrapolate.methods import Method, load, method_names
from jaxtrapolate.methods.options import parsed
from jaxtrapolate.metrics import Metric, metric_names
from jaxtrapolate.metrics import load as load_metric

SCENES = "scenes:"

Step = Callable[[str, float, float], None]
"""How long work tells where it is: what it does, how much is done, of how much."""


def add_input(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """The arguments that name an input, or several."""
    if several:
        text = (
            f"folders of frames, or embedded scenes: {SCENES}NAME[:SEED], {SCENES}all, {SCENES}test (every test seed), "
            f"{SCENES}development (seeds that choices have looked at)"
        )
        parser.add_argument("inputs", nargs="+", metavar="INPUT", help=text)
        parser.add_argument("--size", metavar="WxH", help="of embedded scenes, width and height in pixels (320x180)")
        parser.add_argument("--length", type=int, metavar="N", help="of embedded scenes, how many frames (60)")
        parser.add_argument(
            "--scale",
            type=int,
            metavar="N",
            help="of embedded scenes: the truth is rendered N times as large as well, for methods that super sample",
        )
        parser.add_argument(
            "--jitter",
            action="store_true",
            help="of embedded scenes: each frame's samples are shifted by another fraction of a pixel",
        )
    else:
        text = f"a folder of frames, or {SCENES}NAME[:SEED] for an embedded scene"
        parser.add_argument("input", metavar="INPUT", help=text)
    parser.add_argument(
        "--motion",
        metavar="CONVENTION",
        help="how the motion vectors are stated: current_minus_previous or previous_minus_current, pixels, uv or ndc, "
        "down or up (y), separated by commas; `jaxtrapolate check` finds it out",
    )
    parser.add_argument("--strict", action="store_true", help="refuse non-finite pixels and gaps in the numbering")


@dataclasses.dataclass(frozen=True)
class Input:
    """What an INPUT argument names.

    Attributes:
        text: the argument, for messages.
        name: of its folder of results, different for each input.
        open: its sequence; raises InputError where it cannot be used.
        parts: how many parts of its path, at least, its name consists of: one, unless the last says nothing by itself.
    """

    text: str
    name: str
    open: Callable[[], Sequence]
    parts: int = 1


def open_input(text: str, *, motion: str | None = None, strict: bool = False) -> Sequence:
    """The sequence that an INPUT argument names."""
    inputs = named_inputs([text], motion=motion, strict=strict)
    if len(inputs) > 1:
        raise InputError(f"{text}: names {len(inputs)} inputs; this command takes one")
    return inputs[0].open()


def named_inputs(
    texts: list[str],
    *,
    motion: str | None = None,
    strict: bool = False,
    size: str | None = None,
    length: int | None = None,
    scale: int | None = None,
    jitter: bool = False,
) -> list[Input]:
    """What INPUT arguments name, each input once; none is opened yet.

    Args:
        texts: the arguments.
        motion: how folders state their motion vectors.
        strict: whether folders with gaps or pixels that are not finite are refused.
        size: of embedded scenes, "WxH".
        length: of embedded scenes, how many frames.
        scale: of embedded scenes, how many times as large the truth is rendered as well.
        jitter: whether the samples of embedded scenes are shifted, each frame's by another fraction of a pixel.

    Raises:
        InputError: size, length or scale that cannot be; or any of these for folders, which have their own.
    """
    scenes = {}
    if size is not None:
        scenes["size"] = parse_size(size)
    if length is not None:
        scenes["frames"] = check_count("--length", length)
    if scale is not None:
        if not 1 <= scale <= LARGEST_SCALE:
            raise InputError(f"--scale: expected a number from 1 to {LARGEST_SCALE}, got {scale}")
        scenes["scale"] = scale
    if jitter:
        scenes["jittered"] = True
    if scenes and not any(t.startswith(SCENES) for t in texts):
        given = "--size, --length, --scale, --jitter"
        raise InputError(f"{given}: are for embedded scenes ({SCENES}NAME); a folder has its own")
    found: dict[object, Input] = {}
    for text in texts:
        if text.startswith(SCENES):
            for name, seed in _scenes(text):
                key = f"{name}-{seed}"
                found.setdefault((SCENES, key), Input(f"{SCENES}{name}:{seed}", key, _scene(name, seed, scenes)))
        else:
            path = _resolved(text)
            folder = path.parent if path.suffix == ".toml" else path
            parts = folder_name(folder).count("/") + 1
            found.setdefault(path, Input(text, "/".join(folder.parts[1:]), _folder(text, motion, strict), parts))
    return _named_apart(list(found.values()))


def _resolved(text: str) -> Path:
    """The path without symbolic links, wherever they lead."""
    try:
        return Path(os.path.realpath(text, strict=os.path.lexists(text)))
    except (OSError, ValueError) as error:
        raise os_input_error(text, error if isinstance(error, OSError) else OSError(str(error))) from error


def _scenes(text: str) -> list[tuple[str, str]]:
    """Names and seeds that scenes:NAME, scenes:NAME:SEED, scenes:all, scenes:development or scenes:test means."""
    from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, TEST_SEEDS, scene_names

    name, _, seed = text.removeprefix(SCENES).partition(":")
    sets = {"all": (0,), "development": DEVELOPMENT_SEEDS, "test": TEST_SEEDS}
    if name in sets and not seed:
        seeds = sets[name]
        return [(scene, str(seed)) for scene in scene_names() for seed in seeds]
    return [(name, seed or "0")]


def _scene(name: str, seed: str, options: dict) -> Callable[[], Sequence]:
    def opened() -> Sequence:
        from jaxtrapolate.scenes import SceneSequence, scene_names

        if name not in scene_names():
            raise InputError(f"{SCENES}{name}: no such scene; the embedded ones are {', '.join(scene_names())}")
        if not re.fullmatch("[0-9]{1,19}", seed):
            raise InputError(f"{SCENES}{name}:{seed}: expected a seed of digits, such as {SCENES}{name}:0")
        return SceneSequence(name, check_seed(f"{SCENES}{name}:SEED", int(seed)), **options)

    return opened


def _folder(text: str, motion: str | None, strict: bool) -> Callable[[], Sequence]:
    return lambda: open_sequence(text, motion=motion, strict=strict)


def _named_apart(inputs: list[Input]) -> list[Input]:
    """The inputs with names fit for folders: the last parts of their paths, as many as tell them all apart.

    Where only characters that no folder should have tell two apart, a number does: clip, clip-2.
    """

    def ends(entry: Input, count: int) -> str:
        parts = [re.sub(r"[^\w.-]+", "_", part).strip(".") for part in entry.name.split("/")[-count:]]
        return "-".join(filter(None, parts)) or "input"

    deepest = max((entry.name.count("/") + 1 for entry in inputs), default=1)
    names: list[str] = []
    for entry in inputs:
        others = [other for other in inputs if other is not entry]
        counts = range(entry.parts, deepest + 1)
        apart = (n for n in counts if all(ends(entry, n).lower() != ends(other, n).lower() for other in others))
        names.append(ends(entry, next(apart, entry.parts)))
    result, taken = [], set()
    for entry, plain in zip(inputs, names, strict=True):
        tries = (plain if i == 1 else f"{plain}-{i}" for i in range(1, len(inputs) + 2))
        name = next(n for n in tries if n.lower() not in taken)
        taken.add(name.lower())
        result.append(dataclasses.replace(entry, name=name))
    return result


MOST_FRAMES, LARGEST_SIDE, MOST_PIXELS, LARGEST_SCALE = 1_000_000, 32768, 1 << 28, 8
"""Of embedded scenes: far beyond what can be rendered, and short of what overflows."""


def check_count(option: str, value: int) -> int:
    """A number of frames, at least 1."""
    if not 1 <= value <= MOST_FRAMES:
        raise InputError(f"{option}: expected a number from 1 to {MOST_FRAMES}, got {value}")
    return value


def check_factor(value: int) -> int:
    """A factor of frame rates, 2 to 1000."""
    if not 2 <= value <= 1000:
        raise InputError(f"--factor: expected 2 to 1000, got {value}")
    return value


def parse_size(text: str) -> tuple[int, int]:
    """(H, W) from "WxH"."""
    match = re.fullmatch(r"([0-9]{1,9})x([0-9]{1,9})", text)
    width, height = (int(g) for g in match.groups()) if match else (0, 0)
    if min(width, height) < 1 or max(width, height) > LARGEST_SIDE or width * height > MOST_PIXELS:
        most = f"sides of at most {LARGEST_SIDE} and {MOST_PIXELS} pixels"
        raise InputError(f"--size: expected WxH such as 320x180, with {most}, got {text!r}")
    return height, width


def check_seed(option: str, value: int) -> int:
    """A scene's seed, not negative."""
    if not 0 <= value < 2**63:
        raise InputError(f"{option}: expected a number from 0 to {2**63 - 1}, got {value}")
    return value


def add_fresh(parser: argparse.ArgumentParser) -> None:
    """The argument that starts anew in a folder of another run."""
    parser.add_argument("--fresh", action="store_true", help="delete what an earlier run wrote to DIR, and start anew")


def add_weights(parser: argparse.ArgumentParser) -> None:
    """The argument that names files of weights."""
    parser.add_argument(
        "--weights",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="a method's weights: a file of this library (.npz), an Orbax checkpoint (a folder), or for extranet the "
        "authors' .pth.tar; may be given several times",
    )


def parse_weights(texts: list[str]) -> dict[str, str]:
    """Files of weights by method, from arguments NAME=FILE."""
    found = {}
    for text in texts:
        name, separator, path = text.partition("=")
        if not separator or not path or name not in method_names():
            raise InputError(f"--weights: expected NAME=FILE, NAME a method, such as extranet=FILE, got {text!r}")
        found[name] = path
    return found


def open_method(name: str, weights: str | None) -> Method:
    """A method with the weights in a file; with `None`, those that come with the package.

    Raises:
        InputError: the file cannot be used.
        ValueError: no weights of this method come with the package.
    """
    if weights is None:
        return load(name)
    try:
        return load(name, weights=weights)
    except OSError as error:
        raise os_input_error(weights, error) from error
    except ValueError as error:
        raise InputError(f"--weights {name}: {error}") from error


def split_options(text: str) -> tuple[str, dict[str, str]]:
    """A method's name and the texts of its options, of NAME:OPTION=VALUE:...

    Raises:
        ValueError: an option without a value, or one that is given twice.
    """
    name, *given = text.split(":")
    options: dict[str, str] = {}
    for part in given:
        option, separator, value = part.partition("=")
        if not option or not separator or not value or option in options:
            raise ValueError(f"{text}: expected NAME:OPTION=VALUE:..., each option once, got {part!r}")
        options[option] = value
    return name, options


def open_methods(
    names: str | Iterable[str], *, option: str = "--methods", weights: list[str] | None = None
) -> tuple[dict[str, Method], dict[str, str]]:
    """Methods of a comma-separated list of NAME:OPTION=VALUE:..., by what was said of each.

    So that a method stands beside itself with other options. And of those that have no weights, why they cannot be had.
    Tuples are written 1-3-5.

    Args:
        names: the list.
        option: where it was given.
        weights: arguments NAME=FILE, for every mention of that method.

    Raises:
        InputError: an unknown name or option, none at all, or weights that cannot be used or belong to a method not
            named.
    """
    listed = [n.strip() for n in names.split(",")] if isinstance(names, str) else list(names)
    files = parse_weights(weights or [])
    methods, unavailable, plain = {}, {}, {}
    for text in filter(None, listed):
        try:
            name, given = split_options(text)
        except ValueError as error:
            raise InputError(f"{option}: {error}") from error
        if name not in method_names():
            raise InputError(f"{option}: no method {name!r}; there are {', '.join(method_names())}")
        try:
            plain[name] = plain[name] if name in plain else open_method(name, files.get(name))
        except ValueError as error:
            unavailable[text] = str(error)
            continue
        try:
            values = parsed(f"method {name!r}", plain[name].settings, given)
            methods[text] = plain[name].replace(**values) if values else plain[name]
        except ValueError as error:
            raise InputError(f"{option}: {error}") from error
    files = {name: path for name, path in files.items() if name not in plain}
    if not methods and not unavailable:
        raise InputError(f"{option}: expected names separated by commas, of {', '.join(method_names())}")
    if files:
        raise InputError(f"--weights: {', '.join(files)} is not among the methods of {option}")
    return methods, unavailable


def open_metrics(names: str) -> dict[str, Metric]:
    """The metrics of a comma-separated list."""
    found = {}
    for name in filter(None, (n.strip() for n in names.split(","))):
        if name not in metric_names():
            raise InputError(f"--metrics: no metric {name!r}; there are {', '.join(metric_names())}")
        try:
            found[name] = load_metric(name)
        except ImportError as error:
            raise InputError(f"--metrics: {error}") from error
    if not found:
        raise InputError(f"--metrics: expected names separated by commas, of {', '.join(metric_names())}")
    return found


def terminal(*, stderr: bool = False) -> Console:
    """Where a command prints, without markup: brackets in a name stay brackets."""
    return Console(stderr=stderr, markup=False)


def progress(console: Console) -> Progress:
    """A progress bar on stderr, gone when it is done; none where stderr is no terminal."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


@contextlib.contextmanager
def steps(console: Console) -> Iterator[Step]:
    """A progress bar that follows the `Step` it gives."""
    with progress(console) as bar:
        task = bar.add_task("", total=None)
        yield lambda text, done, total: bar.update(task, description=text, completed=done, total=total)
