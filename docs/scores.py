"""The tables of what `evaluate` said: `experiments/results/evaluated` keeps its `results.json`."""

from collections.abc import Callable, Sequence
from functools import partial
from statistics import fmean
from typing import Any

from tabulate import ROOT, milliseconds, read, table


def evaluated(name: str) -> str:
    """What `evaluate` says of an input: its `results.json` is kept by the input's name."""
    found = read(f"experiments/results/evaluated/{name}.json")["methods"]
    causes = {c: entry["share"] for m in found.values() for c, entry in m["by_cause"].items()}
    columns: dict[str, Callable[[dict[str, Any]], float]] = {
        "dB": lambda method: method["psnr"],
        "SSIM": lambda method: method["ssim"],
        "ms": lambda method: -method["ms"]["median"],
    } | {
        f"{cause} {100 * share:.1f} %": lambda method, cause=cause: method["by_cause"][cause]["psnr"]
        for cause, share in causes.items()
    }

    def cell(column: str, value: float) -> str:
        if column == "ms":
            return milliseconds(-value) if value < -1 else f"{-value:.2f}"
        return f"{value:.3f}" if column == "SSIM" else f"{value:.2f}"

    best = {c: max(get(method) for method in found.values()) for c, get in columns.items() if c != "ms"}
    rows = []
    for method, entry in found.items():
        values = {column: get(entry) for column, get in columns.items()}
        cells = [f"**{cell(c, v)}**" if best.get(c) == v else cell(c, v) for c, v in values.items()]
        rows.append([method, *cells])
    return table(["method", *columns], rows)


PAST = ("repeat", "warp", "reproject", "warp_3d", "grid_extrapolate", "extranet", "occlusion_warp", "extrass_warp")
PAST += ("guided_warp", "extrass_refine", "shading_warp", "guided_net")
"""Methods that use the past alone, in the order of their tables."""

BOTH = ("blend", "half_motion", "grid_warp", "dis", "softmax_splat", "interpolator")
BOTH += ("bidirectional_image", "bidirectional", "bidirectional_guided", "bidirectional_shading")
"""Methods that know the next rendered frame."""


def _best(columns: Sequence[Sequence[float]], digits: int = 2) -> list[list[str]]:
    """Columns of numbers as text, the largest of each in bold."""
    texts = [[f"{value:.{digits}f}" for value in column] for column in columns]
    return [
        [f"**{t}**" if v == max(c) else t for t, v in zip(row, c, strict=True)]
        for row, c in zip(texts, columns, strict=True)
    ]


def _found(name: str) -> dict[str, Any]:
    """What was found on an input in several runs: of methods that have changed since a run, what the next says."""
    methods: dict[str, Any] = {}
    inputs: dict[str, dict[str, Any]] = {}
    for run in (name, f"{name}_light", f"{name}_past"):
        if not (ROOT / f"experiments/results/evaluated/{run}.json").exists():
            continue
        found = read(f"experiments/results/evaluated/{run}.json")
        methods |= found["methods"]
        for entry in found.get("inputs") or ():
            inputs.setdefault(entry["input"], {}).update(entry["methods"])
    return {"methods": methods, "inputs": inputs}


def by_scene(names: Sequence[str]) -> str:
    """dB of methods on the test seeds, the mean over each scene's and over all."""
    found = _found("test_seeds")
    inputs: dict[str, list[dict[str, Any]]] = {}
    for name, methods in found["inputs"].items():
        if not any(method["psnr"] == "inf" for method in methods.values()):  # not the scene in which nothing moves
            inputs.setdefault(name.rpartition("-")[0], []).append(methods)
    columns = [[fmean(methods[name]["psnr"] for methods in group) for name in names] for group in inputs.values()]
    columns.append([found["methods"][name]["psnr"] for name in names])
    rows = zip(names, *_best(columns), strict=True)
    return table(["dB", *inputs, "mean"], [list(row) for row in rows])


def by_cause(names: Sequence[str]) -> str:
    """dB of methods on the test seeds by cause."""
    found = _found("test_seeds")["methods"]
    causes = {cause: entry["share"] for cause, entry in found[names[0]]["by_cause"].items()}
    columns = [[found[name]["by_cause"][cause]["psnr"] for name in names] for cause in causes]
    head = [f"{cause} {100 * share:.1f} %" for cause, share in causes.items()]
    return table(["dB by cause", *head], [list(row) for row in zip(names, *_best(columns), strict=True)])


_RENAMED = {"extranet": "guided_net"}

