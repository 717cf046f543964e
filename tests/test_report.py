"""The report: from synthetic results, complete, sparse and hostile; in a browser where one is installed."""

import base64
import html.parser
import io
import json
import math
import re
import shutil
import subprocess
import urllib.parse
import xml.etree.ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image

from jaxtrapolate import report
from jaxtrapolate import results as results_module
from jaxtrapolate.errors import InputError
from jaxtrapolate.files import write_png
from jaxtrapolate.ops.causes import CAUSES
from jaxtrapolate.report import plots, values
from jaxtrapolate.report.pictures import Pictures

HOSTILE = (
    "<script>document.documentElement.dataset.hacked=1</script>",
    '"><img src=x onerror="document.documentElement.dataset.hacked=1">',
    "</style></script>--><b>$\\frac{",
    "_漢字 {{ 7*7 }} \x1b\ud800" + "long" * 30,
)
METHODS = (
    *("repeat", "warp", "occlusion_warp", "guided_warp", "blend", "reproject", "half_motion", "warp_3d", "grid_warp"),
    *("grid_extrapolate", "softmax_splat", "dis", "bidirectional_image", "bidirectional", "bidirectional_guided"),
)
VOID = {"meta", "img", "input", "br", "link"}


def entry(psnr, ms, numbers=(2, 4, 6)):
    """One method's entry, complete."""
    frames = [{"number": n, "psnr": psnr + 0.3 * i, "ssim": 0.9, "ms": ms} for i, n in enumerate(numbers)]
    by_cause = {c: {"psnr": psnr + i, "share": 1 / 6} for i, c in enumerate(CAUSES)}
    stages = {"reproject": {"median": ms / 3, "iqr": 0.1, "compile": 20.0}, "warp": {"median": ms / 2}}
    return {
        "psnr": psnr,
        "ssim": 0.93,
        "ms": {"median": ms, "iqr": 0.2, "compile": 1234.0},
        "by_cause": by_cause,
        "stages": stages,
        "left_out": {"sky": ["target.sky", "target.sky_color"]},
        "frames": frames,
    }


def complete(folder, methods=("repeat", "warp", "guided_warp"), size=(36, 64)):
    """Results with several methods and the pictures of one frame in `folder`."""
    random = np.random.default_rng(0)
    place = folder / "pictures" / "0004"
    place.mkdir(parents=True)

    def put(name, picture):
        write_png(place / f"{name}.png", picture)
        return f"pictures/0004/{name}.png"

    ramp = np.linspace(0, 1, size[1], dtype=np.float32)[None, :, None] * np.ones((*size, 3), np.float32)
    pictures = {
        "number": 4,
        "truth": put("truth", (ramp * 255).astype(np.uint8)),
        "previous": put("previous", (ramp[:, ::-1] * 255).astype(np.uint8)),
        "causes": put("causes", report.colorize_causes(random.integers(0, len(CAUSES), size))),
        "holes": put("holes", np.repeat((ramp[..., :1] > 0.5).astype(np.uint8) * 255, 3, -1)),
        "methods": {},
        "buffers": {"depth": put("depth", (ramp * 200).astype(np.uint8))},
    }
    for i, name in enumerate(methods):
        made = np.clip(ramp + random.normal(0, 0.1, ramp.shape), 0, 1).astype(np.float32)
        image = put(f"m{i}", (made * 255).astype(np.uint8))
        pictures["methods"][name] = {"image": image, "error": put(f"m{i}_error", report.colorize_error(made - ramp))}
    return {
        "input": "a scene",
        "machine": {"cpu": "a processor", "cores": 2, "gpu": None, "versions": {"jax": "1.2"}},
        "size": list(size),
        "hdr": True,
        "settings": {"motion": "previous_minus_current,pixels,down", "methods": list(methods)},
        "notes": ["a gap in the numbering"],
        "frames": [2, 4, 6],
        "methods": {name: entry(22.0 + 4 * i, 0.5 * 5.0**i) for i, name in enumerate(methods)},
        "skipped": {"extranet": "missing target.roughness"},
        "pictures": [pictures],
    }


