"""Data parallelism over all devices: one mesh, the batch split over it, everything else on every device.

The step is compiled once for the whole mesh (jit with shardings), so that it computes what one device would compute on
the whole batch: the gradient is that of the global batch and batch normalisation sees all of it. `jax.pmap` of the
same step would need `axis_name`, `lax.pmean` of gradients and metrics, and the axis name handed to batch
normalisation, to arrive at the same numbers; JAX keeps pmap in maintenance mode, on top of the same machinery.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from mdnvo_jax.errors import InputError

_any = jax.jit(jax.numpy.any)


def make_mesh(batch_size: int, devices: int | None = None, *, accumulate: int = 1) -> Mesh:
    """Return a mesh with one axis `data` over `devices` devices, or over all.

    Raises:
      InputError: the devices, and the parts that each takes its share in, do not divide the batch.
    """
    found = jax.devices()[:devices]
    if accumulate < 1 or batch_size % (len(found) * accumulate):
        parts = f", in {accumulate} parts each (training.accumulate)" if accumulate != 1 else ""
        raise InputError(
            f"training.batch_size is {batch_size}: expected a multiple of the {len(found)} devices that share it{parts}"
        )
    return jax.make_mesh((len(found),), ("data",), axis_types=(AxisType.Auto,), devices=found)


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of what every device holds."""
    return NamedSharding(mesh, PartitionSpec())


def split(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a batch: its first axis is spread over the devices."""
    return NamedSharding(mesh, PartitionSpec("data"))


def compile_step(function: Callable[..., Any], mesh: Mesh, *, donate: bool) -> jax.stages.Wrapped:
    """Compile `function(state, batch)` for the mesh; everything it returns is on every device.

    Args:
      function: a pure function of a replicated state and a split batch.
      mesh: the devices.
      donate: whether the state's memory may be reused for the result.
    """
    return jax.jit(
        function,
        in_shardings=(replicated(mesh), split(mesh)),
        out_shardings=replicated(mesh),
        donate_argnums=(0,) if donate else (),
    )


def anywhere(here: bool, mesh: Mesh) -> bool | jax.Array:
    """Return whether `here` is true in any process; of several, as an array that is computed in turn with the steps."""
    if jax.process_count() == 1:
        return here
    rows = np.full(len(mesh.local_devices), here)
    return _any(jax.make_array_from_process_local_data(split(mesh), rows))


def place(batch: dict[str, np.ndarray], mesh: Mesh) -> dict[str, jax.Array]:
    """Put the rows of a batch that this process read on its devices; together they are the global batch."""
    return {name: jax.make_array_from_process_local_data(split(mesh), value) for name, value in batch.items()}
