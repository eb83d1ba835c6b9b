"""Timing of captured work: variants in turns, many launches a replay, the median of many rounds."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import warp as wp

MAX_LAUNCHES = 200


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long to time."""

    rounds: int = 20
    """Replays of each variant, in turns; the median counts."""
    replay_s: float = 2e-3
    """Wanted length of one replay [s]: as many launches as that takes, at most 200."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way of doing a work: ``replay()`` does it ``launches`` times."""

    replay: Callable[[], None]
    launches: int
    work: Callable[[], object]
    """What one launch does; a graph knows only the addresses of its arrays, this keeps them alive."""
    outputs: list[Any] = field(default_factory=list)
    """What the last launch of a torch variant returned; overwritten by each replay."""


def repeat_warp(launch: Callable[[], None], launches: int, device: str) -> Variant:
    """Warp launches in one captured graph, on CUDA and CPU alike."""
    with wp.ScopedDevice(device):
        launch()  # loads the kernels
        with wp.ScopedCapture() as capture:
            for _ in range(launches):
                launch()
    graph: Any = capture.graph

    def replay() -> None:
        with wp.ScopedDevice(device):
            wp.capture_launch(graph)

    return Variant(replay=replay, launches=launches, work=launch)


def repeat_torch(call: Callable[[], object], launches: int, device: str) -> Variant:
    """Calls of torch: in one captured graph on CUDA, on the stream that Warp uses too; in a plain loop on the CPU."""
    outputs: list[Any] = []

    @torch.no_grad()
    def call_all() -> None:
        for _ in range(launches):
            outputs[:] = [call()]

    if not device.startswith("cuda"):
        return Variant(replay=call_all, launches=launches, work=call, outputs=outputs)
    for _ in range(3):  # compiles, and lets the allocator and the autotuner settle
        call_all()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=torch.cuda.current_stream()):
        call_all()
    return Variant(replay=graph.replay, launches=launches, work=call, outputs=outputs)


def time_once(variant: Variant, device: str) -> float:
    """Seconds a launch in one replay, by the device's clock."""
    if device.startswith("cuda"):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        variant.replay()
        end.record()
        torch.cuda.synchronize()
        return start.elapsed_time(end) * 1e-3 / variant.launches
    began = time.perf_counter()
    variant.replay()
    return (time.perf_counter() - began) / variant.launches


def fit_launches(make: Callable[[int], Variant], device: str, cfg: Timing) -> Variant:
    """A variant with as many launches as fill ``cfg.replay_s``; ``make`` builds it for a number of them."""
    single = make(1)
    seconds = min(time_once(single, device) for _ in range(3))
    launches = max(1, min(MAX_LAUNCHES, round(cfg.replay_s / max(seconds, 1e-9))))
    return single if launches == 1 else make(launches)


def time_in_turns(variants: dict[str, Variant], device: str, cfg: Timing) -> dict[str, float]:
    """Median seconds a launch of each variant; all are replayed in every round, so that they share its conditions."""
    rounds = [[time_once(variant, device) for variant in variants.values()] for _ in range(cfg.rounds + 1)]
    return dict(zip(variants, np.median(rounds[1:], axis=0).tolist(), strict=True))  # the first warms up
