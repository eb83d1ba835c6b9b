"""TorchScript modules, read by C++: without memory, or with buffers that remember one robot."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from sim.controllers.runner import Recurrent, with_rows_of_zeros


class _Script(torch.nn.Module):
    """A module without memory, whatever ``reset()`` its exporter gave it."""

    def __init__(self, module: Any) -> None:
        super().__init__()
        self.module = module

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return self.module(with_rows_of_zeros(rows))[: len(rows)]


class _RecurrentScript(Recurrent):
    """A module that remembers one robot in its buffers, with a row of them for each robot."""

    def __init__(self, module: Any, initial: Mapping[str, torch.Tensor], axis: int) -> None:
        super().__init__([*initial.values()], axis)
        self.module = module
        self._paths = [name.split(".") for name in initial]

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        owners = [functools.reduce(getattr, path[:-1], self.module) for path in self._paths]
        for owner, path, value in zip(owners, self._paths, state, strict=True):
            setattr(owner, path[-1], value)
        action = self.module(rows)
        return action, [getattr(owner, path[-1]) for owner, path in zip(owners, self._paths, strict=True)]


@torch.no_grad()
def separate_robots(module: Any, probe: Any, path: Path, width: int, device: str) -> Any:
    """The module of a file, for rows of ``width`` columns, with a memory of each robot if it remembers one.

    ``probe`` is a copy of the module on the CPU. The buffers that a call of it changes are the memory.
    """
    rows = torch.randn((3, 3, width), generator=torch.Generator().manual_seed(0))  # steps, robots
    reset = next((getattr(probe, name) for name in ("reset", "reset_memory") if hasattr(probe, name)), None)
    if reset is not None:
        reset()
    before = {name: value.clone() for name, value in probe.named_buffers()}
    try:
        first, second = (probe(rows[0, :1]) for _ in range(2))
    except Exception:  # it takes another width, or has nothing to call: trying it later says so
        return _Script(module)
    if not isinstance(first, torch.Tensor):
        return _Script(module)
    initial = {name: before[name] for name, value in probe.named_buffers() if not torch.equal(before[name], value)}
    if not initial:
        return _Script(module) if reset is None or torch.equal(first, second) else module  # it has another memory
    separate = []
    for robot in range(rows.shape[1]):
        for name, value in probe.named_buffers():
            value.copy_(before[name])
        separate.append(torch.cat([probe(step[robot : robot + 1]) for step in rows]))
    for axis in (1, 0):  # the axis of robots is the one along which they act as they do alone
        if all(value.ndim > axis and value.shape[axis] == 1 for value in initial.values()):
            recurrent = _RecurrentScript(probe, initial, axis)
            try:
                together = torch.stack([recurrent(step) for step in rows], dim=1)
            except (RuntimeError, torch.jit.Error):
                continue
            if torch.allclose(together, torch.stack(separate), rtol=1e-4, atol=1e-4):
                return _RecurrentScript(module, initial, axis).to(device)
    buffers = ", ".join(initial)
    raise ValueError(
        f"policy '{path}' remembers one robot alone, in {buffers}: give the checkpoint of which it was made"
    )
