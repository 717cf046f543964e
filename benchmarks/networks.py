"""The networks of jaxtrapolate, one frame at a time, against PyTorch and OpenVINO with the same weights.

    python benchmarks/networks.py --sizes 720p --threads 1 --output networks.json

The weights are random; batch norms are folded for everyone. Each peer's answer is compared with ours before it is
timed. All that belongs to one network and size is timed in turn; a ratio is the median over the rounds of our time over
the peer's, less is better. Compilation is apart. On a GPU ours is timed in each precision, peers are not.
"""

import argparse
import importlib
import json
import os
import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from inputs import size_of
from operations import confine, difference
from rich.console import Console
from rich.table import Table

from jaxtrapolate.networks.extranet import GATED_CONVOLUTION, ExtraNet, ExtraNetConfig
from jaxtrapolate.networks.inference import fold, inference
from jaxtrapolate.networks.interpolator import Interpolator, InterpolatorConfig
from jaxtrapolate.runtime.timing import Timing, compiled, machine, measure_pairs, ratio

EXTRANETS = {
    "extranet": ExtraNetConfig(),
    "extranet, full gates": ExtraNetConfig(gate="full"),
    "gated convolution": GATED_CONVOLUTION,
}
NETWORKS = (*EXTRANETS, "interpolator")
TOLERANCE = 1e-3
PRECISIONS = {"float32": jnp.float32, "bfloat16": jnp.bfloat16, "float16": jnp.float16}


def frames(height: int, width: int, config: ExtraNetConfig, seed: int = 0) -> tuple[np.ndarray | None, ...]:
    """x, mask, features and history of one frame: noise, and a mask with a tenth of holes."""
    random = np.random.default_rng(seed)
    x = random.uniform(0, 2, (height, width, 3 * config.warps)).astype(np.float32)
    mask = (random.uniform(size=(height, width, 1)) > 0.1).astype(np.float32)
    features = random.normal(size=(height, width, config.features)).astype(np.float32)
    history = random.uniform(0, 2, (config.histories, height, width, 4)).astype(np.float32)
    return x, mask, features, history if config.histories else None


def torch_extranet(model: ExtraNet) -> Any:
    """The same network, folded, as a PyTorch module: `module(x, mask, features[, history])`, all NCHW."""
    torch = importlib.import_module("torch")
    functional = torch.nn.functional
    config = model.config

    class Layer(torch.nn.Module):
        def __init__(self, layer: Any) -> None:
            super().__init__()
            self.stride, self.relu = layer.feature.strides, layer.activation == "relu"
            self.padding = layer.feature.kernel.shape[0] // 2
            for name, part in (("feature", layer.feature), ("gate", layer.gate)):
                if part is not None:
                    kernel = np.array(np.transpose(part.kernel[...], (3, 2, 0, 1)))
                    self.register_buffer(f"{name}_kernel", torch.from_numpy(kernel))
                    self.register_buffer(f"{name}_bias", torch.from_numpy(np.array(part.bias[...])))
            self.gated = layer.gate is not None
            self.shifted = layer.offset is not None
            if self.shifted:
                self.register_buffer("offset", torch.from_numpy(np.array(layer.offset[...]))[None, :, None, None])

        def forward(self, x: Any) -> Any:
            how = {"stride": self.stride, "padding": self.padding}
            y = functional.conv2d(x, self.feature_kernel, self.feature_bias, **how)
            if self.gated:
                y = y * torch.sigmoid(functional.conv2d(x, self.gate_kernel, self.gate_bias, **how))
            if self.shifted:
                y = y + self.offset
            return functional.relu(y) if self.relu else y

    def row(layers: Any) -> Any:
        return torch.nn.Sequential(*(Layer(layer) for layer in layers))

    class Network(torch.nn.Module):
        def __init__(self, folded: ExtraNet) -> None:
            super().__init__()
            self.encoder = torch.nn.ModuleList([row(level.layers) for level in folded.encoder])
            self.decoder = torch.nn.ModuleList([row(level.layers) for level in folded.decoder])
            self.output = Layer(folded.output)
            if folded.history is not None:
                self.history, self.merge = row(folded.history.layers), Layer(folded.merge)

        def forward(self, x: Any, mask: Any, features: Any, history: Any = None) -> Any:
            value, skips = torch.cat([x, x * mask, features], 1), []
            for level in self.encoder:
                value = level(value)
                skips.append(value)
            value = skips.pop()
            if history is not None:
                codes = self.history(history)
                value = torch.cat([value, self.merge(codes.reshape(1, -1, *codes.shape[2:]))], 1)
            for level in self.decoder:
                value = functional.interpolate(value, scale_factor=2, mode="bilinear", align_corners=True)
                value = level(torch.cat([skips.pop(), value], 1))
            return x[:, :3] + self.output(value)

    if config.direct:
        raise ValueError("config: no peer sees the histories at full resolution")
    return Network(fold(model)).eval()


