"""A stand-in for pyorbslam3, and a vocabulary for it."""

import gzip
import os

import pytest
from orbslam_stand_in import STAND_IN, WORDS


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Put a stand-in for pyorbslam3 before the real one, here and in processes started here."""
    folder = tmp_path / "site"
    (folder / "pyorbslam3-0.0.7.dist-info").mkdir(parents=True)
    (folder / "pyorbslam3-0.0.7.dist-info" / "METADATA").write_text("Name: pyorbslam3\nVersion: 0.0.7\n")
    (folder / "pyorbslam3.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return folder


@pytest.fixture
def vocabulary(tmp_path):
    path = tmp_path / "words.txt.gz"
    path.write_bytes(gzip.compress(WORDS.encode(), mtime=0))
    return path
