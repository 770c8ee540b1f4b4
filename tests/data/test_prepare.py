import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from nuscenes_fixture import SCENES, VERSION, write_nuscenes

from mdnvo_jax.config import Config, DataConfig, ImageConfig
from mdnvo_jax.data import cache, load, windows
from mdnvo_jax.data.prepare import main
from mdnvo_jax.errors import InputError

SCRIPT = Path(__file__).resolve().parents[2] / "bin" / "prepare_kitti"
SIZE = ["--height", "20", "--width", "62"]


def test_it_says_how_much_it_will_write_and_resumes(kitti_root, tmp_path, capsys):
    arguments = ["--root", str(kitti_root), "--output", str(tmp_path / "c"), *SIZE]
    main([*arguments, "--sequences", "07"])
    out = capsys.readouterr().out
    assert "1 sequences, 8 frames as 62x20x3: 1 MB in " in out and "1 MB are to be written" in out
    camera = windows.resolve_camera(cache.read_cache(tmp_path / "c", ImageConfig(20, 62)), ImageConfig(20, 62)).camera
    # Without --sequences: all that have poses. The virtual camera stays the one of the cache, whatever theirs.
    calibration = kitti_root / "sequences" / "00" / "calib.txt"
    calibration.write_text(calibration.read_text().replace("72.0", "80.0"))
    main(arguments)
    out = capsys.readouterr().out
    assert "2 sequences, 20 frames" in out and "8/8" in out and "12/12" in out
    for sequence in cache.read_cache(tmp_path / "c", ImageConfig(20, 62, camera=camera)):
        assert sequence.camera == camera
    main(arguments)
    assert "of which 0 MB are to be written" in capsys.readouterr().out


def test_the_config_and_the_options_decide(kitti_root, tmp_path, capsys):
    config = tmp_path / "config.py"
    config.write_text(
        "from mdnvo_jax.config import *\n"
        "config = Config(image=ImageConfig(24, 70, 1), data=DataConfig(camera_folder='image_0'))\n"
    )
    arguments = ["--root", str(kitti_root), "--sequences", "07", "--config", str(config)]
    main([*arguments, "--output", str(tmp_path / "a")])
    assert cache.read_cache(tmp_path / "a", ImageConfig(24, 70, 1))[0].read(0).shape == (24, 70, 1)
    main([*arguments, "--output", str(tmp_path / "b"), "--height", "30", "--camera-folder", "image_2"])
    assert cache.read_cache(tmp_path / "b", ImageConfig(30, 70, 1))[0].read(0).shape == (30, 70, 1)


def test_nuscenes_is_prepared_for_training(tmp_path, capsys):
    """What cannot be used is left out and said; training from the cache is training from the files."""
    root, size = tmp_path / "data", ["--height", "18", "--width", "32"]
    write_nuscenes(root, SCENES[:6], frames=7)
    arguments = ["--dataset", "nuscenes", "--nuscenes-version", VERSION, "--root", str(root), *size]
    main([*arguments, "--output", str(tmp_path / "all")])
    said = capsys.readouterr()
    assert "4 sequences, 26 frames as 32x18x3" in said.out
    assert "scenes left out, of fewer than 2 frames: 1 (scene-0553)" in said.err
    assert "scenes left out, with images that are not on disk: 1 (scene-0103)" in said.err
    data = DataConfig("nuscenes", train_sequences=(), window=2)
    splits = [
        load.load_split(Config(image=ImageConfig(18, 32), data=dataclasses.replace(data, **source)))[:2]
        for source in ({"root": str(root), "version": VERSION}, {"cache": str(tmp_path / "all")})
    ]
    for files, cached in zip(*splits, strict=True):
        assert [s.name for s in files] == [s.name for s in cached] and len(files) in (1, 3)
        np.testing.assert_array_equal(files[0].poses, cached[0].poses)
        assert cached[0].read(0).shape == (18, 32, 3)
    # A config says which data set, and scenes can be named.
    config = tmp_path / "config.py"
    config.write_text(
        "from mdnvo_jax.config import *\n"
        f"config = Config(data=DataConfig('nuscenes', version='{VERSION}', key_frames_only=True))\n"
    )
    given = ["--config", str(config), "--root", str(root), "--sequences", "scene-1077", *size]
    main([*given, "--output", str(tmp_path / "one")])
    assert [(s.name, s.count) for s in cache.read_cache(tmp_path / "one", ImageConfig(18, 32))] == [("scene-1077", 2)]


