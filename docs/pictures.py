"""Makes the pictures of the README from what `jaxtrapolate demo` wrote, and the contact sheet of the scenes.

jaxtrapolate demo && python docs/pictures.py demo
"""

import argparse
import json
from pathlib import Path

from PIL import Image, ImageDraw

from jaxtrapolate.checks import check_present
from jaxtrapolate.evaluation.pictures import buffer_picture, eight_bit, motion_picture
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.scenes import SceneSequence, scene_names

HERE = Path(__file__).parent


def labelled(picture: Image.Image, text: str) -> Image.Image:
    """A picture with a caption under it."""
    result = Image.new("RGB", (picture.width, picture.height + 18), "white")
    result.paste(picture, (0, 0))
    ImageDraw.Draw(result).text((4, picture.height + 3), text, fill="black")
    return result


def sheet(pictures: list[Image.Image], columns: int) -> Image.Image:
    """Pictures of one size in rows."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    result = Image.new("RGB", (columns * width, rows * height), "white")
    for i, picture in enumerate(pictures):
        result.paste(picture, (i % columns * width, i // columns * height))
    return result


def demo_strip(folder: Path) -> Image.Image:
    """Input, result and error of the frame that the demo found hardest."""
    results = json.loads((folder / "results.json").read_text())
    shown = results["pictures"][0]
    crop = [("rendered before: the input", shown["previous"]), ("the true frame, held back", shown["truth"])]
    scores = {
        name: next(f["psnr"] for f in m["frames"] if f["number"] == shown["number"])
        for name, m in results["methods"].items()
    }
    for name in ("warp", "extranet"):
        crop.append((f"{name}: {scores[name]:.1f} dB", shown["methods"][name]["image"]))
    for name in ("warp", "extranet"):
        crop.append((f"error of {name}", shown["methods"][name]["error"]))
    order = [0, 2, 4, 1, 3, 5]
    tiles = [labelled(Image.open(folder / crop[i][1]).convert("RGB"), crop[i][0]) for i in order]
    return sheet(tiles, 3)


def contact_sheet() -> Image.Image:
    """Every embedded scene with its buffers, a row each."""
    tiles = []
    for name in scene_names():
        frame = SceneSequence(name, frames=22, size=(90, 160), samples=4).frame(21)
        g = check_present("gbuffer", frame.gbuffer, needed_by="contact_sheet")
        shown = {name: eight_bit(display(frame.color, hdr=True)), "motion": motion_picture(frame.motion)}
        shown |= {n: buffer_picture(n, getattr(g, n), g.sky) for n in ("albedo", "normal", "depth", "roughness")}
        shown |= {n: buffer_picture(n, getattr(g, n), g.sky) for n in ("stencil", "shadow")}
        tiles += [labelled(Image.fromarray(picture), text) for text, picture in shown.items()]
    return sheet(tiles, 8)


def main() -> None:
    """Writes docs/demo.jpg and docs/scenes.jpg."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="the folder that `jaxtrapolate demo` wrote")
    parser.add_argument("--scenes", action="store_true", help="the contact sheet too")
    options = parser.parse_args()
    demo_strip(options.demo).save(HERE / "demo.jpg", quality=88)
    if options.scenes:
        contact_sheet().save(HERE / "scenes.jpg", quality=85)


if __name__ == "__main__":
    main()
