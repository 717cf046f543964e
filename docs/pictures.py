"""Makes the pictures of the pages: what an operation does, a wrong convention of motion, the scenes, the demo.

python docs/pictures.py --operations --convention --scenes --wrong
jaxtrapolate demo && python docs/pictures.py --demo demo   # or, for the same picture in less time:
jaxtrapolate evaluate scenes:demo --size 480x270 --length 16 --methods warp,guided_warp,guided_net --output demo
"""

import argparse
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter

import jaxtrapolate as jx
from jaxtrapolate.bidirectional.assisted import CASES
from jaxtrapolate.checks import check_present
from jaxtrapolate.evaluation.pictures import buffer_picture, eight_bit, motion_picture
from jaxtrapolate.evaluation.score import display
from jaxtrapolate.evaluation.windows import arguments, windows
from jaxtrapolate.methods.stages import find_holes
from jaxtrapolate.report import CAUSE_COLORS, ERROR_LIMIT, colorize_error
from jaxtrapolate.scenes import DEVELOPMENT_SEEDS, SceneSequence, scene_names

HERE = Path(__file__).parent
FONT = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
SIZE = (180, 320)
LIMIT = 150_000  # bytes of a picture
MARK = (224, 46, 175)  # what is missing, and frames of close-ups
CASE_COLORS = {"agree": "#2b2f36", "nearer": "#56b4e9", "one": "#e69f00", "neither": "#d55e00"}


