"""What all tests share: annotations checked at run time, strict promotion, float64, and the folder of large data."""

import atexit
import os
import shutil
import tempfile

import jaxtyping
import pytest

CHECKED = os.environ.get("JAXTRAPOLATE_TYPECHECK", "1") != "0"


def check_annotations(function):
    """beartype on every function of the library but those that build a record, where transformations put any leaf."""
    from beartype import beartype

    return function if function.__name__ == "__init__" else beartype(function)


if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # What one process has compiled the others need not, nor commands that tests call: workers inherit the variables.
    _compiled = tempfile.mkdtemp(prefix="jaxtrapolate-tests-")
    atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": _compiled, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3"}

if "PYTEST_XDIST_WORKER" not in os.environ:
    # What the user has measured here is none of the tests' business: they have a cache folder of their own.
    _cache = tempfile.mkdtemp(prefix="jaxtrapolate-tests-cache-")
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)
    os.environ["XDG_CACHE_HOME"] = _cache


def pytest_configure(config):
    """The fast tests alone let LLVM leave out what makes programs faster: most of their time is compilation.

    With slow ones among them, programs are those that users get.
    """
    if config.option.markexpr == "not slow" and "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"


if CHECKED:
    jaxtyping.install_import_hook("jaxtrapolate", "conftest.check_annotations")

import jax  # noqa: E402  the hook comes before all that may import the library


@pytest.fixture(scope="session")
def typechecked():
    """Skip where the annotations are not checked."""
    if not CHECKED:
        pytest.skip("JAXTRAPOLATE_TYPECHECK=0")


@pytest.fixture
def unchecked():
    """Without the type checker: the library's own errors are seen, and NumPy arrays are taken."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def strict():
    """No implicit promotion of dtypes or ranks, in the library and in the test."""
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture
def x64():
    """64-bit types, for comparisons and gradient checks in float64."""
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):  # strict, float64 and float32 have no common type
        yield


@pytest.fixture(scope="session")
def data():
    """The folder of large data, which JAXTRAPOLATE_DATA names."""
    from pathlib import Path

    folder = os.environ.get("JAXTRAPOLATE_DATA")
    if not folder:
        pytest.skip("JAXTRAPOLATE_DATA is not set")
    path = Path(folder)
    assert path.is_dir(), f"JAXTRAPOLATE_DATA={folder} is not a folder"
    return path