_MEASURED = {"czest1dm": "path-traced map", "torcs": "cars", "bunker": "engine clip"}


CAUSES = ("border", "hole", "shadow", "glossy", "edge", "rest")


LIGHT = ("guided_warp", "shading_warp", "guided_net", "bidirectional_guided", "bidirectional_shading")
"""Methods without and with the light's own motion."""


def by_scene_and_cause(names: Sequence[str]) -> str:
    """dB of methods by scene and cause, one after the other, the mean over a scene's test seeds."""
    found: dict[str, list[dict[str, Any]]] = {}
    for name, methods in _found("test_seeds")["inputs"].items():
        if not any(method["psnr"] == "inf" for method in methods.values()):
            found.setdefault(name.rpartition("-")[0], []).append(methods)
    causes = list(_found("test_seeds")["methods"][names[0]]["by_cause"])

    def cell(sequences: list[dict[str, Any]], name: str, cause: str) -> str:
        values = [by[cause]["psnr"] for s in sequences if cause in (by := s[name]["by_cause"])]
        return f"{fmean(values):.1f}" if values else ""

    rows = []
    for scene, sequences in found.items():
        cells = [" / ".join(cell(sequences, name, cause) for name in names) for cause in causes]
        rows.append([scene, *(text if text.strip(" /") else "" for text in cells)])
    return table([" / ".join(names), *causes], rows)


def error_shares(names: Sequence[str]) -> str:
    """Which share of the squared error each cause has, in per cent, on test seeds and measured inputs."""
    titles = {"test_seeds": "embedded scenes"} | {f"{name}_both": title for name, title in _MEASURED.items()}
    rows = []
    for run, title in titles.items():
        for name in names:
            by_cause = _found(run)["methods"][name]["by_cause"]
            errors = {cause: entry["share"] * 10 ** (-entry["psnr"] / 10) for cause, entry in by_cause.items()}
            shares = [100 * errors[cause] / sum(errors.values()) if cause in errors else None for cause in CAUSES]
            rows.append([title, name, *("" if share is None else f"{share:.0f}" for share in shares)])
    return table(["% of the squared error", "", *CAUSES], rows)


def both_sides() -> str:
    """dB of methods that know the next frame too, on measured inputs."""
    found = {name: _found(f"{name}_both")["methods"] for name in _MEASURED}
    names = [*BOTH, "extranet", "extrass_warp", "guided_warp", "extrass_refine", "shading_warp", "guided_net"]
    columns = [[methods[name]["psnr"] for name in names] for methods in found.values()]
    titles = [f"{name} (from one side)" if name in PAST else name for name in names]
    return table(["dB", *_MEASURED.values()], [list(row) for row in zip(titles, *_best(columns), strict=True)])


def before() -> str:
    """dB of methods before holes, light and numbers were mended, and since, in one run on the same frames."""
    found = {}
    columns = {"test_seeds": "embedded scenes"} | {f"{name}_both": title for name, title in _MEASURED.items()}
    for name in columns:
        old, since = read(f"experiments/results/evaluated/before/{name}.json")["methods"], _found(name)["methods"]
        found[name] = [
            {_RENAMED.get(key, key): method["psnr"] for key, method in old.items()},
            {key: method["psnr"] for key, method in since.items()},
        ]
    rows = []
    for name in (*PAST, *BOTH):
        cells = [f"{old[name]:.2f} -> {new[name]:.2f}" if name in old else "" for old, new in found.values()]
        rows += [[name, *cells]] if any(cells) else []
    return table(["dB, before -> since", *columns.values()], rows)


TABLES: dict[str, Callable[[], str]] = {
    "map": partial(evaluated, "czest1dm"),
    "clip": partial(evaluated, "bunker"),
    "cars": partial(evaluated, "torcs"),
    "map-stripped": partial(evaluated, "czest1dm_stripped"),
    "cars-stripped": partial(evaluated, "torcs_stripped"),
    "test-past": partial(by_scene, PAST),
    "test-both": partial(by_scene, (*BOTH, "guided_warp", "guided_net")),
    "test-causes": partial(by_cause, PAST),
    "test-causes-both": partial(by_cause, BOTH),
    "both-sides": both_sides,
    "light": partial(by_scene, LIGHT),
    "light-causes": partial(by_cause, LIGHT),
    "light-scenes": partial(by_scene_and_cause, LIGHT[:3]),
    "light-errors": partial(error_shares, LIGHT[:3]),
    "before": before,
}
"""Each by its name in the pages."""
