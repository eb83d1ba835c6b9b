"""A controller in the loop: from the observation buffer to that of the actions, every control step."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from sim.policy.spec import in_one_line


def action_problem(action: Any, shape: tuple[int, ...]) -> str | None:
    """What a controller returned instead of floats of that shape, if anything; waits for no device."""
    if not isinstance(action, torch.Tensor):
        return f"got {type(action).__name__}"
    if tuple(action.shape) != shape:
        return f"got {tuple(action.shape)}"
    if not action.is_floating_point() or action.is_meta or action.layout != torch.strided:
        return f"as plain floats, got {action.dtype}, {action.layout}, on {action.device}"
    return None


def forget(policy: Any) -> bool:
    """Let a policy that remembers forget; returns whether it is one."""
    reset = getattr(policy, "reset", None)
    if callable(reset):
        reset()
    return callable(reset)


class PolicyRunner:
    """Runs a policy between two Warp buffers: captured as a CUDA graph where it is a torch module without memory."""

    def __init__(self, policy: Callable[[torch.Tensor], torch.Tensor], observation: Any, action: Any) -> None:
        """Bind the buffers.

        Args:
            policy: The controller.
            observation: Warp array, shape (num_envs, observation_size).
            action: Warp array the actions are written to, shape (num_envs, num_joints).
        """
        self._policy = policy
        self._observation = wp.to_torch(observation)
        self._action = wp.to_torch(action)
        self._graph: torch.cuda.CUDAGraph | None = None
        # A graph would repeat its first memory for ever.
        if self._observation.is_cuda and isinstance(policy, torch.nn.Module) and not forget(policy):
            self._graph = self._capture()

    def reset(self) -> None:
        """Let a policy that remembers forget."""
        forget(self._policy)

    def _call(self) -> None:
        """Calls the controller with a copy of the rows, which it may keep or change, and checks its actions."""
        try:
            action = self._policy(self._observation.clone())
        except (Exception, SystemExit) as error:  # a controller can fail with anything
            raise ValueError(f"the controller failed in the middle of a crossing: {in_one_line(error)}") from error
        shape = tuple(self._action.shape)
        problem = action_problem(action, shape)
        if problem is not None:
            raise ValueError(f"the controller must return actions of shape {shape}, {problem}, during a crossing")
        self._action.copy_(action)

    @torch.inference_mode()
    def _capture(self) -> torch.cuda.CUDAGraph:
        for _ in range(3):
            self._call()
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=torch.cuda.current_stream()):
            self._call()
        return graph

    @torch.inference_mode()
    def __call__(self) -> None:
        """Write the actions of the present observations."""
        if self._graph is not None:
            self._graph.replay()
        else:
            self._call()
