"""The operations of jaxtrapolate against cv2, numba, scipy and torch, and XLA on a GPU against XLA on the CPU.

    python benchmarks/operations.py --sizes 360p,720p,1080p --threads 1 --output results.json

Every peer's answer is compared with ours before it is timed. All that belongs to one operation and size is timed in
turn (A B C A B C ...); a ratio is the median over the rounds of our time over the peer's, less is better. Compilation
is apart.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import peers
from inputs import Inputs, make_inputs, size_of
from peers import Peer, numba_loop
from rich.console import Console
from rich.progress import Progress

import jaxtrapolate as jt
from jaxtrapolate.runtime.timing import Timing, compiled, machine, measure, measure_pairs, ratio

_ONE_THREAD = ("--xla_cpu_multi_thread_eigen=false", "intra_op_parallelism_threads=1")
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Operation:
    """A public function, the names of its arguments in `Inputs`, and its peers.

    Attributes:
        others: further forms of ours that are timed in the same rounds, by name; their answers are not compared.
        gpu_share: of values that may differ by more than `gpu_tolerance` between GPU and CPU.
    """

    name: str
    function: Callable[..., Any]
    reads: tuple[str, ...]
    peers: tuple[Peer, ...] = ()
    others: tuple[tuple[str, Callable[..., Any]], ...] = ()
    gpu_tolerance: float = 1e-4
    gpu_share: float = 1e-3


_CV2_BITS = "cv2 rounds positions to 1/32 pixel"
_STRIDES = (1, 3, 5, 9)
_TIES = 1e-3  # of the pixels, where rounding decides between two


def _guided(sigma_guide: float, sigma_space: float, guides: str) -> Operation:
    how: dict[str, Any] = {"strides": _STRIDES, "sigma_guide": sigma_guide, "sigma_space": sigma_space, "keep": 4}
    loop = numba_loop(peers.guided_warp, sigma_guide, sigma_space, peers.guided_taps(_STRIDES))
    packed = guides == "packed"
    peer = Peer("numba", "numba", loop, tolerance=1e-3, share=0.3 if packed else 2e-3, note="early reject, float32")
    others = (("float32", partial(jt.guided_warp, **how, guides="float32")),) if packed else ()
    return Operation(
        f"guided_warp {guides}, sigma {sigma_guide:g} and {sigma_space:g} px",
        partial(jt.guided_warp, **how, guides=guides),
        ("image", "motion", "target_guide", "source_guide"),
        (peer,),
        others,
        gpu_tolerance=1e-3,
        gpu_share=2e-3,
    )


def _search(filter: Any) -> Operation:
    """Three steps in one direction, half way (Yang et al. 2011, section 5.1): the places and their errors."""

    def function(flow):
        found = jt.iterative_search(flow, _HALF, filter=filter, iterations=3)
        return found.position, found.error

    loop = numba_loop(peers.search_nearest if filter == "nearest" else peers.search_bilinear, np.float32(_HALF), 3)
    peer = Peer("numba", "numba", loop, tolerance=1e-3, share=_TIES if filter == "nearest" else 1e-4)
    return Operation(f"iterative_search {filter}", function, ("motion",), (peer,))


def _between(image, motion, depth, *, assisted: bool):
    """A whole frame half way between two whose flows are opposite; assisted: by its own flows to both."""
    forward, backward = (jnp.concatenate([s * motion, jnp.zeros_like(depth)], -1) for s in (1, -1))
    previous, following = (jt.Keyframe(image, depth, forward_flow=forward, backward_flow=backward) for _ in range(2))
    target = jt.Keyframe(depth=depth, forward_flow=_HALF * forward, backward_flow=_HALF * backward)
    return jt.interpolate_bidirectional(previous, following, _HALF, target=target if assisted else None).color


_HALF = 0.5
_IMAGE_MOTION = ("image", "motion")
OPERATIONS = (
    Operation(
        "backward_warp bilinear",
        partial(jt.backward_warp, filter="bilinear"),
        _IMAGE_MOTION,
        (
            Peer("cv2", "cv2", peers.cv2_warp("INTER_LINEAR"), 0.03, 1e-3, note=_CV2_BITS),
            Peer("cv2, map given", "cv2", peers.cv2_warp("INTER_LINEAR", map_given=True), 0.03, 1e-3, note=_CV2_BITS),
            Peer("numba", "numba", numba_loop(peers.warp_bilinear)),
            Peer("map_coordinates", "scipy", peers.scipy_warp(1)),
            Peer("grid_sample", "torch", peers.torch_warp("bilinear"), 1e-3),
        ),
    ),
    Operation(
        "backward_warp nearest",
        partial(jt.backward_warp, filter="nearest"),
        _IMAGE_MOTION,
        (
            Peer("cv2", "cv2", peers.cv2_warp("INTER_NEAREST"), share=0.05, note=_CV2_BITS),
            Peer("cv2, map given", "cv2", peers.cv2_warp("INTER_NEAREST", map_given=True), share=0.05, note=_CV2_BITS),
            Peer("numba", "numba", numba_loop(peers.warp_nearest), share=_TIES),
            Peer("map_coordinates", "scipy", peers.scipy_warp(0), share=1e-3),
            Peer("grid_sample", "torch", peers.torch_warp("nearest"), share=1e-3),
        ),
    ),
    Operation(
        "backward_warp bicubic",
        partial(jt.backward_warp, filter="bicubic"),
        _IMAGE_MOTION,
        (
            Peer("numba", "numba", numba_loop(peers.warp_bicubic)),
            Peer("cv2", "cv2", peers.cv2_warp("INTER_CUBIC"), same=False, note="another kernel (a = -3/4)"),
            Peer("grid_sample", "torch", peers.torch_warp("bicubic"), same=False, note="another kernel (a = -3/4)"),
        ),
    ),
    Operation(
        "chain_motion",
        jt.chain_motion,
        ("motion", "older"),
        (
            Peer("cv2", "cv2", peers.cv2_chain, 2.0, 1e-3, note=_CV2_BITS),
            Peer("numba", "numba", numba_loop(peers.chain), 1e-3),
            Peer("map_coordinates", "scipy", peers.scipy_chain, 1e-3),
        ),
        gpu_tolerance=1e-3,
    ),
    Operation(
        "splat_nearest",
        jt.splat_nearest,
        ("image", "motion", "depth"),
        (Peer("numba", "numba", numba_loop(peers.splat_nearest, parallel=False), share=_TIES, note="sequential"),),
    ),
    Operation(
        "splat softmax",
        lambda values, motion, weights: jt.splat(values, motion, weights=weights, mode="softmax"),
        ("image", "motion", "importance"),
        (
            Peer(
                "numba", "numba", numba_loop(peers.splat_softmax, True, parallel=False), 1e-3, 1e-4, note="sequential"
            ),
            Peer(
                "numba, unguarded",
                "numba",
                numba_loop(peers.splat_softmax, False, parallel=False),
                1e-3,
                1e-4,
                note="sequential; exp(z) as it is, which may over- and underflow",
            ),
        ),
    ),
    Operation(
        "occlusion_motion",
        jt.occlusion_motion,
        ("motion", "depth"),
        (Peer("numba", "numba", numba_loop(peers.occlusion_motion, parallel=False), share=_TIES, note="sequential"),),
    ),
    _search("nearest"),
    _search("bilinear"),
    *(
        Operation(
            f"interpolate_bidirectional {'scene-assisted' if assisted else 'image-based'}",
            partial(_between, assisted=assisted),
            ("image", "motion", "depth"),
            gpu_tolerance=1e-3,
            gpu_share=2e-3,
        )
        for assisted in (False, True)
    ),
    Operation(
        "farneback_flow",
        jt.farneback_flow,
        ("gray", "moved_gray"),
        (Peer("cv2", "cv2", peers.cv2_farneback, 0.1, 0.02, note="of 8 bits"),),
        gpu_tolerance=0.1,
    ),
    *(
        Operation(
            f"dis_flow {preset}",
            partial(jt.dis_flow, preset=preset),
            ("gray", "moved_gray"),
            (Peer("cv2", "cv2", peers.cv2_dis(preset), same=False, note="of 8 bits; other steps of the search"),),
            gpu_tolerance=0.1,
            gpu_share=0.02,
        )
        for preset in ("ultrafast", "fast", "medium")
    ),
    Operation(
        "shading_flow",
        lambda newer, older, guide: jt.shading_flow(newer, older, guide=guide),
        ("gray", "moved_gray", "normal"),
        gpu_tolerance=0.1,
        gpu_share=0.02,
    ),
    _guided(0.05, 1.0, "float32"),
    _guided(0.05, 1.0, "packed"),
    _guided(0.005, 10.0, "float32"),
    _guided(0.005, 10.0, "packed"),
)


def difference(ours: Any, theirs: Any, tolerance: float) -> dict[str, float]:
    """The largest absolute difference of two answers, and the share of pixels beyond the tolerance."""
    largest, beyond, count = 0.0, 0, 0
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        if a.shape != b.shape:
            raise ValueError(f"answers of different shapes: {a.shape} and {b.shape}")
        apart = np.abs(a - b)
        apart = apart.max(-1) if apart.ndim == 3 else apart
        apart = np.where(np.isnan(apart), np.inf, apart)
        largest = max(largest, float(apart.max()))
        beyond, count = beyond + int((apart > tolerance).sum()), count + apart.size
    return {"max": largest, "share": beyond / count}


def copy_bandwidth(device: jax.Device, *, megabytes: int = 256) -> float:
    """GB/s, read and written, of a large copy: on a CPU numpy.copyto between two buffers, else XLA's negation."""
    size = megabytes << 18
    if device.platform == "cpu":
        source, target = np.ones(size, np.float32), np.zeros(size, np.float32)
        timing = measure(np.copyto, target, source, repeats=7)
    else:
        ones = jax.device_put(np.ones(size, np.float32), device)
        timing = measure(jax.jit(jnp.negative), ones, repeats=7, calls=10)
    return 2 * size * 4 / timing.median / 1e6