class Page(html.parser.HTMLParser):
    """Reads a page and checks that it is well formed and self-contained."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.root, self.images, self.links = [], [], [], {}, [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append(tag)
        self.open += [] if tag in VOID else [tag]
        if tag == "html":
            self.root = attributes
        if tag == "img":
            assert attributes.get("alt") is not None
            self.images.append(attributes.get("src"))
        for name, value in attributes.items():
            assert not name.startswith("on"), f"inline handler {name}"
            if name == "href" and not value.startswith("#"):  # a file beside the page
                assert not urllib.parse.urlsplit(value).scheme
                assert not value.startswith("/")
                self.links.append(value)
            elif name in ("src", "href", "srcset", "action", "poster", "data"):
                assert value.startswith(("data:image/", "#")), value[:80]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    @property
    def visible(self):
        return " ".join(" ".join(self.text).split())


def check_svg(svg):
    """The texts that the drawing holds, as matplotlib notes them beside their outlines."""
    root = xml.etree.ElementTree.fromstring(svg)
    assert root.tag.endswith("svg")
    assert b"prefers-color-scheme:dark" in svg
    assert not re.search(rb"(?:href|src)=\"(?!#)", svg)
    assert b"<script" not in svg
    return svg.decode()


def test_page_is_complete_and_self_contained(tmp_path):
    results = complete(tmp_path)
    path = report.write_report(results, tmp_path)
    assert path == tmp_path / "report.html"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pictures", "report.html"]
    text = path.read_text()
    page = Page(text)
    assert "http" not in re.sub(r"http-equiv|data:[^\"]*", "", text)
    assert text.count("@import") == text.count("url(") == 0
    assert page.tags.count("script") == 1
    assert "guided_warp: 30.0 dB at 12.5 ms, +4.0 dB over warp" in page.visible
    for expected in (
        "64 × 36 pixels",
        "3 frames",
        "16.7 %",
        "left out, missing: target.sky, target.sky_color",
        "1.2 s",
    ):
        assert expected in page.visible
    for expected in (
        "missing target.roughness",
        "a gap in the numbering",
        "versions jax",
        "a processor",
        "0.25 or more",
    ):
        assert expected in page.visible
    assert "gpu" not in page.visible
    assert all(color in text for color in report.CAUSE_COLORS.values())
    embedded = [uri for uri in page.images if uri and uri.startswith("data:image/webp")]
    assert len(embedded) == len(set(embedded)) == 4 + 2 * 3 + 1  # each picture once
    assert sum(bool(uri) and uri.startswith("data:image/svg+xml") for uri in page.images) == 3


def decoded(uri):
    """The picture in a data URI."""
    kind, data = re.fullmatch(r"data:image/(\w+);base64,(.*)", uri).groups()
    return kind, np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")), len(data)


def test_pictures_are_small_and_near_and_those_of_few_colours_exact(tmp_path):
    y, x = np.mgrid[0:180, 0:320]
    noise = np.random.default_rng(0).normal(0, 4, (180, 320, 3))
    photograph = np.stack([128 + 90 * np.sin(0.05 * x + k) * np.cos(0.04 * y) for k in range(3)], -1) + noise
    photograph = photograph.round().clip(0, 255).astype(np.uint8)
    error = report.colorize_error(np.abs(noise / 255).astype(np.float32))
    write_png(tmp_path / "photograph.png", photograph)
    write_png(tmp_path / "error.png", error)
    pictures = Pictures(tmp_path)
    kind, seen, size = decoded(pictures.uri("photograph.png"))
    assert kind == "webp"
    assert size < (tmp_path / "photograph.png").stat().st_size / 3
    assert 10 * np.log10(255**2 / np.mean((seen.astype(float) - photograph) ** 2)) > 32
    kind, seen, size = decoded(pictures.uri("error.png"))
    assert kind == "webp"
    np.testing.assert_array_equal(seen, error)
    assert size < (tmp_path / "error.png").stat().st_size * 0.8
    assert pictures.missing == []


def several(folder):
    """Results over inputs, one of which could not be used."""
    results = complete(folder)
    results |= {"pictures": [], "frames": None, "input": "2 of 3 inputs", "failed": {"gone": "gone: does not exist"}}
    results["metrics"] = {
        "psnr": {"better": "higher", "unit": "dB"},
        "flip": {"better": "lower", "unit": ""},
        "vmaf": {"per": "clip", "better": "higher"},
    }
    for i, method in enumerate(results["methods"].values()):
        method |= {"flip": 0.3 - 0.1 * i, "vmaf": 70.0 + i, "frames": []}
    scores = {name: {"psnr": 20.0 + i} for i, name in enumerate(results["methods"])}
    results["inputs"] = [
        {"folder": "demo-0", "size": [36, 64], "frames": 4, "methods": scores},
        {"folder": "a b", "size": [180, 320], "frames": 7, "methods": {**scores, "repeat": {"psnr": "inf"}}},
    ]
    return results


def test_page_of_several_inputs(tmp_path):
    text = report.write_report(several(tmp_path), tmp_path).read_text()
    page = Page(text)
    assert page.links == ["demo-0/report.html", "a%20b/report.html"]
    for expected in ("demo-0 20.00 21.00 22.00 64 × 36, 4 frames", "a b ∞ 21.00 22.00", "mean 22.00 26.00 30.00"):
        assert expected in page.visible
    for expected in ("2 of 3 inputs", "11 frames", "gone: does not exist", "FLIP ↓", "VMAF", "0.1000"):
        assert expected in page.visible
    assert "SSIM" not in page.visible
    assert '<td class="top">0.1000</td>' in text  # of FLIP less is better
    assert '<td class="top">72.00</td>' in text


def test_links_lead_only_to_files_beside_the_page(tmp_path):
    results = several(tmp_path)
    results["inputs"][0]["folder"] = "javascript:alert(1)"
    results["inputs"][1]["folder"] = "//elsewhere.example"
    results["video"] = "../some where.webp"
    page = Page(report.render_report(results, tmp_path))
    assert page.links == [
        "javascript%3Aalert%281%29/report.html",
        "elsewhere.example/report.html",
        "../some%20where.webp",
    ]


def test_page_is_the_same_from_json_and_every_time(tmp_path):
    results = complete(tmp_path)
    text = report.render_report(results, tmp_path)
    assert report.render_report(json.loads(json.dumps(results)), tmp_path) == text


@pytest.mark.parametrize(
    "results",
    [
        {},
        {"methods": {}},
        {"methods": {"warp": {}}, "pictures": [{}], "size": None, "machine": None, "notes": None},
        {"methods": {"a": {"psnr": None, "ms": {"median": None}, "by_cause": {"hole": {"psnr": None, "share": 0.1}}}}},
        {
            "methods": {"a": {"psnr": 1.0, "frames": [{"number": 1}, {}]}},
            "pictures": [{"number": 1, "methods": {"a": {}}}],
        },
        {"methods": {"a": "?"}, "pictures": "?", "skipped": 3, "frames": 1, "hdr": False, "size": [1]},
    ],
)
def test_page_of_sparse_results(tmp_path, results):
    Page(report.write_report(results, tmp_path).read_text())
    for plot in (report.plot_error_time, report.plot_causes, report.plot_frames):
        check_svg(plot(results))


def test_missing_and_foreign_pictures_are_left_out_and_named(tmp_path):
    folder = tmp_path / "results"
    folder.mkdir()
    results = complete(folder)
    (folder / "pictures/0004/holes.png").unlink()
    write_png(tmp_path / "secret.png", np.zeros((2, 2, 3), np.uint8))
    results["pictures"][0]["previous"] = "../secret.png"
    (folder / "notes.txt").write_text("no picture")
    results["pictures"][0]["buffers"]["notes"] = "notes.txt"
    page = Page(report.render_report(results, folder))
    assert "could not be read: pictures/0004/" not in page.visible  # in the order of the page
    assert "could not be read: ../secret.png, pictures/0004/holes.png, notes.txt" in page.visible


@pytest.mark.parametrize("infinite", [math.inf, "inf"])
def test_infinite_decibels(tmp_path, infinite):
    results = complete(tmp_path)
    best = results["methods"]["warp"]
    best |= {"psnr": infinite, "ssim": 1.0}
    best["frames"][1] |= {"psnr": infinite, "ssim": 1.0}
    best["by_cause"]["hole"]["psnr"] = infinite
    page = Page(report.render_report(results, tmp_path))
    assert "warp: ∞ dB at 2.50 ms, +∞ dB over repeat" in page.visible
    assert "nan" not in page.visible.lower()
    assert "∞ dB" in check_svg(report.plot_error_time(results))


def test_equal_images_without_decibels_have_infinitely_many():
    equal, unknown = values.named_methods(
        {"methods": {"a": {"psnr": None, "ssim": 1.0}, "b": {"psnr": None, "ssim": 0.9}}}
    )
    assert equal.psnr == math.inf
    assert unknown.psnr is None


def test_all_infinite(tmp_path):
    results = {"methods": {n: {"psnr": "inf", "ms": {"median": 1.0}} for n in "ab"}}
    page = Page(report.render_report(results, tmp_path))
    assert "a: ∞ dB at 1.00 ms" in page.visible


def test_hostile_texts_are_only_texts(tmp_path):
    results = complete(tmp_path, methods=HOSTILE)
    results |= {
        "input": HOSTILE[0],
        "notes": list(HOSTILE),
        "skipped": {HOSTILE[1]: HOSTILE[0]},
        "settings": {HOSTILE[1]: 1},
    }
    results["methods"][HOSTILE[0]]["left_out"] = {HOSTILE[0]: [HOSTILE[1]]}
    results["pictures"][0]["buffers"] = {HOSTILE[1]: "pictures/0004/depth.png"}
    text = report.write_report(results, tmp_path).read_text()
    page = Page(text)
    assert page.tags.count("script") == 1
    assert HOSTILE[0] in page.visible
    assert "{{ 7*7 }}" in page.visible
    for plot in (report.plot_error_time, report.plot_causes, report.plot_frames):
        check_svg(plot(results))


def test_plots_hold_each_method_and_leave_matplotlib_alone(tmp_path):
    results = complete(tmp_path)
    with matplotlib.rc_context({"axes.facecolor": "red", "svg.fonttype": "none", "font.size": 30}):
        before = dict(matplotlib.rcParams)
        styled = report.plot_error_time(results)
        assert dict(matplotlib.rcParams) == before
    assert styled == report.plot_error_time(results)
    for plot in (report.plot_error_time, report.plot_causes, report.plot_frames):
        svg = check_svg(plot(results))
        assert all(f"<!-- {name} -->" in svg for name in results["methods"])


def boxes_of(labels, figure):
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    return [Text.get_window_extent(label, renderer) for label in labels]


@pytest.mark.parametrize("count, spread", [(2, 0.0), (8, 0.0), (8, 0.02), (12, 0.1), (16, 1.0), (16, 0.3), (3, 0.001)])
@pytest.mark.parametrize("seed", range(3))
def test_labels_cover_neither_points_nor_each_other(count, spread, seed):
    """Also of points on top of each other; then a leader says whose each is."""
    random = np.random.default_rng(seed)
    names = [*METHODS[: count - 1], "a name of twenty-six signs"]
    found = {
        n: {"psnr": 30 + 6 * spread * u, "ms": {"median": 10 * 30 ** (spread * v)}}
        for n, u, v in zip(names, random.random(count), random.random(count), strict=True)
    }
    found |= {"far": {"psnr": 20.0, "ms": {"median": 0.5}}}
    methods = values.named_methods({"methods": found})
    figure, labels = plots._error_time(methods)
    assert [label.get_text() for label in labels] == [*names, "far"]
    boxes = boxes_of(labels, figure)
    axes = figure.axes[0]
    inner = axes.get_window_extent()
    for i, box in enumerate(boxes):
        assert inner.x0 - 1 <= box.x0 < box.x1 <= inner.x1 + 1
        assert inner.y0 - 1 <= box.y0 < box.y1 <= inner.y1 + 1
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])
        for method in methods:
            x, y = axes.transData.transform((method.ms.median, method.psnr))
            assert not box.overlaps(Bbox.from_bounds(x - 4, y - 4, 8, 8))


@pytest.mark.parametrize("count", [22, 40])
def test_a_legend_where_there_is_no_place_for_labels(count):
    found = {f"a method of a long name {i}": {"psnr": 30.0, "ms": {"median": 1.0}} for i in range(count)}
    figure, labels = plots._error_time(values.named_methods({"methods": found}))
    assert labels == []
    assert len(figure.legends[0].get_texts()) == count
    check_svg(report.plot_error_time({"methods": found}))


def test_pareto_front():
    from jaxtrapolate.report.plots import _pareto

    points = [(10.0, 30.0), (1.0, 20.0), (5.0, 25.0), (6.0, 24.0), (1.0, 19.0), (20.0, 30.0)]
    assert _pareto(points) == [(1, 20.0), (5, 25.0), (10, 30.0)]


def test_many_methods_are_told_apart():
    methods = values.named_methods({"methods": {f"m{i}": {} for i in range(40)}})
    assert len({(m.color, m.marker) for m in methods}) == 40


def test_best_and_reference():
    methods = values.named_methods({"methods": {"warp": entry(30.0, 5), "b": entry(30.0, 2), "repeat": entry(9.0, 1)}})
    assert values.best_method(methods).name == "b"
    assert values.reference_method(methods).name == "warp"
    assert values.headline(methods[:1]) == "warp: 30.0 dB at 5.00 ms"
    assert values.headline([]) == "No method was scored."


@pytest.mark.parametrize(
    "value, expected",
    [(1, 1.0), ("2.5", 2.5), ("inf", math.inf), ("-Infinity", -math.inf), (math.nan, None), (True, None), ([], None)],
)
def test_number(value, expected):
    assert results_module.number(value) == expected


def test_texts():
    assert values.fixed(-1.25, 1, signed=True) == "−1.2"
    assert [values.milliseconds(v) for v in (None, 0.123, 12.34, 123.4)] == ["–", "0.12", "12.3", "123"]
    assert [values.duration(v) for v in (None, 4.5, 12345.0)] == ["–", "4.50 ms", "12.3 s"]
    assert [values.percent(v) for v in (None, 0.0, 1e-4, 0.285)] == ["–", "0.0 %", "< 0.1 %", "28.5 %"]


def test_colorize_error():
    error = np.array([[0.0, 0.125, -0.25, 3.0], [np.nan, 0.0625, 0.1, 0.2]], np.float32)
    picture = report.colorize_error(error)
    assert picture.dtype == np.uint8
    assert picture.shape == (2, 4, 3)
    expected = matplotlib.colormaps["inferno"](np.array([0.0, 0.5, 1.0, 1.0]))[:, :3]
    np.testing.assert_allclose(picture[0] / 255, expected, atol=0.02)
    assert tuple(picture[1, 0]) == (0, 255, 255)
    channels = np.stack([error, -error, error], -1)
    np.testing.assert_array_equal(report.colorize_error(channels), picture)
    np.testing.assert_array_equal(report.colorize_error(2 * error, limit=0.5), picture)
    ordered = report.colorize_error(np.linspace(0, 0.25, 256, dtype=np.float32)[None])
    luminance = ordered[0] @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) > -0.5).all()
    assert luminance[-1] > 200


def test_colorize_causes():
    index_map = np.arange(len(CAUSES) * 2).reshape(2, -1) % len(CAUSES)
    picture = report.colorize_causes(index_map)
    assert picture.shape == (2, len(CAUSES), 3)
    found = ["#" + bytes(color).hex() for color in picture[0]]
    assert found == [report.CAUSE_COLORS[cause] for cause in CAUSES]
    assert len(set(found)) == len(CAUSES)


@pytest.mark.usefixtures("unchecked")
def test_errors():
    with pytest.raises(ValueError, match=r"error: expected shape \[H, W\] or \[H, W, C\], got \[3\]"):
        report.colorize_error(np.zeros(3))
    with pytest.raises(ValueError, match="limit: expected a number above 0, got 0"):
        report.colorize_error(np.zeros((2, 3)), limit=0)
    with pytest.raises(ValueError, match=r"index_map: expected shape \[H, W\], got \[2, 3, 1\]"):
        report.colorize_causes(np.zeros((2, 3, 1), int))
    with pytest.raises(ValueError, match=r"index_map: expected indices 0..5 \(border, .*\), got 0..6"):
        report.colorize_causes(np.array([[0, 6]]))


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="its folder does not exist"):
        report.write_report({}, tmp_path / "nowhere")


@pytest.fixture(scope="module")
def browse(tmp_path_factory):
    """Opens a page in headless Chromium with the given options, and returns what that prints."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
    if program is None:
        pytest.skip("no Chromium on PATH")
    profile = tmp_path_factory.mktemp("profile")
    switches = ["headless", "no-sandbox", "disable-gpu", "disable-background-networking", "disable-component-update"]
    switches += [
        "disable-sync",
        "no-first-run",
        "hide-scrollbars",
        f"user-data-dir={profile}",
        "virtual-time-budget=3000",
    ]

    def run(path, *options, fragment=""):
        command = [program, *(f"--{s}" for s in (*switches, *options)), path.resolve().as_uri() + fragment]
        return subprocess.run(command, capture_output=True, timeout=120, check=True).stdout.decode()

    return run


