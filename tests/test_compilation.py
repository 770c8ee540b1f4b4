"""Where compiled programs are kept."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mdnvo_jax import compilation

SCRIPT = """
import jax
from mdnvo_jax import compilation
print(compilation.keep_compiled())
jax.jit(lambda x: x * 3 + 1)(2.0)
"""


def run(**variables: str) -> str:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= variables
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.strip()


def test_programs_are_kept_in_the_users_cache_folder_and_found_again(tmp_path: Path) -> None:
    folder = tmp_path / "mdnvo_jax" / "xla"
    assert run(XDG_CACHE_HOME=str(tmp_path)) == str(folder)
    first = sorted(folder.iterdir())
    assert any(path.name.endswith("-cache") for path in first)
    assert run(XDG_CACHE_HOME=str(tmp_path)) == str(folder)
    assert [path for path in sorted(folder.iterdir()) if path.name.endswith("-cache")] == [
        path for path in first if path.name.endswith("-cache")
    ]


def test_without_xdg_it_is_below_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(XDG_CACHE_HOME="", HOME=str(tmp_path)) == str(tmp_path / ".cache" / "mdnvo_jax" / "xla")


def test_the_variable_of_jax_comes_first(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    assert run(XDG_CACHE_HOME=str(tmp_path), JAX_COMPILATION_CACHE_DIR=str(theirs)) == "None"
    assert not (tmp_path / "mdnvo_jax").exists()


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(compilation.VARIABLE, raising=False)
    (tmp_path / "mdnvo_jax").write_text("a file in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compilation.keep_compiled() is None
