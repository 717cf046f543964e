"""Lag and pacing of typical engines, rendered, interpolated and extrapolated, and a picture of it.

python experiments/latency.py --picture docs/latency.png --output experiments/results/latency.json
"""

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np

from jaxtrapolate.latency import Timeline, additional_lag, presentation_latency, simulate, summarize
from jaxtrapolate.latency.plot import plot_latency

REFRESH = 120.0
GENERATE = 1.0
LOAD = 0.85  # of the GPU, on average
METHODS = ("none", "interpolation", "extrapolation")
COLUMNS = (
    "engine",
    "rendered",
    "shown",
    "method",
    "how",
    "queue",
    "lag",
    "latency",
    "worst",
    "reaction",
    "missed",
    "uneven",
)


def engine(rate: float, method: str, shown: int, *, partitioned: bool, ahead: int = 0, spread: float = 0.0) -> Timeline:
    """Rendering that takes what the load leaves for it beside generation, with a spread drawn from a seed."""
    count = 1 if method == "none" else shown
    mean = 1000 / rate * LOAD - (count - 1) * GENERATE
    render = mean * (1 + spread * np.random.default_rng(0).standard_normal(240))
    hold = max(1, round(REFRESH / rate / count))
    options = {"shown": shown, "generate": GENERATE, "partitioned": partitioned, "ahead": ahead, "hold": hold}
    return simulate(np.maximum(render, 1), refresh_rate=REFRESH, method=method, **options)


def rows(spread: float) -> list[dict]:
    """The table's settings; a queue only where every frame takes the same time."""
    result = []
    for rate, shown in ((30, 1), (30, 2), (30, 4), (60, 1), (60, 2), (60, 4)):
        for method in METHODS[1:] if shown > 1 else METHODS[:1]:
            for partitioned, ahead in ((True, 0), (True, 1), (False, 0)) if shown > 1 else ((True, 0), (True, 1)):
                if spread and ahead:
                    continue
                timeline = engine(rate, method, shown, partitioned=partitioned, ahead=ahead, spread=spread)
                settings = {"rate": rate, "method": method, "shown": shown, "partitioned": partitioned}
                summary = dataclasses.asdict(summarize(timeline))
                result.append(settings | {"ahead": ahead, "spread": spread} | summary)
    return result


def main() -> None:
    """Prints the table, writes the picture and the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="the picture, by its ending PNG or SVG")
    parser.add_argument("--output", type=Path, metavar="FILE", help="all figures as JSON")
    options = parser.parse_args()
    results = rows(0.0) + rows(0.1)
    for spread in (0.0, 0.1):
        print(f"\n{REFRESH:g} Hz, {GENERATE:g} ms to generate a frame, render times spread by {100 * spread:g} %; ms\n")
        print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
        for r in results:
            if r["spread"] == spread:
                how = "" if r["method"] == "none" else "partitioned" if r["partitioned"] else "in one go"
                cells = [
                    str(r["rate"]),
                    f"{r['rendered_rate']:.0f}",
                    f"{r['shown_rate']:.0f}",
                    r["method"],
                    how,
                    str(r["ahead"]),
                ]
                figures = ("lag_mean", "latency_mean", "latency_worst", "reaction_mean")
                cells += [f"{r[name]:.1f}" for name in figures]
                print("| " + " | ".join([*cells, str(r["missed"]), f"{r['irregularity']:.1f}"]) + " |")
    print("\nadditional lag of partitioned interpolation, in steps of rendered frames")
    for shown in (2, 4):
        print(f"  {shown} shown: " + ", ".join(f"{additional_lag(shown, ahead=k):+.2f} (queue {k})" for k in (0, 1, 2)))
    print("\nfrom the end of rendering to the display, 90 Hz, 15 ms rendered, two shown")
    for method in METHODS[1:]:
        clocks = {
            c: presentation_latency(15.0, refresh_rate=90.0, method=method, clock=c) for c in ("vsync", "printed")
        }
        print(f"  {method}: " + ", ".join(f"{value:.2f} ms ({clock})" for clock, value in clocks.items()))
    if options.output:
        text = json.dumps({"refresh_rate": REFRESH, "generate": GENERATE, "rows": results}, indent=1)
        options.output.write_text(text + "\n")
    if options.picture:
        settings = {
            "30 fps rendered": ("none", 1, 0),
            "interpolated to 60": ("interpolation", 2, 0),
            "interpolated to 120": ("interpolation", 4, 0),
            "30 fps rendered, queue of 1": ("none", 1, 1),
            "interpolated to 120, queue of 1": ("interpolation", 4, 1),
            "extrapolated to 120": ("extrapolation", 4, 0),
        }
        panels = {
            title: engine(30, method, shown, partitioned=True, ahead=ahead)
            for title, (method, shown, ahead) in settings.items()
        }
        plot_latency(panels, steps=3).savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()