def _speed(timing: Timing, moved: int, bandwidth: float) -> dict[str, float]:
    """Achieved GB/s, and the milliseconds that a plain copy of as many bytes would take."""
    return {"gb_per_s": moved / timing.median / 1e6, "floor_ms": moved / bandwidth / 1e6}


def run_peers(operation: Operation, given: tuple, answer: Any, *, found: dict, parallel: bool) -> tuple[dict, dict]:
    """The peers that are installed: their calls, and how far their answers are from ours."""
    calls, entries = {}, {}
    for peer in operation.peers:
        if not found[peer.needs]:
            continue
        call = peer.make(parallel, *given)
        start = time.perf_counter()
        theirs = call()  # compiles a loop of numba
        first = (time.perf_counter() - start) * 1e3
        entry: dict[str, Any] = {"note": peer.note, "first_call": first, "compared": peer.same}
        if peer.same:
            entry["difference"] = difference(answer, theirs, peer.tolerance) | {"tolerance": peer.tolerance}
            entry["agrees"] = entry["difference"]["share"] <= peer.share
        entries[peer.name] = entry
        if entry.get("agrees", True):
            calls[peer.name] = call
    return calls, entries


def run_operation(
    operation: Operation, inputs: Inputs, *, found: dict, parallel: bool, repeats: int, bandwidth: dict[str, float]
) -> dict[str, Any]:
    """One operation at one size: ours and every peer, and the GPU where there is one."""
    given = tuple(getattr(inputs, name) for name in operation.reads)
    cpu = jax.devices("cpu")[0]
    arguments = tuple(jax.device_put(a, cpu) for a in given)
    function = jax.jit(operation.function)
    call, compile_ms = compiled(function, *arguments)
    answer = jax.block_until_ready(call())
    calls, entries = run_peers(operation, given, answer, found=found, parallel=parallel)
    ours: dict[str, Callable[[], Any]] = {"ours": call}
    ours |= {f"ours, {name}": partial(jax.jit(other), *arguments) for name, other in operation.others}
    timings = measure_pairs(ours | calls, repeats=repeats)
    for name in [*ours, *calls]:
        if name != "ours":
            entry = entries.setdefault(name, {"note": "", "compared": False})
            entry |= timings[name].summary() | {"ratio": ratio(timings["ours"], timings[name])}
            if name in calls:
                entry["compile"] = max(0.0, entry.pop("first_call") - entry["median"])
    moved = sum(a.nbytes for a in jax.tree.leaves((arguments, answer)))
    result = {
        "operation": operation.name,
        "height": inputs.image.shape[0],
        "width": inputs.image.shape[1],
        "bytes": moved,
        "ms": timings["ours"].summary() | {"compile": compile_ms},
        **_speed(timings["ours"], moved, bandwidth["cpu"]),
        "peers": entries,
    }
    device = jax.devices()[0]
    if device.platform != "cpu":
        there = tuple(jax.device_put(a, device) for a in given)
        call, compile_ms = compiled(function, *there)
        apart = difference(answer, call(), operation.gpu_tolerance)
        timing = measure(call, repeats=repeats, calls=20)
        result["gpu"] = {
            "ms": timing.summary() | {"compile": compile_ms},
            **_speed(timing, moved, bandwidth["gpu"]),
            "ratio_to_cpu": timing.median / timings["ours"].median,
            "difference": apart | {"tolerance": operation.gpu_tolerance},
            "agrees": apart["share"] <= operation.gpu_share,
        }
    return result


