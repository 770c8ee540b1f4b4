"""A named run of frames: how to read frame i, and what is known about it."""

import dataclasses
from collections import abc

import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.errors import InputError

# Intrinsics fx, fy, cx, cy of a pinhole camera in pixels; the centre of the top left pixel is (0, 0).
Camera = tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class Sequence:
    """A run of frames in the order of time, read one at a time.

    Attributes:
      name: what messages and files call it, such as "00".
      count: number of frames N.
      read: takes a frame's index, 0 to N-1, and returns the decoded frame, uint8 `[h, w, C]`, RGB or grey. May be
        called by several threads at once.
      timestamps: `[N]`, s, float64, or None.
      poses: `T_world_camera` of every frame, `[N, 4, 4]`, m, float64, rotations in SO(3), or None.
      camera: intrinsics of the decoded frame, or None.
      paths: what to call each frame in a message, `N` names, or empty: the name and the index are used.
      in_order: whether frames are cheap to read in order only, as those of a video are.
      flow: takes a frame's index and returns the optical flow to the next frame on a map of the network
        (`network.flow_size`), in pixels of that map, `[h, w, 2]`; NaN where it is not known. None where none is known.

    Raises:
      InputError: timestamps, poses or paths are not one a frame, or are not finite.
    """

    name: str
    count: int
    read: abc.Callable[[int], np.ndarray]
    timestamps: np.ndarray | None = None
    poses: np.ndarray | None = None
    camera: Camera | None = None
    paths: abc.Sequence[str] = ()
    in_order: bool = False
    flow: abc.Callable[[int], np.ndarray] | None = None

    def __post_init__(self) -> None:
        for what, values, shape in (("timestamps", self.timestamps, ()), ("poses", self.poses, (4, 4))):
            if values is None:
                continue
            if values.shape != (self.count, *shape):
                raise InputError(
                    f"sequence {self.name}: {what} of shape {values.shape} for {self.count} frames: "
                    f"expected {(self.count, *shape)}, one a frame"
                )
            if not np.isfinite(values).all():
                frame = int(np.argwhere(~np.isfinite(values))[0][0])
                raise InputError(f"sequence {self.name}: frame {frame} has {what} that are not finite: mend the source")
        if len(self.paths) not in (0, self.count):
            raise InputError(
                f"sequence {self.name}: {len(self.paths)} paths for {self.count} frames: expected one a frame"
            )
        camera = self.camera
        if camera is not None and not (len(camera) == 4 and np.isfinite(camera).all() and min(camera[:2]) > 0):
            raise InputError(
                f"sequence {self.name}: camera {camera}: expected the four numbers fx, fy, cx, cy, fx and fy above 0"
            )

    def steps(self, stride: int = 1) -> np.ndarray:
        """Return the labels: step of frame i to i + stride as (tx, ty, tz, rx, ry, rz), `[N - stride, 6]`, m and rad.

        With t counted in strides, `T_{t-1,t} = inv(T_world_{t-1}) @ T_world_t`. float64.

        Raises:
          InputError: the sequence has no poses.
        """
        if self.poses is None:
            raise InputError(f"sequence {self.name} has no poses, so no labels: training and evaluation need them")
        return geometry.matrix_to_step(geometry.compose(geometry.inverse(self.poses[:-stride]), self.poses[stride:]))

    def subsequence(self, start: int, stop: int) -> "Sequence":
        """Return frames `start` up to, not including, `stop`; poses and timestamps keep their values.

        Raises:
          InputError: the range is empty or leaves the sequence.
        """
        if not 0 <= start < stop <= self.count:
            raise InputError(f"sequence {self.name} has {self.count} frames: frames {start} to {stop} are not in it")
        flow = self.flow
        return dataclasses.replace(
            self,
            count=stop - start,
            read=lambda index: self.read(start + index),
            flow=None if flow is None else lambda index: flow(start + index),
            timestamps=None if self.timestamps is None else self.timestamps[start:stop],
            poses=None if self.poses is None else self.poses[start:stop],
            paths=self.paths[start:stop],
        )

    def label(self, index: int) -> str:
        """Return what to call frame `index` in a message."""
        return self.paths[index] if self.paths else f"frame {index} of sequence {self.name}"


def rigid(poses: np.ndarray) -> np.ndarray:
    """Return `poses`, `[N, 3 or 4, 4]`, as `[N, 4, 4]` float64 with each rotation block moved to the nearest rotation.

    Files carry few digits (KITTI's seven), so that their rotations are not quite in SO(3) and labels made of them would
    not compose to the poses again.
    """
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, 3] = poses[:, :3, 3]
    result[:, :3, :3] = geometry.project_to_so3(np.asarray(poses[:, :3, :3], np.float64))
    return result


def one_size(read: abc.Callable[[int], np.ndarray], label: abc.Callable[[int], str]) -> abc.Callable[[int], np.ndarray]:
    """Return `read` with a check that every frame has the size of the first one that was read.

    Raises:
      InputError: (the returned function) a size differs; the message names both frames, as `label` calls them.
    """
    first: dict[str, tuple[tuple[int, int], str]] = {}

    def checked(index: int) -> np.ndarray:
        frame = read(index)
        size = (frame.shape[0], frame.shape[1])
        # One call, so that of several threads only one sets the size.
        expected, name = first.setdefault("size", (size, label(index)))
        if size != expected:
            raise InputError(
                f"{label(index)} is {size[1]}x{size[0]} but {name} is {expected[1]}x{expected[0]}: "
                "expected frames of one camera, all of one size"
            )
        return frame

    return checked