@cache
def _font(points: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(FONT, points)


def labelled(picture: Any, text: str, *, scale: int = 1, points: int = 13) -> Image.Image:
    """A picture with a caption under it, in as many lines as the text has."""
    picture = picture if isinstance(picture, Image.Image) else Image.fromarray(np.asarray(picture))
    picture = picture.resize((picture.width * scale, picture.height * scale), Image.Resampling.NEAREST)
    lines = text.split("\n")
    widest = max(_font(points).getlength(line) for line in lines)
    if widest > picture.width - 8:
        raise ValueError(f"caption: expected at most {picture.width - 8} pixels, got {widest:.0f}: {text!r}")
    result = Image.new("RGB", (picture.width, picture.height + (points + 4) * len(lines) + 6), "white")
    result.paste(picture, (0, 0))
    draw = ImageDraw.Draw(result)
    for i, line in enumerate(lines):
        draw.text((4, picture.height + 2 + i * (points + 4)), line, fill="black", font=_font(points))
    return result


def sheet(pictures: Sequence[Image.Image], columns: int, *, gap: int = 4) -> Image.Image:
    """Pictures in rows, each row as high as its highest; all columns as wide as the widest picture."""
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    width = max(p.width for p in pictures) + gap
    heights = [max(p.height for p in row) + gap for row in rows]
    result = Image.new("RGB", (columns * width - gap, sum(heights) - gap), "white")
    for j, row in enumerate(rows):
        for i, picture in enumerate(row):
            result.paste(picture, (i * width, sum(heights[:j])))
    return result


def legend(entries: dict[str, Any], width: int) -> Image.Image:
    """A row of colours and what they mean."""
    result = Image.new("RGB", (width, 22), "white")
    draw, x = ImageDraw.Draw(result), 4
    for text, color in entries.items():
        draw.rectangle((x, 4, x + 14, 18), fill=color, outline="black")
        draw.text((x + 20, 3), text, fill="black", font=_font(13))
        x += 36 + round(_font(13).getlength(text))
    if x > width:
        raise ValueError(f"legend: expected at most {width} pixels, got {x}")
    return result


def error_scale(width: int) -> Image.Image:
    """The colours of error maps, from none to `ERROR_LIMIT`, with ticks."""
    result = Image.new("RGB", (width, 40), "white")
    bar = 320
    left = 4 + round(_font(13).getlength("error, of a range of 0..1: ")) + 6
    draw = ImageDraw.Draw(result)
    draw.text((4, 3), "error, of a range of 0..1: ", fill="black", font=_font(13))
    levels = np.broadcast_to(np.linspace(0, ERROR_LIMIT, bar, dtype=np.float32), (14, bar))
    result.paste(Image.fromarray(colorize_error(levels)), (left, 4))
    for part in range(6):
        x = left + round(part * (bar - 1) / 5)
        text = f"{ERROR_LIMIT * part / 5:.2f}" + (" or more" if part == 5 else "")
        draw.line((x, 18, x, 22), fill="black")
        draw.text((x - 12, 22), text, fill="black", font=_font(12))
    return result


def stacked(*pictures: Image.Image) -> Image.Image:
    """Pictures under each other."""
    result = Image.new("RGB", (max(p.width for p in pictures), sum(p.height for p in pictures)), "white")
    y = 0
    for picture in pictures:
        result.paste(picture, (0, y))
        y += picture.height
    return result


def most(mask: np.ndarray, size: tuple[int, int]) -> tuple[slice, slice]:
    """The window of a size that holds most of a mask."""
    share = uniform_filter(mask.astype(np.float64), size, mode="constant")
    y, x = (
        int(np.clip(place - part // 2, 0, whole - part))
        for place, part, whole in zip(np.unravel_index(share.argmax(), share.shape), size, mask.shape, strict=True)
    )
    return slice(y, y + size[0]), slice(x, x + size[1])


def boxed(picture: Any, window: tuple[slice, slice], *, width: int = 2) -> Image.Image:
    """A picture with a window marked."""
    result = Image.fromarray(np.array(picture))
    rows, columns = window
    ImageDraw.Draw(result).rectangle((columns.start, rows.start, columns.stop, rows.stop), outline=MARK, width=width)
    return result


def shown(color: Any) -> np.ndarray:
    """Radiance as 8-bit RGB."""
    return eight_bit(display(jnp.asarray(color), hdr=True))


def off(made: Any, truth: Any) -> np.ndarray:
    """The error of radiance as a picture."""
    error = np.abs(np.asarray(display(jnp.asarray(made), hdr=True) - display(jnp.asarray(truth), hdr=True)))
    return colorize_error(error.mean(-1))


def decibels(made: Any, truth: Any) -> str:
    """PSNR in the report's display space."""
    pair = (display(jnp.asarray(image), hdr=True) for image in (made, truth))
    return f"{float(jx.psnr(*pair)):.1f} dB"


@cache
def pair(name: str, seed: int, now: float, before: float):
    """World, frame now with motion to the frame before, and that frame."""
    world = jx.scenes.scene(name, seed)
    source = jx.scenes.render(world, before, size=SIZE, samples=4)
    return world, jx.scenes.render(world, now, size=SIZE, samples=4, previous_time=before), source


def walkers():
    """The frames that most operations are shown on."""
    return pair("walkers", 11, 30.0, 27.0)


def warp_picture() -> Image.Image:
    """What a fetch along the motion makes."""
    _, now, before = walkers()
    made = jx.backward_warp(before.color, now.motion)
    tiles = [
        labelled(shown(before.color), "the frame before", scale=2),
        labelled(shown(now.color), "the truth", scale=2),
        labelled(shown(made), f"warped: {decibels(made, now.color)}; what was in front stands there twice", scale=2),
        labelled(off(made, now.color), "its error", scale=2),
    ]
    tiles = [t.resize((480, t.height * 480 // t.width), Image.Resampling.LANCZOS) for t in tiles]
    return stacked(sheet(tiles, 2), error_scale(964))


def splat_picture() -> Image.Image:
    """Four ways to scatter, and what stays empty."""
    world, _, before = walkers()
    ahead = jx.scenes.flow(world, 27.0, 30.0, size=SIZE)[..., :2]
    depth = before.gbuffer.depth
    importance = -4 * jnp.log(jnp.where(jnp.isfinite(depth), depth, 1e4))
    ones = jnp.ones((*SIZE, 1))
    hits = np.asarray(jx.splat(ones, ahead, mode="sum"))[..., 0] > 0
    nearest, covered = jx.splat_nearest(before.color, ahead, depth)
    made = {
        'splat, "sum": brighter where several land': (jx.splat(before.color, ahead, mode="sum"), hits),
        'splat, "average": they are mixed': (jx.splat(before.color, ahead), hits),
        'splat, "softmax" of -4 log depth: the nearest counts': (
            jx.splat(before.color, ahead, weights=importance, mode="softmax"),
            hits,
        ),
        "splat_nearest: the nearest alone": (nearest, np.asarray(covered)),
    }
    tiles = []
    for text, (image, there) in made.items():
        tiles.append(labelled(np.where(there[..., None], shown(image), np.uint8(MARK)), text, scale=1, points=11))
    whole = sheet(tiles, 2)
    window = most(~np.asarray(covered), (45, 80))
    close = [
        labelled(np.where(there[window][..., None], shown(image)[window], np.uint8(MARK)), text.split(":")[0], scale=4)
        for text, (image, there) in made.items()
    ]
    return stacked(whole, sheet(close, 2), legend({"nothing landed": MARK}, whole.width))


def occlusion_picture() -> Image.Image:
    """The motion of occluders, and what the warp makes of it."""
    _, now, before = walkers()
    occluder = jx.occlusion_motion(now.motion, now.gbuffer.depth)
    holes = find_holes(now.gbuffer, before.gbuffer, now.motion)
    along = jnp.where(holes, occluder, now.motion)
    window = most(np.asarray(holes)[..., 0], (60, 107))
    plain, made = (jx.backward_warp(before.color, m) for m in (now.motion, along))
    tiles = [
        labelled(motion_picture(now.motion), "motion (x red, y green)"),
        labelled(motion_picture(occluder), "occlusion motion"),
        labelled(boxed(shown(now.color), window), "the truth"),
        labelled(shown(plain)[window], "warped by the motion", scale=3),
        labelled(shown(made)[window], "in holes by the occlusion motion", scale=3),
        labelled(shown(now.color)[window], "the truth", scale=3),
    ]
    return sheet(tiles, 3)


def holes_picture() -> Image.Image:
    """Each hole mask over the truth, and the exact holes."""
    world, now, before = walkers()
    masks = jx.hole_masks(now.gbuffer, before.gbuffer, now.motion, taps="nearest")
    frames = [jx.scenes.keyframe(world, t, size=SIZE, next_time=t + 3, previous_time=t - 3) for t in (30.0, 27.0)]
    exact = jx.disoccluded(jx.replace(frames[0], color=None), jx.replace(frames[1], color=None))
    parts = {
        "stencil: another object": masks.stencil,
        "normal: turned, on what moves": masks.normal,
        "position: elsewhere, on what is static": masks.position,
        "depth: a surface against nothing": masks.depth,
        "outside: beyond the frame": masks.outside,
        "disoccluded: exact, by 3D flow": np.asarray(exact)[..., None],
    }
    grey = shown(now.color) // 2
    tiles = [labelled(np.where(np.asarray(m) > 0, np.uint8(MARK), grey), text) for text, m in parts.items()]
    return sheet(tiles, 3)


def guided_picture() -> Image.Image:
    """Close-ups of what three methods put into holes."""
    _, now, before = walkers()
    target = jx.replace(now, color=None, gbuffer=jx.replace(now.gbuffer, sky_color=None))  # the sky too is to be warped
    holes = np.asarray(find_holes(now.gbuffer, before.gbuffer, now.motion))[..., 0]
    window = most(holes & (np.asarray(now.gbuffer.sky)[..., 0] < 0.5), (60, 80))
    made = {name: jx.load(name)((before,), target) for name in ("warp", "occlusion_warp", "guided_warp")}
    tiles = [labelled(shown(now.color)[window], "the truth", scale=3)]
    tiles += [labelled(shown(i)[window], f"{n}: {decibels(i, now.color)}", scale=3) for n, i in made.items()]
    picture = np.where(holes[window][..., None], np.uint8(MARK), shown(now.color)[window] // 2)
    tiles += [labelled(picture, "holes", scale=3)]
    tiles += [labelled(off(i, now.color)[window], "its error", scale=3) for i in made.values()]
    whole = sheet(tiles, 4)
    return stacked(whole, error_scale(whole.width))


def search_picture() -> Image.Image:
    """A frame between two rendered ones: how each pixel was found."""
    world = jx.scenes.scene("walkers", 11)
    times = 27.0, 31.0
    first, second = (jx.scenes.keyframe(world, t, size=SIZE, next_time=times[1], previous_time=times[0]) for t in times)
    truth = jx.scenes.render(world, 29.0, size=SIZE).color
    made = jx.interpolate_bidirectional(first, second, 0.5)
    case = np.asarray(made.case)
    colors = np.zeros((len(CASES), 3), np.uint8)
    for name, color in CASE_COLORS.items():
        colors[CASES.index(name)] = tuple(bytes.fromhex(color[1:]))
    missed = np.minimum(np.asarray(made.forward.error), np.asarray(made.backward.error))[..., 0]
    tiles = [
        labelled(shown(first.color), "rendered, time 0"),
        labelled(shown(made.color), f"made, time 1/2: {decibels(made.color, truth)}"),
        labelled(shown(second.color), "rendered, time 1"),
        labelled(colors[case], "how each pixel was found"),
        labelled(off(made.color, truth), "error of the frame generated"),
        labelled(eight_bit(np.minimum(missed, 2)[..., None] / 2), "Correspondence.error: white = 2 pixels or more"),
    ]
    whole = sheet(tiles, 3)
    meanings = {
        "agree: one point in both": CASE_COLORS["agree"],
        "nearer: of two points": CASE_COLORS["nearer"],
        "one: in one frame alone": CASE_COLORS["one"],
        "neither: the smaller miss": CASE_COLORS["neither"],
    }
    return stacked(whole, legend(meanings, whole.width), error_scale(whole.width))


OPERATIONS = {
    "warp": warp_picture,
    "splat": splat_picture,
    "occlusion": occlusion_picture,
    "holes": holes_picture,
    "guided": guided_picture,
    "search": search_picture,
}


def convention_picture() -> Image.Image:
    """One frame warped by motion vectors as they are, and as they are misread."""
    _, now, before = pair("terrain", 4, 33.0, 30.0)
    size = jnp.asarray([SIZE[1], SIZE[0]], jnp.float32)
    misread = {
        "as they are": now.motion,
        "sign reversed": -now.motion,
        "y up taken for down": now.motion * jnp.asarray([1.0, -1.0]),
        "both reversed": now.motion * jnp.asarray([-1.0, 1.0]),
        "UV taken for pixels": now.motion / size,
        "pixels taken for NDC": now.motion * size / 2,
    }
    made = {text: jx.backward_warp(before.color, motion) for text, motion in misread.items()}
    images = [labelled(shown(i), f"{text}: {decibels(i, now.color)}") for text, i in made.items()]
    errors = [labelled(off(i, now.color), f"error, {text}") for text, i in made.items()]
    whole = sheet([*images[:3], *errors[:3], *images[3:], *errors[3:]], 3)
    whole = whole.resize((whole.width * 5 // 6, whole.height * 5 // 6), Image.Resampling.LANCZOS)
    return stacked(whole, error_scale(whole.width))


_WRONG = {
    "walkers": "edges of shadows",
    "street": "a lamp went out",
    "forest": "thin trunks",
    "windmill": "shadows that turn",
}
"""Scenes, and what is wrong where `shading_warp` errs most."""


def wrong_picture() -> Image.Image:
    """Of four scenes the window in which `shading_warp` errs most: by method, and the error of each."""
    names = ("guided_warp", "shading_warp", "guided_net")
    tiles = []
    for name, text in _WRONG.items():
        sequence = SceneSequence(name, DEVELOPMENT_SEEDS[0], frames=10, size=SIZE)
        (window,) = windows(sequence, [9], past=3)
        made = {n: jx.load(n)(*arguments(jx.load(n), window)) for n in names}
        truth = window.truth.color
        missed = np.square(display(made["shading_warp"], hdr=True) - display(truth, hdr=True)).sum(-1)
        part = most(np.asarray(missed), (45, 80))
        tiles.append(labelled(shown(truth)[part], f"{name}: {text}", scale=3))
        texts = {n: f"{n}: {decibels(i[part], truth[part])} here" for n, i in made.items()}
        tiles += [labelled(shown(i)[part], texts[n], scale=3) for n, i in made.items()]
        tiles.append(labelled(boxed(shown(truth), part), "where").resize((240, 158), Image.Resampling.LANCZOS))
        tiles += [labelled(off(i, truth)[part], "its error", scale=3) for i in made.values()]
    whole = sheet(tiles, 4)
    return stacked(whole, error_scale(whole.width))


def demo_strip(folder: Path) -> Image.Image:
    """Input, result, error and a close-up of the frame that the demo found hardest."""
    results = json.loads((folder / "results.json").read_text())
    chosen = results["pictures"][0]
    methods = ("warp", "guided_warp", "guided_net")
    scores = {
        name: next(f["psnr"] for f in results["methods"][name]["frames"] if f["number"] == chosen["number"])
        for name in methods
    }

    def read(path: str) -> np.ndarray:
        return np.asarray(Image.open(folder / path).convert("RGB"))

    hole = np.uint8(tuple(bytes.fromhex(CAUSE_COLORS["hole"][1:])))
    holes = (read(chosen["causes"]) == hole).all(-1)
    bad = read(chosen["methods"]["warp"]["error"]).astype(float).sum(-1)
    height, width = holes.shape
    part = height // 4, width // 4
    window = most(holes * bad, part)
    truth, before = read(chosen["truth"]), read(chosen["previous"])
    images = [read(chosen["methods"][name]["image"]) for name in methods]
    errors = [read(chosen["methods"][name]["error"]) for name in methods]
    scale = width // part[1]
    tiles = [labelled(before, "rendered before: the input", points=15)]
    tiles += [labelled(i, f"{n}: {scores[n]:.1f} dB", points=15) for n, i in zip(methods, images, strict=True)]
    tiles += [labelled(boxed(truth, window), "the true frame, held back", points=15)]
    tiles += [labelled(e, f"error of {n}", points=15) for n, e in zip(methods, errors, strict=True)]
    closer = [("the true frame", truth), *zip(methods, images, strict=True)]
    tiles += [labelled(i[window], f"{n}, a disocclusion, {scale}x", scale=scale, points=15) for n, i in closer]
    whole = sheet(tiles, 4)
    whole = stacked(whole, error_scale(whole.width))
    return whole.resize((whole.width * 3 // 4, whole.height * 3 // 4), Image.Resampling.LANCZOS)


def contact_sheet() -> Image.Image:
    """Every embedded scene, a row each; what the columns are stands above them."""
    names = ("color", "motion", "albedo", "normal", "depth", "roughness", "stencil", "shadow")
    headings = ("colour", *names[1:])
    rows = []
    for scene in scene_names():
        frame = SceneSequence(scene, frames=22, size=(90, 160), samples=4).frame(21)
        g = check_present("gbuffer", frame.gbuffer, needed_by="contact_sheet")
        pictures = [eight_bit(display(frame.color, hdr=True)), motion_picture(frame.motion)]
        pictures += [buffer_picture(n, getattr(g, n), g.sky) for n in names[2:]]
        rows.append((scene, pictures))
    left, top = 84, 26
    whole = Image.new("RGB", (left + 164 * len(names) - 4, top + 94 * len(rows) - 4), "white")
    draw = ImageDraw.Draw(whole)
    for i, heading in enumerate(headings):
        draw.text((left + 164 * i + 2, 4), heading, fill="black", font=_font(15))
    for j, (scene, pictures) in enumerate(rows):
        draw.text((4, top + 94 * j + 36), scene, fill="black", font=_font(15))
        for i, picture in enumerate(pictures):
            whole.paste(Image.fromarray(picture), (left + 164 * i, top + 94 * j))
    return whole


def main() -> None:
    """Writes pictures into docs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demo", type=Path, metavar="DIR", help="demo.jpg, from what `jaxtrapolate demo` wrote")
    parser.add_argument("--scenes", action="store_true", help="scenes.jpg")
    parser.add_argument("--operations", nargs="*", choices=OPERATIONS, help="operations/*.jpg, or those named")
    parser.add_argument("--convention", action="store_true", help="convention.jpg")
    parser.add_argument("--wrong", action="store_true", help="wrong.jpg: what is still wrong with light that moves")
    options = parser.parse_args()
    made = {}
    if options.demo:
        made["demo"] = demo_strip(options.demo)
    if options.scenes:
        made["scenes"] = contact_sheet()
    if options.convention:
        made["convention"] = convention_picture()
    if options.wrong:
        made["wrong"] = wrong_picture()
    if options.operations is not None:
        (HERE / "operations").mkdir(exist_ok=True)
        made |= {f"operations/{name}": OPERATIONS[name]() for name in options.operations or OPERATIONS}
    for name, picture in made.items():
        path = HERE / f"{name}.jpg"
        for quality in (85, 80, 75, 70, 65, 60):
            picture.save(path, quality=quality, optimize=True, progressive=True)
            if path.stat().st_size <= LIMIT:
                break
        print(f"{path.relative_to(HERE)}: {picture.width}x{picture.height}, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
