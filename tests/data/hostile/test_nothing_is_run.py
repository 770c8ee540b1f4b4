"""Nothing that a file holds is run: nothing of the package unpickles."""

import ast
import pickle
from pathlib import Path

import numpy as np
import pytest

import mdnvo_jax
from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data.cache import prepare_cache, read_cache
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.evaluation import formats
from mdnvo_jax.model import flownet


class Marker:
    """What, unpickled, makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_hostile_files_are_not_run(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    payload = np.array([Marker(marker)], dtype=object)
    np.savez(tmp_path / "a.npz", logits=payload, mean=payload, log_scale=payload, conv1=payload)
    (tmp_path / "a.pth").write_bytes(pickle.dumps({"state_dict": Marker(marker)}))
    sequence = Sequence("toy", 2, lambda _: np.zeros((4, 8, 1), np.uint8))
    config = ImageConfig(height=4, width=8, channels=1)
    prepare_cache([sequence], config, tmp_path / "cache")
    np.save(tmp_path / "cache" / "toy.npy", payload)
    output = tmp_path / "output"
    output.mkdir()
    (output / "trajectory_kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    (tmp_path / "a.npz").rename(output / "mixture.npz")
    for read in (
        lambda: formats.read_trajectory(output),
        lambda: flownet.load_stack(output / "mixture.npz", {"params": {"stack": {}}}),
        lambda: read_cache(tmp_path / "cache", config),
        lambda: flownet.read_flownet(tmp_path / "a.pth", order="rgb"),
    ):
        with pytest.raises(InputError):
            read()
        assert not marker.exists()
    pickle.loads((tmp_path / "a.pth").read_bytes())
    assert marker.exists(), "the files would do harm if they were unpickled"


def test_nothing_of_the_package_unpickles() -> None:
    package = Path(mdnvo_jax.__file__).parent
    for path in [*package.rglob("*.py"), *(package.parent / "bin").glob("*")]:
        text = path.read_text()
        if path.suffix != ".py" and "python" not in text.splitlines()[0]:
            continue
        for node in ast.walk(ast.parse(text)):
            named = [alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
            named += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            bad = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"} & set(named)
            assert not bad, f"{path}:{node.lineno} imports {bad}"
            if not isinstance(node, ast.Call):
                continue
            call = ast.unparse(node.func)
            assert call not in ("eval", "exec", "torch.load", "pd.read_pickle"), f"{path}:{node.lineno}"
            if call in ("np.load", "numpy.load"):
                given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                assert given.get("allow_pickle", "False") == "False", f"{path}:{node.lineno}"
