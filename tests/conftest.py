"""What every test may use."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

# How long an example takes says more about the machine's load than about the code.
hypothesis.settings.register_profile("mdnvo", deadline=None)
hypothesis.settings.load_profile("mdnvo")

# Programs that several tests and the processes they start compile alike are compiled once, and the small ones are many.
_CACHE = tempfile.TemporaryDirectory(prefix="mdnvo-test-cache-")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", _CACHE.name)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# Tests compute little and compile much: without optimisation they take half as long, and programs are compiled in a
# third of what is left where XLA's older emitters write the fused loops.
_QUICK = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_QUICK}".strip()


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real clips; without it the test is skipped."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    root = Path(os.environ.get("MDNVO_DATA", default))
    if not root.is_dir():
        pytest.skip(f"no real data at {root}: set MDNVO_DATA to the folder that holds kitti/ and trajectories/")
    return root


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX in float64."""
    import jax  # reads the environment above when it is imported

    with jax.enable_x64(True):
        yield
