"""Several processes of one training, as torchrun starts them: one a GPU, gradients averaged, the first one writes."""

import os
from dataclasses import dataclass

import torch
from rsl_rl.runners import OnPolicyRunner
from torch import distributed


@dataclass(frozen=True, kw_only=True)
class Ranks:
    """Which of how many processes this one is."""

    rank: int = 0
    local_rank: int = 0
    """Its number on this machine, which is its GPU's."""
    size: int = 1

    @classmethod
    def of_environment(cls) -> "Ranks":
        """What torchrun put into RANK, LOCAL_RANK and WORLD_SIZE; one process without it."""
        rank, local_rank, size = (int(os.environ.get(name, 0)) for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"))
        return cls(rank=rank, local_rank=local_rank, size=max(1, size))

    @property
    def is_first(self) -> bool:
        """Whether this process prints and writes."""
        return self.rank == 0

    def device(self, name: str) -> str:
        """The Warp device of this process, where ``name`` was asked for.

        Raises:
            ValueError: If one GPU was named for several processes.
        """
        if self.size == 1 or not name.startswith("cuda"):
            return name
        if name not in ("cuda", "cuda:0"):
            raise ValueError(f"with torchrun each process takes its own GPU, got device {name}: give cuda, or leave it")
        return f"cuda:{self.local_rank}"

    def all_want(self, wish: bool, device: torch.device | str) -> bool:
        """Whether every process wishes so; all get the same answer."""
        if self.size == 1:
            return wish
        flag = torch.tensor(int(wish), device=device)
        distributed.all_reduce(flag, op=distributed.ReduceOp.MIN)
        return bool(flag.item())

    def check_same(self, parameters: list[torch.Tensor]) -> None:
        """That the processes hold the same numbers, as averaged gradients must leave them.

        Raises:
            FloatingPointError: If they do not.
        """
        if self.size == 1:
            return
        own = torch.cat([parameter.detach().flatten() for parameter in parameters])
        first = own.clone()
        distributed.broadcast(first, src=0)
        if not self.all_want(bool(torch.equal(own, first)), own.device):
            raise FloatingPointError("the networks of the processes have drifted apart: this training is not one")


class Runner(OnPolicyRunner):
    """rsl_rl's runner, which several processes may share on CPUs too."""

    def _configure_multi_gpu(self) -> None:
        if Ranks.of_environment().size == 1 or self.device.startswith("cuda"):
            super()._configure_multi_gpu()
            return
        ranks = Ranks.of_environment()
        self.is_distributed, self.gpu_world_size = True, ranks.size
        self.gpu_local_rank, self.gpu_global_rank = ranks.local_rank, ranks.rank
        self.cfg["multi_gpu"] = {
            "global_rank": ranks.rank,
            "local_rank": ranks.local_rank,
            "world_size": ranks.size,
        }
        distributed.init_process_group("gloo")  # rsl_rl's own choice is NCCL, which CPUs do not have