def torch_calls(model: ExtraNet, given: tuple[np.ndarray | None, ...]) -> dict[str, Callable[[], np.ndarray]]:
    """PyTorch's calls: as it comes, and with channels last; and OpenVINO's, if it is there."""
    torch = importlib.import_module("torch")
    module = torch_extranet(model)

    def laid_out(memory: Any) -> list[Any]:
        tensors = []
        for array in given:
            if array is not None:
                batch = array if array.ndim == 4 else array[None]
                tensors.append(
                    torch.from_numpy(np.ascontiguousarray(batch.transpose(0, 3, 1, 2))).contiguous(memory_format=memory)
                )
        return tensors

    def call(memory: Any) -> Callable[[], np.ndarray]:
        network, tensors = torch_extranet(model).to(memory_format=memory), laid_out(memory)

        @torch.inference_mode()
        def run() -> np.ndarray:
            return network(*tensors)[0].permute(1, 2, 0).numpy()

        return run

    calls = {"torch": call(torch.contiguous_format), "torch, channels last": call(torch.channels_last)}
    if present("openvino"):
        openvino = importlib.import_module("openvino")
        tensors = laid_out(torch.contiguous_format)
        converted = openvino.convert_model(module, example_input=tuple(tensors), input=[t.shape for t in tensors])
        hints = {"INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
        if threads := os.environ.get("OMP_NUM_THREADS"):
            hints["INFERENCE_NUM_THREADS"] = threads
        network = openvino.Core().compile_model(converted, "CPU", hints)
        arrays = [t.numpy() for t in tensors]
        calls["openvino"] = lambda: network(arrays)[0][0].transpose(1, 2, 0)
    return calls


def present(module: str) -> str | None:
    """The version of a module, None where it cannot be imported."""
    try:
        importlib.import_module(module)
    except ImportError:
        return None
    return version(module)


def run_network(name: str, height: int, width: int, repeats: int) -> dict[str, Any]:
    """One network at one size."""
    cpu, device = jax.devices("cpu")[0], jax.devices()[0]
    if name in EXTRANETS:
        model: Any = ExtraNet(EXTRANETS[name], rngs=nnx.Rngs(0))
        given = frames(height, width, EXTRANETS[name])
    else:
        model = Interpolator(InterpolatorConfig(), rngs=nnx.Rngs(0))
        random = np.random.default_rng(0)
        first, second = random.uniform(size=(2, height, width, 3)).astype(np.float32)
        given = (first, second, np.float32(0.5))
    model.eval()
    function, state = inference(model)
    call, compile_ms = compiled(function, *jax.device_put((state, *given), cpu))
    answer = np.asarray(call())
    peers = torch_calls(model, given) if name in EXTRANETS and present("torch") else {}
    apart = {peer: difference(answer, other(), TOLERANCE) for peer, other in peers.items()}
    timings = measure_pairs({"ours": call, **peers}, repeats=repeats, warmup=1)
    rows = {peer: timings[peer].summary() | {"difference": apart[peer]} for peer in peers}
    for peer in peers:
        rows[peer]["ratio"] = ratio(timings["ours"], timings[peer])
    result = {"network": name, "height": height, "width": width, "peers": rows}
    result["gflop"] = _operations(function, (state, *given))
    result["ms"] = timings["ours"].summary() | {"compile": compile_ms}
    if device.platform != "cpu":
        result["gpu"] = _accelerated(model, given, answer, device, repeats)
    return result


def _operations(function: Any, arguments: tuple) -> float:
    """10^9 operations, as XLA counts them before it compiles."""
    return (function.lower(*arguments).cost_analysis() or {}).get("flops", float("nan")) / 1e9


def _accelerated(model: Any, given: tuple, answer: np.ndarray, device: jax.Device, repeats: int) -> dict[str, Any]:
    found = {}
    for name, dtype in PRECISIONS.items():
        function, state = inference(model, dtype=dtype)
        call, compile_ms = compiled(function, *jax.device_put((state, *given), device))
        apart = np.abs(np.asarray(call(), np.float32) - answer)
        timing: Timing = measure_pairs({"": call}, repeats=repeats, calls=20)[""]
        found[name] = timing.summary() | {
            "compile": compile_ms, "largest_difference": float(apart.max()), "rms": float(np.sqrt(np.mean(apart**2)))
        }  # fmt: skip
    return found


def table(results: dict[str, Any]) -> Table:
    """The results for a person."""
    found = Table(title="ms (ratio of our time to the peer's, less is better)")
    peers = list(dict.fromkeys(peer for row in results["networks"] for peer in row["peers"]))
    gpu = [p for p in PRECISIONS if any("gpu" in row for row in results["networks"])]
    for column in ("network", "size", "GFLOP", "ours", *peers, *(f"GPU {precision}" for precision in gpu)):
        found.add_column(column)
    for row in results["networks"]:
        cells = [row["network"], row["size"], f"{row['gflop']:.1f}", f"{row['ms']['median']:.0f}"]
        for peer in peers:
            entry = row["peers"].get(peer)
            cells.append("" if entry is None else f"{entry['median']:.0f} ({entry['ratio']:.2f})")
        cells += [f"{row['gpu'][precision]['median']:.3f}" for precision in gpu]
        found.add_row(*cells)
    return found


def main(argv: list[str] | None = None) -> int:
    """Runs the benchmark; 0 where every answer agrees, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="720p", help="names or WIDTHxHEIGHT, comma-separated")
    parser.add_argument("--only", default="", help="only networks whose name contains one of these, comma-separated")
    parser.add_argument("--threads", choices=("1", "all"), default="1")
    parser.add_argument("--allocator", choices=("default", "keep"), default="default", help="as of operations.py")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--output", default="networks.json")
    options = parser.parse_args(argv)
    words = [word.strip() for word in options.only.split(",")]
    names = [name for name in NETWORKS if any(word in name for word in words)]
    if not names:
        parser.error(f"--only: no network of that name; there are {'; '.join(NETWORKS)}")
    try:
        sizes = {name: size_of(name) for name in options.sizes.split(",")}
    except ValueError as error:
        parser.error(str(error))
    confine(options.threads, options.allocator)
    if options.threads == "1" and present("torch"):
        importlib.import_module("torch").set_num_threads(1)
    results: dict[str, Any] = {
        "machine": machine(),
        "settings": {"threads": options.threads, "allocator": options.allocator, "repeats": options.repeats},
        "peer_versions": {module: present(module) for module in ("torch", "openvino")},
        "networks": [],
    }
    for size, (height, width) in sizes.items():
        for name in names:
            results["networks"].append({"size": size, **run_network(name, height, width, options.repeats)})
            jax.clear_caches()
    with open(f"{options.output}.part", "w", encoding="utf-8") as file:
        json.dump(results, file, indent=1)
        file.write("\n")
    os.replace(f"{options.output}.part", options.output)
    Console(width=140).print(table(results))
    rows = [(row, peer, entry) for row in results["networks"] for peer, entry in row["peers"].items()]
    differing = [f"{row['network']}: {peer} answers otherwise" for row, peer, e in rows if e["difference"]["share"]]
    print("\n".join(differing), file=sys.stderr, end="\n" if differing else "")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
