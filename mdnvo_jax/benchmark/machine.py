"""What a figure has beside it: processor, threads, versions, load."""

import datetime
import os
import platform
import shlex
import sys
from pathlib import Path
from typing import Any

# What decides how fast a processor multiplies.
_FLAGS = ("avx2", "fma", "avx512f", "avx512_vnni", "avx512_bf16", "avx512_fp16", "amx_tile", "amx_int8", "amx_bf16")
_PEERS = ("openvino", "torch", "numpyro")


def describe(threads: int) -> dict[str, Any]:
    """Return the machine, the versions and the command."""
    # Here, so that a process whose memory is measured does without it.
    from mdnvo_jax.training.logs import versions

    cpu = _cpu_info()
    flags = cpu.get("flags", "").split()
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "command": shlex.join(sys.orig_argv),
        "processor": cpu.get("model name") or platform.processor() or platform.machine(),
        "processor_family_model_stepping": " ".join(cpu.get(key, "?") for key in ("cpu family", "model", "stepping")),
        "flags": [flag for flag in _FLAGS if flag in flags],
        "flags_missing": [flag for flag in _FLAGS if flag not in flags],
        "cores": os.cpu_count(),
        "threads": threads,
        "platform": platform.platform(),
        "memory_gb": _memory_gb(),
        "versions": versions(*_PEERS),
    }


def load_average() -> float | None:
    """Return how many processes wanted to run over the last minute, None where the system does not tell."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory_mb() -> float:
    """Return the most memory that this process ever held.

    `getrusage` tells of the program that started this one as well, where that held more when it did.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import resource

    unit = 1024**2 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _cpu_info() -> dict[str, str]:
    """Return what Linux says of the first processor, nothing elsewhere."""
    path = Path("/proc/cpuinfo")
    if not path.exists():
        return {}
    first = path.read_text().split("\n\n")[0]
    pairs = (line.partition(":") for line in first.splitlines())
    return {key.strip(): value.strip() for key, _, value in pairs}


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (ValueError, OSError, AttributeError):
        return None
