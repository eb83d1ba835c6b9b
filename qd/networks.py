"""The surrogate's networks, and steps of their training: on CUDA each is one launch of a captured graph."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from sim.corridor import SHAPE

MEMBERS = 4
"""Networks of the ensemble. Each begins with weights of its own, and learns from draws of its own."""
_CONVOLUTIONS = ((5, (3, 3), 12), (3, (2, 2), 24), (3, (2, 1), 32))  # size, strides across and along the way, channels
_FEATURES = 64  # of each place along the way
_WAVES = 4  # cosines by which a place is known
_EAGER_STEPS = 3  # before the capture: they allocate the optimiser's state and choose the convolutions' kernels
_LEARNING_RATE, _WEIGHT_DECAY = 1e-3, 1e-2
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of Adam

Moments = list[dict[str, Tensor]]
"""What Adam remembers of each tensor of weights: `step`, `exp_avg` and `exp_avg_sq`; nothing before its first step."""


class Networks(nn.ModuleList):
    """Small convolutional networks side by side, as groups of channels.

    They slide along the way, and then keep mean and maximum, so that an obstacle is the same wherever it lies. What
    depends on where it lies can be learned, too: the last convolution that slides also sees how far along the way each
    place lies, as cosines. These separate parts of the way in fewer steps of training than one coordinate does. Of
    ``num_maps`` maps of a terrain each network says ``num_out`` numbers.
    """

    def __init__(self, num_maps: int, num_out: int) -> None:
        super().__init__()
        self._num_maps = num_maps
        (rows, cols), channels = SHAPE, num_maps
        for size, strides, channels_out in _CONVOLUTIONS:
            self.append(_beside(channels, channels_out, size, stride=strides, padding=size // 2))
            rows, cols, channels = -(-rows // strides[0]), -(-cols // strides[1]), channels_out
        self.append(_beside(channels + _WAVES, _FEATURES, (rows, 3), padding=(0, 1)))
        self.append(_beside(2 * _FEATURES, num_out, 1))
        waves = math.pi * torch.arange(1, _WAVES + 1)[:, None] * torch.linspace(0.0, 1.0, cols)  # from start to goal
        self.register_buffer("_where", waves.cos()[:, None].repeat(1, rows, 1), persistent=False)

    def forward(self, maps: Tensor) -> Tensor:
        """What each network says of the maps that it sees, (batch, MEMBERS, num_maps, *SHAPE).

        Shape (batch, MEMBERS, num_out).
        """
        if maps.is_cuda:
            return self._through(maps.flatten(1, 2), slice(None))
        # One by one, since groups are slow on the CPU.
        members = (slice(member, member + 1) for member in range(MEMBERS))
        return torch.cat([self._through(maps[:, member].flatten(1, 2), member) for member in members], dim=1)

    def judge(self, maps: Tensor) -> Tensor:
        """What each network says of the same maps, (batch, num_maps, *SHAPE); on CUDA half precision is enough.

        Float32, shape (batch, MEMBERS, num_out).
        """
        if not maps.is_cuda:
            return self(maps[:, None].expand(-1, MEMBERS, -1, -1, -1))
        with torch.autocast("cuda", torch.float16):
            return self._through(maps, slice(None)).float()

    def _through(self, rows: Tensor, members: slice) -> Tensor:
        """What some of the networks say of maps for each of them or for all, shape (batch, networks, num_out)."""
        count = len(range(MEMBERS)[members])
        alike = rows.shape[1] < count * self._num_maps
        for index, layer in enumerate(self):
            assert isinstance(layer, nn.Conv2d) and layer.bias is not None
            weight, bias = (
                part.unflatten(0, (MEMBERS, -1))[members].flatten(0, 1) for part in (layer.weight, layer.bias)
            )
            rows = nn.functional.relu(rows) if index else rows
            if index == len(_CONVOLUTIONS):
                rows = self._placed(rows, count)
            elif index > len(_CONVOLUTIONS):
                rows = _pooled(rows, count)
            groups = count if index or not alike else 1
            rows = nn.functional.conv2d(rows, weight, bias, layer.stride, layer.padding, groups=groups)
        return rows.reshape(len(rows), count, -1)

    def _placed(self, rows: Tensor, networks: int) -> Tensor:
        """Each network's channels, and beside them where they lie."""
        apart = rows.unflatten(1, (networks, -1))
        where = self.get_buffer("_where").expand(len(rows), networks, -1, -1, -1)
        return torch.cat([apart, where], dim=2).flatten(1, 2)


