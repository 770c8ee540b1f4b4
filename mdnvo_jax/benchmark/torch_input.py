"""The input of training as a `torch.utils.data.DataLoader`: the windows and pixels of ours.

It imports torch at its head: only the section that found torch imports this module, and the loader's workers.
"""

from collections.abc import Iterator
from collections.abc import Sequence as Many

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data.images import prepare, read_image


class Windows(Dataset):
    """Windows of frames `[T+1, H, W, C]` uint8 with their steps `[T, 6]`."""

    def __init__(self, frames: Many[str] | str, steps: np.ndarray, window: int, image: ImageConfig) -> None:
        """Take the paths of pictures, or the path of an array of prepared frames."""
        self.frames, self.steps, self.window, self.image = frames, steps.astype(np.float32), window, image

    def __len__(self) -> int:
        return len(self.steps) - self.window + 1

    def __getitem__(self, start: int) -> tuple[torch.Tensor, torch.Tensor]:
        stop = start + self.window
        if isinstance(self.frames, str):
            frames = np.load(self.frames, mmap_mode="r")[start : stop + 1].copy()
        else:
            chosen = self.frames[start : stop + 1]
            frames = np.stack([prepare(read_image(path, self.image.channels), None, self.image) for path in chosen])
        return torch.from_numpy(frames), torch.from_numpy(self.steps[start:stop])


class Draw(torch.utils.data.Sampler):
    """As many windows as are asked for, drawn at random."""

    def __init__(self, windows: int, count: int) -> None:
        self.order = np.random.default_rng(0).integers(0, windows, count).tolist()

    def __iter__(self) -> Iterator[int]:
        return iter(self.order)

    def __len__(self) -> int:
        return len(self.order)


def loader(windows: Windows, batch: int, batches: int, workers: int) -> DataLoader:
    """Return a loader of so many batches; its workers live on from one pass to the next."""
    return DataLoader(
        windows,
        batch_size=batch,
        sampler=Draw(len(windows), batch * batches),
        num_workers=workers,
        persistent_workers=workers > 0,
        # JAX runs threads in this process: a plain fork may come at a bad moment.
        multiprocessing_context="forkserver" if workers else None,
        worker_init_fn=_one_thread,
    )


def _one_thread(worker: int) -> None:
    """Leave OpenCV one thread in each worker: there is a worker for every core."""
    del worker
    cv2.setNumThreads(1)
