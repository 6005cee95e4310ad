"""The device that torch computes on, its number of threads and its precision."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from tungsten_dip.cores import thread_count
from tungsten_dip.errors import InputError
from tungsten_dip.fit.settings import FitSettings

_MAKING_LAYERS = threading.Lock()


def check_torch_device(device: str) -> None:
    """Raise InputError if torch cannot compute there."""
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: expected one that torch can use, found none; use cpu or auto")


@contextmanager
def compute_device(settings: FitSettings) -> Iterator[torch.device]:
    """Yield the device of the settings; meanwhile, torch uses their number of threads.

    Gradients are on, whatever the caller's contexts.

    Raises InputError if torch cannot compute on the device.
    """
    check_torch_device(settings.device)
    use_cuda = settings.device != "cpu" and torch.cuda.is_available()
    threads_before = torch.get_num_threads()
    torch.set_num_threads(thread_count(settings.threads))
    try:
        with torch.inference_mode(False), torch.enable_grad():
            yield torch.device("cuda" if use_cuda else "cpu")
    finally:
        torch.set_num_threads(threads_before)


@contextmanager
def seeded_layers(seed: int) -> Iterator[None]:
    """Let layers that are made meanwhile have float32 weights on the CPU, drawn with this seed.

    Type and seed are global in torch: one thread at a time, and afterwards they are as before.
    """
    with _MAKING_LAYERS, torch.random.fork_rng(devices=[]), torch.device("cpu"):
        dtype = torch.get_default_dtype()
        torch.set_default_dtype(torch.float32)
        torch.default_generator.manual_seed(seed)
        try:
            yield
        finally:
            torch.set_default_dtype(dtype)


def convolution_dtype(device: torch.device) -> torch.dtype:
    """Return bfloat16 where the processor computes with it, else float32."""
    capabilities: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
    native = bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
    return torch.bfloat16 if device.type == "cpu" and native else torch.float32
