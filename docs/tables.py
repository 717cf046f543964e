"""Writes the tables of the pages from what was measured: no figure is typed by hand.

python docs/tables.py           # rewrites what stands between `<!-- table: NAME -->` and `<!-- end -->`
python docs/tables.py --check   # exit status 1 where a page differs
"""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from statistics import fmean
from typing import Any

import scores
from tabulate import ROOT, milliseconds, read, table

PAGES = (
    "README.md",
    *(f"docs/{name}.md" for name in ("results", "speed", "scenes", "extreme")),
    "experiments/README.md",
)
BLOCK = re.compile(r"(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def search() -> str:
    """How exact the search is: figure 11 of Yang et al. 2011."""
    results = read("experiments/results/bidirectional_errors.json")

    def percents(values: Sequence[float]) -> str:
        return " / ".join(f"{v:.1f}" for v in values[:3])

    rows = []
    for name, scene in results["scenes"].items():
        ours, paper = scene["total"]["default"]["4"], scene["total"]["bilinear, error (paper)"]["4"]
        columns = scene["lin"]["4"], ours["found_all"], ours["found_hit"], ours["found_shown"], paper["found_shown"]
        rows.append([name.split(",")[0], *map(percents, columns)])
    for name, title in (("walkers", "the paper's walking scene"), ("head", "the paper's head")):
        stated = {key: " / ".join(f"{v:g}" for v in values) for key, values in results["paper"][name].items()}
        rows.append([title, stated["lin"], stated["all"], "", "", stated["hit"]])
    return table(
        ["scene", "E_lin", "found, all", "found, visible", "found, shown", "the same by the paper's options"], rows
    )


def stiff() -> str:
    """Up to which motion the searches find their points."""
    reach = read("experiments/results/stiff_motion.json")["reach"]

    def cell(family: str, solver: str) -> str:
        values = [reach[f"{family}|{solver}|float32"][steps].replace("none", "-") for steps in ("3", "8", "16")]
        return " / ".join(values) + (" degrees" if family == "rotation" else "")

    rows = []
    families = {"zoom, stretch": ("zoom", "stretch"), "shrink": ("shrink",), "rotation": ("rotation",)}
    families["simple shear, the control"] = ("shear",)
    for title, names in families.items():
        cells = {tuple(cell(name, solver) for solver in ("fixed point", "newton")) for name in names}
        if len(cells) != 1:
            raise ValueError(f"{title}: expected the same of {names}, got {cells}")
        rows.append([title, *cells.pop()])
    return table(["motion", "fixed point (the paper's)", "Newton"], rows)


def quality() -> str:
    """Mean SSIM over time."""
    scenes = read("experiments/results/quality_over_time.json")["scenes"]
    names = ("blend", "half_motion", "warp_3d", "reproject", "grid_warp", "reproject_shade")
    names += ("bidirectional_image", "bidirectional")
    rows = [[name, *(f"{fmean(s['methods'][name]['ssim']):.4f}" for s in scenes.values())] for name in names]
    return table(["SSIM", *scenes], rows)


def guided() -> str:
    """The guided warp by its sigmas, mean over the moving scenes."""
    scenes = [s for n, s in read("experiments/results/guided_warp_defaults.json")["scenes"].items() if n != "still-0"]
    spaces = list(scenes[0]["bare"])
    guides = list(dict.fromkeys(key.split(",")[0] for key in scenes[0]["grid"]))
    rows = [[g, *(f"{fmean(s['grid'][f'{g},{space}'] for s in scenes):.2f}" for space in spaces)] for g in guides]
    rows.append(["bare", *(f"{fmean(s['bare'][space] for s in scenes):.2f}" for space in spaces)])
    return table(["sigma guide", *(f"{space} px" for space in spaces)], rows)


_OPERATIONS = {
    "backward_warp bilinear": "`backward_warp` bilinear, RGB",
    "backward_warp nearest": "nearest",
    "backward_warp bicubic": "bicubic",
    "chain_motion": "`chain_motion`",
    "splat_nearest": "`splat_nearest`, 4 pixels",
    "splat softmax": "`splat`, softmax",
    "occlusion_motion": "`occlusion_motion`",
    "iterative_search nearest": "`iterative_search`, 3 steps, nearest pixel's flow",
    "iterative_search bilinear": "interpolated flow",
    "interpolate_bidirectional image-based": "`interpolate_bidirectional`, rendered frames alone",
    "interpolate_bidirectional scene-assisted": "by the target's own flows",
    "guided_warp float32, sigma 0.05 and 1 px": "`guided_warp`, sigma 0.05 and 1 px",
    "guided_warp float32, sigma 0.005 and 10 px": "sigma 0.005 and 10 px",
}
_PEERS = {
    "cv2": "cv2.remap",
    "cv2, map given": "with its map given",
    "numba": "numba",
    "numba, unguarded": "numba without guards against overflow",
    "grid_sample": "grid_sample",
    "map_coordinates": "map_coordinates",
}


def operations() -> str:
    """Milliseconds of operations, and ratios to their peers."""
    measured = {(r["operation"], r["size"]): r for r in read("benchmarks/results/cpu_1_thread.json")["operations"]}
    rows = []
    for name, title in _OPERATIONS.items():
        times = [f"{measured[name, size]['ms']['median']:.1f}" for size in ("360p", "720p", "1080p")]
        peers, texts = measured[name, "1080p"]["peers"], []
        for peer, label in _PEERS.items():
            if peer in peers:
                entry = peers[peer]
                note = entry.get("note", "")
                label += " with early reject" if "early reject" in note else ""
                label += " (another kernel)" if "another kernel" in note else ""
                text = f"{entry['ratio']:.2f} {label}"
                if peer == "cv2, map given":
                    texts[-1] += f" ({text})"
                else:
                    texts.append(text)
        rows.append([title, *times, ", ".join(texts)])
    return table(["operation, float32", "360p ms", "720p ms", "1080p ms", "ratios at 1080p"], rows)


def flows() -> str:
    """Milliseconds of dense flows, OpenCV's beside them, and of what they are measured by."""
    rows = []
    found = {(r["operation"], r["size"]): r for r in read("benchmarks/results/cpu_1_thread_flows.json")["operations"]}
    measure = "guided_warp float32, sigma 0.05 and 1 px"
    for name in [*dict.fromkeys(name for name, _ in found if "flow" in name), measure]:
        cells = []
        for size in ("360p", "720p", "1080p"):
            peer = found[name, size]["peers"].get("cv2", {})
            cells += [f"{found[name, size]['ms']['median']:.0f}", f"{peer['ratio']:.2f}" if "ratio" in peer else ""]
        rows.append([f"`{name}`", *cells])
    head = [text for size in ("360p", "720p", "1080p") for text in (f"{size} ms", "ours / cv2")]
    return table(["one thread, memory kept", *head], rows)


def networks() -> str:
    """Milliseconds of networks, and ratios to their peers."""
    names = {"extranet": "ExtraNet, light gates", "extranet, full gates": "full gates"}
    names |= {"gated convolution": "full gates, no histories (GC)", "interpolator": "learned interpolator"}

    def row(title: str, entry: dict[str, Any]) -> list[str]:
        peers = [entry["peers"].get(peer) for peer in ("torch", "torch, channels last", "openvino")]
        cells = ["" if p is None else f"{p['median']:.0f} ({p['ratio']:.2f})" for p in peers]
        return [title, f"{entry['gflop']:.1f}", f"{entry['ms']['median']:.0f}", *cells]

    kept = {r["network"]: r for r in read("benchmarks/results/cpu_1_thread_networks_keep.json")["networks"]}
    plain = {r["network"]: r for r in read("benchmarks/results/cpu_1_thread_networks.json")["networks"]}
    rows = [row(title, kept[name]) for name, title in names.items()]
    rows.append(row("*ExtraNet, default allocator*", plain["extranet"]))
    head = ["ms (our time / the peer's), memory kept", "GFLOP", "ours", "PyTorch", "channels last", "OpenVINO"]
    return table(head, rows)


def scenes() -> str:
    """How hard the embedded scenes are, means over the development seeds."""
    found = read("experiments/results/scene_statistics.json")["scenes"]
    shares = ("hidden", "outside", "shadow", "glossy", "dynamic", "sky")
    rows = []
    for name, seeds in found.items():
        means = [f"{100 * fmean(s[key] for s in seeds.values()):.1f}" for key in shares]
        rows.append([name, f"{fmean(s['motion'] for s in seeds.values()):.1f}", *means])
    return table(["scene", "motion, px", *(f"{key}, %" for key in shares)], rows)


def reach() -> str:
    """How far the guided warp looks, mean dB and that in exact holes."""
    sizes = read("experiments/results/guided_reach.json")["sizes"]
    rows = []
    titles = {"None": "the kernels alone", "240": "240 rows", "180": "**180 rows**", "120": "120 rows"}
    for key, title in titles.items():
        cells = []
        for found in sizes.values():
            whole, hole = (fmean(scene[key][part] for scene in found.values()) for part in ("whole", "hole"))
            cells.append(f"{whole:.2f} ({hole:.2f})")
        rows.append([title, *cells])
    return table(["", *sizes], rows)


def spaces() -> str:
    """In which space colours are fetched, mean dB."""
    rows = []
    for name, scenes in read("experiments/results/space.json")["methods"].items():
        means = {space: fmean(row[space] for row in scenes.values()) for space in ("linear", "log", "tone")}
        rows.append([name, *(f"{mean:.2f}" for mean in means.values())])
    return table(["", *("linear", "log", "tone")], rows)


_PARTS = {
    "warp": "warp",
    "occlusion_warp": "occlusion_warp",
    "guided_warp": "guided_warp",
    "first guess": "first guess",
    "whole": "**whole**, our recipe",
    "without histories": 'without histories (table 7, "w/o HE")',
    "without occlusion motion": 'without occlusion motion ("w/o OMV")',
    "the paper's loss": "the paper's loss",
    "the paper's loss without shading": 'the paper\'s loss without shading ("w/o SL")',
    "the paper's network and loss": "the paper's network and loss",
    "full gates": "full gates (section 6.5)",
    "GC": "full gates, no histories (GC)",
    "histories by their encoder alone": "histories by their encoder alone",
    "images as they are": "images themselves, not their differences",
    "batch norm": "batch norm",
    "errors in the log domain": "errors in the log domain",
    "warp as first guess": "the plain warp as first guess",
    "seen scenes": "seen scenes: without interior and dock",
    "one scene": "one scene: walkers",
}
_TRAINED = list(_PARTS)[4:]


def ablations() -> str:
    """What each part of ExtraNet is worth, mean and standard deviation over seeds."""
    found = read("experiments/results/ablations.json")

    def cell(entry: dict[str, Any]) -> str:
        spread = entry["spread"]
        return f"{entry['mean']:.2f}" + ("" if spread is None else f" ± {spread:.2f}")

    rows = []
    for name, title in _PARTS.items():
        seeds = str(len(found["dB by seed"][name])) if name in _TRAINED else ""
        whole, unseen = found["all scenes"][name], found["on interior and dock"][name]["psnr"]
        cells = [cell(whole[part]) for part in ("psnr", "hole", "shadow", "border")]
        rows.append([title, seeds, *cells, cell(unseen)])
    return table(["", "seeds", "whole", "hole", "shadow", "border", "unseen"], rows)


def failures() -> str:
    """Where ExtraNet fails: figure 21 of Guo et al. 2021 in numbers."""
    found = read("experiments/results/failures.json")
    border, edges, light = found["border"], found["shadow edges"], found["sudden light"]
    rows = []
    for name in light:
        cells = [f"{border[step][name]:.2f}" for step in border]
        cells += [f"{edges['psnr'][name]:.2f}", f"{edges['sharpness'][name]:.2f}"]
        cells += [f"{light[name][key]:.2f}" for key in ("kept", "steady", "flash")]
        rows.append([name, *cells])
    steps = [f"step {float(step):g} ({100 * border[step]['share']:.1f} %)" for step in border]
    steps[0] = f"border, {steps[0]}"
    return table(["", *steps, "moved shadow", "its sharpness", "flash kept", "dB", "with flash"], rows)


def curve() -> str:
    """The validation gain of ExtraNet's three rounds of training, over its first guess."""
    lines = [line for line in read("experiments/results/guided_net_training.jsonl") if line["kind"] == "validation"]
    steps = (1000, 2000, 3000, 4000, 6000, 8000, 10000, 12000, 14000)
    rows = []
    for number in sorted({line["round"] for line in lines}):
        found = {line["step"]: line for line in lines if line["round"] == number}
        gains = {
            "whole": {step: line["gain"] for step, line in found.items()},
            "holes": {step: line["psnr_hole"] - line["guess_hole"] for step, line in found.items()},
        }
        for part, by_step in gains.items():
            rows.append([f"{number}: {part}", *(f"{by_step[s]:.2f}" if s in by_step else "" for s in steps)])
    return table(["step", *map(str, steps)], rows)


def extranet_curve() -> str:
    """The validation gain of the paper's network over its first guess, the plain warp, in both runs."""
    lines = [line for line in read("experiments/results/extranet_training.jsonl") if line["kind"] == "validation"]
    steps, rows = (1000, 3000, 5000, 7000, 9000, 11000, 13000, 15000, 17000, 19000, 20000, 21000, 22000), []
    for number in (1, 2):
        found = {line["step"]: line for line in lines if line["round"] == number}
        gains = {step: (line["gain"], line["psnr_hole"] - line["guess_hole"]) for step, line in found.items()}
        for k, part in enumerate(("whole", "holes")):
            cells = (f"{gains[step][k]:.2f}" if step in gains else "" for step in steps)
            rows.append([f"{number}: {part}", *cells])
    return table(["step", *map(str, steps)], rows)


def noted(name: str) -> str:
    """Rows that were noted as they were seen."""
    found = read(f"experiments/results/{name}.json")
    return table(found["columns"], found["rows"])


_BY_SIZE = {name: name for name in ("warp", "occlusion_warp", "guided_warp", "warp_3d", "grid_extrapolate")} | {
    "guided_net": "**guided_net**",
    "interpolator": "interpolator (both sides)",
    "bidirectional": "bidirectional (both sides)",
}


def sizes() -> str:
    """Error and time of methods by resolution."""
    found = read("experiments/results/resolutions.json")
    errors, times = found["errors"], found["times"]
    rows = []
    for name, title in _BY_SIZE.items():
        decibels = [f"{errors[size][name]['psnr']:.2f}" for size in errors]
        rows.append([title, *decibels, *(milliseconds(times[size]["whole"][name]) for size in errors)])
    head = [f"{size}{unit if i == 0 else ''}" for unit in (" dB", " ms") for i, size in enumerate(errors)]
    return table(["", *head], rows)


_STAGES = {
    "reproject three histories": ("reproject",),
    "occlusion motion": ("occlusion motion",),
    "hole masks": ("holes",),
    "demodulate": ("demodulate",),
    "warp": ("warp",),
    "guided warp": ("guided warp",),
    "the network's inputs": ("inputs",),
    "network": ("network",),
    "modulate, sky": ("modulate", "warped sky"),
}


_ALONE = {"*networks alone:* the paper's, light gates": "light gates", "full gates": "full gates"}
_ALONE |= {"full gates, no histories (GC)": "full gates, no histories (GC)"}


def stage_times() -> str:
    """Milliseconds of guided_net's stages, and of its networks alone, by resolution."""
    times = read("experiments/results/resolutions.json")["times"]
    rows = [
        [title, *(milliseconds(sum(found["guided_net's stages"][name] for name in names)) for found in times.values())]
        for title, names in _STAGES.items()
    ]
    rows += [
        [title, *(milliseconds(found["networks"][name]) for found in times.values())] for title, name in _ALONE.items()
    ]
    return table(["guided_net by stage, ms", *times], rows)


def shading_times() -> str:
    """Milliseconds of shading_warp's stages by resolution, the guided warp's beside them."""
    times = read("experiments/results/shading_times.json")["times"]
    stages = {stage: None for found in times.values() for stage in found["shading_warp's stages"]}
    rows = [
        [stage, *(milliseconds(found["shading_warp's stages"].get(stage, 0)) for found in times.values())]
        for stage in stages
    ]
    rows += [
        [f"*{name}, whole*", *(milliseconds(found["whole"][name]) for found in times.values())]
        for name in ("guided_warp", "shading_warp")
    ]
    return table(["shading_warp by stage, ms", *times], rows)


def _extreme(part: str) -> str:
    """Rows of extreme inputs: how many, in how many all is finite; how far one pixel that is not a number reaches."""
    measured = read("experiments/results/extreme.json")

    def far(pixels: int, name: str) -> str:
        if name.split("-")[0] in measured["means"]:
            return "the mean"
        return "none" if pixels < 0 else f"{pixels}"

    rows = []
    for name, found in measured[part].items():
        good = sum(not what for what in found["rows"].values())
        value, gradient = (far(pixels, name) for pixels in found["reach"])
        rows.append([f"`{name}`", f"{len(found['rows'])}", f"{good}", value, gradient])
    return table(["", "rows", "all finite", "reach in the value, px", "in the gradient"], rows)


def extreme_listed() -> str:
    """What is documented not to be finite."""
    measured = read("experiments/results/extreme.json")
    by_reason: dict[str, dict[str, list[str]]] = {}
    for name, row, reason in measured["listed"]:
        by_reason.setdefault(reason, {}).setdefault(name, []).append(row)
    rows = []
    for reason, found in by_reason.items():
        names: dict[tuple[str, ...], list[str]] = {}
        for name, listed in found.items():
            names.setdefault(tuple(listed), []).append(f"`{name}`")
        rows += [[reason, ", ".join(cases), ", ".join(listed)] for listed, cases in names.items()]
    return table(["what is said", "of", "in the rows"], rows)


def extreme_errors() -> str:
    """Errors of half precision by method."""
    measured = read("experiments/results/extreme.json")["errors"]

    def cell(found: dict[str, float]) -> str:
        return " / ".join(f"{1000 * found[key]:.3g}" for key in ("mean", "most", "largest"))

    rows = [[f"`{name}`", *map(cell, by_kind.values())] for name, by_kind in measured.items()]
    return table(["1000 times the difference", *next(iter(measured.values()))], rows)


def masks() -> str:
    """Precision and recall of the hole masks, before and after holes were found by planes and by depth alone."""
    before, after = (read(f"experiments/results/hole_masks{k}.json") for k in ("_before", ""))

    def cell(row: dict[str, Sequence[float]], name: str) -> str:
        return " / ".join(f"{v:.3f}" for v in row[name])

    rows = []
    for name in after["mean"]:
        for title, results in ((name, after), ("*before*", before)):
            rows.append([title, *(cell(row, name) for row in (*results["scenes"].values(), results["mean"]))])
    return table(["precision / recall", *after["scenes"], "mean"], rows)


TABLES: dict[str, Callable[[], str]] = scores.TABLES | {
    "extreme-functions": partial(_extreme, "functions"),
    "extreme-methods": partial(_extreme, "methods"),
    "extreme-listed": extreme_listed,
    "extreme-errors": extreme_errors,
    "search": search,
    "stiff": stiff,
    "quality": quality,
    "guided": guided,
    "operations": operations,
    "flows": flows,
    "networks": networks,
    "scenes": scenes,
    "reach": reach,
    "spaces": spaces,
    "ablations": ablations,
    "failures": failures,
    "curve": curve,
    "extranet-curve": extranet_curve,
    "rounds": partial(noted, "rounds"),
    "recipes": partial(noted, "recipes"),
    "frnet": partial(noted, "frnet"),
    "sizes": sizes,
    "stage-times": stage_times,
    "shading-times": shading_times,
    "masks": masks,
}


def written(text: str) -> str:
    """A page with its tables as they should be."""
    return BLOCK.sub(lambda match: match[1] + TABLES[match["name"]]() + match[3], text)


def main() -> int:
    """Rewrites the pages, or says where they differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; exit status 1 where a page differs")
    options = parser.parse_args()
    differ = False
    for name in PAGES:
        page = ROOT / name
        old = page.read_text()
        new = written(old)
        if new != old and options.check:
            differ = True
            sys.stdout.writelines(difflib.unified_diff(old.splitlines(True), new.splitlines(True), name, name, n=0))
        elif new != old:
            page.write_text(new)
            print(f"{name}: rewritten")
    return int(differ)


if __name__ == "__main__":
    sys.exit(main())