def _cell(entry: dict | None) -> str:
    if entry is None:
        return ""
    if "median" not in entry:
        return "differs"
    return f"{entry['ratio']:.2f} ({entry['median']:.2f}{'' if entry['compared'] else '*'})"


def table(results: dict[str, Any]) -> str:
    """The results in Markdown: ratios of our time to each peer's, with the peer's milliseconds."""
    rows = results["operations"]
    names = list(dict.fromkeys(name for row in rows for name in row["peers"]))
    head = ["operation", "size", "ms (IQR)", "compile, ms", "GB/s", "of copy", *names]
    gpu = any("gpu" in row for row in rows)
    head += ["GPU, ms (IQR)", "GPU / CPU", "GPU GB/s", "GPU of copy", "GPU differs"] if gpu else []
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        ms = row["ms"]
        cells = [row["operation"], row["size"], f"{ms['median']:.2f} ({ms['iqr']:.2f})", f"{ms['compile']:.0f}"]
        cells += [f"{row['gb_per_s']:.2f}", f"{row['floor_ms'] / ms['median']:.0%}"]
        cells += [_cell(row["peers"].get(name)) for name in names]
        if "gpu" in row:
            on, apart = row["gpu"], row["gpu"]["difference"]
            cells += [f"{on['ms']['median']:.4f} ({on['ms']['iqr']:.4f})", f"{on['ratio_to_cpu']:.2g}"]
            cells += [f"{on['gb_per_s']:.0f}", f"{on['floor_ms'] / on['ms']['median']:.0%}"]
            cells += [f"{apart['share']:.2%} (max {apart['max']:.2g})"]
        lines.append("| " + " | ".join(cells) + " |")
    missing = [name for name, found in results["peer_versions"].items() if not found]
    slower = [
        f"{row['operation']} at {row['size']}: {entry['ratio']:.2f} x {name}"
        for row in rows
        for name, entry in row["peers"].items()
        if entry.get("ratio", 0) > 1
    ]
    bandwidth = ", ".join(f"{name} {rate:.1f} GB/s" for name, rate in results["copy_gb_per_s"].items())
    lines += [
        "",
        "Columns of peers: our time / the peer's, less is better (the peer's ms; * its answer is not compared).",
        f"Copy bandwidth: {bandwidth}. Left out, not installed: {', '.join(missing) or 'none'}.",
        f"Slower than a peer: {'; '.join(slower) or 'nowhere'}.",
    ]
    return "\n".join(lines)


