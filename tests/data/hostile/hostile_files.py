"""Damage for files, and a check that what reads them gives something or refuses in one line; no test itself."""

import os
from collections.abc import Callable

import cv2
import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from mdnvo_jax.errors import InputError

PICTURE = cv2.GaussianBlur(np.random.default_rng(2).integers(0, 256, (24, 32, 3), dtype=np.uint8), (0, 0), 2)
# A soak asks for more than an ordinary run of the tests.
EXAMPLES = int(os.environ.get("MDNVO_FUZZ_EXAMPLES", "60"))
quickly = settings(
    max_examples=EXAMPLES,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def in_one_line(read: Callable[[], object]) -> object:
    """Return what `read` gives, or None where it refuses as it should."""
    try:
        return read()
    except InputError as error:
        assert len(str(error)) < 1000
        return None


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Bytes of a whole file with some changed, some cut out, some put in, and perhaps the end missing."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(data) - 1))
        # The first bytes say most.
        at = draw(st.sampled_from([at, at % 64]))
        kind = draw(st.sampled_from(["flip", "cut", "insert"]))
        if kind == "flip":
            data[at] ^= draw(st.integers(1, 255))
        elif kind == "cut" and len(data) > 8:
            del data[at : at + draw(st.integers(1, 4))]
        else:
            data[at:at] = draw(st.binary(max_size=4))
        if not data:
            break
    return bytes(data[: draw(st.sampled_from([len(data), draw(st.integers(0, len(data)))]))])
