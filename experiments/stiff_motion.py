"""Where the searches of bidirectional reprojection fail: strong gradients of the flow, and flows of few bits.

    python experiments/stiff_motion.py --output experiments/results/stiff_motion.json

Flows that are linear in the place, alpha grad V = A, so that a pixel's correspondence is known: c + (I + A)^-1 (p - c).
"zoom": A = r I; "shrink": A = -r I; "stretch": r along x alone; "rotation": I-frames turned by up to 180 degrees about
the centre, A = alpha (R - I); "shear": A = r along y of x, whose spectral radius is 0: the control. At alpha 1/4,
1/2 and 3/4 for flows stored as float32, at 1/2 for float16 and bfloat16. After some steps: the error, the distance to
the true correspondence, and the residual, that the search itself reports; over the pixels whose correspondence is
inside the frame, two pixels from its edge. Times are of float32 flows.
"""

import argparse
import itertools
import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

import jaxtrapolate as jx
from jaxtrapolate.atomic import atomic_path
from jaxtrapolate.bidirectional.search import positions
from jaxtrapolate.runtime.timing import machine, measure_pairs

METHODS = {
    "fixed point": {"solver": "fixed_point", "filter": "bilinear"},
    "newton": {"solver": "newton", "filter": "bilinear"},
    "fixed point, nearest": {"solver": "fixed_point", "filter": "nearest"},
}
RADII = (0.25, 0.5, 0.75, 0.9, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
SHRINKS = (0.25, 0.5, 0.75, 0.9, 1.5, 2.0, 3.0, 5.0, 10.0)  # at 1 all points meet in one
ANGLES = (10, 30, 45, 60, 90, 120, 135, 150, 170, 180)
STEPS = (0, 1, 2, 3, 4, 6, 8, 12, 16)
MEASURED = (1, 3, 8, 16)  # steps that are timed
ALPHAS = (0.25, 0.5, 0.75)
DTYPES = {"float32": jnp.float32, "float16": jnp.float16, "bfloat16": jnp.bfloat16}
GOOD = 0.1  # pixels
SINGULAR = 1e-3


def cases(alpha: float) -> list[tuple[str, float, np.ndarray]]:
    """(family, its parameter, alpha grad V)."""
    found = [("zoom", r, r * np.eye(2)) for r in RADII]
    found += [("shrink", r, -r * np.eye(2)) for r in SHRINKS]
    found += [("stretch", r, np.diag([r, 0.0])) for r in RADII]
    found += [("shear", r, np.array([[0.0, r], [0.0, 0.0]])) for r in RADII]
    for angle in ANGLES:
        cos, sin = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        found.append(("rotation", angle, alpha * (np.array([[cos, -sin], [sin, cos]]) - np.eye(2))))
    return found


@jax.jit
def scores(found: jx.Correspondence, inverse: jax.Array) -> jax.Array:
    """Median and 99th percentile of error and of residual, and the share of good pixels; of each fourth row, column."""
    size = found.position.shape[0]
    center = (size - 1) / 2
    at, left, pixels = (a[::4, ::4] for a in (found.position, found.error[..., 0], positions(size, size)))
    truth = center + (pixels - center) @ inverse.T
    inside = jnp.all((truth > 2) & (truth < size - 3), -1)
    error = jnp.sqrt(jnp.sum(jnp.square(at - truth), -1))
    kept = [jnp.where(inside, a, jnp.nan) for a in (error, left)]
    levels = jnp.array([50.0, 99.0])
    good = jnp.sum(inside & (error < GOOD)) / jnp.maximum(jnp.sum(inside), 1)
    return jnp.concatenate([*(jnp.nanpercentile(a, levels) for a in kept), good[None]])


@partial(jax.jit, static_argnames=("method", "size"))
def trace(flow: jax.Array, alpha: jax.Array, inverse: jax.Array, *, method: str, size: int) -> jax.Array:
    """`scores` after each number of steps."""

    def search(start, iterations):
        found = jx.iterative_search(flow, alpha, start=start, iterations=iterations, **METHODS[method])
        return found.position, scores(found, inverse)

    at, first = search(positions(size, size), 0)
    rows = jax.lax.scan(lambda at, _: search(at, 1), at, None, length=STEPS[-1])[1]
    return jnp.concatenate([first[None], rows])[jnp.asarray(STEPS)]


def field(gradient: np.ndarray, size: int, dtype) -> jax.Array:
    """The flow between the I-frames as it is stored; every search computes in float32 with what is stored."""
    return ((positions(size, size) - (size - 1) / 2) @ jnp.asarray(gradient.T, jnp.float32)).astype(dtype)


def times(size: int, repeats: int) -> dict:
    """Milliseconds by method and steps: measured at some, linear between."""
    flow = field(0.5 * np.eye(2), size, jnp.float32)
    calls = {
        (name, steps): partial(jx.iterative_search, flow, 0.5, iterations=steps, **options)
        for (name, options), steps in itertools.product(METHODS.items(), MEASURED)
    }
    found = measure_pairs(calls, repeats=repeats)  # type: ignore[arg-type]
    return {
        name: [round(float(v), 3) for v in np.interp(STEPS, MEASURED, [found[name, s].median for s in MEASURED])]
        for name in METHODS
    }


def reach(rows: list[dict], family: str, method: str, dtype: str, steps: int) -> str:
    """Up to where 99 % of the pixels are good at every alpha, all smaller parameters included."""
    at, last = STEPS.index(steps), "none"
    for value in dict.fromkeys(r["value"] for r in rows if r["family"] == family):
        same = [r for r in rows if (r["family"], r["value"], r["method"], r["dtype"]) == (family, value, method, dtype)]
        if not all(r["trace"][at][4] >= 0.99 for r in same):
            return last
        last = f"{value:g}"
    return last


def plot(results: dict, path: Path) -> None:
    """Error against steps and time, good pixels against the strength of the motion, by kind of flow."""
    figure = Figure(figsize=(15, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 4)
    rows = results["rows"]
    styles = dict(zip(METHODS, ("-o", "--s", ":^"), strict=True))

    def picked(**wanted) -> list[dict]:
        return [r for r in rows if all(r[k] == v for k, v in wanted.items())]

    for axes, dtype in zip(panels[0], DTYPES, strict=False):
        for color, r in enumerate((0.5, 0.9, 2.0, 10.0)):
            for method in ("fixed point", "newton"):
                for row in picked(family="zoom", value=r, method=method, dtype=dtype, alpha=0.5):
                    axes.plot(
                        STEPS, [max(t[0], 1e-6) for t in row["trace"]], styles[method], color=f"C{color}", markersize=4,
                        label=f"{method}, r = {r:g}",
                    )  # fmt: skip
        axes.set_yscale("log")
        axes.set_title(f"zoom, {dtype} flow, alpha 1/2", fontsize=10)
        axes.set_xlabel("steps")
    panels[0][0].set_ylabel("median error, pixels")
    panels[0][0].legend(fontsize=7)
    axes = panels[0][3]
    for color, (family, value) in enumerate((("zoom", 0.9), ("rotation", 90), ("zoom", 2.0))):
        for method in ("fixed point", "newton"):
            for row in picked(family=family, value=value, method=method, dtype="float32", alpha=0.5):
                ms = results["milliseconds"][method]
                errors = [max(t[0], 1e-6) for t in row["trace"]]
                axes.plot(
                    ms, errors, styles[method], color=f"C{color}", markersize=4, label=f"{method}, {family} {value:g}"
                )
    axes.set_yscale("log")
    axes.set_title("error against time, float32", fontsize=10)
    axes.set_xlabel("milliseconds")
    axes.legend(fontsize=7)
    for axes, (family, unit) in zip(
        panels[1], (("zoom", "r"), ("shrink", "r"), ("rotation", "degrees"), ("shear", "r")), strict=True
    ):
        for method, style in styles.items():
            for color, dtype in enumerate(DTYPES):
                found = picked(family=family, method=method, dtype=dtype, alpha=0.5)
                shares = [100 * r["trace"][STEPS.index(8)][4] for r in found]
                axes.plot([r["value"] for r in found], shares, style, color=f"C{color}", markersize=4,
                          label=f"{method}, {dtype}")  # fmt: skip
        axes.set_title(f"{family}, 8 steps, alpha 1/2", fontsize=10)
        axes.set_xlabel(unit)
        if family != "rotation":
            axes.set_xscale("log")
    panels[1][0].set_ylabel(f"% of pixels below {GOOD:g} px")
    panels[1][3].legend(fontsize=7)
    for axes in panels.ravel():
        axes.grid(True, color="#d5d9dd")
    figure.savefig(path, dpi=100)


def main() -> None:
    """Runs the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeats", type=int, default=9, help="of the timing")
    options = parser.parse_args()
    rows = []
    for alpha, dtype, method in itertools.product(ALPHAS, DTYPES, METHODS):
        if alpha != 0.5 and dtype != "float32":
            continue
        for family, value, gradient in cases(alpha):
            if abs(np.linalg.det(np.eye(2) + gradient)) < SINGULAR:
                continue  # all points meet in one
            row = {"family": family, "value": value, "alpha": alpha, "dtype": dtype, "method": method}
            row["spectral_radius"] = round(float(max(abs(np.linalg.eigvals(gradient)))), 4)
            flow = field(gradient / alpha, options.size, DTYPES[dtype]).astype(jnp.float32)
            inverse = jnp.asarray(np.linalg.inv(np.eye(2) + gradient), jnp.float32)
            found = np.asarray(trace(flow, alpha, inverse, method=method, size=options.size))
            row["trace"] = [[float(f"{v:.4g}") for v in scored] for scored in found]
            rows.append(row)
        print(alpha, dtype, method, flush=True)
    results = {
        "machine": machine(),
        "size": options.size,
        "steps": STEPS,
        "trace": ["error median", "error p99", "residual median", "residual p99", f"share below {GOOD} px"],
        "milliseconds": times(options.size, options.repeats),
        "rows": rows,
    }
    families = ("zoom", "shrink", "stretch", "rotation", "shear")
    combinations = itertools.product(families, METHODS, DTYPES)
    results["reach"] = {"|".join(names): {str(s): reach(rows, *names, s) for s in (3, 8, 16)} for names in combinations}
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(results))
    plot(results, options.output.with_suffix(".png"))
    table = Table("motion", "method", *(f"{d}, 3 / 8 / 16 steps" for d in DTYPES), title="99 % of pixels good up to")
    for family, method in itertools.product(families, METHODS):
        cells = [" / ".join(results["reach"][f"{family}|{method}|{d}"].values()) for d in DTYPES]
        table.add_row(family, method, *cells)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