def test_nuscenes_without_a_scene_to_prepare(tmp_path):
    write_nuscenes(tmp_path, SCENES[2:3])
    arguments = ["--dataset", "nuscenes", "--nuscenes-version", VERSION, "--root", str(tmp_path)]
    with pytest.raises(InputError, match=r"no scene of v1\.0-mini with two frames"):
        main([*arguments, "--output", str(tmp_path / "c")])
    with pytest.raises(InputError, match=r"no folder v1\.0-trainval in"):
        main([*arguments[:2], *arguments[4:], "--output", str(tmp_path / "c")])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sequences", "00", "05"], "no sequence 05 in .*: found 00, 07"),
        (["--sequences", "00", "00"], "each name once"),
        (["--camera-folder", "image_1"], "no folder image_1 in .*: found image_0, image_2"),
        (["--camera-folder", "left"], "no folder left in"),
        (["--height", "0"], "--height 0"),
        (["--channels", "2"], "invalid choice: 2"),
        (["--config", "none.py"], "no config file 'none.py'"),
    ],
)
def test_mistakes_are_named(kitti_root, tmp_path, arguments, message):
    with pytest.raises(InputError, match=message):
        main(["--root", str(kitti_root), "--output", str(tmp_path / "c"), *arguments])
    assert not (tmp_path / "c").exists()


def test_a_root_without_poses(tmp_path):
    with pytest.raises(InputError, match=r"no poses/\*.txt in"):
        main(["--root", str(tmp_path), "--output", str(tmp_path / "c")])


def run(*arguments, python=()):
    # The package may be found by the working folder only: the script has to work from a checkout.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SCRIPT.parents[1]), *sys.path])}
    return subprocess.run(
        [sys.executable, *python, str(SCRIPT), *arguments], capture_output=True, text=True, env=environment
    )


def test_the_script_answers_help_quickly_and_mistakes_in_one_line(tmp_path):
    assert os.access(SCRIPT, os.X_OK)
    helped = run("--help", python=["-X", "importtime"])
    assert helped.returncode == 0 and "--camera-folder" in helped.stdout
    imported = {line.rpartition("|")[2].strip() for line in helped.stderr.splitlines()}
    assert "mdnvo_jax.data.prepare" in imported and not imported & {"numpy", "jax", "cv2", "grain", "rich"}
    failed = run("--root", str(tmp_path), "--output", str(tmp_path / "c"))
    assert failed.returncode == 2 and failed.stderr.startswith("error: no poses/*.txt in")
    assert len(failed.stderr.splitlines()) == 1


def test_rendered_worlds_are_prepared_with_their_flow(tmp_path, capsys):
    config = tmp_path / "config.py"
    config.write_text(
        "from mdnvo_jax.config import *\n"
        "config = Config(image=ImageConfig(20, 62, 1, camera=(31.0, 31.0, 30.5, 8.0)),\n"
        "    data=DataConfig(dataset='synthetic', worlds=1, world_frames=3, validation_worlds=1))\n"
    )
    arguments = ["--config", str(config), "--dataset", "synthetic", "--output", str(tmp_path / "c")]
    main(arguments)
    assert "2 sequences, 6 frames as 62x20x1" in capsys.readouterr().out
    flow = [s.flow(0).shape for s in cache.read_cache(tmp_path / "c", ImageConfig(20, 62, 1))]
    assert flow == [(3, 8, 2), (3, 8, 2)]
    with pytest.raises(InputError, match="takes its worlds from --config"):
        main([*arguments, "--root", "there"])
    with pytest.raises(InputError, match="--root is missing: give the folder of kitti"):
        main(["--output", str(tmp_path / "d")])
