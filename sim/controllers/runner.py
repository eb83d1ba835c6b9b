"""A controller in the loop: from the observation buffer to that of the actions, every control step."""

import inspect
from collections.abc import Sequence
from enum import Enum
from typing import Any

import torch
import warp as wp

from sim.controllers.spec import in_one_line
from sim.device import recording

# Torch sums matrix products of fewer than 4 or 16 rows in another order; 16 to 4,096 give each row the same bits.
_MIN_ROWS = 32


def with_rows_of_zeros(rows: torch.Tensor) -> torch.Tensor:
    """Few rows on the CPU, followed by zeros, so that a module gives each row the same bits in any batch."""
    missing = 0 if rows.is_cuda else max(_MIN_ROWS - len(rows), 0)
    return torch.nn.functional.pad(rows, (0, 0, 0, missing)) if missing else rows


def action_problem(action: Any, shape: tuple[int, ...]) -> str | None:
    """What is wrong with an action, which must be floats of that shape; None if it fits. Waits for no device."""
    if not isinstance(action, torch.Tensor) or tuple(action.shape) != shape:
        return f"got {tuple(action.shape) if isinstance(action, torch.Tensor) else type(action).__name__}"
    if not action.is_floating_point() or action.is_meta or action.layout != torch.strided:
        return f"as plain floats, got {action.dtype}, {action.layout}, on {action.device}"
    return None


class Memory(Enum):
    """What a policy remembers from one step to the next, by its ``reset``."""

    NONE = "no reset"  # nothing
    PER_ROBOT = "reset(rows)"  # each robot; before every step rows, bool, (num_envs,), are true where one begins anew
    SHARED = "reset()"  # all robots, which begin together; those whose episode has ended stand idle until then


def find_memory(policy: Any) -> Memory:
    """Finds out what a policy remembers."""
    if not callable(reset := getattr(policy, "reset", None)):
        return Memory.NONE
    try:
        inspect.signature(reset).bind(None)
    except (TypeError, ValueError):  # ValueError: it has no signature
        return Memory.SHARED
    return Memory.PER_ROBOT


def reset_all(policy: Any, num_envs: int, device: str = "cpu") -> bool:
    """Begins an episode of all robots; returns whether the policy remembers anything."""
    memory = find_memory(policy)
    if memory is Memory.PER_ROBOT:
        policy.reset(torch.ones(num_envs, dtype=torch.bool, device=device))
    elif memory is Memory.SHARED:
        policy.reset()
    return memory is not Memory.NONE


class Recurrent(torch.nn.Module):
    """A network with a state of each robot, for any number of robots, at fixed addresses of the device."""

    graph_safe = True  # whether steps, and a reset, may be captured as a CUDA graph

    def __init__(self, initial: Sequence[torch.Tensor], axis: int) -> None:
        """States at the start of an episode, with one robot along ``axis``."""
        super().__init__()
        self._axis = axis
        self._states: dict[int, list[torch.Tensor]] = {}  # by the number of robots: a graph keeps their addresses
        copies = (torch.nn.Parameter(state.detach().clone(), requires_grad=False) for state in initial)
        self._initial = torch.nn.ParameterList(copies)

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Actions of the rows, shape (num_rows, size), and the state after them; it may change the state in place."""
        raise NotImplementedError

    def _get_state(self, count: int) -> list[torch.Tensor]:
        if count not in self._states:
            rows = count if self._initial[0].is_cuda else max(count, _MIN_ROWS)
            self._states[count] = [state.repeat_interleave(rows, dim=self._axis) for state in self._initial]
        return self._states[count]

    @torch.inference_mode()
    def reset(self, rows: torch.Tensor) -> None:
        """Begin anew where ``rows``, bool, shape (num_envs,), is true."""
        for initial, state in zip(self._initial, self._get_state(len(rows)), strict=True):
            robots = state.movedim(self._axis, -1)[..., : len(rows)]
            robots.copy_(torch.where(rows, initial.movedim(self._axis, -1), robots))

    @torch.inference_mode()
    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Actions, shape (num_envs, num_joints)."""
        state = self._get_state(len(rows))
        # cuDNN's recurrent kernels are made for sequences: a step of many robots takes them far longer than products.
        with torch.backends.cudnn.flags(enabled=False):
            action, after = self.step(with_rows_of_zeros(rows), state)
        for old, new in zip(state, after, strict=True):
            old.copy_(new)
        return action[: len(rows)]


def is_graph_safe(policy: Any) -> bool:
    """Whether a policy may be captured as a CUDA graph: as its ``graph_safe`` says, else a module without memory."""
    return getattr(policy, "graph_safe", isinstance(policy, torch.nn.Module) and find_memory(policy) is Memory.NONE)


class PolicyRunner:
    """Runs a policy between two Warp buffers; one that :func:`is_graph_safe` is captured as a CUDA graph."""

    def __init__(self, policy: Any, observation: Any, action: Any, begins: Any) -> None:
        """Binds the policy to Warp arrays; ``begins`` is not 0 where an episode begins with the coming step."""
        self._policy = policy
        self.memory = find_memory(policy)
        self._observation, self._action, self._begins = map(wp.to_torch, (observation, action, begins))
        self._plain = isinstance(policy, torch.nn.Module) and self.memory is Memory.NONE
        self._graph = torch.cuda.CUDAGraph() if self._observation.is_cuda and is_graph_safe(policy) else None
        if self._graph is not None:
            with torch.inference_mode():
                for _ in range(3):
                    self._call()
                torch.cuda.synchronize()
                stream = torch.cuda.current_stream()
                with recording(), torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
                    self._call()  # while other threads may use the device

    def reset(self) -> None:
        """Begins an episode of all robots, of a policy whose memory is :attr:`Memory.SHARED`."""
        self._policy.reset()

    def _call(self) -> None:
        """Calls the controller with a copy of the rows, which it may keep or change, and checks its actions."""
        observation = self._observation.clone()
        if self._plain:  # a function, or a module that remembers, gets one row a robot
            observation = with_rows_of_zeros(observation)
        shape = (len(observation), self._action.shape[1])
        try:
            if self.memory is Memory.PER_ROBOT:
                self._policy.reset(self._begins != 0)
            action = self._policy(observation)
        except (Exception, SystemExit) as error:  # a controller can fail with anything
            name = getattr(self._policy, "__qualname__", type(self._policy).__qualname__)
            what = f"failed in the middle of a crossing, on observations of shape {tuple(observation.shape)}"
            raise ValueError(f"controller {name} {what}: {in_one_line(error)}") from error
        if problem := action_problem(action, shape):
            raise ValueError(f"the controller must return actions of shape {shape}, {problem}, during a crossing")
        self._action.copy_(action[: len(self._action)])

    @torch.inference_mode()
    def __call__(self) -> None:
        """Write the actions of the present observations."""
        if self._graph is not None:
            self._graph.replay()
        else:
            self._call()