def confine(threads: str, allocator: str) -> None:
    """Starts this program anew on one core, which only counts from the start on; "keep" keeps freed memory."""
    environment = dict(os.environ)
    if threads == "1":
        words = environment.get("XLA_FLAGS", "").split()
        environment["XLA_FLAGS"] = " ".join([*words, *(flag for flag in _ONE_THREAD if flag not in words)])
        environment |= dict.fromkeys(_THREAD_VARIABLES, "1")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    pin = threads == "1" and len(cores) > 1
    if pin:
        os.sched_setaffinity(0, cores[-1:])
    if pin or environment != dict(os.environ):
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)
    if allocator == "keep" and not jt.keep_memory():
        sys.exit("--allocator keep: not on this system, or with allocator settings in the environment")


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="360p,720p,1080p", help="names or WIDTHxHEIGHT, comma-separated")
    parser.add_argument("--only", default="", help="only operations whose name contains one of these, comma-separated")
    parser.add_argument("--threads", choices=("1", "all"), default="1", help="1: one core and one thread for everyone")
    help = "keep: freed memory is kept, for everyone (jaxtrapolate.keep_memory)"
    parser.add_argument("--allocator", choices=("default", "keep"), default="default", help=help)
    parser.add_argument("--repeats", type=int, default=15, help="rounds that count")
    parser.add_argument("--seed", type=int, default=0, help="of the inputs")
    parser.add_argument("--output", default="results.json", help="JSON file")
    options = parser.parse_args(argv)
    try:
        options.sizes = {name: size_of(name) for name in options.sizes.split(",")}
    except ValueError as error:
        parser.error(str(error))
    if options.repeats < 1:
        parser.error(f"--repeats: expected 1 or more, got {options.repeats}")
    words = [word.strip() for word in options.only.split(",")]
    options.operations = [o for o in OPERATIONS if any(word in o.name for word in words)]
    if not options.operations:
        parser.error(f"--only: no operation of that name; there are {'; '.join(o.name for o in OPERATIONS)}")
    return options


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark; 0 where every answer agrees, else 1."""
    options = parse(argv)
    confine(options.threads, options.allocator)
    parallel = options.threads == "all"
    found = peers.installed()
    about = machine()
    peers.set_threads(about["cores_used"] if parallel else 1)
    bandwidth = {"cpu": copy_bandwidth(jax.devices("cpu")[0])}
    if jax.devices()[0].platform != "cpu":
        bandwidth["gpu"] = copy_bandwidth(jax.devices()[0])
    results: dict[str, Any] = {
        "machine": about,
        "settings": {
            "threads": options.threads,
            "allocator": options.allocator,
            "repeats": options.repeats,
            "seed": options.seed,
            "dtype": "float32",
            "numba": "no fastmath; loops that scatter are sequential",
        },
        "peer_versions": found,
        "copy_gb_per_s": bandwidth,
        "operations": [],
    }
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=len(options.sizes) * len(options.operations))
        for size, (height, width) in options.sizes.items():
            inputs = make_inputs(height, width, seed=options.seed)
            for operation in options.operations:
                progress.update(task, description=f"{operation.name}, {size}")
                how = {"found": found, "parallel": parallel, "repeats": options.repeats, "bandwidth": bandwidth}
                result = run_operation(operation, inputs, **how)
                results["operations"].append({"size": size, **result})
                jax.clear_caches()
                progress.advance(task)
    temporary = f"{options.output}.part"
    with open(temporary, "w", encoding="utf-8") as file:
        json.dump(results, file, indent=1)
        file.write("\n")
    os.replace(temporary, options.output)
    print(table(results))
    differing = [
        f"{row['operation']} at {row['size']}: {name} answers otherwise, {entry['difference']}"
        for row in results["operations"]
        for name, entry in [*row["peers"].items(), *([("the GPU", row["gpu"])] if "gpu" in row else [])]
        if not entry.get("agrees", True)
    ]
    print("\n".join(differing), file=sys.stderr, end="\n" if differing else "")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
