"""Stiff and extreme inputs: every row of `extreme_cases` for every public function, loss and method."""

import jax
import pytest
import small_extranet
import test_api
import test_settings
from extreme_cases import (
    EVERYWHERE,
    LISTED,
    MEANS,
    REACHES,
    Case,
    cropped,
    differentiated,
    examine,
    function_cases,
    leaf_kinds,
    method_case,
    verdict,
)

import jaxtrapolate as jx

FUNCTIONS = function_cases()
METHODS = jx.method_names()
QUICK = ("backward_warp", "chain_motion", "splat-linear", "tonemap", "compress", "log_decode", "demodulate", "psnr")
QUICK += ("relative_loss", "camera_motion", "splat_nearest", "hole_loss", "convert_motion", "surface_depth")
QUICK_METHODS = ("repeat", "warp", "blend")


def names(all_names, quick):
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in all_names]


def judge(name: str, case: Case) -> None:
    """Each row is finite, or listed and then not; one pixel that is not a number stays near."""
    found = examine(case)
    wrong = {row: what for row, what in found["rows"].items() if what and (name, row) not in LISTED}
    assert not wrong
    assert not {row for row, what in found["rows"].items() if not what and (name, row) in LISTED}, "listed, but finite"
    value, gradient = found["reach"]
    if name.split("-")[0] not in MEANS:
        assert max(value, gradient) <= REACHES.get(name, REACHES[""])


@pytest.mark.parametrize("name", names(FUNCTIONS, QUICK))
def test_functions(unchecked, name):
    judge(name, FUNCTIONS[name])


@pytest.mark.parametrize("name", names(METHODS, QUICK_METHODS))
def test_methods(unchecked, name):
    judge(name, method_case(name, (40, 48)))


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in FUNCTIONS if n.split("-")[0] != "ssim"])
def test_sizes_of_functions(unchecked, name):
    """Value and gradient of images of one pixel, one row, one column, and odd sizes."""
    case = FUNCTIONS[name]
    equal = name.split("-")[0] == "psnr"
    for size in ((1, 1), (1, 9), (9, 1), (7, 5)):
        results, gradients = differentiated(case.function)(cropped(case.arguments, size))
        usual = name == "forecast" or equal or not verdict(results, ())
        assert usual
        assert not verdict((), gradients), size


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (7, 5)], ids=str)
@pytest.mark.parametrize("name", METHODS)
def test_sizes_of_methods(unchecked, name, size):
    case = method_case(name, (24, 30))
    results = jax.jit(case.function)(*cropped(case.arguments, size))
    scale = small_extranet.load(name).scale
    assert results.shape == (scale * size[0], scale * size[1], 3)
    assert not verdict(results, ())


def test_every_public_function_has_rows():
    """Those that take arrays; all losses are in the list of `test_settings`, whose test sees to it."""
    covered = {name.split("-")[0] for name in FUNCTIONS} | {"cause_map", "disoccluded"}  # of integers and bools
    others = {"load", "open_sequence", "evaluate", "method_names", "keep_memory", "replace"}
    assert {name for name in test_api.FUNCTIONS if "." not in name} <= covered | others
    assert {name.split("-")[0] for name in test_settings.ALL} <= covered
    assert {name for name, _ in LISTED} <= set(FUNCTIONS)
    for name, case in FUNCTIONS.items():
        assert set(leaf_kinds(case)) - {""}, f"{name}: no argument has a kind"
    assert max(REACHES.values()) < EVERYWHERE
