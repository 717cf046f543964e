"""Writes the tables of the pages from what was measured: no figure is typed by hand.

python docs/tables.py           # rewrites what stands between `<!-- table: NAME -->` and `<!-- end -->`
python docs/tables.py --check   # exit status 1 where a page differs
"""

import argparse
import difflib
import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

ROOT = Path(__file__).parents[1]
PAGES = ("docs/results.md", "docs/speed.md", "docs/scenes.md", "experiments/README.md")
BLOCK = re.compile(r"(<!-- table: (?P<name>[\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def read(path: str) -> Any:
    """A JSON file of the repository."""
    return json.loads((ROOT / path).read_text())


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    rows = list(rows)
    if any(len(row) != len(head) for row in rows):
        raise ValueError(f"table: expected {len(head)} columns in every row, got {[len(row) for row in rows]}")
    first, *others = ("|" + "|".join(f" {cell} " if cell else " " for cell in row) + "|\n" for row in (head, *rows))
    return "".join([first, "|" + "---|" * len(head) + "\n", *others])


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
    """How hard the embedded scenes are, means over the test seeds."""
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


TABLES: dict[str, Callable[[], str]] = {
    "search": search,
    "stiff": stiff,
    "quality": quality,
    "guided": guided,
    "operations": operations,
    "networks": networks,
    "scenes": scenes,
    "reach": reach,
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