def root_of(dump):
    """The attributes of <html> in a dump of the page."""
    return dict(re.findall(r'([\w-]+)="([^"]*)"', re.search(r"<html([^>]*)>", dump)[1]))


@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.slow)])
def test_browser_runs_the_script_and_moves_the_slider(tmp_path, browse, width):
    path = report.write_report(complete(tmp_path), tmp_path)
    root = root_of(browse(path, "dump-dom", f"window-size={width},1200", fragment="#selftest"))
    assert "data-error" not in root
    assert root["data-ready"] == "1"
    start, moved, dragged, keyed, picked = (state.split("|") for state in root["data-selftest"].split(";"))
    assert start == ["50", "inset(0px 50% 0px 0px)", "Frame 4: image by guided_warp, 30.3 dB"]
    assert moved[:2] == ["20", "inset(0px 80% 0px 0px)"]
    assert float(dragged[0]) == pytest.approx(80, abs=1)
    assert float(keyed[0]) == pytest.approx(78, abs=1)
    assert picked[2] == "Frame 4: the true image"
    assert root["data-selftest-zoom"] == "4"
    assert root["data-selftest-overflow"] == "0"


def test_browser_does_not_run_hostile_names(tmp_path, browse):
    results = complete(tmp_path, methods=HOSTILE)
    results |= {"input": HOSTILE[0], "notes": list(HOSTILE)}
    root = root_of(browse(report.write_report(results, tmp_path), "dump-dom", fragment="#selftest"))
    assert "data-hacked" not in root
    assert "data-error" not in root
    assert root["data-ready"] == "1"


@pytest.mark.parametrize("width", [1280, 390])
def test_browser_shows_several_inputs_without_overflow(tmp_path, browse, width):
    path = report.write_report(several(tmp_path), tmp_path)
    root = root_of(browse(path, "dump-dom", f"window-size={width},1200", fragment="#selftest"))
    assert "data-error" not in root
    assert root["data-ready"] == "0"
    assert root["data-selftest-overflow"] == "0"


@pytest.mark.parametrize("scheme, ground", [(1, (246, 247, 248)), (0, (16, 19, 22))])
def test_browser_draws_the_page_light_and_dark(tmp_path, browse, scheme, ground):
    path = report.write_report(complete(tmp_path), tmp_path)
    shot = tmp_path / "shot.png"
    browse(path, f"screenshot={shot}", "window-size=390,2400", f"blink-settings=preferredColorScheme={scheme}")
    with Image.open(shot) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape == (2400, 390, 3)
    assert tuple(pixels[2, 2]) == ground
    saturated = np.ptp(pixels.astype(int), -1) > 100
    assert saturated.mean() > 0.02  # plots and pictures are drawn, not only text
