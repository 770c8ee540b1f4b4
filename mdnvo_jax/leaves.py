"""How the arrays of a pytree are named: by their path, joined by dots, such as "params.stack.conv1.kernel"."""

from typing import Any

import jax


def by_name(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by their names, in the order of `jax.tree.leaves`."""
    leaves = jax.tree.leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
