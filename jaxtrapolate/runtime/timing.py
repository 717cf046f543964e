"""Run times: medians with their spread, compilation apart, and the machine that they were taken on."""

import os
import platform
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxtrapolate.runtime.memory import memory_kept

_SETTINGS = ("XLA_", "JAX_", "OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "MALLOC_", "GLIBC_TUNABLES", "LD_PRELOAD")
_CACHES = ("JAX_COMPILATION_CACHE_", "JAX_PERSISTENT_CACHE_")  # change no time but that of compilation, which says so
_FOLDERS = re.compile(r"[^\s=:]*/")


@dataclass(frozen=True)
class Timing:
    """Milliseconds of one call.

    Attributes:
        median, iqr: of the runs; iqr is the distance between the quartiles.
        compile: what the first call needs beyond a usual one, which for a jitted function is its compilation.
        runs: every run, in order.
    """

    median: float
    iqr: float
    compile: float
    runs: tuple[float, ...]

    def summary(self) -> dict[str, float | int]:
        """Median, iqr, compile and the number of runs, for JSON."""
        return {"median": self.median, "iqr": self.iqr, "compile": self.compile, "runs": len(self.runs)}


def ratio(ours: Timing, peer: Timing) -> float:
    """Time of ours over time of the peer: the median over the rounds of `measure_pairs`, less is better."""
    if len(ours.runs) != len(peer.runs):
        raise ValueError(f"peer: expected {len(ours.runs)} runs, as many as ours, got {len(peer.runs)}")
    return float(np.median(np.array(ours.runs) / np.array(peer.runs)))


def _run(call: Callable[[], Any], calls: int) -> float:
    start = time.perf_counter()
    result = None
    for _ in range(calls):
        result = call()
    jax.block_until_ready(result)  # one device works in the order of the calls
    return (time.perf_counter() - start) * 1e3 / calls


def compiled(function: Any, *arguments: Any) -> tuple[Callable[[], Any], float]:
    """function(*arguments) as a call without arguments, compiled, and the milliseconds that compiling took.

    `function` is a jitted one whose arguments are all arrays, or trees of them.
    """
    start = time.perf_counter()
    program = function.lower(*arguments).compile()
    return partial(program, *arguments), (time.perf_counter() - start) * 1e3


def _prepare(call: Callable[[], Any]) -> tuple[Callable[[], Any], float | None]:
    if isinstance(call, partial) and hasattr(call.func, "lower") and not call.keywords:
        return compiled(call.func, *call.args)
    return call, None


def measure_pairs(
    functions: Mapping[str, Callable[[], Any]], *, repeats: int = 15, warmup: int = 2, calls: int = 1
) -> dict[str, Timing]:
    """Times several functions in turn (A B C A B C ...), so that their ratios hold when the machine drifts.

    Args:
        functions: of no arguments. A `functools.partial` of a jitted function is lowered and compiled, which is timed
            apart; all its arguments must then be arrays (or trees of them).
        repeats: rounds that count.
        warmup: rounds before them that do not.
        calls: calls in a row that make one run, before their results are waited for. More than one hides what it costs
            to start a call on an asynchronous device.

    Returns:
        A `Timing` for each name.

    Raises:
        ValueError: repeats or calls below 1, or warmup below 0.
    """
    if repeats < 1 or calls < 1 or warmup < 0:
        raise ValueError(f"expected repeats >= 1, calls >= 1, warmup >= 0, got {repeats}, {calls}, {warmup}")
    prepared, compiling, first = {}, {}, {}
    for name, function in functions.items():
        prepared[name], compiling[name] = _prepare(function)
        first[name] = _run(prepared[name], 1)
    runs: dict[str, list[float]] = {name: [] for name in functions}
    for index in range(warmup + repeats):
        for name, call in prepared.items():
            elapsed = _run(call, calls)
            if index >= warmup:
                runs[name].append(elapsed)
    timings = {}
    for name, values in runs.items():
        low, median, high = (float(q) for q in np.percentile(values, (25, 50, 75)))
        spent = compiling[name]
        spent = max(0.0, first[name] - median) if spent is None else spent
        timings[name] = Timing(median, high - low, spent, tuple(values))
    return timings


def measure(
    function: Callable[..., Any], *arguments: Any, repeats: int = 15, warmup: int = 2, calls: int = 1
) -> Timing:
    """Times function(*arguments); options as of `measure_pairs`.

    A jitted function is compiled apart; of any other the first call is taken for that, less a usual one.
    """
    call = partial(function, *arguments)
    return measure_pairs({"": call}, repeats=repeats, warmup=warmup, calls=calls)[""]


def _field(path: str, key: str) -> str | None:
    """The value of the first line `key : value` in a file of /proc, if there is one."""
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() == key:
            return value.strip()
    return None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _driver() -> str | None:
    """The version of the NVIDIA driver, where its tool is installed."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return None
    query = [tool, "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, timeout=20, check=True).stdout.split()
    except (OSError, subprocess.SubprocessError):
        return None
    return answer[0] if answer else None


def _counts(variable: str) -> bool:
    """Whether a variable of the environment changes run times."""
    return variable.startswith(_SETTINGS) and not variable.startswith(_CACHES)


def machine() -> dict[str, Any]:
    """What a figure depends on: processor, memory, system, versions, devices, thread and allocator settings.

    Entries are None where the system does not tell. No names of hosts, users or folders.
    """
    memory = _field("/proc/meminfo", "MemTotal")
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count()
    device = jax.devices()[0]
    on_gpu = device.platform != "cpu"
    return {
        "cpu": _field("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "cores_used": cores,
        "memory_gib": None if memory is None else round(int(memory.split()[0]) / 2**20, 1),
        "os": f"{platform.system()} {platform.release()}",
        "libc": " ".join(platform.libc_ver()).strip() or None,
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in ("jax", "jaxlib", "numpy", "jaxtrapolate")},
        "backend": device.platform,
        "backend_version": device.client.platform_version.splitlines()[0] if on_gpu else None,
        "gpu": device.device_kind if on_gpu else None,
        "gpu_driver": _driver() if on_gpu else None,
        "memory_kept": memory_kept(),
        "settings": {k: _FOLDERS.sub("", v) for k, v in sorted(os.environ.items()) if _counts(k)},
    }
