"""Simulations that stay open for the next run: on a GPU it takes 10 to 30 s to build and capture one."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace

from qd.workers.evaluator import Evaluate, EvaluatorCfg

_MOST = 4  # the controller and a certifier, each with contact resolved and not
_SPARE = 1.25  # room for a run with some more terrains; robots for it cost time


@dataclass(frozen=True, kw_only=True)
class _Open:
    cfg: EvaluatorCfg
    evaluate: Evaluate
    stack: ExitStack

    def serves(self, cfg: EvaluatorCfg) -> bool:
        """Whether it does what is asked for, with room for the terrains and not for many times as many."""
        room = self.cfg.num_terrains
        return replace(self.cfg, num_terrains=cfg.num_terrains) == cfg and cfg.num_terrains <= room <= max(
            2 * cfg.num_terrains, 8
        )


@contextmanager
def kept_open(
    open_evaluator: Callable[[EvaluatorCfg], AbstractContextManager[Evaluate]],
) -> Iterator[Callable[[EvaluatorCfg], AbstractContextManager[Evaluate]]]:
    """What opens evaluators as another does, but keeps the last four until the end, for whoever asks for the same.

    Args:
        open_evaluator: Opens them.

    Yields:
        The same for several runs. An evaluator under which something failed is not used again.
    """
    kept: list[_Open] = []

    @contextmanager
    def opened(cfg: EvaluatorCfg) -> Iterator[Evaluate]:
        own = next((one for one in kept if one.serves(cfg)), None)
        if own is None:
            while len(kept) >= _MOST:
                kept.pop(0).stack.close()
            spare = _SPARE if cfg.device.startswith("cuda") else 1.0
            roomy = replace(cfg, num_terrains=math.ceil(spare * cfg.num_terrains))
            stack = ExitStack()
            own = _Open(cfg=roomy, evaluate=stack.enter_context(open_evaluator(roomy)), stack=stack)
        else:
            kept.remove(own)
        kept.append(own)  # the last one used is the last one to be closed
        try:
            yield own.evaluate
        except BaseException:
            kept.remove(own)
            own.stack.close()
            raise

    try:
        yield opened
    finally:
        for one in kept:
            one.stack.close()