def _beside(channels_in: int, channels_out: int, size: Any, stride: Any = 1, padding: Any = 0) -> nn.Conv2d:
    channels = MEMBERS * channels_in, MEMBERS * channels_out
    return nn.Conv2d(*channels, size, groups=MEMBERS, stride=stride, padding=padding)


def _pooled(rows: Tensor, networks: int) -> Tensor:
    """Mean and maximum along the way, each network's side by side, shape (batch, networks * 2 * channels, 1, 1)."""
    apart = rows.unflatten(1, (networks, -1))
    return torch.cat([apart.mean(-1, keepdim=True), apart.amax(-1, keepdim=True)], dim=2).flatten(1, 2)


class Training:
    """Steps of AdamW that read and write fixed memory, so that CUDA can repeat one of them as a graph.

    The graph holds the memory of weights and moments. So networks that are moved need a new training, which captures
    anew. ``loss`` is of what the networks say and what they should, both of shape (batch, MEMBERS, num_out).
    ``moments`` are what Adam remembers from before, of each tensor of weights.
    """

    def __init__(
        self, networks: Networks, loss: Callable[[Tensor, Tensor], Tensor], device: str, moments: Moments | None = None
    ) -> None:
        on_cuda = device.startswith("cuda")
        self._networks, self._loss, self._device = networks, loss, device
        weights = list(networks.parameters())
        for tensor in weights:
            tensor.grad = None
        self._optimiser = torch.optim.AdamW(
            weights, lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY, capturable=on_cuda, fused=on_cuda or None
        )
        for tensor, remembered in zip(weights, moments or [{} for _ in weights], strict=True):
            if remembered:  # Adam begins anew where there is nothing
                self._optimiser.state[tensor] = {name: remembered[name].to(device) for name in _MOMENTS}
        self._batch: tuple[Tensor, Tensor, Tensor] | None = None  # maps, targets, which maps are mirrored
        self._stream = torch.cuda.Stream(device) if on_cuda else None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._eager_steps = 0

    @property
    def moments(self) -> Moments:
        """What Adam remembers of each tensor of weights."""
        state = self._optimiser.state
        return [
            {name: state[tensor][name] for name in _MOMENTS} if tensor in state else {}
            for tensor in self._networks.parameters()
        ]

    def run(self, maps: Tensor, targets: Tensor, drawn: Tensor, turned: Tensor) -> None:
        """Takes a step for each batch that was drawn. All tensors are on the device.

        Maps of all terrains are of half precision, shape (N, num_maps, *SHAPE); targets are what the networks should
        say of them, (N, num_out). ``drawn`` are the terrains that each network sees in each step, ``turned`` whether it
        sees them mirrored, both (steps, batch, MEMBERS).
        """
        if self._stream is None:
            self._take_steps(maps, targets, drawn, turned)
            return
        # One stream of our own for every backward pass: autograd remembers the stream of a tensor's first use, and a
        # capture must not meet another one.
        current = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            self._take_steps(maps, targets, drawn, turned)
        current.wait_stream(self._stream)

    def _take_steps(self, maps: Tensor, targets: Tensor, drawn: Tensor, turned: Tensor) -> None:
        if self._batch is None:  # memory of a batch, the same in every step
            count = turned[0].numel()
            batch = maps.new_empty(count, *maps.shape[1:]), targets.new_empty(count, *targets.shape[1:])
            self._batch = *batch, torch.empty_like(turned[0])
        batch_maps, batch_targets, batch_turned = self._batch
        for rows, mirrored in zip(drawn.flatten(1), turned, strict=True):
            # Outside of the graph, since the tensors of all terrains grow and move.
            torch.index_select(maps, 0, rows, out=batch_maps)
            torch.index_select(targets, 0, rows, out=batch_targets)
            batch_turned.copy_(mirrored)
            self._take_step()

    def _take_step(self) -> None:
        if self._stream is None or self._eager_steps < _EAGER_STEPS:
            self._learn_batch()
            self._eager_steps += 1
            return
        if self._graph is None:
            self._optimiser.zero_grad(set_to_none=True)  # so that the graph has gradients of its own
            graph = torch.cuda.CUDAGraph()
            # Other threads may use the device meanwhile.
            with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
                self._learn_batch()  # is recorded, not done
            self._graph = graph
        self._graph.replay()

    def _learn_batch(self) -> None:
        """A step on the batch that lies in fixed memory."""
        assert self._batch is not None
        maps, targets, turned = self._batch
        maps = maps.float().unflatten(0, turned.shape)
        maps = torch.where(turned[..., None, None, None], maps.flip(-2), maps)
        self._optimiser.zero_grad(set_to_none=True)
        self._loss(self._networks(maps), targets.unflatten(0, turned.shape)).backward()
        self._optimiser.step()
